"""Detection of the object's soft shadow, where no reference shows the scene without it.

A shadow changes the light smoothly, whatever the texture below it, whereas borders of materials are sharp. The light is
therefore estimated on the plane on which the object stands: a smooth function whose differences between neighboring
cells follow those of the logarithmic brightness in most cells, but not across sharp borders. The dark region of this
function is taken for the object's shadow only if it lies beside the object, is surrounded by lit cells, and darkens
all colors about equally. Weak shadows are left as they are, because a stain looks the same.
"""

from __future__ import annotations

import warnings

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.linalg import splu
from torch import Tensor

from reffusion import geometry, morphology
from reffusion.background.model import Background
from reffusion.background.plane import Plane
from reffusion.inpaint.plane_frames import label_planes
from reffusion.shadows.light import DARK_OFFSET
from reffusion.shadows.soft_shadow import SoftShadow

CELLS, CELL = 64, 1 / 8  # side of the map in cells; side of a cell in radii of the object
FINE = 4  # parts into which the side of a cell is divided; the brightness of a cell is the median of its parts
MAX_VIEWS, MAX_WIDTH = 24, 640  # views whose pixels are used, at most; wider views are thinned to 640 to 1279 columns
MIN_VIEWS = 2  # number of views that must show a cell
MIN_PARTS = 1 / 3  # share of a cell's parts that must be seen
NEAR, MIN_NEAR = 0.3, 0.03  # radii; a plane is a candidate if this share of the object's Gaussians is so near

# Weights of the terms of `_smooth_light`. With the stiff ones, hardly anything but a shadow is dark. The soft ones
# follow the shadow more closely, and are used once a shadow is found.
STIFF, SOFT = (3.0, 2.0), (0.7, 3.0)  # weight of the second differences; clipping of first differences, in deviations
# A smooth function with clipped differences is too flat: without this factor, a lifted shadow stays too dark.
GAIN = 1.1
LIT_DISTANCE = 3.0  # radii from the object's middle beyond which there is no shadow
LIT_WEIGHT, PRIOR_WEIGHT = 0.05, 3e-5  # weights of the squared log light, beyond that distance and within it
# Standard deviation of the texture's differences from cell to cell, at least. On a floor without texture, the edges of
# a soft shadow would else count as borders of materials.
MIN_DEVIATION = 0.05
ITERATIONS = 30  # of the reweighting

DARK = 0.08  # log light below which a cell is dark
MIN_DEPTH, MIN_VOLUME = 0.4, 0.8  # log light of the darkest cell; sum of log light over cells, times squared radii
CORE, MAX_CORE_DISTANCE = 0.7, 0.25  # cells at least this share as dark as the darkest; their radii from hidden cells
MAX_TINT = 0.35  # spread of the channels' log light, relative to their mean
MAX_HIDDEN = 1.2  # radii from the object's middle: unseen cells up to there are hidden by the object
MIN_LIT = 0.4  # share of the cells around the shadow that are seen, and thus lit
FADE = (0.15, 0.45)  # radii: a point up to the first height above the plane is in the shadow, above the second is not
EDGE = 0.03  # log light below which the shadow's rim ends


def find_soft_shadow(background: Background, object_means: Tensor) -> SoftShadow | None:
    """Find the soft shadow that the object casts on the plane on which it stands.

    Args:
        background: the photographs that show the object, and the planes around it.
        object_means: [N, 3], the centers of the object's Gaussians.

    Returns:
        The shadow whose log light sums to the lowest value. None if no shadow is found, or if there are fewer than
        `MIN_VIEWS` photographs.
    """
    if len(background.photos) < MIN_VIEWS:
        return None
    means = object_means.detach().double().cpu().numpy()
    best, best_volume = None, 0.0
    for index, plane in enumerate(background.planes, start=1):
        heights = np.abs(means @ plane.normal - plane.offset) / background.radius
        if (heights < NEAR).mean() < MIN_NEAR:
            continue
        brightness = _cell_brightness(background, index)
        seen = np.isfinite(brightness[..., 0])
        light = _smooth_light(brightness, seen, *STIFF)
        region = _find_region(light, seen)
        if region is None or (volume := -light[region].mean(1).sum() * CELL**2) < best_volume:
            continue
        best, best_volume = _make_shadow(background, plane, brightness, seen, region), volume
    return best


def _cell_brightness(background: Background, index: int) -> np.ndarray:
    """Return [CELLS, CELLS, 3], the log brightness of the cells of plane number `index` (from 1); NaN where unseen."""
    plane, side, samples = background.planes[index - 1], CELLS * FINE, []
    views = [view for view in background.views if view.camera.name in background.photos]
    for view in views[:: -(-len(views) // MAX_VIEWS)]:
        every = max(1, view.camera.width // MAX_WIDTH)
        chosen = (label_planes(view.depth, view.camera, background.planes) == index) & ~view.masked
        chosen[np.arange(chosen.shape[0]) % every != 0] = False
        chosen[:, np.arange(chosen.shape[1]) % every != 0] = False
        points = geometry.unproject(view.depth, view.camera)[chosen]
        cells = _map_coordinates(points, background, plane) * FINE
        inside = ((cells >= 0) & (cells < side)).all(1)
        row, column = cells[inside].astype(np.int64).T
        colors = np.log(background.photos[view.camera.name][chosen][inside].astype(np.float32) + DARK_OFFSET)
        at = row * side + column
        count = np.bincount(at, minlength=side * side)
        total = np.stack([np.bincount(at, channel, side * side) for channel in colors.T], 1)
        with np.errstate(invalid="ignore"):
            samples.append((total / count[:, None]).astype(np.float32))
    views_of_part = np.isfinite([sample[:, 0] for sample in samples]).sum(0)
    in_cells = lambda x: x.reshape(CELLS, FINE, CELLS, FINE, -1).swapaxes(1, 2).reshape(CELLS, CELLS, FINE**2, -1)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a cell that no view shows has no median
        # A cell's brightness is the median over its parts, and that of a part the median over views, so that neither
        # joints of planks nor shine counts.
        brightness = np.nanmedian(in_cells(np.nanmedian(samples, axis=0)), 2)
    parts = in_cells(views_of_part)[..., 0]
    seen = ((parts > 0).mean(2) > MIN_PARTS) & (parts.max(2) >= MIN_VIEWS)
    return np.where(seen[..., None], brightness, np.nan)


def _map_coordinates(points: np.ndarray, background: Background, plane: Plane) -> np.ndarray:
    """Return [P, 2], the coordinates of world points [P, 3] on the map of a plane, in cells; cell 0 is [0, 1)."""
    return (points - background.center) @ plane.axes.T / (CELL * background.radius) + CELLS / 2


def _smooth_light(brightness: np.ndarray, seen: np.ndarray, stiffness: float, clip: float) -> np.ndarray:
    """Return [CELLS, CELLS, 3], the smooth log light of each channel, 0 where unseen; settings: `STIFF` or `SOFT`."""
    # The light L minimizes sum w (dL - dB)^2 + stiffness sum (d2L)^2 + sum a L^2, where B is the brightness, d is the
    # difference of neighboring cells and d2 the second difference. The weights a keep L at 0 far from the object.
    light = np.zeros((CELLS, CELLS, 3))
    number = np.where(seen, np.cumsum(seen).reshape(seen.shape) - 1, -1)
    first = sparse.vstack([_difference(number, [[-1.0], [1.0]]), _difference(number, [[-1.0, 1.0]])]).tocsr()
    if not first.shape[0]:
        return light
    curvature = [[[1.0], [-2.0], [1.0]], [[1.0, -2.0, 1.0]], np.sqrt(2) * np.array([[1.0, -1.0], [-1.0, 1.0]])]
    second = sparse.vstack([_difference(number, stencil) for stencil in curvature])
    values = brightness[seen].astype(np.float64)
    steps = first @ values
    deviation = max(1.4826 * np.median(np.abs(steps.mean(1))), MIN_DEVIATION)
    distance = np.hypot(*(np.indices(seen.shape) - (CELLS - 1) / 2))[seen] * CELL
    prior = sparse.diags(np.where(distance > LIT_DISTANCE, LIT_WEIGHT, PRIOR_WEIGHT))
    fixed = stiffness * (second.T @ second) + prior
    weights = np.ones(len(steps))
    for _ in range(ITERATIONS):
        solver = splu((first.T @ sparse.diags(weights) @ first + fixed).tocsc())
        misfit = first @ solver.solve(first.T @ (weights * steps.mean(1))) - steps.mean(1)
        # The weights w are small where dL and dB differ by more than `clip` standard deviations of dB, as at the border
        # of two materials; they are those of the mean channel.
        weights = (1 + (misfit / (clip * deviation)) ** 2) ** -2.0
    # The solver has the weights of the last round but one, which differ little from these.
    light[seen] = solver.solve(first.T @ (weights[:, None] * steps))
    return light


def _difference(number: np.ndarray, stencil: list[list[float]] | np.ndarray) -> sparse.csr_matrix:
    """Return the sparse matrix that applies a stencil [h, w] wherever all its cells are numbered (`number` >= 0)."""
    stencil = np.asarray(stencil)
    height, width = stencil.shape
    windows = np.lib.stride_tricks.sliding_window_view(number, (height, width)).reshape(-1, height * width)
    windows = windows[(windows >= 0).all(1)]
    rows = np.repeat(np.arange(len(windows)), stencil.size)
    data = np.tile(stencil.reshape(-1), len(windows))
    return sparse.csr_matrix((data, (rows, windows.reshape(-1))), (len(windows), int(number.max()) + 1))


def _find_region(light: np.ndarray, seen: np.ndarray) -> np.ndarray | None:
    """Return the dark cells, bool [CELLS, CELLS], of the object's shadow in a map of light; None without a shadow."""
    mean = light.mean(2)
    parts, count = ndimage.label(mean < -DARK)
    if not count:
        return None
    volumes = ndimage.sum(-mean, parts, np.arange(1, count + 1)) * CELL**2
    region = parts == 1 + int(np.argmax(volumes))
    center_distance = np.hypot(*(np.indices(seen.shape) - (CELLS - 1) / 2)) * CELL
    hidden = ~seen & (center_distance < MAX_HIDDEN)
    if volumes.max() < MIN_VOLUME or mean[region].min() > -MIN_DEPTH or not hidden.any():
        return None
    core = region & (mean < CORE * mean[region].min())
    around = ndimage.binary_dilation(region) & ~region & ~hidden
    tint = light[region].mean(0)
    is_near = (ndimage.distance_transform_edt(~hidden) * CELL)[core].min() <= MAX_CORE_DISTANCE
    is_surrounded = around.any() and seen[around].mean() >= MIN_LIT
    is_neutral = np.ptp(tint) <= MAX_TINT * abs(tint.mean())
    return region if is_near and is_surrounded and is_neutral else None


def _make_shadow(
    background: Background, plane: Plane, brightness: np.ndarray, seen: np.ndarray, region: np.ndarray
) -> SoftShadow:
    """Return the shadow around `region`: the soft light of all dark cells connected to it, and its tint."""
    soft = _smooth_light(brightness, seen, *SOFT)
    tint = soft[region].mean(0)
    mean = GAIN * np.minimum(soft.mean(2), 0)
    dark = mean < -EDGE
    mean = np.where(ndimage.binary_propagation(region & dark, mask=dark), mean, 0)
    # Cells that no photograph shows take the value of the nearest cell that one shows.
    mean = mean[morphology.nearest_known(seen)]
    foot = background.center - (background.center @ plane.normal - plane.offset) * plane.normal
    fade = np.array(FADE) * background.radius
    return SoftShadow(plane.normal, foot, plane.axes, CELL * background.radius, fade, mean, tint / tint.mean())
