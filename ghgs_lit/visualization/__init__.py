"""Pictures of predictions, of attention, and point clouds."""
