"""Weight files: checkpoints of this package, and the published weights in both directions."""
