"""Captures with uncommon masks and references, and pictures paired with poses by order."""

from __future__ import annotations

import base64
import io
import itertools
import json
import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scenes.capture import (
    HEIGHT,
    WIDTH,
    Truth,
    make_truth,
    preview_stages,
    write_capture,
    write_masks,
    write_pictures,
)
from scenes.capture_checks import (
    OBJECT,
    assert_cameras,
    assert_masked_views,
    assert_message,
    refusal_before_writing,
    refusal_message,
    rename_views,
    run_with_messages,
)

from reffusion.capture.scene_folder import read_scene
from reffusion.io.files import BadInput
from reffusion.io.given_masks import load_given_mask
from reffusion.params.poses import Params
from stages import raw_masks
from stages.plan import raw_masks as raw_masks_plan

# ------------------------------------------------------------------------------------------- uncommon kinds of masks


def write_capture_with_masks(folder: Path, masks: str, draw) -> Truth:
    """Write a COLMAP capture with masks in the folder named `masks`; `draw()` returns a mask as a Pillow image."""
    truth = make_truth()
    write_capture(folder, "colmap", truth)
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


def test_palette_whose_black_is_the_last_entry(tmp_path):
    """The first entry of the palette is the object's label, dark red; the last is the background, black."""
    draw = lambda: palette_image(np.where(OBJECT, 0, 2), {0: (128, 0, 0), 1: (0, 128, 0), 2: (0, 0, 0)})
    truth = write_capture_with_masks(tmp_path / "s", "masks", draw)
    _, out, _ = run_with_messages(tmp_path / "s")
    assert_masked_views(out, truth.world_to_camera)


def test_one_class_of_a_palette_by_its_number(tmp_path):
    """Masks of Pascal VOC: palette numbers are classes; the object has class 15, and its bright contour has 255."""
    numbers = np.where(OBJECT, 15, 0)
    numbers[50:60, 10:90] = 7
    numbers[HEIGHT // 4 - 1, WIDTH // 4 : WIDTH // 2] = 255
    colors = {0: (0, 0, 0), 7: (128, 128, 128), 15: (192, 128, 128), 255: (224, 224, 192)}
    truth = write_capture_with_masks(tmp_path / "s", "SegmentationClass", lambda: palette_image(numbers, colors))
    _, out, _ = run_with_messages(tmp_path / "s", masks={"folder": "SegmentationClass", "id": 15})
    assert_masked_views(out, truth.world_to_camera)


def numbered_16_bit() -> Image.Image:
    """Return a 16-bit map of object numbers: the object consists of the parts 3 and 1024; another object is 40000."""
    numbers = np.where(OBJECT, 1024, 0).astype(np.uint16)
    numbers[HEIGHT // 4 : HEIGHT // 4 + 5][:, WIDTH // 4 : WIDTH // 2] = 3
    numbers[50:] = 40000
    return Image.fromarray(numbers)


def test_object_numbers_of_16_bits_are_refused_without_id(tmp_path):
    write_capture_with_masks(tmp_path / "s", "masks", numbered_16_bit)
    message = refusal_before_writing(tmp_path / "s")
    assert ".png" in message and re.search(r"\bid\b", message), message


def test_two_object_numbers_of_16_bits(tmp_path):
    truth = write_capture_with_masks(tmp_path / "s", "masks", numbered_16_bit)
    _, out, _ = run_with_messages(tmp_path / "s", masks={"id": [3, 1024]})
    assert_masked_views(out, truth.world_to_camera)


# ------------------------------------------------------------------------- masks that are no pictures, or lie beside


def write_capture_without_masks(folder: Path) -> list[str]:
    """Write a COLMAP capture without masks; return the names of its views."""
    truth = make_truth()
    write_capture(folder, "colmap", truth)
    shutil.rmtree(folder / "masks")
    return sorted(truth.world_to_camera)


OUTLINE = [[24, 18], [47, 18], [47, 35], [24, 35]]  # of `OBJECT`, through the centers of its outer pixels
POLYGON = {"shape_type": "polygon", "points": OUTLINE}


def box_shape(mask: np.ndarray, corner: tuple[int, int]) -> dict:
    """Return labelme's shape for a mask, bool [H, W], of the box that begins at the pixel `corner`."""
    file, (x, y), (height, width) = io.BytesIO(), corner, mask.shape
    Image.fromarray(mask).save(file, "png")
    points = [[float(x), float(y)], [x + width - 1.0, y + height - 1.0]]
    return {"shape_type": "mask", "points": points, "mask": base64.b64encode(file.getvalue()).decode()}


def labelme_record(shape: dict) -> dict:
    return {"imageWidth": WIDTH, "imageHeight": HEIGHT, "shapes": [{"label": "box", **shape}]}


def coco_record(names: list[str], outline: object = None) -> dict:
    size = {"width": WIDTH, "height": HEIGHT}
    outline = outline or [[number for point in OUTLINE for number in point]]
    pictures = [{"id": k, "file_name": f"{name}.png", **size} for k, name in enumerate(names)]
    annotations = [{"image_id": k, "category_id": 1, "segmentation": outline} for k in range(len(names))]
    return {"images": pictures, "annotations": annotations, "categories": [{"id": 1, "name": "box"}]}


@pytest.mark.parametrize(
    ("place", "shape"), [("masks", POLYGON), ("images", POLYGON), ("images", box_shape(OBJECT[18:36, 24:48], (24, 18)))]
)
def test_outlines_of_labelme_in_a_folder_or_beside_pictures(tmp_path, place, shape):
    names = write_capture_without_masks(tmp_path / "s")
    for name in names:
        (tmp_path / "s" / place).mkdir(exist_ok=True)
        (tmp_path / "s" / place / f"{name}.json").write_text(json.dumps(labelme_record(shape)))
    roles = read_scene(Params(), tmp_path / "s")[1]
    assert {name: path.name for name, path in roles.masks[""].items()} == {name: f"{name}.json" for name in names}
    _, out, _ = run_with_messages(tmp_path / "s")
    assert_masked_views(out, names)


@pytest.mark.parametrize("spec", [None, "annotations/instances.json"])
def test_outlines_of_coco(tmp_path, spec):
    names, file = write_capture_without_masks(tmp_path / "s"), tmp_path / "s/annotations/instances.json"
    file.parent.mkdir()
    file.write_text(json.dumps(coco_record(names)))
    _, out, _ = run_with_messages(tmp_path / "s", masks=spec)
    assert_masked_views(out, names)
    read = raw_masks_plan.scene_files(raw_masks.Params(masks=spec), tmp_path / "s", [])
    assert read == [file]


BLOBS = cv2.resize(np.random.default_rng(3).random((9, 12)), (WIDTH, HEIGHT)) < 0.5


def test_labelme_box_lies_at_its_pixels(tmp_path):
    (tmp_path / "x.json").write_text(json.dumps(labelme_record(box_shape(BLOBS[5:40, 7:60], (7, 5)))))
    truth = np.zeros_like(BLOBS)
    truth[5:40, 7:60] = BLOBS[5:40, 7:60]
    assert np.array_equal(load_given_mask(tmp_path / "x.json"), truth)


def test_labelme_box_of_another_size_is_refused(tmp_path):
    shape = box_shape(BLOBS[5:40, 7:60], (7, 5)) | {"points": [[7, 5], [60, 39]]}
    (tmp_path / "x.json").write_text(json.dumps(labelme_record(shape)))
    with pytest.raises(BadInput, match=r"x\.json: a mask of 53 x 35 pixels in a box of 54 x 35; draw it anew$"):
        load_given_mask(tmp_path / "x.json")


# the runs of `OBJECT`, by pycocotools.mask.encode
RUNS_TEXT = "bf1b0f1000000000000000000000000000000000000000000000^[3"


def compress_runs(runs: list[int]) -> str:
    """Return lengths of runs as pycocotools writes them: base 32, signed, from the fourth on as differences."""
    text = ""
    for k, run in enumerate(runs):
        rest, ends = run - (runs[k - 2] if k > 2 else 0), False
        while not ends:
            rest, digit = divmod(rest, 32)
            ends = rest == (-1 if digit >= 16 else 0)
            text += chr(48 + digit + (0 if ends else 32))
    return text


def load_runs(folder: Path, text: str) -> np.ndarray:
    """Return the mask of a COCO file whose compressed runs are `text`."""
    record = coco_record(["v"], {"size": [HEIGHT, WIDTH], "counts": text})
    (folder / "c.json").write_text(json.dumps(record))
    return load_given_mask(folder / "c.json/v.png")


@pytest.mark.parametrize("mask", [BLOBS, ~BLOBS, OBJECT, np.ones_like(OBJECT)])
def test_compressed_runs_of_coco(tmp_path, mask):
    runs = [len(list(group)) for _, group in itertools.groupby(mask.T.ravel())]
    assert np.array_equal(load_runs(tmp_path, compress_runs([0, *runs] if mask[0, 0] else runs)), mask)


def test_compressed_runs_as_pycocotools_writes_them(tmp_path):
    assert np.array_equal(load_runs(tmp_path, RUNS_TEXT), OBJECT)


@pytest.mark.parametrize("text", ["abc", "0 1", "0é", "5N", f"{RUNS_TEXT}o"])
def test_damaged_compressed_runs_are_refused(tmp_path, text):
    with pytest.raises(BadInput, match=r"c\.json/v\.png: its compressed runs are damaged; export it anew$"):
        load_runs(tmp_path, text)


def test_compressed_runs_that_are_cut_off_are_refused(tmp_path):
    with pytest.raises(BadInput, match=rf"v\.png: its runs cover \d+ pixels of {WIDTH * HEIGHT}; export it anew$"):
        load_runs(tmp_path, RUNS_TEXT[:12])


@pytest.mark.parametrize("extra", [True, False])
@pytest.mark.parametrize("style", ["{}", "{}_png.rf.0a1b"])
def test_pictures_with_names_of_roboflow(tmp_path, extra, style):
    """The photographs have their original names, or those of the export. Newer exports keep the original ones."""
    names = [f"IMG_{k}" for k in range(4)]
    write_pictures(tmp_path / "images", [style.format(name) for name in names])
    record = coco_record([f"{name}_png.rf.0a1b" for name in names])
    for name, picture in zip(names, record["images"], strict=True):
        picture |= {"extra": {"name": f"{name}.png"}} if extra else {}
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks/_annotations.coco.json").write_text(json.dumps(record))
    found = read_scene(Params(), tmp_path)[1].masks[""]
    assert {view: path.stem for view, path in found.items()} == {
        style.format(name): f"{name}_png.rf.0a1b" for name in names
    }


def test_two_versions_of_a_picture_by_roboflow_are_refused(tmp_path):
    write_pictures(tmp_path / "images", ["a", "b", "c"])
    (tmp_path / "masks").mkdir()
    record = coco_record(["a_png.rf.01", "a_png.rf.02", "b_png.rf.03"])
    (tmp_path / "masks/_annotations.coco.json").write_text(json.dumps(record))
    assert re.search(r"a_png\.rf\.02\.png: 'a' has another mask, .*a_png\.rf\.01\.png; ", refusal_message(tmp_path))


def test_several_masks_for_each_picture_are_refused(tmp_path):
    """Segment Anything's automatic generator writes them."""
    for name in write_capture_without_masks(tmp_path):
        write_masks(tmp_path / "masks" / name, ["0", "1", "2"])
        (tmp_path / "masks" / name / "metadata.csv").write_text("id,area\n0,1\n")
    place = tmp_path / "masks/v00"
    assert refusal_message(tmp_path) == (
        f"{place}: a folder of several masks for one picture; copy the object's to {place}.png, and move the folder "
        "elsewhere"
    )


@pytest.mark.parametrize(
    ("place", "spec"), [(".", None), ("masks", None), ("masks", "masks"), (".", "annotations.xml")]
)
def test_annotations_of_cvat_are_not_read(tmp_path, place, spec):
    write_capture_without_masks(tmp_path)
    file = tmp_path / place / "annotations.xml"
    file.parent.mkdir(exist_ok=True)
    file.write_text("<annotations/>")
    assert refusal_message(tmp_path, masks=spec) == (
        f'{file}: CVAT\'s annotations.xml is not read; export "Segmentation mask 1.1" and copy SegmentationClass/*.png '
        "to masks, or export COCO"
    )


def test_arrays_of_one_mask(tmp_path):
    names = write_capture_without_masks(tmp_path / "s")
    (tmp_path / "s/masks").mkdir()
    for name in names:
        np.save(tmp_path / f"s/masks/{name}.npy", OBJECT[None])
    _, out, _ = run_with_messages(tmp_path / "s")
    assert_masked_views(out, names)


@pytest.mark.parametrize("name", ["mask_{}", "dynamic_mask_{}", "{}_mask", "{}-mask", "{}_seg"])
def test_masks_beside_pictures_are_no_photographs(tmp_path, name):
    """`mask_of_gold` has no partner, so it is a photograph."""
    views = ["v00", "v01", "v02", "mask_of_gold"]
    write_pictures(tmp_path / "images", views)
    write_masks(tmp_path / "images", [name.format(view) for view in views])
    capture, roles = read_scene(Params(), tmp_path)
    assert sorted(capture.pictures) == sorted(views)
    assert {view: path.stem for view, path in roles.masks[""].items()} == {view: name.format(view) for view in views}


def test_files_that_are_not_read_as_masks_are_counted(tmp_path):
    names = write_capture_without_masks(tmp_path / "s")
    (tmp_path / "s/masks").mkdir()
    for name in names:
        np.savez(tmp_path / f"s/masks/{name}.npz", OBJECT)
    assert "; masks holds 6 .npz, not read as masks" in refusal_message(tmp_path / "s")


def test_pictures_that_are_not_read_are_named_and_their_masks_are_no_mistake(tmp_path):
    write_capture(tmp_path / "s", "colmap", make_truth())
    (tmp_path / "s/images/v99.jxl").write_bytes(b"x")
    write_masks(tmp_path / "s/masks", ["v99"])
    _, _, sentences = run_with_messages(tmp_path / "s")
    assert any("images holds 1 .jxl pictures" in each for each in sentences), sentences


def test_photographs_with_transparent_pixels_are_named(tmp_path):
    truth = make_truth()
    write_capture(tmp_path / "s", "colmap", truth)
    picture = np.full((HEIGHT, WIDTH, 4), 90, np.uint8)
    picture[..., 3], picture[60:, :, 3] = 255, 0
    Image.fromarray(picture).save(tmp_path / "s/images/v01.png")
    _, out, sentences = run_with_messages(tmp_path / "s")
    assert_message(sentences, "1 photograph has transparent pixels, which are trained on as black: v01")
    trained = np.array(Image.open(out / "images/v01.png"))
    assert (trained[:50] == 90).all() and not trained[65:].any()


# ------------------------------------------------------------------------------------------------- references


def test_reference_and_its_depth_among_photographs_of_input(tmp_path):
    folder, names = tmp_path / "s", [f"IMG_{k}" for k in range(6)]
    write_pictures(folder / "input", [*names, "clean plate"], ending=".jpg")
    Image.fromarray(np.full((HEIGHT, WIDTH), 4000, np.uint16)).save(folder / "input/clean plate depth.png")
    write_masks(folder / "masks", names)
    reference = {"view": "IMG_2", "image": "input/clean plate.jpg", "depth": "input/clean plate depth.png"}
    notes = preview_stages(folder, reference=reference)
    assert_message(notes, "6 photographs build the scene")
    assert_message(notes, "6 masks")
    assert_message(notes, "the poses of 6 photographs are computed")


def test_two_references_beside_pictures_of_llff(tmp_path):
    folder, truth = tmp_path / "s", make_truth()
    write_capture(folder, "llff", truth)
    write_pictures(folder / "images_4", ["v00_inpainted", "v03_inpainted"])
    references = [{"view": f"v0{k}", "image": f"images_4/v0{k}_inpainted.png"} for k in (0, 3)]
    scene, out, _ = run_with_messages(folder, reference=references)
    assert scene.train == tuple(sorted(truth.world_to_camera))
    assert_cameras(scene, truth)
    assert_masked_views(out, truth.world_to_camera)


# ------------------------------------------------------------------- pictures paired with poses by order


@pytest.mark.parametrize("marked", ["clicks", "masks"])
def test_pictures_called_test_are_test_views(tmp_path, marked):
    """Inpaint360GS has photographs without the object, test_*, beside the others; clicks bring no masks to tell."""
    names = [f"IMG_{k}" for k in range(4)] + ["test_IMG_1", "test_IMG_2"]
    truth = make_truth()
    renamed = rename_views(truth, dict(zip(sorted(truth.world_to_camera), names, strict=True)))
    write_capture(tmp_path / "c", "colmap", renamed)
    if marked == "clicks":
        shutil.rmtree(tmp_path / "c/masks")
    else:
        for path in (tmp_path / "c").rglob("masks/test_*"):
            path.unlink()
    params = {"clicks": {"IMG_0": [[30, 30, "+"]]}} if marked == "clicks" else {}
    scene, _, sentences = run_with_messages(tmp_path / "c", **params)
    assert scene.test == ("test_IMG_1", "test_IMG_2") and scene.train == tuple(names[:4])
    assert_message(sentences, "4 photographs build the scene; 2 are kept to test it")
    scene, _, _ = run_with_messages(tmp_path / "c", train=names, **params)
    assert len(scene.train) == 6
