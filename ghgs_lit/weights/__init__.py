"""Weight files: checkpoints of this package, and import and export of published weights."""
