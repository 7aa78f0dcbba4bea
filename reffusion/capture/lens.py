"""Lenses: distortion models, and undistortion, which replaces a distorted lens by a pinhole.

A *direction* is [..., 2], the camera coordinates (x/z, y/z) of a ray, with x right and y down. Pixel coordinates are as
in docs/architecture.md: the center of pixel (column i, row j) is (i + 0.5, j + 0.5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from reffusion.io.files import BadInput

PINHOLE_ENOUGH = 0.05  # px: a lens whose distortion moves no border pixel by more counts as a pinhole


@dataclass(frozen=True)
class Lens:
    """Camera intrinsics with distortion.

    Let l be the length of the direction (x, y), and r = l, or r = atan(l) for a fisheye. Distortion multiplies the
    direction by

        (1 + radial[0] r^2 + radial[1] r^4 + ...) / (1 + denominator[0] r^2 + denominator[1] r^4 + ...)

    and for a fisheye also by r / l. For other lenses Brown's tangential terms with p1 and p2 are then added.

    Attributes:
        width, height: image size in pixels.
        fx, fy, cx, cy: focal lengths and principal point in pixels.
        radial, denominator: any number of polynomial coefficients, lowest power first.
        tangential: p1 and p2 as in OpenCV.
        fisheye: True for an equidistant projection, False for a perspective one.
        model: COLMAP's name of the model, for messages.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    radial: tuple[float, ...] = ()
    denominator: tuple[float, ...] = ()
    tangential: tuple[float, float] = (0.0, 0.0)
    fisheye: bool = False
    model: str = "PINHOLE"

    def resized(self, width: int, height: int) -> Lens:
        """Return the lens for a picture of another size. The coefficients stay, since distortion acts on directions."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )

    @property
    def pinhole(self) -> Lens:
        """The lens with the same size, focal lengths and principal point, and without distortion."""
        return Lens(self.width, self.height, self.fx, self.fy, self.cx, self.cy)

    def coefficients(self) -> str:
        """Return the model and the coefficients other than 0, for messages: `SIMPLE_RADIAL k1=0.0124`."""
        names = [(f"k{i}", k) for i, k in enumerate(self.radial, start=1)]
        names += [(f"k{i}", k) for i, k in enumerate(self.denominator, start=4)]
        names += [("p1", self.tangential[0]), ("p2", self.tangential[1])]
        return " ".join([self.model, *(f"{name}={value:.4g}" for name, value in names if value)])


def from_colmap(model: str, width: int, height: int, params: tuple[float, ...]) -> Lens:
    """Return the lens of a COLMAP camera.

    Args:
        model: COLMAP's name of the camera model.
        params: the parameters in COLMAP's order.

    Raises:
        BadInput: the model is not supported; the message names it.
    """
    if model not in _COLMAP:
        raise BadInput(f"camera model {model} is not understood; convert it to one of {', '.join(_COLMAP)}")
    single_focal, fisheye, names = _COLMAP[model]
    fx, fy, cx, cy = (params[0], *params[:3]) if single_focal else params[:4]
    k = dict(zip(names, params[3 if single_focal else 4 :], strict=True))
    return Lens(
        width,
        height,
        fx,
        fy,
        cx,
        cy,
        radial=tuple(k[n] for n in ("k1", "k2", "k3", "k4") if n in k and (fisheye or n != "k4")),
        denominator=tuple(k[n] for n in ("k4", "k5", "k6") if n in k and not fisheye),
        tangential=(k.get("p1", 0.0), k.get("p2", 0.0)),
        fisheye=fisheye,
        model=model,
    )


# model: (one focal length for both axes, fisheye, parameters after the principal point)
_COLMAP = {
    "SIMPLE_PINHOLE": (True, False, ()),
    "PINHOLE": (False, False, ()),
    "SIMPLE_RADIAL": (True, False, ("k1",)),
    "RADIAL": (True, False, ("k1", "k2")),
    "OPENCV": (False, False, ("k1", "k2", "p1", "p2")),
    "FULL_OPENCV": (False, False, ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "SIMPLE_FISHEYE": (True, True, ()),
    "FISHEYE": (False, True, ()),
    "SIMPLE_RADIAL_FISHEYE": (True, True, ("k1",)),
    "RADIAL_FISHEYE": (True, True, ("k1", "k2")),
    "OPENCV_FISHEYE": (False, True, ("k1", "k2", "k3", "k4")),
}


def distort(directions: np.ndarray, lens: Lens) -> np.ndarray:
    """Apply the distortion of a lens to directions [..., 2]. Returns the distorted directions [..., 2], float64."""
    xy = np.asarray(directions, np.float64)
    length = np.linalg.norm(xy, axis=-1, keepdims=True)
    angle = np.arctan(length) if lens.fisheye else length
    square = angle * angle
    factor = _polynomial(lens.radial, square) / _polynomial(lens.denominator, square)
    if lens.fisheye:
        # atan(l) / l, 1 at the center
        return xy * factor * np.divide(angle, length, out=np.ones_like(length), where=length > 1e-12)
    (p1, p2), x, y = lens.tangential, xy[..., :1], xy[..., 1:]
    tangential = np.concatenate(
        [2 * p1 * x * y + p2 * (square + 2 * x * x), p1 * (square + 2 * y * y) + 2 * p2 * x * y], axis=-1
    )
    return xy * factor + tangential


def _polynomial(coefficients: tuple[float, ...], square: np.ndarray) -> np.ndarray:
    """Return 1 + c[0] s + c[1] s^2 + ... for the coefficients c and s = `square`, any shape."""
    value = np.zeros_like(square)
    for k in reversed(coefficients):
        value = (value + k) * square
    return 1.0 + value


def undistort(distorted: np.ndarray, lens: Lens) -> np.ndarray:
    """Remove the distortion of a lens from directions [..., 2]: the inverse of `distort`, by Newton's method.

    The result is NaN where the method does not converge, or where the distortion folds over.
    """
    distorted = np.asarray(distorted, np.float64)
    xy, step = distorted.copy(), 1e-6
    if lens.fisheye:
        radius = np.linalg.norm(distorted, axis=-1, keepdims=True)
        xy = distorted * np.tan(np.minimum(radius, 1.5)) / np.maximum(radius, 1e-12)
    with np.errstate(all="ignore"):
        for _ in range(30):
            right, below = np.array([step, 0.0]), np.array([0.0, step])
            by_x = (distort(xy + right, lens) - distort(xy - right, lens)) / (2 * step)
            by_y = (distort(xy + below, lens) - distort(xy - below, lens)) / (2 * step)
            error = distort(xy, lens) - distorted
            determinant = by_x[..., 0] * by_y[..., 1] - by_x[..., 1] * by_y[..., 0]
            dx = (error[..., 0] * by_y[..., 1] - error[..., 1] * by_y[..., 0]) / determinant
            dy = (by_x[..., 0] * error[..., 1] - by_x[..., 1] * error[..., 0]) / determinant
            xy = xy - np.stack([dx, dy], axis=-1)
        diverged = (np.abs(distort(xy, lens) - distorted).max(axis=-1) > 1e-8) | ~(determinant > 0)
    return np.where(diverged[..., None], np.nan, xy)


def to_pixels(directions: np.ndarray, lens: Lens) -> np.ndarray:
    """Project undistorted directions [..., 2] to pixels [..., 2] of the distorted picture."""
    return distort(directions, lens) * (lens.fx, lens.fy) + (lens.cx, lens.cy)


def to_directions(pixels: np.ndarray, lens: Lens) -> np.ndarray:
    """Return the undistorted directions [..., 2] of pixels [..., 2] of the distorted picture; NaN as in `undistort`."""
    return undistort((np.asarray(pixels, np.float64) - (lens.cx, lens.cy)) / (lens.fx, lens.fy), lens)


def _border(lens: Lens) -> tuple[np.ndarray, ...]:
    """Return points on the left, top, right and bottom edge of the picture, as pixels [65, 2] each."""
    along = np.linspace(0.0, 1.0, 65)
    across, down = along * lens.width, along * lens.height
    left, right = np.zeros_like(along), np.full_like(along, lens.width)
    top, bottom = np.zeros_like(along), np.full_like(along, lens.height)
    pairs = ((left, down), (across, top), (right, down), (across, bottom))
    return tuple(np.stack(pair, axis=1) for pair in pairs)


@lru_cache(maxsize=4096)
def largest_shift(lens: Lens) -> float:
    """Return the largest distance, in pixels, by which undistortion moves a point on the distorted picture's border.

    Undistortion moves a point to the pixel at which `lens.pinhole` shows the same direction. The distance is 0 for a
    pinhole, and infinite if the distortion cannot be inverted at the border.
    """
    border = np.concatenate(_border(lens))
    seen = to_directions(border, lens)
    if not np.isfinite(seen).all():
        return float("inf")
    return float(np.linalg.norm(seen * (lens.fx, lens.fy) + (lens.cx, lens.cy) - border, axis=1).max())


@lru_cache(maxsize=4096)
def undistorted_pinhole(lens: Lens) -> Lens:
    """Return the pinhole that takes the undistorted picture, of the same size as the distorted one.

    The undistorted picture shows the largest window that lies wholly inside the distorted picture, so that no black
    border remains. Both axes are zoomed by the same factor, so pixels keep their aspect ratio. If the distortion moves
    no border pixel by more than `PINHOLE_ENOUGH` px, the pinhole is the lens without its coefficients.

    Raises:
        BadInput: the distortion cannot be inverted on the picture's border, or the border is more than 85 degrees from
            the optical axis.
    """
    shift = largest_shift(lens)
    if shift <= PINHOLE_ENOUGH:
        return lens.pinhole
    edges = [to_directions(edge, lens) for edge in _border(lens)]
    if not np.isfinite(shift) or np.linalg.norm(np.concatenate(edges), axis=1).max() > np.tan(np.radians(85.0)):
        raise BadInput(
            f"the lens {lens.coefficients()} cannot be undone inside its {lens.width}x{lens.height} px picture; "
            "check its coefficients, or crop the pictures"
        )
    left, top, right, bottom = edges
    low = np.array([left[:, 0].max(), top[:, 1].max()])
    high = np.array([right[:, 0].min(), bottom[:, 1].min()])
    size, focal = np.array([lens.width, lens.height]), np.array([lens.fx, lens.fy])
    fx, fy = focal * (size / (focal * (high - low))).max()
    cx, cy = size / 2 - (fx, fy) * (low + high) / 2
    return Lens(lens.width, lens.height, float(fx), float(fy), float(cx), float(cy))


def sampling_map(lens: Lens, pinhole: Lens) -> np.ndarray:
    """Return [H, W, 2] float64, for each pixel of the pinhole's picture its coordinates in the distorted picture."""
    columns, rows = np.meshgrid(np.arange(pinhole.width) + 0.5, np.arange(pinhole.height) + 0.5)
    directions = np.stack([(columns - pinhole.cx) / pinhole.fx, (rows - pinhole.cy) / pinhole.fy], axis=-1)
    return to_pixels(directions, lens)


@lru_cache(maxsize=4)
def undistortion_map(lens: Lens) -> tuple[Lens, np.ndarray | None]:
    """Return how to undistort pictures of a lens: the pinhole that replaces the lens, and the `sampling_map`.

    The map is None if the distortion is so small that pictures need no resampling. The map is cached and must not be
    changed. Raises BadInput as `undistorted_pinhole` does.
    """
    pinhole = undistorted_pinhole(lens)
    return pinhole, None if pinhole == lens.pinhole else sampling_map(lens, pinhole)


def undistort_image(image: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Resample a picture, uint8 [h, w, 3], to uint8 [H, W, 3] by Lanczos interpolation.

    Args:
        where: [H, W, 2], for each pixel of the result its coordinates in `image` (`sampling_map`).
    """
    import cv2

    at = (where - 0.5).astype(np.float32)  # OpenCV counts from the center of the first pixel
    return cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)


def undistort_mask(mask: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Resample a mask, bool [h, w], to bool [H, W] by bilinear interpolation and a threshold of one half.

    Args:
        where: [H, W, 2], for each pixel of the result its coordinates in `mask` (`sampling_map`).
    """
    import cv2

    at = (where - 0.5).astype(np.float32)
    soft = cv2.remap(mask.astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return soft >= 0.5
