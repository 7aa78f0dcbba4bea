"""Captures with points in other frames, masks beside photographs, and uncommon forms and orders of names."""

from __future__ import annotations

import unicodedata
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scenes.capture import (
    HEIGHT,
    Truth,
    make_truth,
    write_capture,
    write_masks,
    write_model,
    write_pictures,
    write_poses_bounds,
    write_transforms,
)
from scenes.capture_checks import (
    OBJECT,
    assert_cameras,
    assert_masked_views,
    assert_message,
    convert_to_text,
    masked_views,
    rename_views,
    run_with_messages,
    set_in_frames,
    write_mask,
    write_named_model,
)

# -------------------------------------------------------------------------------- points in another frame


def assert_points_near(scene, sentences: list[str], file: str) -> None:
    centers = np.stack([camera.center for camera in scene.cameras.values()])
    extent = np.linalg.norm(np.ptp(centers, axis=0))
    assert extent > 0.1, "the normalized frame is as large as the other frame's points"
    assert np.abs(scene.points - centers.mean(0)).max() < 100 * extent, "points of the other frame"
    assert_message(sentences, file, "not used")


def test_points_in_millimetres_beside_cameras_in_metres(tmp_path):
    folder, truth = tmp_path / "s", make_truth(offset=(12.0, -3.0, 40.0))
    write_capture(folder, "colmap", truth)
    points = np.repeat(1000 * truth.points, 5, 0)
    write_model(folder / "sparse/0", replace(truth, points=points), text=True)
    scene, _, sentences = run_with_messages(folder)
    assert_cameras(scene, truth)
    assert_points_near(scene, sentences, "points3D")


# ------------------------------------------------------------------------------------- masks beside photographs


def test_masks_beside_pictures_of_llff(tmp_path):
    """The names of five views end in numbers. The sixth, `venetian_mask`, is a photograph although it ends in _mask."""
    folder, truth = tmp_path / "s", make_truth()
    names = {v: f"2024-02-0{k + 1} party" for k, v in enumerate(sorted(truth.world_to_camera))}
    names["v05"] = "venetian_mask"
    write_pictures(folder / "images_4", names.values())
    for name in list(names.values())[:5]:
        write_mask(folder / "images_4" / f"{name}_mask.png")
    write_poses_bounds(folder, truth)
    scene, out, _ = run_with_messages(folder, masks="images_4")
    assert scene.train == tuple(sorted(names.values()))
    assert_cameras(scene, rename_views(truth, names))
    assert_masked_views(out, list(names.values())[:5])


# ---------------------------------------------------------------------------------------- LLFF's order of names


def test_copies_with_blanks_and_hyphens(tmp_path):
    folder, truth = tmp_path / "s", make_truth()
    files = ["DSC1 copy.png", "DSC1#2.png", "DSC1+.png", "DSC1-edited.png", "DSC1.png", "DSC10.png"]
    assert files == sorted(files) and [Path(f).stem for f in files] != sorted(Path(f).stem for f in files)
    names = {v: Path(file).stem for v, file in zip(sorted(truth.world_to_camera), files, strict=True)}
    write_pictures(folder / "images_4", names.values())
    write_masks(folder / "images_4/label", names.values())
    write_poses_bounds(folder, truth)
    scene, _, _ = run_with_messages(folder)
    assert_cameras(scene, rename_views(truth, names))


def test_test_masks_follow_the_order_of_file_names(tmp_path):
    """The first three views in order of file names are test views, and out_0000k.png is the test mask of the k-th."""
    folder, truth = tmp_path / "s", make_truth(views=8)
    files = ["20220811(0).jpg", "20220811(1).jpg", "20220811.jpg", *(f"2022082{k}.jpg" for k in range(5))]
    assert files == sorted(files)
    names = {v: Path(file).stem for v, file in zip(sorted(truth.world_to_camera), files, strict=True)}
    write_pictures(folder / "images_4", names.values(), ending=".jpg")
    write_masks(folder / "images_4/label", list(names.values())[3:])
    heights = (40, 20, 10)
    for k, height in enumerate(heights):
        write_mask(folder / f"images_4/test_label/out_{k:05d}.png", np.arange(HEIGHT)[:, None] < height + 0 * OBJECT)
    write_poses_bounds(folder, truth)
    scene, out, _ = run_with_messages(folder)
    assert_cameras(scene, rename_views(truth, names))
    assert sorted(scene.test) == ["20220811", "20220811(0)", "20220811(1)"]
    for file, height in zip(files, heights, strict=False):
        mask = np.array(Image.open(out / "test_masks" / f"{Path(file).stem}.png")) > 0
        assert mask.mean() == pytest.approx(height / HEIGHT, abs=1e-3), file


# ------------------------------------------------------------------------------------------------- forms of Unicode


def to_nfd(name: str) -> str:
    return unicodedata.normalize("NFD", name)


def to_nfc(name: str) -> str:
    return unicodedata.normalize("NFC", name)


def assert_cameras_by_nfc(scene, truth: Truth, names: dict[str, str]) -> None:
    """Assert the true cameras; names are compared in the Unicode form NFC. `names`: view of the truth -> name."""
    found = {to_nfc(name): name for name in scene.cameras}
    assert sorted(found) == sorted(to_nfc(name) for name in names.values())
    assert_cameras(scene, rename_views(truth, {v: found[to_nfc(n)] for v, n in names.items()}))


def test_transforms_json_and_masks_from_another_system(tmp_path):
    folder, truth = tmp_path / "s", make_truth()
    names = {v: to_nfc(f"がぞう é {k}") for k, v in enumerate(sorted(truth.world_to_camera))}
    assert to_nfd(names["v00"]) != names["v00"]
    write_pictures(folder / "images", [to_nfd(name) for name in names.values()])
    for name in names.values():
        write_mask(folder / "masks" / f"{name}.png.png")
    write_transforms(folder, truth)
    set_in_frames(folder, "file_path", lambda view: f"images/{names[view]}.png")
    scene, out, _ = run_with_messages(folder, test=[names["v03"]])
    assert [to_nfc(view) for view in scene.test] == [names["v03"]]
    assert_cameras_by_nfc(scene, truth, names)
    assert {to_nfc(view) for view in masked_views(out)} >= set(names.values()) - {names["v03"]}


def test_folder_of_a_model_written_on_another_system(tmp_path):
    folder, truth = tmp_path / "s", make_truth()
    names = {v: f"{'Ünterführung'}/Brücke_{k}" for k, v in enumerate(sorted(truth.world_to_camera))}
    write_named_model(folder / "sparse/0", truth, {v: f"{to_nfd(n)}.jpg" for v, n in names.items()})
    convert_to_text(folder / "sparse/0")
    write_pictures(folder / "images", [to_nfc(name) for name in names.values()], ending=".jpg")
    for name in names.values():
        write_mask(folder / "masks" / f"{to_nfd(name)}.png")
    stems = {v: Path(name).name for v, name in names.items()}
    scene, out, _ = run_with_messages(folder, cameras_only=[to_nfd(names["v01"]) + ".jpg"])
    assert [to_nfc(view) for view in scene.camera_only] == [to_nfc("Brücke_1")]
    assert_cameras_by_nfc(scene, truth, stems)
    assert {to_nfc(view) for view in masked_views(out)} == {to_nfc(s) for v, s in stems.items() if v != "v01"}


def test_names_of_two_forms_in_one_folder(tmp_path):
    """Every second picture has a decomposed (NFD) name, as after a copy through macOS; the others have NFC names."""
    folder, truth = tmp_path / "s", make_truth()
    names = {v: f"Straße à {k}" for k, v in enumerate(sorted(truth.world_to_camera))}
    pictures = {v: (to_nfd, to_nfc)[k % 2](n) for k, (v, n) in enumerate(names.items())}
    write_pictures(folder / "images", pictures.values())
    write_masks(folder / "masks", [to_nfd(name) for name in names.values()])
    write_named_model(folder / "sparse/0", truth, {v: f"{to_nfc(n)}.png" for v, n in names.items()})
    scene, _, _ = run_with_messages(folder)
    assert len(scene.train) == 6
    assert_cameras_by_nfc(scene, truth, names)
