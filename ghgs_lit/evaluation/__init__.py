"""Measuring methods on evaluation protocols."""
