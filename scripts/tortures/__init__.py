"""The rows of docs/reliability.md: what is done to runs and files, and what must be left."""
