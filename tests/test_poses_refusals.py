"""Captures that `poses` refuses before any work; each message names the file and a remedy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scenes.capture import HEIGHT, WIDTH, make_truth, run_stages, write_capture, write_masks, write_pictures
from scenes.capture_checks import change_transforms


def edit_transforms(change):
    return lambda folder: change_transforms(folder, change)


def set_nan_pose(record):
    record["frames"][2]["transform_matrix"][0][3] = float("nan")


def mirror_pose(record):
    record["frames"][2]["transform_matrix"][0][:3] = [-v for v in record["frames"][2]["transform_matrix"][0][:3]]


def share_stem(folder: Path) -> None:
    write_pictures(folder / "images", ["v00"], ending=".bmp")
    edit_transforms(lambda r: r["frames"][0].update(file_path="images/v00.bmp"))(folder)


def share_mask(folder: Path) -> None:
    write_pictures(folder / "other", ["v00"])
    edit_transforms(lambda r: r["frames"][0].update(file_path="other/v00.png"))(folder)


def drop_views(folder: Path) -> None:
    for k in range(2, 6):
        (folder / "images" / f"v{k:02d}.png").unlink()
        (folder / "masks" / f"v{k:02d}.png").unlink()


def drop_masks(folder: Path) -> None:
    for path in (folder / "masks").iterdir():
        path.unlink()


def move_pictures(folder: Path) -> None:
    drop_masks(folder)
    elsewhere = (folder / "images").rename(folder.with_name("elsewhere"))
    edit_transforms(lambda r: [e.update(file_path=str(elsewhere / Path(e["file_path"]).name)) for e in r["frames"]])(
        folder
    )


def renumber_masks(folder: Path) -> None:
    for k in range(6):
        (folder / "masks" / f"v{k:02d}.png").rename(folder / "masks" / f"{k + 1:05d}.png")


def rename_masks(folder: Path) -> None:
    (folder / "masks").rename(folder / "segmentation")


def stack_masks(folder: Path) -> None:
    drop_masks(folder)
    np.save(folder / "masks.npy", np.zeros((6, HEIGHT, WIDTH), bool))


def double_intrinsics(record: dict) -> None:
    record.update(cx=float(WIDTH), cy=float(HEIGHT))
    for key in ("w", "h"):
        record.pop(key, None)


REFUSALS = [
    ("masks numbered from 1", renumber_masks, {}, r"00001\.png.*numbered from 1, pictures from 0; renumber all masks"),
    ("masks of another name", rename_masks, {}, "segmentation holds 6 pictures named like.*`masks: segmentation`"),
    ("a stack of masks", stack_masks, {}, r"masks\.npy is not read: save a mask for each picture"),
    ("intrinsics of another size", edit_transforms(double_intrinsics), {}, "those of another size; add that size as w"),
    ("mask for no picture", lambda f: write_masks(f / "masks", ["zz"]), {}, r"zz\.png.*no picture"),
    ("no mask at all", drop_masks, {}, "no mask at all.*masks: none"),
    ("no file of the layout", lambda f: (f / "transforms.json").unlink(), {"layout": "transforms"}, "correct `layout`"),
    ("no mask, pictures elsewhere", move_pictures, {}, "no mask at all.*masks: none"),
    ("named masks missing", None, {"masks": "nowhere"}, "nowhere.*correct `masks`"),
    ("empty masks", lambda f: write_masks(f / "masks", [f"v{k:02d}" for k in range(6)], value=0), {}, "are empty"),
    (
        "mask of other proportions",
        lambda f: write_masks(f / "masks", ["v01"], (HEIGHT, WIDTH)),
        {},
        r"v01\.png.*72x96.*by 90",
    ),
    ("two training views", drop_views, {}, "2 training views.*at least 3"),
    ("all views are test views", None, {"test": "every 1"}, "0 training views.*at least 3"),
    ("unreadable picture", lambda f: (f / "images" / "v01.png").write_text("x"), {}, r"v01\.png.*readable image"),
    ("NaN pose", edit_transforms(set_nan_pose), {}, r"transforms\.json.*'v03' is not finite"),
    ("mirrored pose", edit_transforms(mirror_pose), {}, "'v03' is no rotation"),
    ("two views of a name", share_stem, {}, "view name 'v00' is also"),
    ("a mask of two views", share_mask, {}, r"masks/v00\.png: images-v00 and other-v00 are called so"),
    ("no intrinsics", edit_transforms(lambda r: r.pop("fl_x")), {}, "neither fl_x nor camera_angle_x"),
    ("unknown camera model", edit_transforms(lambda r: r.update(camera_model="X")), {}, "camera_model X"),
    ("other proportions than the camera", edit_transforms(lambda r: r.update(w=50)), {}, "other proportions"),
    ("unknown test view", None, {"test": ["w01"]}, r"test: there is no view 'w01'.*v01"),
    ("unknown train view", None, {"train": ["v00", "v01", "q"]}, "train: there is no view 'q'"),
    ("unknown clean view", None, {"clean": ["q"]}, "clean: there is no view 'q'"),
    ("clean view that is a test view", None, {"clean": ["v00"], "test": ["v00"]}, "v00 is no training view"),
    ("both train and test", None, {"train": ["v00", "v01", "v02"], "test": ["v02"]}, "v02 in both"),
    ("split that is neither", None, {"test": "some"}, "'some' is neither"),
    ("missing images folder", None, {"images": "nowhere"}, "nowhere: no such folder"),
    ("missing gaussians", None, {"gaussians": "no.ply"}, r"no\.ply: no such file"),
    ("layout that is not there", None, {"layout": "colmap"}, "no COLMAP model"),
]


@pytest.mark.parametrize(("change", "params", "message"), [r[1:] for r in REFUSALS], ids=[r[0] for r in REFUSALS])
def test_refusals_name_file_and_remedy(tmp_path, change, params, message):
    folder = write_capture(tmp_path / "s", "transforms", make_truth())
    if change is not None:
        change(folder)
    with pytest.raises(ValueError, match=message):
        run_stages(folder, **params)
    assert not list((tmp_path / "s_out").rglob("*.*"))  # no file was written before the refusal


def test_llff_refusals(tmp_path):
    folder = write_capture(tmp_path / "s", "llff", make_truth())
    rows = np.load(folder / "poses_bounds.npy")
    np.save(folder / "poses_bounds.npy", rows[:-1])
    with pytest.raises(ValueError, match=r"5 poses.*6 pictures"):
        run_stages(folder)
    rows[2, 3] = np.nan
    np.save(folder / "poses_bounds.npy", rows)
    with pytest.raises(ValueError, match=r"poses_bounds\.npy: rows \[2\]"):
        run_stages(folder)


def test_masks_none_is_a_scene_to_fit_only(tmp_path):
    folder = write_capture(tmp_path / "s", "transforms", make_truth())
    scene, out = run_stages(folder, masks="none", test="every 3")
    assert not (out / "masks").exists() and len(scene.test) == 2
    drop_masks(folder)
    run_stages(folder, region={"center": (0, 0, 0), "size": (1, 1, 1)})
