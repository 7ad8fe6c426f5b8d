"""The tile of a product that stays in the processor's registers."""

from ghgs_lit.kernels.compile import processor_features

#: Rows and columns: 24 of the 32 registers of AVX-512, or 12 of the 16 of AVX2. They divide ``QUERIES`` and
#: ``WIDTH`` of ``layout``.
ROWS, PANEL = (12, 32) if "avx512f" in processor_features() else (6, 16)
