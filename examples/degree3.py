"""Add spherical harmonics of degree 3, all zero, to a PLY of 3D Gaussian Splatting.

python examples/degree3.py gaussians.ply degree3.ply
"""

import sys
from pathlib import Path

import numpy as np

head, rows = Path(sys.argv[1]).read_bytes().split(b"end_header\n", 1)
names = [line.split()[-1] for line in head.splitlines() if line.startswith(b"property float")]
rows = np.frombuffer(rows, "<f4").reshape(-1, len(names))
rest = b"".join(b"property float f_rest_%d\n" % number for number in range(45))
head = head.replace(b"f_dc_2\n", b"f_dc_2\n" + rest)
rows = np.insert(rows, [names.index(b"f_dc_2") + 1] * 45, 0, axis=1)
Path(sys.argv[2]).write_bytes(head + b"end_header\n" + rows.tobytes())
