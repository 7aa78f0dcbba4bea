"""Rotation of Gaussians: of their quaternions, and of the spherical harmonics of their colors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from reffusion.splat.pure_torch import harmonics
from reffusion.types import Gaussians

DIRECTIONS = 64  # in which rotated and original colors are made equal; degree 3 has 16 unknowns


def rotate_gaussians(gaussians: Gaussians, rotation: np.ndarray) -> Gaussians:
    """Return Gaussians rotated about the origin: means, quaternions and harmonics.

    Args:
        gaussians: float32 on the CPU.
        rotation: [3, 3]; a mean p becomes rotation @ p.
    """
    means = gaussians.means.double().numpy() @ rotation.T
    quaternions = rotate_quaternions(gaussians.quaternions.numpy(), rotation)
    return replace(
        gaussians,
        means=torch.from_numpy(means.astype(np.float32)),
        quaternions=torch.from_numpy(quaternions),
        sh=torch.from_numpy(rotate_harmonics(gaussians.sh.numpy(), rotation)),
    )


def rotate_quaternions(quaternions: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return the orientations of rotated Gaussians, [N, 4] float32, of the same lengths.

    Args:
        quaternions: [N, 4], wxyz, of any length; zero is the identity, and becomes a unit quaternion.
        rotation: [3, 3], by which the Gaussians are rotated.
    """
    w, x, y, z = Rotation.from_matrix(rotation).as_quat(scalar_first=True)
    product = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    found = np.where(quaternions.any(1, keepdims=True), quaternions, [1.0, 0.0, 0.0, 0.0])
    return (found @ product.T).astype(np.float32)


def rotate_harmonics(sh: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return the coefficients of rotated Gaussians: each shows in a rotated direction the color it had before.

    Args:
        sh: [N, K, 3], K = (degree + 1)^2, of degree 0 to 3.
        rotation: [3, 3], by which the Gaussians are rotated.
    """
    degree = round(sh.shape[1] ** 0.5) - 1
    if degree == 0 or not len(sh):
        return sh
    directions = np.random.default_rng(0).normal(size=(DIRECTIONS, 3))
    after, before = (harmonics(torch.from_numpy(each), degree).numpy() for each in (directions, directions @ rotation))
    # The harmonics of a degree are closed under rotation, so that the least squares have no residual.
    return np.einsum("jk,nkc->njc", np.linalg.lstsq(after, before, rcond=None)[0].astype(sh.dtype), sh)
