"""Diagnosis of a machine and its devices."""
