"""Pictures, attention and point clouds to look at."""
