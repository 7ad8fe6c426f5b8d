"""Evaluation of models and baselines on target protocols."""
