"""Stress test: every stage on adversarial inputs against float64, forward and backward."""
