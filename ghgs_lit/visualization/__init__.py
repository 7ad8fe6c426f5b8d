"""Pictures of predictions and of attention."""
