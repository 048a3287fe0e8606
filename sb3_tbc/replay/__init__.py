"""Replay buffers of both levels: rings of rows that give whole bursts of batches at once."""
