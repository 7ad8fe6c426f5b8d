"""Layout of the arrays that the kernels share.

A *splat* is one Gaussian projected into one view: splat ``m`` of view ``v`` is Gaussian
``m - shift[v]``; the splats of a view start at a multiple of eight. A splat's record is 16 floats.
With ``Sigma = L L^T`` its 2D covariance (low-pass included) and ``d`` the vector from its centre to a
pixel's centre, the exponent of the Gaussian is ``-(p^2 + q^2) ln 2`` where ``p = K_XX dx`` and
``q = K_YX dx + K_YY dy``: a sum of squares, which loses no digits and is never negative."""

RECORD = 16
# The centre is stored as its pixel and 0.5 minus its fraction (REST), so that small distances from it
# keep all digits. p^2 + q^2 is smallest along a column of pixels at dy = SLOPE_Y dx, and along a row at
# dx = SLOPE_X dy.
COLUMN, ROW, REST_X, REST_Y, K_XX, K_YX, K_YY, OPACITY, CUTOFF, DEPTH, SLOPE_X, SLOPE_Y = range(12)
# The colour follows.
COLORS = 12
CHANNELS = 3

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
# coordinates, the gradient of the depth and, from COLOR on, the gradient of the colour.
H, H_P, H_Q, H_PP, H_PQ, H_QQ, D_DEPTH, COLOR = range(8)
GRADIENT = 16

# A view: focal lengths, principal point, rotation, translation, the limits of x/z and y/z, then the
# last column and row of pixels.
FX, FY, CX, CY, ROTATION = range(5)
TRANSLATION = 13
X_LOW, X_HIGH, Y_LOW, Y_HIGH, RIGHT, BOTTOM, VIEW = range(16, 23)

# Constants of the image, which are also compiled into gsplat: the smallest rendered alpha, the
# transmittance at or below which a pixel terminates, the radius in standard deviations beyond which a
# Gaussian of opacity above one is cut off, and the fraction of tan(field of view / 2) beyond the frame's
# border at which the Jacobian of centres outside the frame is evaluated.
ALPHA_MIN = 1 / 255
STOP = 1e-4
EXTENT = 3.33
FRUSTUM_MARGIN = 0.3
