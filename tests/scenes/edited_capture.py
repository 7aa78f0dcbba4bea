"""A capture with its Gaussians, and the file that a splat editor writes after some of these Gaussians were deleted."""

import numpy as np
import torch

from reffusion.io.ply import save_ply
from reffusion.types import Gaussians
from scenes.capture import make_truth, write_capture

EDITOR = ("x", "y", "z", "scale_0", "scale_1", "scale_2", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "rot_0", "rot_1",
          "rot_2", "rot_3")  # fmt: skip


def plane_with_ball(count=4000):
    """Return points [count, 3] on a plane and in a ball above it, and bool [count], True for the points in the ball."""
    draws = np.random.default_rng(0)
    points = draws.uniform(-1, 1, (count, 3)) * (1, 1, 0.02)
    points[: count // 4] = 0.1 * draws.normal(size=(count // 4, 3)) + (0.2, 0.1, 0.5)
    return points, np.linalg.norm(points - (0.2, 0.1, 0.5), axis=1) < 0.3


def write_edited_capture(folder, scale=5.0, offset=(50.0, 0.0, 0.0)):
    """Write a capture with its Gaussians (scene.ply), and the Gaussians that an editor kept (cleaned.ply).

    cleaned.ply has another set of properties, the reverse order and degree 0 of spherical harmonics.

    Returns:
        All Gaussians, and bool [N], True for the deleted Gaussians.
    """
    truth = make_truth(scale=scale, offset=offset)
    points, deleted = plane_with_ball()
    means = torch.from_numpy(points * scale + offset).float()
    draw = lambda *shape: torch.rand(*shape, generator=torch.Generator().manual_seed(0))
    count = len(points)
    whole = Gaussians(means, draw(count, 4), draw(count, 3) - 3, draw(count) + 1, draw(count, 4, 3))
    write_capture(folder, "transforms", truth)
    save_ply(folder / "scene.ply", whole, properties=EDITOR)
    rest = whole.map(lambda p: p[torch.from_numpy(~deleted)].flip(0))
    save_ply(folder / "cleaned.ply", Gaussians(*(getattr(rest, n) for n in FIELDS[:4]), rest.sh[:, :1]))
    return whole, deleted


FIELDS = ("means", "quaternions", "log_scales", "opacity_logits", "sh")


def remove_pictures(folder):
    for path in (*(folder / "images").iterdir(), *(folder / "masks").iterdir()):
        path.unlink()
