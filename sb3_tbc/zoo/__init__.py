"""Configurations, run folders and the results ledger: what stands behind the commands."""
