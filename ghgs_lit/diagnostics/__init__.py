"""Diagnostics of the framework: run time against error, numerical stability, doctor."""
