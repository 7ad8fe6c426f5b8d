"""Measuring run time against error: presets and knobs, and a model beside other methods."""
