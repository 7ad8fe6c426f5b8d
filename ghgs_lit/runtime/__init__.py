"""The process and its machine: memory, cores, precision of products, changes of parameters,
recorded work."""
