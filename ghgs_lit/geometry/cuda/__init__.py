"""Photo-consistency for GPUs: one kernel for all depths of all pixels."""
