"""From photographs to files and pages: what a capture is, what corrects it, what is written of it."""
