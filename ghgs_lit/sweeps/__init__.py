"""Sweeps: one directory for each, one run for each different configuration, nothing computed twice.

``run``: a run on disk; ``work``: what a job does; ``grid``: the sweeper; ``plan``: what is printed.
"""
