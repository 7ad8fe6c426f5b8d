"""Runs and sweeps: planning, training once, resuming, results and their provenance."""
