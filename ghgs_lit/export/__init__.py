"""Files of Gaussians for other programs: one file a format."""
