"""Sections of the report with pictures: masks, references, extra views, depth.

An *extra view* is a further view that the stage `initialize` completed from photographs, because no reference shows
some places that the object hid.
"""

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
from report.job_data import JobFiles
from report.sheet import pick_evenly

MAX_MASK_VIEWS, FIRST_MASK_VIEWS, MASK_SIDE = 60, 12, 240  # most views, views shown unfolded, longer side in px
REFERENCE_SIDE, DEPTH_SIDE = 640, 480  # longer side, px
DEPTH_VIEWS = 4  # number of views
ORIGIN_VIEWS = 6  # number of views
WORDS_OF_ORIGINS = {
    "photographs": "green, other photographs show it:",
    "conflict": "white, photographs show it in another color:",
    "reference": "blue, a reference:",
    "patches": "orange, invented from patches of the photographs:",
    "nothing": "red, no picture shows it:",
}
REMOVED, INVENTED = (255, 210, 0), (0, 230, 230)  # outline colors of consistent masks and of invent masks
MIN_ALPHA = 0.5  # below this alpha there is no depth
RESULTS = ("distill", "initialize", "fit")  # stages with Gaussians, latest first


def masks_section(job: JobFiles) -> list[str]:
    """Return the section on masks: photographs with tinted input masks and the outlines of the pixel classes.

    The photographs are at most `MAX_MASK_VIEWS` training views, evenly chosen. The outlined classes are the consistent
    mask (pixels that show the object, made consistent over all views) and the invent mask (pixels that are made up).
    Both come from the stage `masks`; before this stage no outline is drawn.
    """
    poses, raw_masks = (job.folders.get(stage, Path()) for stage in ("poses", "raw_masks"))
    top = page.heading("Masks")
    if not (poses / "views.json").is_file() or not any((raw_masks / "masks").rglob("*.png")):
        return [top, page.paragraph("None: no photograph has a mask.")]
    views = load_json(poses / "views.json")
    names = pick_evenly(sorted(views["train"]), MAX_MASK_VIEWS)
    cell = lambda name: (
        inline_images.photo_address(draw_mask_classes(job, poses, name), MASK_SIDE),
        f"{name}, {view_role(name, views)}",
    )
    first = pick_evenly(names, FIRST_MASK_VIEWS)
    rest = [name for name in names if name not in first]
    more = (
        f"<details><summary>{len(rest)} more</summary>{inline_images.picture_grid(list(map(cell, rest)))}</details>"
        if rest
        else ""
    )
    words = "Magenta: the input mask. "
    if "masks" in job.folders:
        words += "Yellow line: the removed region, consistent over all views. Cyan line: what no photograph shows. "
    else:
        words += "Consistent masks come with the stage `masks`. "
    words += f"{len(names)} of {len(views['train'])} training views."
    grid = inline_images.picture_grid(list(map(cell, first)))
    return [top, page.paragraph(words, quiet=True), grid, more, *remnant_pictures(job)]


def remnant_pictures(job: JobFiles) -> list[str]:
    """Return HTML parts with pictures of the parts of the object that the masks seem to leave out, largest first.

    The list is empty if the stage `masks` has not run or found no such part.
    """
    pictures = sorted((job.folders.get("masks", Path()) / "remnants").glob("*.png"), key=lambda path: int(path.stem))
    if "masks" not in job.folders or not pictures:
        return []
    cells = [(inline_images.photo_address(load_image(path), MASK_SIDE), f"part {path.stem}") for path in pictures]
    words = "Magenta: parts of the object that the masks seem to leave out; the warnings above say what became of each."
    return [page.paragraph(words, quiet=True), inline_images.picture_grid(cells)]


def draw_mask_classes(job: JobFiles, poses: Path, name: str) -> np.ndarray:
    """Return a photograph, uint8 [h, w, 3], with its input mask tinted and its pixel classes outlined.

    The size is that of `check.overlay_masks`. Masks and classes that do not exist are left out.

    Args:
        poses: folder of the stage `poses`, which has the photographs.
        name: name of the view.
    """
    small = np.ascontiguousarray(overlay_masks(poses, job.folders.get("raw_masks", Path()), name))
    for kind, color in (("consistent", REMOVED), ("invent", INVENTED)):
        path = job.folders.get("masks", Path()) / kind / f"{name}.png"
        if "masks" in job.folders and path.is_file():
            draw_outline(small, load_mask(path), color)
    return small


def draw_outline(picture: np.ndarray, mask: np.ndarray, color: tuple[int, int, int]) -> None:
    """Draw the outline of a mask into a picture, uint8 [H, W, 3], in place.

    Args:
        mask: bool [h, w], True inside, of the picture's aspect but of any size.
        color: RGB.
    """
    scale = picture.shape[1] / mask.shape[1]
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    moved = [((contour + 0.5) * scale - 0.5).round().astype(np.int32) for contour in contours]
    cv2.polylines(picture, moved, True, color, 1 if picture.shape[1] < 400 else 2)


def references_section(job: JobFiles) -> list[str]:
    """Return the section on references: each reference with its outlined hole, beside its photograph and its depth.

    The caption says where the reference comes from and, if it was given by the user, how well it fits its photograph.
    """
    folder, poses = job.folders.get("reference", Path()), job.folders.get("poses", Path())
    top = page.heading("References")
    if "reference" not in job.folders:
        return [top, page.paragraph("None: the stage `reference` has not run, or was left out.")]
    facts = job.facts("reference")
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
    return [*parts, *extra_views_section(job), *origins_section(job)]


def _origin(facts: dict, folder: Path, name: str) -> str:
    """Return in words where a reference comes from and, if given, how it fits; `facts` is the stage's facts.json."""
    if name in facts.get("given", ()):
        return f"given; {facts.get('fits', {}).get(name, 'how well it fits was not recorded')}"
    path = folder / "candidates.json"
    record = load_json(path) if path.is_file() else {}
    way = "composed of patches of the photographs" if "misfits" in record else "painted by the diffusion model"
    way = f"painted by {record['painter']}" if "painter" in record else way
    scores = record.get("misfits") or record.get("seams") or []
    return f"{way}, the best of {len(scores)} tries" if len(scores) > 1 else way


def extra_views_section(job: JobFiles) -> list[str]:
    """Return HTML parts with the extra views and the reason for them; empty if there are none."""
    folder = job.folders.get("initialize", Path())
    shares = job.facts("initialize").get("extra_views", {})
    if not shares:
        return []
    reason = "No reference shows these places, so these views were completed from patches of the photographs."
    cells = [
        (
            inline_images.photo_address(load_image(folder / "extra_views" / f"{view}.png"), DEPTH_SIDE),
            f"{view}: {share:.1%} of its mask",
        )
        for view, share in shares.items()
    ]
    return [page.heading("Extra views", 3), page.paragraph(reason), inline_images.picture_grid(cells)]


def origins_section(job: JobFiles) -> list[str]:
    """Return HTML parts with the origin of what views show in the hole; empty before the stage `initialize`."""
    folder = job.folders.get("initialize", Path())
    facts = job.facts("initialize")
    shares, invented = facts.get("origins", {}), facts.get("invented_shares", {})
    names = sorted(path.stem for path in (folder / "origins").glob("*.png")) if shares else []
    if not names or "poses" not in job.folders:
        return []
    words = "; ".join(f"{WORDS_OF_ORIGINS[origin]} {share:.0%}" for origin, share in shares.items())
    cells = []
    for name in pick_evenly(names, ORIGIN_VIEWS):
        photo = load_image(job.folders["poses"] / "images" / f"{name}.png")
        origin = load_image(folder / "origins" / f"{name}.png")
        tinted = np.where(origin.any(-1, keepdims=True), photo // 3 + origin // 3 * 2, photo)
        cells.append((inline_images.photo_address(tinted, DEPTH_SIDE), f"{name}: {invented.get(name, 0):.0%} invented"))
    parts = [page.heading("Where the filling comes from", 3), page.paragraph(f"Mean over views: {words}.")]
    return [*parts, inline_images.picture_grid(cells)]


def depth_section(job: JobFiles) -> list[str]:
    """Return HTML parts on depth: a few views of the fit and of the latest Gaussians, colored by disparity.

    The two pictures of a view have the same scale of colors; different views have different scales.
    """
    stages = [s for s in RESULTS if s in job.folders and (job.folders[s] / "gaussians.ply").is_file()]
    if not stages or "fit" not in stages or "poses" not in job.folders:
        return [page.paragraph("None yet: the stage `fit` has not run.")]
    scene = load_scene(job.folders["poses"])
    names = pick_evenly(before_after.rendered_views(job) or list(scene.train), DEPTH_VIEWS)
    states = {"with the object": "fit"} | ({f"after {stages[0]}": stages[0]} if len(stages) > 1 else {})
    loaded = {words: load_ply(job.folders[stage] / "gaussians.ply") for words, stage in states.items()}
    cells = []
    for name in names:
        pictures = color_disparity([render_depth(gaussians, scene.cameras[name]) for gaussians in loaded.values()])
        for words, picture in zip(loaded, pictures, strict=True):
            cells.append((inline_images.photo_address(picture, DEPTH_SIDE), f"{name}, {words}"))
    legend = "Bright is near; pairs share a scale; gray is empty."
    return [page.paragraph(legend, quiet=True), inline_images.picture_grid(cells)]


def render_depth(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Return a rendered depth map [H, W] of camera z, 0 where alpha is `MIN_ALPHA` or less."""
    rendering = rasterizer.render(gaussians, camera, sh_degree=0)
    return np.where(rendering.alpha.numpy() > MIN_ALPHA, rendering.depth.numpy(), 0.0)


def color_disparity(depths: list[np.ndarray]) -> list[np.ndarray]:
    """Return a picture of each depth map, uint8 [H, W, 3], with disparity (1 / depth) in colors.

    Bright means near, gray means unknown. The scale of colors, which is the same for all maps, extends from the 1st to
    the 99th percentile of the first map's disparities.

    Args:
        depths: [H, W] each, camera z, 0 where unknown.
    """
    from matplotlib import colormaps

    near = [np.where(depth > 0, 1 / np.where(depth > 0, depth, 1.0), np.nan) for depth in depths]
    known = near[0][np.isfinite(near[0])]
    low, high = np.percentile(known, (1, 99)) if len(known) else (0.0, 1.0)
    pictures = []
    for disparity in near:
        level = np.clip((disparity - low) / max(high - low, 1e-9), 0, 1)
        picture = (colormaps["inferno"](np.nan_to_num(level))[..., :3] * 255).round().astype(np.uint8)
        picture[~np.isfinite(disparity)] = 128
        pictures.append(picture)
    return pictures
