"""What a job was given and made of it, as pictures: masks, references, views completed beside them, depth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from reffusion.io.arrays import load_json
from reffusion.io.images import load_exr, load_image, load_mask
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_scene
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians
from report import before_after, inline_images, page
from report.check import overlay_masks, view_role
from report.job_data import Job
from report.sheet import pick_evenly

MAX_MASK_VIEWS, FIRST_MASK_VIEWS, MASK_SIDE = 60, 12, 240  # views; those that are seen at once; px a side
REFERENCE_SIDE, DEPTH_SIDE = 640, 480  # px a side
DEPTH_VIEWS = 4  # views
REMOVED, INVENTED = (255, 210, 0), (0, 230, 230)  # outlines over photographs
MIN_ALPHA = 0.5  # alpha under which there is no depth
RESULTS = ("distill", "initialize", "fit")  # the last of what is there


def masks_section(job: Job) -> list[str]:
    """Masks over photographs: the given ones tinted, what the stage masks made of them outlined."""
    poses, given = (job.folders.get(stage, Path()) for stage in ("poses", "raw_masks"))
    top = page.heading("Masks")
    if not (poses / "views.json").is_file() or not any((given / "masks").rglob("*.png")):
        return [top, page.paragraph("None: nothing is marked in the photographs.")]
    views = load_json(poses / "views.json")
    shown = pick_evenly(sorted(views["train"]), MAX_MASK_VIEWS)
    cell = lambda name: (
        inline_images.photo_address(draw_mask_classes(job, poses, name), MASK_SIDE),
        f"{name}, {view_role(name, views)}",
    )
    first = pick_evenly(shown, FIRST_MASK_VIEWS)
    rest = [name for name in shown if name not in first]
    more = (
        f"<details><summary>{len(rest)} more</summary>{inline_images.picture_grid(list(map(cell, rest)))}</details>"
        if rest
        else ""
    )
    words = "Magenta: the mask as given. "
    if "masks" in job.folders:
        words += "Yellow line: what all views agreed to remove. Cyan line: what no photograph shows and was made up. "
    else:
        words += "What all views agree on comes with the stage masks. "
    words += f"{len(shown)} of {len(views['train'])} training views."
    return [top, page.paragraph(words, quiet=True), inline_images.picture_grid(list(map(cell, first))), more]


def draw_mask_classes(job: Job, poses: Path, name: str) -> np.ndarray:
    """uint8 [h, w, 3]: the photograph, small, its mask over it, and the outlines of its pixel classes."""
    small = np.ascontiguousarray(overlay_masks(poses, job.folders.get("raw_masks", Path()), name))
    for kind, colour in (("consistent", REMOVED), ("invent", INVENTED)):
        path = job.folders.get("masks", Path()) / kind / f"{name}.png"
        if "masks" in job.folders and path.is_file():
            draw_outline(small, load_mask(path), colour)
    return small


def draw_outline(picture: np.ndarray, mask: np.ndarray, colour: tuple[int, int, int]) -> None:
    """Draw a mask's outline into a picture, uint8 [H, W, 3], of any size."""
    scale = picture.shape[1] / mask.shape[1]
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    moved = [((contour + 0.5) * scale - 0.5).round().astype(np.int32) for contour in contours]
    cv2.polylines(picture, moved, True, colour, 1 if picture.shape[1] < 400 else 2)


def references_section(job: Job) -> list[str]:
    """Each reference beside its photograph, the hole outlined, and how it fits or was made."""
    folder, poses = job.folders.get("reference", Path()), job.folders.get("poses", Path())
    top = page.heading("References")
    if "reference" not in job.folders:
        return [top, page.paragraph("None: the stage reference has not run, or was left out.")]
    facts = _facts(folder)
    parts = [top]
    for path in sorted((folder / "references").glob("*.png")):
        name, picture = path.stem, load_image(path)
        draw_outline(picture, load_mask(folder / "masks" / path.name), INVENTED)
        cells = [
            (
                inline_images.photo_address(picture, REFERENCE_SIDE),
                f"{name}, the hole outlined: {_origin(facts, folder, name)}",
            )
        ]
        photo = poses / "images" / path.name
        if photo.is_file():
            cells.insert(0, (inline_images.photo_address(load_image(photo), REFERENCE_SIDE), f"{name}, photograph"))
        depth = job.folders.get("initialize", Path()) / "depth" / f"{name}.exr"
        if "initialize" in job.folders and depth.is_file():
            cells.append(
                (
                    inline_images.photo_address(color_disparity([load_exr(depth)])[0], REFERENCE_SIDE),
                    "its depth behind the object",
                )
            )
        parts.append(inline_images.picture_grid(cells))
    return [*parts, *extra_views_section(job)]


def _facts(folder: Path) -> dict:
    return load_json(folder / "facts.json") if (folder / "facts.json").is_file() else {}


def _origin(facts: dict, folder: Path, name: str) -> str:
    """Where a reference comes from, and how well it fits."""
    if name in facts.get("given", ()):
        return f"given; {facts.get('fits', {}).get(name, 'how well it fits was not recorded')}"
    path = folder / "candidates.json"
    said = load_json(path) if path.is_file() else {}
    if "painter" in said:
        return f"painted by {said['painter']}"
    way = "put together from patches of the photographs" if "misfits" in said else "painted by the diffusion model"
    scores = said.get("misfits") or said.get("seams") or []
    return f"{way}, the best of {len(scores)} tries" if len(scores) > 1 else way


def extra_views_section(job: Job) -> list[str]:
    """The views that were completed beside the references, and why."""
    folder = job.folders.get("initialize", Path())
    shares = _facts(folder).get("further", {}) if "initialize" in job.folders else {}
    if not shares:
        return []
    said = "No reference shows what was open there: these views were put together from patches of the photographs."
    cells = [
        (
            inline_images.photo_address(load_image(folder / "further" / f"{view}.png"), DEPTH_SIDE),
            f"{view}: {share:.1%} of its mask",
        )
        for view, share in shares.items()
    ]
    return [page.heading("Further views", 3), page.paragraph(said), inline_images.picture_grid(cells)]


def depth_section(job: Job) -> list[str]:
    """Depth of a few views before and after, in the same colours."""
    there = [s for s in RESULTS if s in job.folders and (job.folders[s] / "gaussians.ply").is_file()]
    top = page.heading("Depth, before and after")
    if not there or "fit" not in there or "poses" not in job.folders:
        return [top, page.paragraph("None yet: the stage fit has not run.")]
    scene = load_scene(job.folders["poses"])
    names = pick_evenly(before_after.rendered_views(job) or list(scene.train), DEPTH_VIEWS)
    states = {"with the object": "fit"} | ({f"after {there[0]}": there[0]} if len(there) > 1 else {})
    loaded = {words: load_ply(job.folders[stage] / "gaussians.ply") for words, stage in states.items()}
    cells = []
    for name in names:
        drawn = color_disparity([render_depth(gaussians, scene.cameras[name]) for gaussians in loaded.values()])
        for words, picture in zip(loaded, drawn, strict=True):
            cells.append((inline_images.photo_address(picture, DEPTH_SIDE), f"{name}, {words}"))
    said = "Bright is near; pairs share a scale; grey where nothing is."
    return [top, page.paragraph(said, quiet=True), inline_images.picture_grid(cells)]


def render_depth(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """[H, W] camera z, 0 where nothing is."""
    drawn = rasterizer.render(gaussians, camera, sh_degree=0)
    return np.where(drawn.alpha.numpy() > MIN_ALPHA, drawn.depth.numpy(), 0.0)


def color_disparity(depths: list[np.ndarray]) -> list[np.ndarray]:
    """uint8 [H, W, 3] each: disparity, on the scale of the first."""
    from matplotlib import colormaps

    near = [np.where(depth > 0, 1 / np.where(depth > 0, depth, 1.0), np.nan) for depth in depths]
    known = near[0][np.isfinite(near[0])]
    low, high = np.percentile(known, (1, 99)) if len(known) else (0.0, 1.0)
    made = []
    for disparity in near:
        level = np.clip((disparity - low) / max(high - low, 1e-9), 0, 1)
        picture = (colormaps["inferno"](np.nan_to_num(level))[..., :3] * 255).round().astype(np.uint8)
        picture[~np.isfinite(disparity)] = 128
        made.append(picture)
    return made
