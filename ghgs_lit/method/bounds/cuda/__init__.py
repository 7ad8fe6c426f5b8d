"""Bounds for GPUs: each search of a hull is one kernel."""
