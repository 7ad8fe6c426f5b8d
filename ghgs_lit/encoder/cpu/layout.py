"""Sizes of the kernel's blocks; all but ``ROWS`` are multiples of a vector's 16 lanes."""

#: Rows and columns of a tile of a product; it fills 24 of the 32 registers of AVX-512.
ROWS, PANEL = 12, 32
#: Keys whose scores and weights are held at once, for ``ROWS`` queries.
KEYS = 256
#: Queries that are compared with those keys before the next keys are read.
QUERIES = 8 * ROWS
