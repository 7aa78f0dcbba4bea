"""Adoption of references that come with a scene: each is aligned with its photograph, and its usable pixels are found.

A reference is a completed view: a picture of a training view without the object.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from reffusion.capture.lens import Lens, undistorted_pinhole
from reffusion.capture.lenses import load_lenses
from reffusion.fit import exposure
from reffusion.io.files import BadInput
from reffusion.io.scene import has_photograph, load_views
from reffusion.references import agreement, changes, color, registration, view_ranking
from reffusion.references.files import ReferenceFile
from reffusion.references.registration import Registration
from reffusion.references.undistort import undistort_reference, undistort_reference_depth
from reffusion.shadows.reference_shadows import detect_shadow
from reffusion.types import Camera, MaskSet, Reference
from reffusion.workspace import Workspace

# Of the image's width: how far around the hole the reference's own pixels are taken, and the width of the strip beyond
# in which they are blended into the photograph.
PASTE_MARGIN, PASTE_BLEND = 0.01, 0.01
LEAST_HOLE_SHARE = 0.9  # share of the invent mask that a reference must cover after alignment
# A reference is unpainted if at least the share UNPAINTED of its hole differs by at most SAME (of 255) in each channel
# from the photograph, or from the gray of the pictures that are offered for painting.
UNPAINTED, SAME = 0.95, 6
NEIGHBORS = 4  # nearest views with which a matching reference is compared, in case it shows one of them better


def adopt_references(files: Sequence[ReferenceFile], space: Workspace) -> tuple[list[Reference], dict[str, str]]:
    """Align the references with their views, and drop those in whose view nothing has to be invented.

    A reference is used inside the invent mask I of its view (the pixels to be invented). In a clean view, whose
    photograph shows the scene without the object, it is used inside the consistent mask C instead (the pixels where the
    object's Gaussians would be), and is never dropped, because it still teaches the prior.

    Args:
        files: the references that come with the scene, at least one.
        space: results of earlier stages.

    Returns:
        The references that are left, see `adopt_reference`; and for these, view name -> a description of how well the
        reference fits its photograph.

    Raises:
        BadInput: a reference does not show its view, and scene.yaml does not say that it is trusted; or a file cannot
            be used.
        ValueError: no reference is left, a reference covers too little of the hole, two references contradict each
            other, or a depth map does not fit the scene.
    """
    references, fits = [], {}
    for file in files:
        masks, is_clean = space.mask_sets[file.view], file.view in space.scene.clean
        masks = replace(masks, invent=masks.consistent) if is_clean else masks
        if masks.invent.any() or is_clean:  # a clean view without a hole still teaches the prior
            reference, fits[file.view] = adopt_reference(file, masks, space)
            references.append(reference)
        else:
            print(f"reference {file.view} is left out: nothing has to be invented in its view")
    if not references:
        raise ValueError(f"{files[0].path}: in no reference's view anything has to be invented; choose other views")
    check_agreement(references, space)
    return references, fits


def adopt_reference(file: ReferenceFile, masks: MaskSet, space: Workspace) -> tuple[Reference, str]:
    """Align one reference with its photograph.

    Only the hole, the object's shadow and a blended rim are taken from the picture and pasted into the photograph. A
    picture that equals the photograph outside the object (`Registration.is_identical`) is pasted without alignment.

    Args:
        file: the reference's files.
        masks: pixel classes of its view; the reference is used inside `masks.invent`.
        space: results of earlier stages.

    Returns:
        The reference in the scene's common exposure, and a description of how well it fits its photograph. The
        reference's mask holds those pixels of `masks.invent` that the picture covers and that are in `masks.consistent`
        or differ from the photograph. The depth, if any, is multiplied by the scale of the normalized frame.

    Raises:
        BadInput: the picture does not show its view, or shows another view better, and scene.yaml does not say that it
            is trusted; or a file cannot be used.
        ValueError: the picture covers less than `LEAST_HOLE_SHARE` of the hole.
    """
    camera, lens = space.scene.cameras[file.view], load_lenses(space.poses)[0][file.view]
    keeps_exposure = not file.painted and has_photograph(space.poses, file.view)
    photo = load_photo(space, file.view) if keeps_exposure else space.load_photos([file.view])[file.view]
    hidden = object_pixels(masks)
    lens, image, inside, found = find_lens(file, lens, photo, hidden)
    if not found.is_identical:
        found = check_match(file, found, image, space)
    print(f"reference {file.view}: {found}", flush=True)
    usual = 0.0
    if not found.is_identical:
        image, inside = undistort_reference(file, lens, photo, found.affine)
        image = color.recolor(image, found.gain, found.offset)
        usual = changes.redrawn_difference(image, photo, inside & ~hidden)
    if has_photograph(space.poses, file.view) and file.view not in space.scene.clean:
        check_painted(file, image, photo, masks)
    margin, blend = (share * camera.width for share in (PASTE_MARGIN, PASTE_BLEND))
    hole = hidden | detect_shadow(image, photo, hidden) & inside
    image = color.paste(image, photo, hole, inside, margin, blend)
    if masks.invent.any() and (share := inside[masks.invent].mean()) < LEAST_HOLE_SHARE:
        raise ValueError(
            f"{file.path}: shows only {share:.0%} of the hole in '{file.view}'; crop less, or paint all of it"
        )
    differs = masks.consistent | changes.changed_pixels(image, photo, masks.invent, usual)
    image = image if file.painted else exposure.normalize_exposure(image, space.fit, file.view)
    depth = undistort_reference_depth(file, lens, found.affine)
    if depth is not None:  # a depth map in the unit of the scene's own files is now in that of the normalized frame
        depth = depth * space.scene.similarity.scale
    return Reference(camera, image, masks.invent & inside & differs, depth), str(found)


def find_lens(
    file: ReferenceFile, lens: Lens, photo: np.ndarray, hidden: np.ndarray
) -> tuple[Lens, np.ndarray, np.ndarray, Registration]:
    """Find out whether a picture was made over the photograph of its view or over the undistorted photograph.

    Args:
        file: the reference's files.
        lens: the lens of the photograph.
        photo: uint8 [H, W, 3], the undistorted photograph.
        hidden: bool [H, W], the object's pixels.

    Returns:
        The lens of the picture, both results of `undistort_reference` for this lens, and the registration. The lens is
        the one whose registration has more inliers. If the two are equal, it is the pinhole for a painting, and the
        lens of the photograph for any other picture.
    """
    pinhole = undistorted_pinhole(lens)
    lenses = [lens] if pinhole == lens.pinhole else [pinhole, lens] if file.painted else [lens, pinhole]
    found = []
    for each in lenses:
        image, inside = undistort_reference(file, each, photo)
        found.append((each, image, inside, registration.register(image, photo, hidden)))
        if found[-1][-1].is_identical:
            return found[-1]
    return max(found, key=lambda each: float(np.nan_to_num(each[-1].inlier_ratio)))


def check_match(file: ReferenceFile, found: Registration, image: np.ndarray, space: Workspace) -> Registration:
    """Check that a picture shows its own view, and shows no other view better; return its registration.

    If the check fails but scene.yaml says that the picture is trusted, a warning replaces the error. A trusted picture
    that does not fit its own view is used without alignment.

    Args:
        file: the reference's files.
        found: the registration of the picture with the photograph of its own view.
        image: uint8 [H, W, 3], the undistorted picture before alignment.
        space: results of earlier stages.

    Raises:
        BadInput: the check fails, and the picture is not trusted.
    """
    scene = space.scene
    others = [name for name in scene.train if name != file.view and has_photograph(space.poses, name)]
    others.sort(key=lambda name: view_distance(scene.cameras[name], scene.cameras[file.view]))
    others = others[:NEIGHBORS] if found.fits else others
    loaded = ((name, load_photo(space, name), object_pixels(space.mask_sets[name])) for name in others)
    closer = registration.find_better_view(image, found, loaded)
    if found.fits and closer is None:
        return found
    problem = f"{file.path}: does not fit its view '{file.view}': {found if found.fits else found.mismatch}"
    problem += f"; it fits the view '{closer[0]}' better ({closer[1]:.0%})" if closer else ""
    if file.trust:
        warnings.warn(f"{problem}; taken all the same: scene.yaml says `trust: true`", stacklevel=1)
        return found if found.fits else replace(found, affine=None, gain=np.ones(3), offset=np.zeros(3))
    raise BadInput(f"{problem}; is it of another view, or of another scene? If it is right, {file.trust_hint}")


def check_painted(file: ReferenceFile, image: np.ndarray, photo: np.ndarray, masks: MaskSet) -> None:
    """Raise BadInput if a picture shows the object, or the gray of a hole that nobody has painted.

    Nothing is checked if scene.yaml says that the picture is trusted, or if the hole takes more than half of the
    picture's border: then it surrounds what stays, and photographs may show what belongs there.

    Args:
        file: the reference's files.
        image: uint8 [H, W, 3], the picture after alignment.
        photo: uint8 [H, W, 3], the photograph of its view, which shows the object.
        masks: pixel classes of its view.
    """
    pixels = masks.consistent & masks.invent
    border = np.concatenate([pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]])
    if file.trust or not pixels.any() or border.mean() > 0.5:
        return
    looks_like = lambda other: (np.abs(image[pixels].astype(int) - other) <= SAME).all(-1).mean() >= UNPAINTED
    problem = "shows the object, as its photograph does" if looks_like(photo[pixels]) else None
    problem = "shows the gray of a hole that is not painted" if looks_like(view_ranking.GRAY) else problem
    if problem:
        raise BadInput(f"{file.path}: {problem}; paint what is behind the object. If it is right, {file.trust_hint}")


def check_agreement(references: Sequence[Reference], space: Workspace) -> None:
    """Raise ValueError if two references contradict each other.

    Two references contradict each other if their colors differ in the part of the hole that both show
    (`references.agreement`). Training would average the two.
    """
    if len(references) < 2:
        return
    cameras = [each.camera for each in references]
    hidden = {camera.name: space.mask_sets[camera.name].consistent for camera in cameras}
    holes = view_ranking.find_holes(
        space.remaining, cameras, hidden, {each.camera.name: each.mask for each in references}
    )
    holes = agreement.refine_hole_depth(holes, references, space.remaining, hidden)
    for first, second, unlike in agreement.find_contradictions(references, holes):
        raise ValueError(
            f"the references of '{first}' and '{second}' contradict each other: in what both show, colors differ by "
            f"{255 * unlike:.0f} of 255; make them alike, or give one of them"
        )


def load_photo(space: Workspace, name: str) -> np.ndarray:
    """Return uint8 [H, W, 3], the undistorted photograph of a view, in the exposure of its camera."""
    return load_views(space.poses, [name])[name]


def object_pixels(masks: MaskSet) -> np.ndarray:
    """Return bool [H, W], the pixels of a view that may show the object or that are to be invented."""
    return masks.raw | masks.consistent | masks.invent


def view_distance(a: Camera, b: Camera) -> float:
    """Return a measure of how differently two cameras see the scene.

    This is the distance of their centers, in units of the normalized frame, plus the angle between their optical axes,
    in radians.
    """
    cosine = a.world_to_camera[2, :3] @ b.world_to_camera[2, :3]
    return float(np.linalg.norm(a.center - b.center) + np.arccos(np.clip(cosine, -1, 1)))
