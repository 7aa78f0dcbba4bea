"""Refuses focal lengths that are not in pixels, and principal points of pictures of another size."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from reffusion.capture.lens import Lens
from reffusion.io.files import BadInput

WIDEST = {False: 150.0, True: 360.0}  # fisheye or not -> degrees; the widest perspective lenses see about 130


def check_intrinsics(lenses: Mapping[str, Lens], source: Path) -> None:
    """Check the lenses of all views of a capture, at the sizes of their pictures.

    Principal points are judged by their mean over the views, in units of width and height. Intrinsics of a picture n
    times as large move it to n/2 in both, so that it is at the lower right corner for n = 2. Crops around an object,
    and tiles, whose principal points may be far outside, lie on all sides of it.

    Args:
        lenses: view name -> lens.
        source: the file of the poses, for messages.

    Raises:
        BadInput: a field of view is wider than `WIDEST`; or the mean principal point is at the upper left or lower
            right corner, or beyond the right or lower border by more than half of the picture's size.
    """
    for name, lens in lenses.items():
        angle = _field_of_view(lens)
        if angle > WIDEST[lens.fisheye]:
            raise BadInput(
                f"{source}: view '{name}': the focal length of {min(lens.fx, lens.fy):.4g} px means a field of view of "
                f"{angle:.0f} degrees; is it in millimeters? It must be in pixels"
            )
    places = {name: (lens.cx / lens.width, lens.cy / lens.height) for name, lens in lenses.items()}
    x, y = np.mean(list(places.values()), axis=0)
    name = max(places, key=places.__getitem__)
    lens = lenses[name]
    what = f"{source}: view '{name}': the principal point (cx, cy = {lens.cx:.4g}, {lens.cy:.4g})"
    if max(abs(x), abs(y)) < 0.01:
        raise BadInput(f"{what} is in the picture's corner; give its middle in pixels, or leave cx and cy out")
    if max(x, y) > 1.5 or min(x, y) > 0.9:
        where = "outside of" if max(x, y) > 1 else "in the corner of"
        raise BadInput(
            f"{what} lies {where} the picture of {lens.width}x{lens.height} px: are fl, cx and cy those of another "
            "size? Give w and h of that size, or scale them"
        )


def _field_of_view(lens: Lens) -> float:
    """Return the larger of the horizontal and vertical field of view, in degrees, without distortion."""
    extent = max(lens.width / lens.fx, lens.height / lens.fy)
    return float(np.degrees(extent if lens.fisheye else 2 * np.arctan(extent / 2)))
