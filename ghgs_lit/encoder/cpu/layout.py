"""Sizes of what the kernel holds at once: multiples of a vector's 16 lanes but for ``ROWS``."""

#: A tile of a product: rows of its left factor, columns of its right one; 24 of the 32 registers of AVX-512.
ROWS, PANEL = 12, 32
#: Keys whose scores and weights are held at once, for ``ROWS`` queries.
KEYS = 256
#: Queries that share a look at those keys.
QUERIES = 8 * ROWS
