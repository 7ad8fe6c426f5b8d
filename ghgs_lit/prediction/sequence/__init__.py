"""Several instants of one rig: what its cameras share, and instants that start from the last."""
