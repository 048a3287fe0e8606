"""The whole two-level policy as ONNX, C99 or a NumPy-only module."""
