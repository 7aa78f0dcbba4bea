"""Layout of the arrays of the compiled kernels."""

import math

from reffusion.splat.conventions import MIN_ALPHA

# Columns of a footprint: its anchor, the point of the image nearest to the 2D mean; slant xy/yy; whitening factors
# along x and y, scaled so that log2(alpha) = LEVEL - u^2 - v^2 with v = ANCHOR_V + WHITEN_Y dy and
# u = ANCHOR_U + WHITEN_X (dx - SLANT dy), dx and dy from the anchor; camera z; colour.
ANCHOR_X, ANCHOR_Y, SLANT, WHITEN_X, WHITEN_Y, LEVEL, DEPTH, RED, GREEN, BLUE = range(10)
# Then u and v at the anchor (0 if the mean is inside the image; without them a needle with a distant mean would lose
# digits), and its ellipse alpha >= 1/255 (`binning.ellipse`), which fills the cache line.
ANCHOR_U, ANCHOR_V, HALF_WIDTH, HALF_HEIGHT, TILT, COLUMN, FOOTPRINT = range(10, 17)

# Columns of an entry of a tile's list: the Gaussian; first + 256 * (one past the last) row of the tile that it can
# touch; the index of its gradient record; unused.
MEMBER, ROWS, SLOT, ENTRY = 0, 1, 2, 4

# Columns of a gradient record: the sums over pixels of g = dLoss/d(ln alpha), and of g times u, v, uu, uv, vv;
# then the gradients of camera z, colour and features.
SUM_G, SUM_U, SUM_V, SUM_UU, SUM_UV, SUM_VV, GRAD_DEPTH, GRAD_RED, GRAD_GREEN, GRAD_BLUE, GRAD_FEATURES = range(11)

TILE_WIDTH = 8  # narrow, because rows are determined per tile column, and small footprints cover few columns
TILE_HEIGHT = 64

CHUNKS = 32  # parts of the work over Gaussians; fixed, so that results do not depend on the number of threads
AHEAD = 8  # steps between prefetching a row (`memory.prefetch`) and using it
CUT = math.log2(MIN_ALPHA)  # log2(alpha) below which a pixel is skipped
