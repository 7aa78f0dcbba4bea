"""Photographs without poses, in uncommon formats and in two orientations."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes.capture_checks import pose_errors, run_with_messages
from scenes.room import render_room_corner, room_textures, room_walk

from reffusion.capture.load import load_capture
from reffusion.io.files import BadInput

pytestmark = pytest.mark.integration

ORIENTATION, EXIF_FOLDER, FOCAL_35_MM = 0x0112, 0x8769, 0xA405


def exif(orientation: int = 1) -> Image.Exif:
    """Return EXIF data with an orientation tag and the renderings' 35 mm focal length (170 px at 200 px width)."""
    result = Image.Exif()
    result[ORIENTATION] = orientation
    result.get_ifd(EXIF_FOLDER)[FOCAL_35_MM] = round(36 * 170 / 200)
    return result


def save_walk(folder: Path, ending: str, **options) -> dict[str, np.ndarray]:
    truth, surfaces = room_walk(6), room_textures(np.random.default_rng(0))
    folder.mkdir(parents=True)
    for name, pose in truth.items():
        Image.fromarray(render_room_corner(pose, surfaces)).save(folder / f"{name}{ending}", **options)
    return truth


def assert_placed(scene, truth: dict[str, np.ndarray]) -> None:
    """Assert that all views have poses: rotations within 2 degrees, centers within 2 % of the extent of all centers."""
    assert sorted(scene.train) == sorted(truth)
    percents, degrees = pose_errors({name: scene.cameras[name].world_to_camera for name in scene.train}, truth)
    assert degrees.max() < 2 and percents.max() < 2


def test_lossy_webp_with_focal_lengths_in_capitals(tmp_path):
    truth = save_walk(tmp_path / "s/images", ".WEBP", format="WEBP", quality=92, exif=exif())
    scene, _, _ = run_with_messages(tmp_path / "s", masks="none")
    assert_placed(scene, truth)


def test_webp_saved_by_a_browser_as_jpg(tmp_path):
    truth = save_walk(tmp_path / "s", ".jpg", format="WEBP", lossless=True)
    scene, _, _ = run_with_messages(tmp_path / "s", masks="none")
    assert_placed(scene, truth)


def test_copies_are_named_and_placeholders_of_icloud_are_refused(tmp_path):
    save_walk(tmp_path / "images", ".png")
    assert not load_capture(tmp_path).warnings
    first = min((tmp_path / "images").iterdir())
    shutil.copy(first, tmp_path / "images/copy.png")
    (warning,) = load_capture(tmp_path).warnings
    assert warning.startswith("copies among the photographs (1, such as ") and "copy.png" in warning
    (tmp_path / "images/.IMG_1.HEIC.icloud").touch()
    with pytest.raises(
        BadInput, match=r"images: placeholders of iCloud in place of photographs \(1, such as .IMG_1.HEIC.icloud"
    ):
        load_capture(tmp_path)


def save_two_orientations(folder: Path, portrait: set[int], save) -> dict[str, np.ndarray]:
    """Save nine views by `save(path without ending, picture, is_portrait)`; return view -> world_to_camera [4, 4].

    The views whose numbers are in `portrait` are 150 x 200 px, the others 200 x 150 px (width x height).
    """
    truth, surfaces = room_walk(9), room_textures(np.random.default_rng(0))
    folder.mkdir(parents=True)
    for k, (name, pose) in enumerate(truth.items()):
        size = (150, 200) if k in portrait else (200, 150)
        save(folder / name, Image.fromarray(render_room_corner(pose, surfaces, size)), k in portrait)
    return truth


def assert_two_orientations(scene, truth: dict[str, np.ndarray], portrait: set[int]) -> None:
    assert_placed(scene, truth)
    for k, name in enumerate(truth):
        camera = scene.cameras[name]
        assert (camera.width < camera.height) == (k in portrait), name


def test_turned_by_their_tag(tmp_path):
    """All photographs are stored in landscape, and the EXIF orientation says which to turn, as phones store them."""

    def save(path: Path, picture: Image.Image, upright: bool) -> None:
        stored = picture.transpose(Image.Transpose.ROTATE_90) if upright else picture
        stored.save(path.with_suffix(".jpg"), quality=95, exif=exif(6 if upright else 1))

    portrait = {2, 5, 6, 8}
    truth = save_two_orientations(tmp_path / "s/images", portrait, save)
    scene, _, _ = run_with_messages(tmp_path / "s", masks="none")
    assert_two_orientations(scene, truth, portrait)


def test_stored_upright_without_tags(tmp_path):
    portrait = {0, 3, 4}
    save = lambda path, picture, upright: picture.save(path.with_suffix(".png"))
    truth = save_two_orientations(tmp_path / "s/photos", portrait, save)
    scene, _, _ = run_with_messages(tmp_path / "s", masks="none")
    assert_two_orientations(scene, truth, portrait)
