"""Layout of the arrays that the kernels share.

A *splat* is one Gaussian projected into one view: splat ``m`` of view ``v`` is Gaussian
``m - shift[v]``; the splats of a view start at a multiple of eight. A splat's record is 16 floats.
With ``Sigma = L L^T`` its 2D covariance (low-pass included) and ``d`` the vector from its centre to a
pixel's centre, the exponent of the Gaussian is ``-(p^2 + q^2) ln 2`` where ``p = K_XX dx`` and
``q = K_YX dx + K_YY dy``: a sum of squares, which loses no digits and is never negative."""

from ghgs_lit.ops.compile import helper

RECORD = 16
# The centre is stored as its pixel and 0.5 minus its fraction (REST), so that small distances from it
# keep all digits. p^2 + q^2 is smallest along a column of pixels at dy = SLOPE_Y dx, and along a row at
# dx = SLOPE_X dy.
COLUMN, ROW, REST_X, REST_Y, K_XX, K_YX, K_YY, OPACITY, CUTOFF, DEPTH, SLOPE_X, SLOPE_Y = range(12)
# Colours follow, if they have at most ROOM channels.
COLORS = 12
ROOM = 4

TILE = 16
BLOCK = 4
PIXELS = TILE * TILE

# The box of tiles that a splat touches; empty if the splat is not visible.
X0, X1, Y0, Y1 = range(4)

# An entry is a splat in a tile, a row of integers: the bits of its depth, the splat, the slot of
# its gradients (the slots of a splat are contiguous). Rendering a tile moves its visible splats to the
# front, ordered front to back, and replaces the depth by the blocks that the splat reaches, as bits.
KEY, SPLAT, SLOT = range(3)
BLOCKS = KEY
ENTRY = 4

# Gradients of an entry, summed over pixels, with ``h = dL / d ln(alpha)``: moments of h in whitened
# coordinates, the gradient of the depth and, from COLOR on, the gradients of the colours.
H, H_P, H_Q, H_PP, H_PQ, H_QQ, D_DEPTH, COLOR = range(8)

# A view: focal lengths, principal point, rotation, translation, the limits of x/z and y/z, then the
# last column and row of pixels.
FX, FY, CX, CY, ROTATION = range(5)
TRANSLATION = 13
X_LOW, X_HIGH, Y_LOW, Y_HIGH, RIGHT, BOTTOM, VIEW = range(16, 23)


def gradient_width(channels: int) -> int:
    """Number of floats of an entry's gradients with ``channels`` colours, a multiple of 16."""
    return -(-(COLOR + channels) // 16) * 16


#: :func:`gradient_width` inside kernels.
kernel_gradient_width = helper(gradient_width)
