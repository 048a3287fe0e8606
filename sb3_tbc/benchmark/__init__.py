"""Timings of this package beside others, taken in turns in one run."""
