"""Hyper-parameter search with Optuna: several seeds per trial, resumable, on several processes."""
