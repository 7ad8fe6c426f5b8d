"""Benchmark of run time against error, for presets and knobs."""
