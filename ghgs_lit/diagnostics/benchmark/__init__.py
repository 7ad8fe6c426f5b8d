"""Measuring run time against error: presets and knobs on data, and how cost grows on analytic scenes."""
