"""Numerical stability: every stage on adversarial inputs, against float64, forward and backward."""
