"""Stress test: numerical errors of all stages on adversarial inputs."""
