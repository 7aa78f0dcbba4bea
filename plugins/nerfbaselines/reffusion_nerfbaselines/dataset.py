"""Scenes in SPIn-NeRF's layout, undistorted by RefFusion, or what its stage `poses` made of one.

Masks of training views are True where a pixel may be used; those of test views are True where the object would be,
which is where the protocol scores.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
from nerfbaselines import DatasetNotFoundError, camera_model_to_int, new_cameras, new_dataset

from reffusion_nerfbaselines.ask import RefFusionError, ask
from reffusion_nerfbaselines.spec import DATASET, PROTOCOL

CACHE = Path.home() / ".cache" / "reffusion" / "nerfbaselines"


def load(path: str, split: str, features: Any = None, **_: Any) -> Any:
    """See nerfbaselines' LoadDatasetFunction."""
    scene = Path(path).resolve()
    if split not in ("train", "test"):
        raise ValueError(f"split {split!r}: train or test")
    labelled = any((scene / name / "label").is_dir() for name in ("images_4", "images_2", "images"))
    if not labelled and not (scene / "views.json").is_file():
        raise DatasetNotFoundError(f"{scene}: not in SPIn-NeRF's layout, no masks in images_4/label")
    cache = CACHE / hashlib.sha256(str(scene).encode()).hexdigest()[:16]
    cache.mkdir(parents=True, exist_ok=True)
    try:
        answer = ask("dataset", path=str(scene), split=split, cache=str(cache))
    except RefFusionError as error:
        raise DatasetNotFoundError(str(error)) from None
    pictures = answer["pictures"].tolist()
    cameras = new_cameras(
        poses=answer["poses"],
        intrinsics=answer["intrinsics"],
        camera_models=np.full(len(pictures), camera_model_to_int("pinhole"), np.int32),
        image_sizes=answer["sizes"].astype(np.int32),
        nears_fars=answer["bounds"].astype(np.float32),
    )
    return new_dataset(
        cameras=cameras,
        image_paths=pictures,
        image_paths_root=str(Path(pictures[0]).parent),
        mask_paths=answer["masks"].tolist(),
        mask_paths_root=str(cache / split),
        points3D_xyz=answer["points"].astype(np.float32),
        points3D_rgb=answer["colors"],
        metadata={
            "id": DATASET,
            "scene": scene.parent.name if scene.name == "poses" and not labelled else scene.name,
            "color_space": "srgb",
            "type": "forward-facing",
            "evaluation_protocol": PROTOCOL,
        },
    )


def download(path: str, output: str) -> None:
    """Its authors publish it on Google Drive, for people to fetch."""
    raise RuntimeError(
        f"{path}: fetch SPIn-NeRF's data set from its authors' page, and name the scene's folder instead"
    )
