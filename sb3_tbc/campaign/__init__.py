"""Campaigns of many runs: what is to do, how long it takes, and execution here, on Slurm or on a Ray cluster."""
