"""A user's own photographs and calibration: read, checked, and made into a batch."""
