"""A completed view that another tool wrote, brought back onto its photograph: moved, colours matched, judged, cut in.

Pictures are uint8 [H, W, 3] of one size; an affine map [2, 3] takes a pixel (CONVENTIONS.md) of the photograph to the
pixel that shows the same in the picture. Only what both show is compared: pixels outside the object.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from reffusion.io.images import to_uint8

COARSEST = 40  # px, the shorter side at the coarsest level: a shift of a tenth of the picture is 4 px there
ITERATIONS = 30
STILL = 0.02  # px: a step that moves no corner further is the last of its level
MARGIN = 0.01  # of the picture's width: pixels nearer to the object are not compared, its blurred edge lies there
WINDOW = 0.03  # of the picture's width: what is compared locally
TEXTURE = 4.0  # levels of 255: standard deviation in a window from which it can be told whether two pictures agree
AGREES = 0.6  # correlation in a window from which it does
ENOUGH_TEXTURE = 0.02  # share of the compared pixels; with fewer nothing can be said
ACCEPTED = 0.85  # share of the windows that must agree; half the resolution leaves 0.9, the nearest other view 0.8
AS_WELL = 0.1  # px: a map that moves no corner further is the identity
UNTOUCHED = 1.5  # levels of 255: a median difference up to which a picture is the photograph outside the hole
TOLD_APART = 1.0  # levels of 255: a change of colours up to which there is none
SMALLEST, LARGEST = 0.7, 1.4  # scales a map may have: people resize and crop, they do not zoom

IDENTITY = np.eye(2, 3)


@dataclass(frozen=True)
class Registration:
    """How a picture lies over its photograph.

    Attributes:
        moved: [2, 3] affine map, from the photograph's pixels to the picture's; None where it lies as it should.
        shift: px, by how far the corner that moves most does.
        gain, offset: [3] each, colours in [0, 1]: photograph = gain * picture + offset; 1 and 0 where none is needed.
        agrees: share in [0, 1] of textured pixels, in whose surroundings the two correlate; NaN without texture.
        correlation: median of these correlations, NaN without texture.
        untouched: it is the photograph outside the hole, to rounding.
    """

    moved: np.ndarray | None
    shift: float
    gain: np.ndarray
    offset: np.ndarray
    agrees: float
    correlation: float
    untouched: bool

    @property
    def fits(self) -> bool:
        """Is it a picture of this view? Yes where nothing can be said."""
        return not self.agrees < ACCEPTED

    @property
    def misfit(self) -> str:
        """How badly it fits, in words."""
        moved = (
            f"moved by up to {self.shift:.0f} px and its colours matched" if self.moved is not None else "as it lies"
        )
        return (
            f"{moved}, only {self.agrees:.0%} of what it shows around the hole agrees with the photograph "
            f"(at least {ACCEPTED:.0%} must; correlation {self.correlation:.2f})"
        )

    def __str__(self) -> str:
        if np.isnan(self.agrees):
            return "what it shows around the hole is too plain to be compared"
        moved = f"moved by up to {self.shift:.1f} px" if self.moved is not None else "not moved"
        brighter = (self.gain.mean() + self.offset.mean() - 1) * 100
        colors = f"colours matched ({brighter:+.0f} %)" if (self.gain != 1).any() or self.offset.any() else "as exposed"
        return f"{moved}, {colors}; {self.agrees:.0%} of what it shows around the hole agrees"


def register(picture: np.ndarray, photo: np.ndarray, hidden: np.ndarray) -> Registration:
    """Where the picture lies over the photograph, and its colours; as it lies, where that fits as well.

    Args:
        picture: the completed view, resized to the photograph's size.
        hidden: bool [H, W], where the object stands in the photograph.
    """
    known = ~_widened(hidden, MARGIN)
    difference = np.abs(picture.astype(np.int16) - photo)[known]
    if not known.any() or np.median(difference) <= UNTOUCHED:
        share, correlation = agreement(picture, photo, known)
        share = 1.0 if np.isnan(share) else share
        found = Registration(None, 0.0, np.ones(3), np.zeros(3), share, correlation, untouched=True)
        if found.fits:
            return found
    best = _judged(IDENTITY, picture, photo, known)
    for start in (IDENTITY, _by_features(picture, photo, known)):
        if start is not None and (found := _judged(_aligned(picture, photo, known, start), picture, photo, known)):
            better = found.agrees > best.agrees + 0.001 or (
                found.agrees > best.agrees - 0.001 and found.correlation > best.correlation + 0.001
            )
            best = found if better else best
    return best if best.shift > AS_WELL else replace(best, moved=None)


def warped(picture: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The picture as the photograph lies, float32 if it is, and bool [H, W]: pixels that it has."""
    height, width = picture.shape[:2]
    linear, shift = moved[:, :2], moved[:, 2] + (moved[:, :2] - np.eye(2)) @ (0.5, 0.5)
    matrix = np.concatenate([linear, shift[:, None]], 1)  # OpenCV counts from the centre of the first pixel
    flags = cv2.INTER_LANCZOS4 if picture.dtype == np.uint8 else cv2.INTER_LINEAR
    read = cv2.warpAffine(picture, matrix, (width, height), flags=flags | cv2.WARP_INVERSE_MAP,
                          borderMode=cv2.BORDER_REPLICATE)  # fmt: skip
    at = _pixels(height, width) @ linear.T.astype(np.float32) + moved[:, 2].astype(np.float32)
    return read, ((at >= 0) & (at <= (width, height))).all(-1)


def recolored(picture: np.ndarray, gain: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """uint8 [H, W, 3] with the colours of the photograph."""
    return to_uint8(picture / 255.0 * gain + offset)


def cut_in(
    picture: np.ndarray, photo: np.ndarray, hole: np.ndarray, given: np.ndarray, margin: float, rim: float
) -> np.ndarray:
    """The photograph with the picture in the hole, uint8 [H, W, 3].

    Args:
        picture: registered and in the photograph's colours.
        hole: bool [H, W]. given: bool [H, W], pixels that the picture has.
        margin: px around the hole that are taken from the picture too, rim: px beyond over which they are blended.
    """
    away = cv2.distanceTransform((~hole).astype(np.uint8), cv2.DIST_L2, 5) if hole.any() else np.full(hole.shape, 1e9)
    share = np.clip(1 - (away - margin) / max(rim, 1e-6), 0, 1) * given
    mixed = share[..., None] * picture + (1 - share[..., None]) * photo
    return np.round(mixed).astype(np.uint8)


def agreement(picture: np.ndarray, photo: np.ndarray, known: np.ndarray) -> tuple[float, float]:
    """(Share of the textured known pixels around which the two correlate by `AGREES`, median correlation there).

    Exposure does not count. NaN and NaN where hardly anything is textured.
    """
    side = max(7, round(WINDOW * photo.shape[1])) | 1
    weight = known.astype(np.float32)
    total = _box(weight, side)
    a, b = _grey(picture), _grey(photo)
    mean = lambda values: _box(values * weight, side) / np.maximum(total, 1e-6)
    mean_a, mean_b = mean(a), mean(b)
    var_a, var_b = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2
    textured = known & (total > 0.3) & (np.maximum(var_a, var_b) > TEXTURE**2)
    if textured.sum() <= ENOUGH_TEXTURE * max(known.sum(), 1):
        return float("nan"), float("nan")
    both = (mean(a * b) - mean_a * mean_b)[textured]
    correlation = both / np.sqrt(np.maximum(var_a * var_b, 1.0)[textured])
    return float((correlation > AGREES).mean()), float(np.median(correlation))


def matched_colors(picture: np.ndarray, photo: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gain and offset [3] of each channel, robustly; 1 and 0 where they would hardly change a colour."""
    small = lambda image: cv2.GaussianBlur(image, (0, 0), 1.5).astype(np.float64)[known] / 255
    x, y = small(picture), small(photo)
    gain, offset = np.ones(3), np.zeros(3)
    for channel in range(3):
        gain[channel], offset[channel] = _robust_line(x[:, channel], y[:, channel])
    low, high = np.quantile(x, (0.05, 0.95), axis=0) if len(x) else (np.zeros(3), np.ones(3))
    changed = max(np.abs((gain - 1) * at + offset).max() for at in (low, high)) * 255
    return (gain, offset) if changed > TOLD_APART else (np.ones(3), np.zeros(3))


# ------------------------------------------------------------------------------------------------------- the parts


def _judged(moved: np.ndarray | None, picture: np.ndarray, photo: np.ndarray, known: np.ndarray) -> Registration | None:
    """What a map makes of the picture; None for no map, or one that people would not make."""
    if moved is None or not _plausible(moved):
        return None
    read, given = (picture, np.ones_like(known)) if moved is IDENTITY else warped(picture, moved)
    shown = known & given
    share, correlation = agreement(read, photo, shown)
    gain, offset = matched_colors(read, photo, shown)
    return Registration(moved, _shift(moved, known.shape), gain, offset, share, correlation, untouched=False)


def _plausible(moved: np.ndarray) -> bool:
    stretch = np.linalg.svd(moved[:, :2])[1]
    return bool(np.isfinite(moved).all() and SMALLEST < stretch[1] and stretch[0] < LARGEST)


def _shift(moved: np.ndarray, shape: tuple[int, ...]) -> float:
    height, width = shape
    corners = np.array([(0, 0), (width, 0), (0, height), (width, height)], np.float64)
    return float(np.linalg.norm(corners @ moved[:, :2].T + moved[:, 2] - corners, axis=1).max())


def _aligned(picture: np.ndarray, photo: np.ndarray, known: np.ndarray, start: np.ndarray) -> np.ndarray | None:
    """`start` refined coarse to fine: robust least squares of grey values, gain and offset of exposure included."""
    a, b, moved = _grey(picture), _grey(photo), start
    height, width = known.shape
    levels = max(0, int(np.log2(max(min(height, width) / COARSEST, 1))))
    for level in range(levels, -1, -1):
        size = (max(2, width >> level), max(2, height >> level))
        scale = np.array(size) / (width, height)
        blurred = (cv2.GaussianBlur(each, (0, 0), 1.0) for each in (a, b))
        shrunk = (cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in blurred)
        seen = cv2.resize(known.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.9
        moved = _solved(*shrunk, seen, _scaled(moved, scale))
        if moved is None:
            return None
        moved = _scaled(moved, 1 / scale)
    return moved


def _scaled(moved: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """The same map between pictures of another size."""
    return np.concatenate([moved[:, :2] * scale[:, None] / scale, (moved[:, 2] * scale)[:, None]], 1)


def _solved(a: np.ndarray, b: np.ndarray, known: np.ndarray, moved: np.ndarray) -> np.ndarray | None:
    """Gauss-Newton steps with Geman-McClure weights at one level; None where it loses the picture."""
    x, y = np.moveaxis(_pixels(*b.shape), -1, 0)
    x, y = (x - b.shape[1] / 2) / b.shape[1], (y - b.shape[0] / 2) / b.shape[0]
    gain, offset = 1.0, 0.0
    for _ in range(ITERATIONS):
        read, given = warped(a, moved)
        seen = known & given
        if seen.sum() < 0.2 * known.sum() or seen.sum() < 100:
            return None
        # gradients along the photograph's axes, turned into the picture's
        along, down = cv2.Sobel(read, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(read, cv2.CV_32F, 0, 1, scale=0.125)
        back = np.linalg.inv(moved[:, :2])
        gx, gy = along * back[0, 0] + down * back[1, 0], along * back[0, 1] + down * back[1, 1]
        error = (b - gain * read - offset)[seen]
        spread = max(1.4826 * float(np.median(np.abs(error))), 0.5)
        weight = (1 + (error / (2 * spread)) ** 2) ** -2
        gx, gy, px, py = gain * gx[seen], gain * gy[seen], x[seen], y[seen]
        columns = np.stack([gx * px, gx * py, gx, gy * px, gy * py, gy, read[seen] / 64, np.ones(len(error))])
        normal = (columns * weight) @ columns.T
        step = np.linalg.lstsq(normal, (columns * weight) @ error, rcond=1e-9)[0]
        gain, offset = gain + step[6] / 64, offset + step[7]
        linear = step[:6].reshape(2, 3)[:, :2] / (b.shape[1], b.shape[0])
        change = np.concatenate([linear, (step[[2, 5]] - linear @ (b.shape[1] / 2, b.shape[0] / 2))[:, None]], 1)
        moved = moved + change
        if not _plausible(moved):
            return None
        if _shift(IDENTITY + change, b.shape) < STILL:
            break
    return moved


def _by_features(picture: np.ndarray, photo: np.ndarray, known: np.ndarray) -> np.ndarray | None:
    """A map by points that look alike, for shifts that the refinement would not find; None where there are few."""
    finder = cv2.SIFT_create(2000)
    grey = lambda image: cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    there, of_photo = finder.detectAndCompute(grey(photo), known.astype(np.uint8))
    here, of_picture = finder.detectAndCompute(grey(picture), None)
    if of_photo is None or of_picture is None or min(len(there), len(here)) < 12:
        return None
    pairs = [p for p in cv2.BFMatcher().knnMatch(of_photo, of_picture, k=2) if len(p) == 2]
    pairs = [first for first, second in pairs if first.distance < 0.75 * second.distance]
    if len(pairs) < 12:
        return None
    source = np.array([there[p.queryIdx].pt for p in pairs]) + 0.5
    target = np.array([here[p.trainIdx].pt for p in pairs]) + 0.5
    cv2.setRNGSeed(0)
    moved, inliers = cv2.estimateAffine2D(source, target, ransacReprojThreshold=2.0)
    return moved if moved is not None and inliers.sum() >= 12 else None


def _robust_line(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Gain and offset of y ~ gain * x + offset, outliers let go; no gain where x hardly varies."""
    if len(x) < 100:
        return 1.0, 0.0
    gain, offset = 1.0, float(np.median(y - x))
    for _ in range(20):
        error = y - gain * x - offset
        spread = max(1.4826 * float(np.median(np.abs(error))), 1e-3)
        weight = (1 + (error / (2 * spread)) ** 2) ** -2
        mean_x, mean_y = np.average(x, weights=weight), np.average(y, weights=weight)
        dx = x - mean_x
        variance = np.average(dx**2, weights=weight)
        gain = float(np.average(dx * (y - mean_y), weights=weight) / variance) if variance > 1e-4 else 1.0
        offset = float(mean_y - gain * mean_x)
    return gain, offset


def _grey(image: np.ndarray) -> np.ndarray:
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32)


def _box(values: np.ndarray, side: int) -> np.ndarray:
    return cv2.boxFilter(values.astype(np.float64), -1, (side, side), borderType=cv2.BORDER_CONSTANT)


def _pixels(height: int, width: int) -> np.ndarray:
    """[H, W, 2] float32 coordinates of the pixels' centres."""
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).astype(np.float32)


def _widened(mask: np.ndarray, fraction: float) -> np.ndarray:
    reach = max(1, round(fraction * mask.shape[1]))
    return cv2.dilate(mask.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
