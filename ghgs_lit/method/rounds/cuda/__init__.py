"""Rounds for GPUs: observations of Gaussians in one kernel."""
