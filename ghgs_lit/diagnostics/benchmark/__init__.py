"""Measuring run time against error: presets and knobs."""
