"""Reading of masks from annotation files: outlines that labelme or COCO's tools wrote as .json.

labelme writes a file for each picture. A COCO file holds the outlines of many pictures. The mask of one of them has the
path of the file, followed by the picture's file name, as if the file were a folder: `masks/instances.json/IMG_1.png`.
"""

from __future__ import annotations

import math
import re
from base64 import b64decode
from collections.abc import Iterable
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from reffusion.io.arrays import load_json
from reffusion.io.files import BadInput, as_bad_input, check_pixels

KIND = "outlines of labelme or COCO"


def is_annotation(path: Path) -> bool:
    """Return whether a path is a .json file, or the path of a picture in one."""
    return file_of(path).suffix.lower() == ".json"


def file_of(path: Path) -> Path:
    """Return the file that holds a mask: the .json file for the path of a picture in it, else the path itself."""
    return next((each for each in path.parents if each.suffix.lower() == ".json" and each.is_file()), path)


def is_labelme(path: Path) -> bool:
    """Return whether a .json file is labelme's, for one picture. Raises BadInput if the file is unreadable."""
    return "shapes" in _load(path)


def annotated_pictures(path: Path) -> list[str]:
    """Return the sorted file names of the pictures with outlines in a COCO file; empty for other .json files.

    Pictures without outlines are left out: nothing tells whether they show no object, or were not annotated yet.
    Raises BadInput if the file is unreadable.
    """
    record = _load(path)
    with as_bad_input(path, KIND):
        named = {each["image_id"] for each in record.get("annotations", ())}
        return sorted(_file_name(each) for each in record.get("images", ()) if each["id"] in named)


def original_names(path: Path, names: Iterable[str]) -> dict[str, str]:
    """Return file name -> the original name of the picture, to which Roboflow adds a hash.

    Args:
        path: a COCO file, or a folder, which gives an empty result.
        names: file names of pictures in the COCO file.
    """
    if not path.is_file():
        return {}
    with as_bad_input(path, KIND):
        originals = {_file_name(each): _original_name(each) for each in _load(path)["images"]}
        return {name: originals[name] for name in names}


def annotation_size(path: Path) -> tuple[int, int]:
    """Return the (width, height) in px of the picture whose outlines are at `path`; raises BadInput if unreadable."""
    file, record = file_of(path), _load(file_of(path))
    with as_bad_input(file, KIND):
        names = ("imageWidth", "imageHeight") if file == path else ("width", "height")
        width, height = (int((record if file == path else _picture(record, path))[name]) for name in names)
    check_pixels(path, width, height)
    return width, height


def load_annotation(path: Path, categories: tuple[int, ...] = ()) -> np.ndarray:
    """Return the mask at `path`, bool [H, W], True inside the outlines.

    Outlines themselves belong to the mask, as in labelme's own export. COCO's may be polygons or runs.

    Args:
        categories: numbers of the categories of a COCO file that are the object; empty if there is only one, and for
            labelme's files.

    Raises:
        BadInput: the file is unreadable, or has outlines of several labels, of several categories without
            `categories`, or of another kind. The message names the file.
    """
    file, record, (width, height) = file_of(path), _load(file_of(path)), annotation_size(path)
    with as_bad_input(file, KIND):
        if file == path:
            return _draw(path, _one_label(path, record["shapes"], categories), (width, height))
        chosen = _chosen_categories(file, record, categories)
        number, mask = _picture(record, path)["id"], np.zeros((height, width), bool)
        for each in record["annotations"]:
            if each["image_id"] == number and each["category_id"] in chosen:
                mask |= _outline(path, each["segmentation"], (width, height))
        return mask


def _load(file: Path) -> dict[str, Any]:
    """Read a .json file; {} if it holds anything else than an object. Files are kept, because COCO's are large."""
    return _load_once(file, file.stat().st_mtime_ns) if file.is_file() else load_json(file)


@lru_cache(maxsize=2)
def _load_once(file: Path, _changed: int) -> dict[str, Any]:
    """Read a .json file as `_load` does; the cache is keyed by the file and its time of change."""
    record = load_json(file)
    return record if isinstance(record, dict) else {}


def _file_name(picture: dict[str, Any]) -> str:
    """Return a COCO file's name of a picture, relative, so that it can follow the path of the file."""
    return str(picture["file_name"]).replace("\\", "/").lstrip("/")


def _original_name(picture: dict[str, Any]) -> str:
    """Return the original name that Roboflow keeps, else `A.jpg` for `A_jpg.rf.HASH.jpg`, else the file name."""
    match picture:
        case {"extra": {"name": str(name)}}:
            return name
    return re.sub(r"_([^\W_]+)\.rf\.[^./]+\.\w+$", r".\1", _file_name(picture))


def _picture(record: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the entry of a COCO file for the picture that `path` names."""
    name = path.relative_to(file_of(path)).as_posix()
    return next(each for each in record["images"] if Path(_file_name(each)).as_posix() == name)


def _one_label(path: Path, shapes: list[dict[str, Any]], categories: tuple[int, ...]) -> list[dict[str, Any]]:
    """Return labelme's shapes. Raises BadInput if they have several labels, or if `categories` is not empty."""
    labels = sorted({str(shape["label"]) for shape in shapes})
    if len(labels) > 1 or categories:
        found = f"{len(labels)} labels ({', '.join(labels)})" if len(labels) > 1 else "labels are no object numbers"
        raise BadInput(f"{path}: {found}; leave the object's outlines, and write no `id` in scene.yaml")
    return shapes


def _chosen_categories(file: Path, record: dict[str, Any], categories: tuple[int, ...]) -> set[int]:
    """Return the categories of a COCO file that are the object. Raises BadInput if this is ambiguous."""
    used = {each["category_id"] for each in record["annotations"]}
    names = {each["id"]: each["name"] for each in record.get("categories", ())}
    if len(used) > 1 and not categories:
        found = ", ".join(f"{number} {names.get(number, '')}".strip() for number in sorted(used))
        raise BadInput(
            f"{file}: {len(used)} categories ({found}); name the object's in scene.yaml: `masks: {{folder: ..., id: "
            f"{min(used)}}}`"
        )
    return used & set(categories) if categories else used


def _draw(path: Path, shapes: Iterable[dict[str, Any]], size: tuple[int, int]) -> np.ndarray:
    """Return the area of shapes as labelme writes them, bool [H, W]."""
    canvas = Image.new("L", size)
    draw = ImageDraw.Draw(canvas)
    for shape in shapes:
        kind, points = shape.get("shape_type", "polygon"), [tuple(map(float, point)) for point in shape["points"]]
        if kind == "polygon" and len(points) > 2:
            draw.polygon(points, fill=1, outline=1)
        elif kind == "rectangle":
            (x, y), (right, bottom) = np.sort(points, axis=0).tolist()
            draw.rectangle((x, y, right, bottom), fill=1, outline=1)
        elif kind == "circle":
            radius = math.dist(*points)
            draw.circle(points[0], radius, fill=1, outline=1)
        elif kind == "mask":
            _paste_box(path, canvas, points, shape["mask"])
        else:
            raise BadInput(f"{path}: a {kind} of {len(points)} points is no area; draw polygons, rectangles or circles")
    return np.array(canvas) > 0


def _paste_box(path: Path, canvas: Image.Image, points: list[tuple[float, ...]], png: str) -> None:
    """Add the white pixels of labelme's mask of a box to the canvas.

    Args:
        points: the box's first and last pixel.
        png: a PNG of the box, in base64.
    """
    box = Image.open(BytesIO(b64decode(png)))
    (x, y), (right, bottom) = np.sort(points, axis=0).astype(int).tolist()
    width, height = right - x + 1, bottom - y + 1
    if box.size != (width, height):
        raise BadInput(
            f"{path}: a mask of {box.width} x {box.height} pixels in a box of {width} x {height}; draw it anew"
        )
    canvas.paste(1, (x, y), Image.fromarray(np.array(box) > 0))


def _outline(path: Path, outline: Any, size: tuple[int, int]) -> np.ndarray:
    """Return the area of one annotation of a COCO file, bool [H, W]: polygons, or runs of columns."""
    if isinstance(outline, list) and outline:
        return _draw(path, [{"points": np.reshape(polygon, (-1, 2))} for polygon in outline], size)
    if not outline:
        raise BadInput(f"{path}: boxes without outlines are not read; export polygons")
    runs = outline["counts"]
    if isinstance(runs, str):
        runs = _decompress(path, runs)
    if sum(runs) != size[0] * size[1]:
        raise BadInput(f"{path}: its runs cover {sum(runs)} pixels of {size[0] * size[1]}; export it anew")
    columns = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
    return columns.reshape(size).T


def _decompress(path: Path, text: str) -> list[int]:
    """Return the lengths of the runs in a text of pycocotools.

    A character holds 5 bits of a number, low bits first, and a bit that says whether more follow. From the fourth on,
    numbers are differences to the length two before.
    """
    runs: list[int] = []
    number = shift = 0
    for bits in (ord(character) - 48 for character in text):
        number |= (bits & 0x1F) << shift
        shift += 5
        if not bits & 0x20:
            number -= (bits & 0x10) << (shift - 4)  # the sign
            runs.append(number + (runs[-2] if len(runs) > 2 else 0))
            number = shift = 0
    if shift or min(runs, default=0) < 0 or not all("0" <= character <= "o" for character in text):
        raise BadInput(f"{path}: its compressed runs are damaged; export it anew")
    return runs
