"""Configurations, run folders and the results ledger, on which the commands rest."""
