"""Runs of the first stages with their messages and refusals, and captures with names of any kind."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from reffusion.io import colmap
from reffusion.io.files import BadInput
from reffusion.types import Scene
from scenes.capture import (
    HEIGHT,
    WIDTH,
    Truth,
    convert_to_text,
    preview_stages,
    reprojection_error,
    run_stages,
    run_stages_into,
)

SHARE = 1 / 16  # of a view, the rectangle that `scenes.capture.write_masks` masks
EXACT = 0.01  # px, between a pinhole camera and the truth
OBJECT = np.zeros((HEIGHT, WIDTH), bool)
OBJECT[HEIGHT // 4 : HEIGHT // 2, WIDTH // 4 : WIDTH // 2] = True


def run_with_messages(folder: Path, **params) -> tuple[Scene, Path, list[str]]:
    """Preview and run the stages: the scene, its folder, and all messages, with paths relative to `folder`."""
    sentences = preview_stages(folder, **params)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene, out = run_stages(folder, **params)
    sentences += [str(each.message) for each in caught]
    return scene, out, [each.replace(str(folder), "") for each in sentences]  # whose path may hold any word or number


def assert_message(sentences: Iterable[str], *words: str) -> None:
    """One of the messages contains all words; a number must not be part of a longer number."""
    sentences = list(sentences)
    patterns = [rf"(?<![\d.]){word}(?![\d])" if word.isdigit() else re.escape(word) for word in words]
    found = any(all(re.search(p, each, re.IGNORECASE) for p in patterns) for each in sentences)
    assert found, f"no sentence with {words} among {sentences}"


def refusal_message(folder: Path, **params) -> str:
    """The one line with which the preview refuses a capture."""
    with pytest.raises(BadInput) as caught:
        preview_stages(folder, **params)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def refusal_before_writing(folder: Path, **params) -> str:
    """The one line with which the preview, or the stages before they write anything, refuse a capture."""
    out = folder.parent / f"{folder.name}_refused"
    out.mkdir()
    with pytest.raises(BadInput) as caught, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        preview_stages(folder, **params)
        run_stages_into(folder, out, **params)
    written = sorted(path.name for path in out.iterdir())
    assert "\n" not in str(caught.value) and not written, (str(caught.value), written)
    return str(caught.value)


def assert_cameras(scene: Scene, truth: Truth) -> None:
    """Assert the true poses and, for pinhole cameras, the true intrinsics."""
    assert reprojection_error(scene, truth) < EXACT
    at = truth.lens
    for name in truth.world_to_camera:
        camera = scene.cameras[name]
        found = (camera.fx, camera.fy, camera.cx, camera.cy)
        assert found == pytest.approx((at.fx, at.fy, at.cx, at.cy), abs=EXACT), name


def rename_views(truth: Truth, names: Mapping[str, str]) -> Truth:
    """The truth of the views in `names`, under their new names."""
    return replace(truth, world_to_camera={new: truth.world_to_camera[old] for old, new in names.items()})


def select_views(truth: Truth, first: int, last: int) -> Truth:
    """The truth of the views from `first` up to `last`."""
    return replace(truth, world_to_camera=dict(sorted(truth.world_to_camera.items())[first:last]))


def write_named_model(folder: Path, truth: Truth, names: Mapping[str, str], text: bool = False) -> None:
    """Write a COLMAP model whose images are called `names`: view of the truth -> name."""
    at = truth.lens
    cameras = {1: colmap.ModelCamera("PINHOLE", WIDTH, HEIGHT, (at.fx, at.fy, at.cx, at.cy))}
    listed = enumerate(sorted(names.items(), reverse=True), start=3)
    images = {k: colmap.ModelImage(name, 1, truth.world_to_camera[view]) for k, (view, name) in listed}
    colmap.save_model(folder, cameras, images, truth.points, np.full((len(truth.points), 3), 99, np.uint8))
    if text:
        convert_to_text(folder)


def write_mask(path: Path, mask: np.ndarray = OBJECT) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(255 * mask.astype(np.uint8)).save(path)


def masked_share(out: Path, view: str) -> float:
    """The share of the view's pixels that its mask covers."""
    return float((np.array(Image.open(out / "masks" / f"{view}.png")) > 0).mean())


def masked_views(out: Path) -> list[str]:
    return sorted(path.stem for path in (out / "masks").glob("*.png"))


def assert_masked_views(out: Path, views: Iterable[str], share: float = SHARE) -> None:
    """Exactly these views have a mask of this share, and objects are not distinguished."""
    views = sorted(views)
    assert masked_views(out) == views, masked_views(out)
    shares = [masked_share(out, view) for view in views]
    assert shares == pytest.approx([share] * len(views), abs=1e-3), shares
