"""Reads a scene folder as the keys of its scene.yaml tell, and checks these keys against the folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from reffusion.capture.click_coordinates import check_clicks
from reffusion.capture.layouts.cameras import has_pictures
from reffusion.capture.layouts.capture import AS_GIVEN, Capture, Correction
from reffusion.capture.lens import undistorted_pinhole
from reffusion.capture.load import LONGEST, load_capture
from reffusion.capture.mask_files import group_by_object
from reffusion.capture.names import list_pictures
from reffusion.capture.roles import Roles, assign_roles
from reffusion.capture.views import resolve_view
from reffusion.io.files import BadInput, is_file
from reffusion.io.splats import load_splats, summarize_splats
from reffusion.params.capture import SceneKeys
from reffusion.params.reference import reference_list


def read_scene(
    params: SceneKeys, scene: Path, longest: int = LONGEST, correction: Correction = AS_GIVEN
) -> tuple[Capture, Roles]:
    """Read a scene folder: return the capture (pictures and cameras) and the roles of its views.

    Views that scene.yaml names under `exclude` are neither in `Capture.pictures` nor in the roles.

    Args:
        params: the keys of scene.yaml.
        scene: the scene's folder.
        longest: requested longer side of the pictures in pixels, see `load_capture`; no role depends on it.
        correction: what is changed in the poses, see `load_capture`.

    Raises:
        BadInput: a file or a key of scene.yaml is wrong; the message names it and the remedy.
    """
    specs = reference_list(params.reference)
    references = frozenset(scene / name for each in specs for name in (each.image, each.depth) if name is not None)
    capture = load_capture(scene, params.layout, params.images, longest, references, correction)
    roles = assign_roles(
        scene,
        capture,
        masks=params.masks,
        test_masks=params.test_masks,
        ignore=params.ignore,
        train=params.train,
        test=params.test,
        clean=params.clean,
        region=not (params.region is params.fill is params.cleaned is params.clicks is None),
        cameras_only=params.cameras_only,
        remove=params.remove,
    )
    capture, roles = _exclude(params, capture, roles)
    if params.fill is not None:
        roles = replace(roles, fill=_find_fill_masks(scene / params.fill, capture, roles))
    if params.region is not None and params.region.view is not None:
        resolve_view(params.region.view, {*roles.train, *roles.test}, "region")
    if params.clicks:
        check_clicks(params.clicks, capture, roles)
    check_gaussian_files(params, scene)
    _check_lenses(capture)
    return capture, roles


def _exclude(params: SceneKeys, capture: Capture, roles: Roles) -> tuple[Capture, Roles]:
    """Return capture and roles without views in `exclude` of scene.yaml, with `keep`; BadInput for a view in both."""
    excluded, kept = (
        {resolve_view(n, capture.pictures, key) for n in getattr(params, key)} for key in ("exclude", "keep")
    )
    if both := sorted(excluded & kept):
        raise BadInput(f"scene.yaml: {', '.join(both)} in both exclude and keep; name a view in one of them")
    roles = replace(roles, keep=frozenset(kept))
    if not excluded:
        return capture, roles
    pictures = {name: path for name, path in capture.pictures.items() if name not in excluded}
    return replace(capture, pictures=pictures), roles.restrict(set(pictures))


def check_gaussian_files(params: SceneKeys, scene: Path) -> list[str]:
    """Check the files of Gaussians that scene.yaml names (`gaussians` and `cleaned`), mostly by their headers.

    Returns:
        A sentence for each thing that will be changed when the files are read.

    Raises:
        BadInput: a file is missing or holds no Gaussians; `cleaned` is given without `gaussians`, or has as many
            Gaussians as `gaussians`, so that nothing was deleted.
    """
    counts: dict[str, int | None] = {}
    notes: list[str] = []
    for key, name in (("gaussians", params.gaussians), ("cleaned", params.cleaned)):
        if name is not None:
            if not is_file(scene / name):
                raise BadInput(f"{scene / name}: no such file; correct `{key}` in scene.yaml")
            summary = summarize_splats(scene / name)
            counts[key], notes = summary.count, [*notes, *(f"{name}: {note}" for note in summary.notes)]
            if counts[key] == 0:
                why = ": everything was deleted; delete the object only" if key == "cleaned" else ""
                raise BadInput(f"{scene / name}: it holds no Gaussians{why}")
    if params.cleaned is None:
        return notes
    if params.gaussians is None:
        raise BadInput("scene.yaml: cleaned: name the scene before anything was deleted too, as `gaussians`")
    files = [scene / name for name in (params.gaussians, params.cleaned)]
    if counts["cleaned"] is not None and counts["cleaned"] == counts["gaussians"]:
        # Only the rows that can be drawn count.
        counts["gaussians"], counts["cleaned"] = (len(load_splats(path).rows) for path in files)
        if counts["cleaned"] < counts["gaussians"]:
            return notes
        raise BadInput(
            f"{files[1]}: {counts['cleaned']} splats, and {files[0]} has {counts['gaussians']}: nothing was deleted; "
            "delete the object in an editor, and save what is left"
        )
    return notes


def is_gaussians_only(params: SceneKeys, scene: Path) -> bool:
    """Return whether the scene has Gaussians but no photographs; cameras (a transforms file, COLMAP model) may exist.

    Then scene.yaml names a fitted scene of Gaussians as `gaussians`, and as `cleaned` the same scene after the user
    deleted the object. Renders of these Gaussians are used in place of photographs. Only `cleaned` is tested here;
    `check_gaussian_files` checks that `gaussians` is named too.

    Raises:
        BadInput: the scene is of this kind, and scene.yaml has a key about photographs.
    """
    named = [each.image for each in reference_list(params.reference)]
    if params.cleaned is None or params.images is not None or has_pictures(scene, frozenset(named)):
        return False
    about_views = ("train", "test", "clean", "cameras_only", "exclude", "keep")
    for key in (*about_views, "test_masks", "ignore", "fill", "remove", "region", "masks"):
        if getattr(params, key) and (key != "masks" or params.has_masks):
            raise BadInput(f"scene.yaml: {key}: the scene has no photographs; add them, or remove the key")
    return True


def _find_fill_masks(folder: Path, capture: Capture, roles: Roles) -> dict[str, Path]:
    """Return training view -> mask file in the folder `fill`; raises BadInput if a view that is not clean has none."""
    found = group_by_object(folder, list_pictures(folder, nested=True), capture)
    files = {name: path for views in found.values() for name, path in views.items()}
    if lacking := [name for name in roles.train if name not in {*files, *roles.clean}]:
        raise BadInput(
            f"{folder}: no mask for {len(lacking)} of {len(roles.train)} training views, '{lacking[0]}' for one; each "
            "needs one of what is to be filled, an empty one where it does not show that place"
        )
    return {name: files[name] for name in roles.train if name in files}


def _check_lenses(capture: Capture) -> None:
    """Raise BadInput if the distortion of a lens cannot be removed inside its picture."""
    lenses = capture.poses.lenses.items() if capture.poses else ()
    of = {lens: name for name, lens in lenses if replace(lens.pinhole, model=lens.model) != lens}
    for lens, name in of.items():
        try:
            undistorted_pinhole(lens)
        except BadInput as error:
            raise BadInput(f"{capture.pose_source}: view '{name}': {error}") from None
