"""Masks that a user made: pictures of every kind, cut-outs, arrays and outlines; and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from reffusion.io.annotations import annotated_pictures
from reffusion.io.files import BadInput
from reffusion.io.given_masks import MaskValues, load_given_mask, mask_file_size

WIDTH, HEIGHT = 96, 72
OBJECT = np.zeros((HEIGHT, WIDTH), bool)
OBJECT[20:44, 16:64] = True
FULL = 255 * OBJECT.astype(np.uint8)
# a picture of many colors, none of them near black
NOISE = np.random.default_rng(0).integers(0, 256, (9, 12, 3), dtype=np.uint8)
PHOTO = np.clip(cv2.resize(NOISE, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC), 50, 255)
REFUSED = "a photograph, not a mask; save white where the object is, black elsewhere"


def on_black(colors) -> np.ndarray:
    return (OBJECT[..., None] * np.asarray(colors)).astype(np.uint8)


def with_alpha(colors: np.ndarray, alpha: np.ndarray = FULL) -> Image.Image:
    return Image.fromarray(np.dstack([colors, alpha]))


def share_wrong(path: Path, truth: np.ndarray = OBJECT) -> float:
    """Return the number of wrong pixels of a mask, as a share of the object's pixels."""
    return float((load_given_mask(path) ^ truth).sum() / truth.sum())


def refusal(path: Path, **options) -> str:
    with pytest.raises(BadInput) as caught:
        load_given_mask(path, **options)
    return str(caught.value).removeprefix(f"{path.parent}/")


def palette(numbers: np.ndarray, *colors: int) -> Image.Image:
    image = Image.fromarray(numbers.astype(np.uint8), "P")
    image.putpalette(colors)
    return image


# --------------------------------------------------------------------------------------------- pictures of two levels


def test_masks_of_every_kind(tmp_path):
    truth = np.random.default_rng(0).random((6, 8)) < 0.5
    one, full = truth.astype(np.uint8), truth.astype(np.uint8) * 255
    pictures = {
        "one": Image.fromarray(one),
        "full": Image.fromarray(full),
        "bit": Image.fromarray(truth),
        "rgb": Image.fromarray(np.dstack([full, full, full])),
        "rgba": Image.fromarray(np.dstack([one, one, one, np.full_like(one, 255)])),
        "palette": palette(one * 3, *[0, 0, 0] * 3, 200, 0, 0),
        "deep": Image.fromarray(one.astype(np.uint16) * 65535),
        "gray": Image.fromarray(one * 200),
        "cmyk": Image.fromarray(np.dstack([full, full, full])).convert("CMYK"),
        "float": Image.fromarray(truth.astype(np.float32)),
        "float to 255": Image.fromarray(full.astype(np.float32)),
    }
    for name, picture in pictures.items():
        path = tmp_path / f"{name}.{'tif' if name in ('cmyk', 'float', 'float to 255') else 'png'}"
        picture.save(path)
        assert np.array_equal(load_given_mask(path), truth), name
        assert mask_file_size(path) == (8, 6)
    assert np.array_equal(load_given_mask(tmp_path / "one.png", (3, 4)), truth[1::2, 1::2])


@pytest.mark.parametrize("quality", [50, 90])
@pytest.mark.parametrize("color", [(255, 255, 255), (128, 0, 0), (0, 128, 0), (192, 128, 128), (200, 200, 200)])
def test_lossy_masks_of_one_color(tmp_path, color, quality):
    """The threshold lies between the levels: half of a red of 128 is 64. JPEG halves the resolution of hues."""
    large = np.kron(OBJECT, np.ones((4, 4), bool))
    Image.fromarray((large[..., None] * np.array(color)).astype(np.uint8)).save(tmp_path / "x.jpg", quality=quality)
    assert share_wrong(tmp_path / "x.jpg", large) < 0.03


def test_lossy_masks_of_a_layout_program(tmp_path):
    Image.fromarray(FULL).convert("RGB").convert("CMYK").save(tmp_path / "x.jpg", quality=95)
    assert share_wrong(tmp_path / "x.jpg") == 0


@pytest.mark.parametrize("deviation", [1, 2, 4])
def test_soft_edges_end_at_one_half(tmp_path, deviation):
    soft = cv2.GaussianBlur(FULL, (0, 0), deviation)
    Image.fromarray(soft).save(tmp_path / "x.png")
    assert np.array_equal(load_given_mask(tmp_path / "x.png"), soft >= 128)
    Image.fromarray(soft / np.float32(255)).save(tmp_path / "x.tif")
    assert np.array_equal(load_given_mask(tmp_path / "x.tif"), soft >= 128)


@pytest.mark.parametrize("level", [0, 255])
@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_empty_and_full_masks(tmp_path, level, ending):
    Image.fromarray(np.full((HEIGHT, WIDTH), level, np.uint8)).save(tmp_path / f"x.{ending}")
    assert (load_given_mask(tmp_path / f"x.{ending}") == (level > 0)).all()


def test_other_values_are_refused(tmp_path):
    Image.fromarray(np.array([[0, 1, 7]], np.uint8)).save(tmp_path / "x.png")
    assert "its values (7) are neither 0/1 nor 0/255" in refusal(tmp_path / "x.png")
    numbers = np.full((HEIGHT, WIDTH), 7, np.uint8)
    numbers[OBJECT] = 200
    Image.fromarray(numbers).save(tmp_path / "x.png")
    assert "its values (200) are neither" not in str(load_given_mask(tmp_path / "x.png"))  # 7 is nearly black
    numbers[:9] = 90
    Image.fromarray(numbers).save(tmp_path / "x.png")
    assert "its values (90, 200) are neither 0/1 nor 0/255" in refusal(tmp_path / "x.png")


def test_masks_of_several_colors_are_refused(tmp_path):
    colors = on_black((255, 0, 0))
    colors[50:60] = (0, 0, 255)
    Image.fromarray(colors).save(tmp_path / "x.png")
    assert refusal(tmp_path / "x.png") == (
        "x.png: 2 colors beside black; write white where the object is, black elsewhere"
    )


# ------------------------------------------------------------------------------------------------------------- alpha


@pytest.mark.parametrize("hidden", [PHOTO, on_black(PHOTO), np.where(OBJECT[..., None], PHOTO, 255)])
def test_the_opaque_part_of_a_photograph_is_the_object(tmp_path, hidden):
    with_alpha(hidden.astype(np.uint8)).save(tmp_path / "x.png")
    assert share_wrong(tmp_path / "x.png") == 0


def test_transparent_pixels_of_a_drawn_mask_are_not_the_object(tmp_path):
    """The mask is white on black, and white where it is transparent."""
    gray, alpha = FULL.copy(), np.full_like(FULL, 255)
    gray[:, :10], alpha[:, :10] = 255, 0
    Image.fromarray(np.dstack([gray, alpha])).save(tmp_path / "x.png")
    assert share_wrong(tmp_path / "x.png") == 0


@pytest.mark.parametrize("color", [(255, 255, 255), (200, 0, 0)])
def test_a_shape_on_transparent_ground(tmp_path, color):
    with_alpha(on_black(color)).save(tmp_path / "x.png")
    assert share_wrong(tmp_path / "x.png") == 0


def test_object_numbers_count_where_they_are_opaque(tmp_path):
    alpha = np.full_like(FULL, 255)
    alpha[:30] = 0
    Image.fromarray(np.dstack([OBJECT * np.uint8(15), alpha])).save(tmp_path / "x.png")
    found = load_given_mask(tmp_path / "x.png", values=MaskValues((15,)))
    assert np.array_equal(found, OBJECT & (alpha > 0))


def test_alpha_over_a_single_color_is_refused(tmp_path):
    with_alpha(np.full((HEIGHT, WIDTH, 3), 255, np.uint8)).save(tmp_path / "x.png")
    assert "its alpha differs, its colors do not" in refusal(tmp_path / "x.png")


# -------------------------------------------------------------------------------------------------------- photographs


@pytest.mark.parametrize(("ending", "wrong"), [("png", 0), ("jpg", 0.06)])
def test_all_but_black_is_the_object_of_a_cut_out(tmp_path, ending, wrong):
    cut = on_black(PHOTO)
    cut[30, 30:32] = 0  # a dark dot in the object
    Image.fromarray(cut).save(tmp_path / f"x.{ending}", quality=92)
    assert share_wrong(tmp_path / f"x.{ending}") <= wrong


def test_photographs_are_no_masks(tmp_path):
    tinted = np.where(OBJECT[..., None], 0.4 * PHOTO + 0.6 * np.array([30, 144, 255]), PHOTO).astype(np.uint8)
    for name, picture in (("copy", PHOTO), ("overlay", tinted), ("gray", PHOTO[..., 0])):
        for ending in ("png", "jpg"):
            Image.fromarray(picture).save(tmp_path / f"{name}.{ending}")
            assert refusal(tmp_path / f"{name}.{ending}") == f"{name}.{ending}: {REFUSED}"


def test_a_cut_out_on_white_is_no_mask(tmp_path):
    Image.fromarray(np.where(OBJECT[..., None], PHOTO, 255).astype(np.uint8)).save(tmp_path / "x.png")
    assert refusal(tmp_path / "x.png").startswith("x.png: a photograph cut out on one color; save white")


def test_a_drawing_in_color_may_have_soft_edges(tmp_path):
    soft = cv2.GaussianBlur(on_black((255, 0, 0)), (0, 0), 1)
    Image.fromarray(np.where(soft > 250, 255, soft)).save(tmp_path / "x.png")
    assert share_wrong(tmp_path / "x.png") < 0.1


def test_a_cut_out_that_is_mostly_object_is_ambiguous(tmp_path):
    """It could also be a photograph in which the object was blackened."""
    Image.fromarray(np.where(OBJECT[..., None], 0, PHOTO).astype(np.uint8)).save(tmp_path / "x.png")
    assert refusal(tmp_path / "x.png") == f"x.png: {REFUSED}"


# ---------------------------------------------------------------------------------------------------- arrays, outlines


@pytest.mark.parametrize("array", [OBJECT, OBJECT[None], FULL, OBJECT.astype(np.float32)])
def test_arrays(tmp_path, array):
    np.save(tmp_path / "x.npy", array)
    assert share_wrong(tmp_path / "x.npy") == 0 and mask_file_size(tmp_path / "x.npy") == (WIDTH, HEIGHT)


def test_arrays_of_several_masks_are_refused(tmp_path):
    np.save(tmp_path / "x.npy", np.stack([OBJECT] * 3))
    assert refusal(tmp_path / "x.npy") == (
        "x.npy: an array of 3 x 72 x 96 bool; save one mask, as high and wide as its picture"
    )


CORNERS = [[16, 20], [63, 20], [63, 43], [16, 43]]


def write_labelme(path: Path, *shapes: dict) -> None:
    path.write_text(json.dumps({"imageWidth": WIDTH, "imageHeight": HEIGHT, "shapes": shapes}))


def test_outlines_of_labelme(tmp_path):
    polygon = {"label": "box", "shape_type": "polygon", "points": CORNERS}
    rectangle = {"label": "box", "shape_type": "rectangle", "points": [CORNERS[2], CORNERS[0]]}
    for shape in (polygon, rectangle):
        write_labelme(tmp_path / "x.json", shape)
        assert share_wrong(tmp_path / "x.json") == 0
    assert mask_file_size(tmp_path / "x.json") == (WIDTH, HEIGHT)
    write_labelme(tmp_path / "x.json", {"label": "box", "shape_type": "circle", "points": [[40, 36], [50, 36]]})
    assert load_given_mask(tmp_path / "x.json").sum() == pytest.approx(np.pi * 10.5**2, rel=0.05)
    write_labelme(tmp_path / "x.json")
    assert not load_given_mask(tmp_path / "x.json").any()


def test_outlines_of_labelme_that_are_refused(tmp_path):
    write_labelme(tmp_path / "x.json", *({"label": label, "points": CORNERS} for label in ("box", "ball")))
    assert refusal(tmp_path / "x.json") == (
        "x.json: 2 labels (ball, box); leave the object's outlines, and write no `id` in scene.yaml"
    )
    write_labelme(tmp_path / "x.json", {"label": "box", "shape_type": "line", "points": CORNERS[:2]})
    assert refusal(tmp_path / "x.json") == (
        "x.json: a line of 2 points is no area; draw polygons, rectangles or circles"
    )


def write_coco(path: Path, *annotations: dict) -> None:
    pictures = [{"id": k, "file_name": f"day\\IMG_{k}.jpg", "width": WIDTH, "height": HEIGHT} for k in (4, 5, 6)]
    names = [{"id": 1, "name": "box"}, {"id": 3, "name": "ball"}]
    defaults = {"image_id": 5, "category_id": 1, "segmentation": [[x for corner in CORNERS for x in corner]]}
    found = [defaults | each for each in annotations]
    path.write_text(json.dumps({"images": pictures, "categories": names, "annotations": found}))


def runs_of(mask: np.ndarray) -> list[int]:
    """Return the lengths of the runs of False and True along the columns of a mask, the first of False."""
    flat = mask.T.ravel()
    borders = np.flatnonzero(np.diff(flat)) + 1
    lengths = np.diff([0, *borders, flat.size]).tolist()
    return [0, *lengths] if flat[0] else lengths


@pytest.mark.parametrize(
    "change",
    [{}, {"segmentation": {"size": [HEIGHT, WIDTH], "counts": runs_of(OBJECT)}, "iscrowd": 1}],
    ids=["polygons", "runs"],
)
def test_outlines_of_coco(tmp_path, change):
    file = tmp_path / "instances.json"
    write_coco(file, change)
    assert annotated_pictures(file) == ["day/IMG_5.jpg"]
    assert share_wrong(file / "day/IMG_5.jpg") == 0 and mask_file_size(file / "day/IMG_5.jpg") == (WIDTH, HEIGHT)


def test_categories_of_coco_are_chosen_by_number(tmp_path):
    file = tmp_path / "instances.json"
    write_coco(file, {}, {"category_id": 3, "segmentation": [[0, 0, 9, 0, 9, 9, 0, 9]]})
    assert refusal(file / "day/IMG_5.jpg").endswith(
        "instances.json: 2 categories (1 box, 3 ball); name the object's in scene.yaml: `masks: {folder: ..., id: 1}`"
    )
    found = load_given_mask(file / "day/IMG_5.jpg", values=MaskValues((3,)))
    assert found[:10, :10].all() and found.sum() == 100


@pytest.mark.parametrize(
    ("segmentation", "message"),
    [
        ({"size": [HEIGHT, WIDTH], "counts": "abc"}, "its compressed runs are damaged; export it anew"),
        ({"size": [HEIGHT, WIDTH], "counts": [5, 7]}, "its runs cover 12 pixels of 6912; export it anew"),
        ([], "boxes without outlines are not read; export polygons"),
    ],
)
def test_outlines_of_coco_that_are_refused(tmp_path, segmentation, message):
    write_coco(tmp_path / "instances.json", {"segmentation": segmentation})
    assert refusal(tmp_path / "instances.json/day/IMG_5.jpg").endswith(f"IMG_5.jpg: {message}")
