"""Tools that look at the framework: run time against error, numerical stability, what is wrong."""
