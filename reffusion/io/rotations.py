"""Conversion between rotation matrices and quaternions, in the convention of COLMAP's files (w, x, y, z)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def quaternion_to_pose(
    quaternion: np.ndarray | Sequence[float], translation: np.ndarray | Sequence[float]
) -> np.ndarray:
    """Return the rigid transform [4, 4] float64 of a rotation and a translation.

    Args:
        quaternion: [4], wxyz, of any length; it is normalized. The rotation of a zero quaternion is not finite.
        translation: [3].
    """
    with np.errstate(all="ignore"):
        w, x, y, z = np.asarray(quaternion, np.float64) / np.linalg.norm(quaternion)
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = translation
    return matrix


def rotation_to_quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the unit quaternion [4], wxyz with w >= 0, of a rotation matrix [3, 3].

    The result is accurate for all angles, also near pi, where w is close to 0.
    """
    r = np.asarray(rotation, np.float64)
    # The largest of the four components is computed first, to avoid a division by a small number.
    squares = np.array(
        [
            1 + r[0, 0] + r[1, 1] + r[2, 2],
            1 + r[0, 0] - r[1, 1] - r[2, 2],
            1 - r[0, 0] + r[1, 1] - r[2, 2],
            1 - r[0, 0] - r[1, 1] + r[2, 2],
        ]
    )
    products = np.array(
        [
            [squares[0], r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]],
            [r[2, 1] - r[1, 2], squares[1], r[1, 0] + r[0, 1], r[0, 2] + r[2, 0]],
            [r[0, 2] - r[2, 0], r[1, 0] + r[0, 1], squares[2], r[2, 1] + r[1, 2]],
            [r[1, 0] - r[0, 1], r[0, 2] + r[2, 0], r[2, 1] + r[1, 2], squares[3]],
        ]
    )
    quaternion = products[int(np.argmax(squares))]
    quaternion = quaternion / np.linalg.norm(quaternion)
    return quaternion if quaternion[0] >= 0 else -quaternion
