"""What a machine has, and what a configuration needs."""
