"""Held-out variants of the inputs that people bring, rows F to M: masks, references, order and form of names, points.

The letter in a test's name is its row in the list of inputs that went wrong.
"""

from __future__ import annotations

import json
import unicodedata
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from held_out import (
    EXACT,
    OBJECT,
    SHARE,
    assert_masked,
    assert_sentence,
    attempt,
    masked_share,
    masked_views,
    refusal,
    refusal_before_work,
    renamed,
    write_as_text,
    write_mask,
    write_named_model,
)
from PIL import Image
from small_capture import (
    HEIGHT,
    WIDTH,
    Truth,
    prepare,
    reprojection_error,
    some_truth,
    write_masks,
    write_model,
    write_pictures,
    write_poses_bounds,
    write_transforms,
)
from test_sfm import draw_corner, noise, walk

from reffusion.io.images import save_image
from reffusion.io.ply import save_points
from stages import poses
from stages.plan.poses import preview

# ---------------------------------------------------------------------------------------------- F: masks of any kind


def capture_with_masks(folder: Path, masks: str, draw) -> Truth:
    """A COLMAP capture whose masks are the Pillow images that `draw` returns."""
    truth = some_truth()
    prepare(folder, "colmap", truth)
    (folder / "masks").rename(folder / masks)
    for path in (folder / masks).iterdir():
        draw().save(path)
    return truth


def palette_image(numbers: np.ndarray, colors: dict[int, tuple[int, int, int]]) -> Image.Image:
    image, table = Image.fromarray(numbers.astype(np.uint8), "L"), np.full((256, 3), 17)
    for number, color in colors.items():
        table[number] = color
    image.putpalette(table.astype(np.uint8).tobytes())
    assert image.mode == "P"
    return image


def test_F_palette_whose_black_is_the_last_entry(tmp_path):
    """As an annotation tool writes it whose table begins with the first label, dark red."""
    draw = lambda: palette_image(np.where(OBJECT, 0, 2), {0: (128, 0, 0), 1: (0, 128, 0), 2: (0, 0, 0)})
    truth = capture_with_masks(tmp_path / "s", "masks", draw)
    _, out, _ = attempt(tmp_path / "s")
    assert_masked(out, truth.world_to_camera)


def test_F_one_class_of_a_palette_by_its_number(tmp_path):
    """Pascal VOC: classes by number, the contour is 255 and bright."""
    numbers = np.where(OBJECT, 15, 0)
    numbers[50:60, 10:90] = 7
    numbers[HEIGHT // 4 - 1, WIDTH // 4 : WIDTH // 2] = 255
    colors = {0: (0, 0, 0), 7: (128, 128, 128), 15: (192, 128, 128), 255: (224, 224, 192)}
    truth = capture_with_masks(tmp_path / "s", "SegmentationClass", lambda: palette_image(numbers, colors))
    _, out, _ = attempt(tmp_path / "s", masks={"folder": "SegmentationClass", "id": 15})
    assert_masked(out, truth.world_to_camera)


def numbered_16_bit() -> Image.Image:
    """An object index pass: the object has two parts, 3 and 1024, and stands on 40000."""
    numbers = np.where(OBJECT, 1024, 0).astype(np.uint16)
    numbers[HEIGHT // 4 : HEIGHT // 4 + 5][:, WIDTH // 4 : WIDTH // 2] = 3
    numbers[50:] = 40000
    return Image.fromarray(numbers)


def test_F_object_numbers_of_16_bits_are_refused_without_id(tmp_path):
    capture_with_masks(tmp_path / "s", "masks", numbered_16_bit)
    message = refusal_before_work(tmp_path / "s")
    assert_sentence([message], ".png", " id")


def test_F_two_object_numbers_of_16_bits(tmp_path):
    truth = capture_with_masks(tmp_path / "s", "masks", numbered_16_bit)
    _, out, _ = attempt(tmp_path / "s", masks={"id": [3, 1024]})
    assert_masked(out, truth.world_to_camera)


def test_F_antialiased_outlines_are_no_object_numbers(tmp_path):
    soft = cv2.GaussianBlur(255 * OBJECT.astype(np.uint8), (0, 0), 0.8)
    truth = capture_with_masks(tmp_path / "s", "masks", lambda: Image.fromarray(soft))
    _, out, _ = attempt(tmp_path / "s")
    assert [masked_share(out, v) for v in truth.world_to_camera] == pytest.approx([SHARE] * 6, abs=0.003)


# ---------------------------------------------------------------------------------------------- G: references


def test_G_reference_and_its_depth_among_photographs_of_input(tmp_path):
    folder, names = tmp_path / "s", [f"IMG_{k}" for k in range(6)]
    write_pictures(folder / "input", [*names, "clean plate"], ending=".jpg")
    Image.fromarray(np.full((HEIGHT, WIDTH), 4000, np.uint16)).save(folder / "input/clean plate depth.png")
    write_masks(folder / "masks", names)
    reference = {"view": "IMG_2", "image": "input/clean plate.jpg", "depth": "input/clean plate depth.png"}
    notes = preview(poses.Params(reference=reference), folder)
    assert_sentence(notes, "6 training", "6 masks")
    assert_sentence(notes, "6 photos bring no poses")
    assert not any("clean plate" in note for note in notes)


def test_G_two_references_beside_pictures_of_llff(tmp_path):
    folder, truth = tmp_path / "s", some_truth()
    prepare(folder, "llff", truth)
    write_pictures(folder / "images_4", ["v00_inpainted", "v03_inpainted"])
    references = [{"view": f"v0{k}", "image": f"images_4/v0{k}_inpainted.png"} for k in (0, 3)]
    scene, out, _ = attempt(folder, reference=references)
    assert scene.train == tuple(sorted(truth.world_to_camera))
    assert reprojection_error(scene, truth) < EXACT
    assert_masked(out, truth.world_to_camera)


# ---------------------------------------------------------------------------------------------- H: order


def test_H_frames_of_another_tool_are_not_paired_by_order(tmp_path):
    folder, truth = tmp_path / "s", some_truth()
    stems = [f"frame_{k:05d}" for k in range(6)]
    write_pictures(folder / "images", stems, ending=".jpg")
    write_masks(folder / "masks", stems)
    names = {v: f"DJI_{10 * k:04d}_V.JPG" for k, v in enumerate(sorted(truth.world_to_camera))}
    write_named_model(folder / "sparse/0", truth, names, text=True)
    assert_sentence([refusal(folder)], "images")


def corner_capture(folder: Path, order: list[int]) -> Truth:
    """A drawn corner of a room, its points coloured as seen, and images IMG_8 to IMG_13 in the model; `image00k.png` is
    the view number `order[k]`."""
    generator, cameras = np.random.default_rng(5), walk(6)
    textures = np.stack([cv2.GaussianBlur(noise(generator), (0, 0), 5) for _ in range(3)])
    textures = 255 * (textures - textures.min()) / np.ptp(textures)
    pictures = [draw_corner(pose, textures, (WIDTH, HEIGHT), 90.0) for pose in cameras.values()]
    columns, rows = (axis.ravel() for axis in np.meshgrid(np.arange(4, WIDTH, 9), np.arange(4, HEIGHT, 9)))
    rays = np.stack([(columns + 0.5 - WIDTH / 2) / 90, (rows + 0.5 - HEIGHT / 2) / 90, np.ones(len(rows))], -1)
    points, colors = [], []
    for pose, picture in zip(cameras.values(), pictures, strict=True):
        directions, center = rays @ pose[:3, :3], -pose[:3, :3].T @ pose[:3, 3]
        times = (np.array([2.0, 1.5, 3.0]) - center) / directions
        points.append(center + directions * np.where(times > 0, times, np.inf).min(-1, keepdims=True))
        colors.append(picture[rows, columns])
    truth = Truth(cameras, np.concatenate(points), ("SIMPLE_PINHOLE", (90.0, WIDTH / 2, HEIGHT / 2)))
    write_named_model(folder / "sparse/0", truth, {v: f"IMG_{8 + k}.JPG" for k, v in enumerate(cameras)})
    recolor(folder / "sparse/0/points3D.bin", np.concatenate(colors))
    for k, chosen in enumerate(order):
        save_image(folder / f"images_4/image{k:03d}.png", pictures[chosen])
    write_masks(folder / "images_4/label", [f"image{k:03d}" for k in range(6)])
    return renamed(truth, {f"p{chosen}": f"image{k:03d}" for k, chosen in enumerate(order)})


def recolor(path: Path, colors: np.ndarray) -> None:
    from reffusion.io.colmap import POINT

    data = path.read_bytes()
    records = np.frombuffer(data[8:], POINT).copy()
    records["rgb"] = colors
    path.write_bytes(data[:8] + records.tobytes())


def test_H_renamed_copies_follow_the_order_of_file_names(tmp_path):
    """IMG_10.JPG comes before IMG_8.JPG."""
    truth = corner_capture(tmp_path / "s", [2, 3, 4, 5, 0, 1])
    scene, _, sentences = attempt(tmp_path / "s")
    assert reprojection_error(scene, truth) < EXACT
    assert_sentence(sentences, "order")


def test_H_renamed_copies_that_points_contradict_are_refused(tmp_path):
    corner_capture(tmp_path / "s", [0, 3, 5, 1, 4, 2])
    assert_sentence([refusal_before_work(tmp_path / "s")], "images", "order")


# ---------------------------------------------------------------------------------------------- I: points


def assert_points_near(scene, sentences: list[str], file: str) -> None:
    assert np.abs(scene.points).max() < 50, "points of another frame"
    assert_sentence(sentences, file, "not used")


def test_I_points_in_millimetres_beside_cameras_in_metres(tmp_path):
    folder, truth = tmp_path / "s", some_truth(offset=(12.0, -3.0, 40.0))
    prepare(folder, "colmap", truth)
    points = np.repeat(1000 * truth.points, 5, 0)
    write_model(folder / "sparse/0", replace(truth, points=points), text=True)
    scene, _, sentences = attempt(folder)
    assert reprojection_error(scene, truth) < EXACT
    assert_points_near(scene, sentences, "points3D")


def test_I_points_in_utm_beside_a_complete_model_of_llff(tmp_path):
    folder, truth = tmp_path / "s", some_truth()
    prepare(folder, "llff+bin", truth)
    utm = truth.points[:, [0, 2, 1]] * (1, 1, -1) + (448_262.0, 5_411_932.0, 35.0)
    write_model(folder / "sparse/0", replace(truth, points=np.repeat(utm, 3, 0)), factor=4)
    scene, _, sentences = attempt(folder)
    assert reprojection_error(scene, truth) < EXACT
    assert_points_near(scene, sentences, "points3D")


# ---------------------------------------------------------------------------------------------- J: masks beside


def test_J_masks_beside_photographs_without_a_key(tmp_path):
    folder, truth = tmp_path / "s", some_truth()
    write_pictures(folder / "images", truth.world_to_camera, ending=".jpg")
    for view in truth.world_to_camera:
        write_mask(folder / "images" / f"{view}_mask.png")
    write_model(folder / "sparse/0", truth)
    scene, out, sentences = attempt(folder)
    assert scene.train == tuple(sorted(truth.world_to_camera))
    assert_masked(out, truth.world_to_camera)
    assert not any("not in the model" in sentence for sentence in sentences)


def test_J_masks_beside_pictures_of_llff(tmp_path):
    """Names that end in numbers; one view's photograph is called _mask too, and has no mask."""
    folder, truth = tmp_path / "s", some_truth()
    names = {v: f"2024-02-0{k + 1} party" for k, v in enumerate(sorted(truth.world_to_camera))}
    names["v05"] = "venetian_mask"
    write_pictures(folder / "images_4", names.values())
    for name in list(names.values())[:5]:
        write_mask(folder / "images_4" / f"{name}_mask.png")
    write_poses_bounds(folder, truth)
    scene, out, _ = attempt(folder, masks="images_4")
    assert scene.train == tuple(sorted(names.values()))
    assert reprojection_error(scene, renamed(truth, names)) < EXACT
    assert_masked(out, list(names.values())[:5])


# ---------------------------------------------------------------------------------------------- L: LLFF's order


def test_L_copies_with_blanks_and_hyphens(tmp_path):
    folder, truth = tmp_path / "s", some_truth()
    files = ["DSC1 copy.png", "DSC1#2.png", "DSC1+.png", "DSC1-edited.png", "DSC1.png", "DSC10.png"]
    assert files == sorted(files) and [Path(f).stem for f in files] != sorted(Path(f).stem for f in files)
    names = {v: Path(file).stem for v, file in zip(sorted(truth.world_to_camera), files, strict=True)}
    write_pictures(folder / "images_4", names.values())
    write_masks(folder / "images_4/label", names.values())
    write_poses_bounds(folder, truth)
    scene, _, _ = attempt(folder)
    assert reprojection_error(scene, renamed(truth, names)) < EXACT


def test_L_test_masks_follow_the_order_of_file_names(tmp_path):
    """Three views before the masked ones; out_00000 stands for the first by file name, and has the largest mask."""
    folder, truth = tmp_path / "s", some_truth(views=8)
    files = ["20220811(0).jpg", "20220811(1).jpg", "20220811.jpg", *(f"2022082{k}.jpg" for k in range(5))]
    assert files == sorted(files)
    names = {v: Path(file).stem for v, file in zip(sorted(truth.world_to_camera), files, strict=True)}
    write_pictures(folder / "images_4", names.values(), ending=".jpg")
    write_masks(folder / "images_4/label", list(names.values())[3:])
    heights = (40, 20, 10)
    for k, height in enumerate(heights):
        write_mask(folder / f"images_4/test_label/out_{k:05d}.png", np.arange(HEIGHT)[:, None] < height + 0 * OBJECT)
    write_poses_bounds(folder, truth)
    scene, out, _ = attempt(folder)
    assert reprojection_error(scene, renamed(truth, names)) < EXACT
    assert sorted(scene.test) == ["20220811", "20220811(0)", "20220811(1)"]
    for file, height in zip(files, heights, strict=False):
        mask = np.array(Image.open(out / "test_masks" / f"{Path(file).stem}.png")) > 0
        assert mask.mean() == pytest.approx(height / HEIGHT, abs=1e-3), file


# ---------------------------------------------------------------------------------------------- M: forms of Unicode


def decomposed(name: str) -> str:
    return unicodedata.normalize("NFD", name)


def composed(name: str) -> str:
    return unicodedata.normalize("NFC", name)


def assert_right_for_composed(scene, truth: Truth, names: dict[str, str]) -> None:
    """The cameras are right, whichever form the views' names have."""
    found = {composed(name): name for name in scene.cameras}
    assert sorted(found) == sorted(composed(name) for name in names.values())
    assert reprojection_error(scene, renamed(truth, {v: found[composed(n)] for v, n in names.items()})) < EXACT


def test_M_transforms_json_and_masks_from_another_system(tmp_path):
    folder, truth = tmp_path / "s", some_truth()
    names = {v: composed(f"がぞう é {k}") for k, v in enumerate(sorted(truth.world_to_camera))}
    assert decomposed(names["v00"]) != names["v00"]
    write_pictures(folder / "images", [decomposed(name) for name in names.values()])
    for name in names.values():
        write_mask(folder / "masks" / f"{name}.png.png")
    write_transforms(folder, truth)
    record = json.loads((folder / "transforms.json").read_text())
    for frame in record["frames"]:
        frame["file_path"] = f"images/{names[Path(frame['file_path']).stem]}.png"
    (folder / "transforms.json").write_text(json.dumps(record))
    scene, out, _ = attempt(folder, test=[names["v03"]])
    assert [composed(view) for view in scene.test] == [names["v03"]]
    assert_right_for_composed(scene, truth, names)
    assert {composed(view) for view in masked_views(out)} >= set(names.values()) - {names["v03"]}


def test_M_folder_of_a_model_written_on_another_system(tmp_path):
    folder, truth = tmp_path / "s", some_truth()
    names = {v: f"{'Ünterführung'}/Brücke_{k}" for k, v in enumerate(sorted(truth.world_to_camera))}
    write_named_model(folder / "sparse/0", truth, {v: f"{decomposed(n)}.jpg" for v, n in names.items()})
    write_as_text(folder / "sparse/0")
    write_pictures(folder / "images", [composed(name) for name in names.values()], ending=".jpg")
    for name in names.values():
        write_mask(folder / "masks" / f"{decomposed(name)}.png")
    stems = {v: Path(name).name for v, name in names.items()}
    scene, out, _ = attempt(folder, clean=[], cameras_only=[decomposed(names["v01"])])
    assert [composed(view) for view in scene.blank] == [composed("Brücke_1")]
    assert_right_for_composed(scene, truth, stems)
    assert {composed(view) for view in masked_views(out)} == {composed(s) for v, s in stems.items() if v != "v01"}


def test_M_points_beside_names_of_two_forms(tmp_path):
    """Every second picture was copied through macOS."""
    folder, truth = tmp_path / "s", some_truth()
    names = {v: f"Straße à {k}" for k, v in enumerate(sorted(truth.world_to_camera))}
    pictures = {v: (decomposed, composed)[k % 2](n) for k, (v, n) in enumerate(names.items())}
    write_pictures(folder / "images", pictures.values())
    write_masks(folder / "masks", [decomposed(name) for name in names.values()])
    write_named_model(folder / "sparse/0", truth, {v: f"{composed(n)}.png" for v, n in names.items()})
    save_points(folder / "points.ply", truth.points, np.zeros((60, 3), np.uint8))
    scene, _, _ = attempt(folder)
    assert len(scene.train) == 6
    assert_right_for_composed(scene, truth, names)
