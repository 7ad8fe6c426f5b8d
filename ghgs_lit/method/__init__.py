"""The paper: one module or package a stage, and :mod:`ghgs_lit.method.model`."""
