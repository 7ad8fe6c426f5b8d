"""The process and its machine: memory, CPU cores and watchers of stages."""
