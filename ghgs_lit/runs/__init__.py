"""Runs of sweeps: planning, carrying out, resuming, results and where they come from."""
