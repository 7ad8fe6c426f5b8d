"""Pictures of predictions, and point clouds."""
