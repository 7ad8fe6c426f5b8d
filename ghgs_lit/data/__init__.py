"""Photographs of people: reading, sampling and batching of data sets."""
