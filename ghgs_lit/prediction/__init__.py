"""From photographs to files and pages: captures, their refinement, and the files of predictions."""
