"""Reading of what a user did to a scene in a splat editor, besides deleting an object: folder of the stage `poses`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from reffusion.gaussians.movement import Movement
from reffusion.io.arrays import load_json, load_labels
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_scene
from reffusion.splat.rotation import rotate_gaussians
from reffusion.types import Gaussians, Similarity


def repeat_edit(poses: Path, gaussians: Gaussians, new: Tensor) -> tuple[Gaussians, Similarity, Tensor]:
    """Return a filled scene, cropped, merged and moved as the user did in an editor; unchanged without such edits.

    Args:
        poses: folder of the stage `poses`.
        gaussians: N Gaussians in the normalized frame, on the CPU.
        new: bool [N], True for those that fill the hole.

    Returns:
        The Gaussians in the normalized frame, turned as the user turned the scene; the similarity from the frame of the
        user's file to that frame; and `new` for these Gaussians.
    """
    similarity = load_scene(poses).similarity
    if (poses / "cropped.npy").exists():
        nearest = cKDTree(load_ply(poses / "gaussians.ply").means.numpy()).query(gaussians.means.numpy())[1]
        kept = new | ~load_labels(poses / "cropped.npy")[torch.from_numpy(nearest)]
        gaussians, new = gaussians.map(lambda values: values[kept]), new[kept]
    if (poses / "added.ply").exists():
        added, width = load_ply(poses / "added.ply"), gaussians.sh.shape[1]
        missing = torch.zeros(len(added), max(0, width - added.sh.shape[1]), 3)
        added = replace(added, sh=torch.cat([added.sh, missing], 1)[:, :width])
        gaussians = gaussians.zip_map(added, lambda one, other: torch.cat([one, other]))
        new = torch.cat([new, torch.zeros(len(added), dtype=torch.bool)])
    if (poses / "movement.json").exists():
        facts = load_json(poses / "movement.json")
        movement = Movement(facts["scale"], np.array(facts["rotation"]), np.array(facts["shift"]))
        gaussians = rotate_gaussians(gaussians, movement.rotation)
        similarity = Similarity(similarity.scale / movement.scale, movement.apply(similarity.offset))
    return gaussians, similarity, new
