"""Layout of the arrays of the compiled kernels: the columns of footprints, tile lists and gradient records."""

import math

from reffusion.splat.conventions import MIN_ALPHA

# Columns of a footprint, a Gaussian projected into the image. The anchor is the point of the image nearest to the 2D
# mean. SLANT is xy/yy of the 2D covariance. The whitening factors along x and y give the whitened coordinates
#     u = ANCHOR_U + WHITEN_X (dx - SLANT dy) and v = ANCHOR_V + WHITEN_Y dy
# of a pixel at (dx, dy) from the anchor, scaled so that log2(alpha) = LEVEL - u^2 - v^2. DEPTH is camera z.
ANCHOR_X, ANCHOR_Y, SLANT, WHITEN_X, WHITEN_Y, LEVEL, DEPTH, RED, GREEN, BLUE = range(10)
# ANCHOR_U and ANCHOR_V are u and v at the anchor, 0 if the mean is inside the image. If dx and dy were relative to a
# distant mean instead, a needle would lose digits. The next four columns describe the ellipse alpha >= 1/255
# (`binning.ellipse`) and fill the cache line. FOOTPRINT is the number of columns.
ANCHOR_U, ANCHOR_V, HALF_WIDTH, HALF_HEIGHT, TILT, COLUMN, FOOTPRINT = range(10, 17)

# Columns of an entry of a tile's list: the index of the Gaussian; first + 256 * (one past the last) row of the tile
# that the footprint can touch; the index of the pair's gradient record; an unused column. ENTRY is their number.
MEMBER, ROWS, SLOT, ENTRY = 0, 1, 2, 4

# Columns of a gradient record, which belongs to a pair of a footprint and a tile: the sums over the tile's pixels of
# g = dLoss/d(ln alpha), and of g times u, v, uu, uv, vv; then the gradients of camera z, color and, from GRAD_FEATURES
# on, features.
SUM_G, SUM_U, SUM_V, SUM_UU, SUM_UV, SUM_VV, GRAD_DEPTH, GRAD_RED, GRAD_GREEN, GRAD_BLUE, GRAD_FEATURES = range(11)

TILE_WIDTH = 8  # narrow, because rows are determined per tile column, and small footprints cover few columns
TILE_HEIGHT = 64

CHUNKS = 32  # parts into which work on Gaussians is divided; fixed, so that results do not depend on the threads
AHEAD = 8  # steps between prefetching a row (`memory.prefetch`) and using it
CUT = math.log2(MIN_ALPHA)  # log2(alpha) below which a pixel is skipped
