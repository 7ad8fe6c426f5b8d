"""Photographs of people: read from data sets, sampled and put into batches."""
