"""Sizes of the kernel's blocks, the same on all processors; multiples of a vector's 16 lanes."""

#: Head widths that the kernel can compute are multiples of this.
WIDTH = 32
#: Keys whose scores and weights are held at once, for some queries.
KEYS = 256
#: Queries that are compared with those keys before the next keys are read.
QUERIES = 96
