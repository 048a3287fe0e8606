"""One level of the hierarchy: SB3's SAC, updated on flat storage, acting in NumPy."""
