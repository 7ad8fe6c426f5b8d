"""Runs and sweeps: planning, locking, resuming, results and their provenance."""
