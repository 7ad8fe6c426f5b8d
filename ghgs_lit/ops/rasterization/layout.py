"""Layout of the arrays that the kernels share.

A *splat* is one Gaussian seen by one camera: splat ``m`` of view ``v`` is Gaussian
``m - shift[v]``; the splats of a view start at a multiple of eight. Its record is 16 floats. With
``Sigma = L L^T`` its 2D covariance (low-pass included) and ``d`` the vector from its centre to a
pixel's centre, the exponent of the Gaussian is ``-(p^2 + q^2) ln 2`` where ``p = K_XX dx`` and
``q = K_YX dx + K_YY dy``: a sum of squares, which loses no digits and is never negative."""

from ghgs_lit.ops.compile import helper

RECORD = 16
# Centre: the pixel, and 0.5 minus the fraction,
# so that small distances from it keep all their digits.
COLUMN = 0
ROW = 1
REST_X = 2
REST_Y = 3
K_XX = 4
K_YX = 5
K_YY = 6
OPACITY = 7
CUTOFF = 8
DEPTH = 9
# Along a column of pixels p^2 + q^2 is smallest at dy = SLOPE_Y dx, along a row at dx = SLOPE_X dy.
SLOPE_X = 10
SLOPE_Y = 11
# Colours with at most ROOM channels follow.
COLORS = 12
ROOM = 4

TILE = 16
BLOCK = 4
PIXELS = TILE * TILE

# The box of tiles that a splat touches; empty if the camera does not see it.
X0 = 0
X1 = 1
Y0 = 2
Y1 = 3

# An entry is a splat in a tile, a row of integers: the bits of its depth, the splat, the slot of
# its gradients (the slots of a splat are contiguous). After a tile is drawn, its visible splats
# come first, front to back, with the blocks that each reaches in place of the depth.
KEY = 0
SPLAT = 1
SLOT = 2
BLOCKS = KEY
ENTRY = 4

# Gradients of an entry, with ``h = dL / d ln(alpha)`` and sums over pixels: moments of h in
# whitened coordinates, the gradient of the depth, then from COLOR on those of the colours.
H = 0
H_P = 1
H_Q = 2
H_PP = 3
H_PQ = 4
H_QQ = 5
D_DEPTH = 6
COLOR = 7

# A view: focal lengths, principal point, rotation, translation, the limits of x/z and y/z, then the
# last column and row of pixels.
FX = 0
FY = 1
CX = 2
CY = 3
ROTATION = 4
TRANSLATION = 13
X_LOW = 16
X_HIGH = 17
Y_LOW = 18
Y_HIGH = 19
RIGHT = 20
BOTTOM = 21
VIEW = 22


def gradient_width(channels: int) -> int:
    """Floats of an entry's gradients with ``channels`` colours, in whole vectors of 16."""
    return -(-(COLOR + channels) // 16) * 16


#: :func:`gradient_width` inside kernels.
kernel_gradient_width = helper(gradient_width)
