"""Timings of this package compared with others, measured in turns in one run."""
