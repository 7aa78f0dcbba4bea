"""Generator of synthetic scenes with known truth: `python -m lab.scenes.generate --out data/demo --seed 0 --kind demo`.

A furnished room is ray-cast with and without one object. Kinds:
  demo    100 views in SPIn-NeRF's layout: 40 test views without the object, 60 training views with it
  mini    demo with 3 test and 8 training views of 64 x 48 px, for tests
  wide    demo with cameras +-50 degrees around the object
  360     demo with cameras all around an object that lies on the floor
  beside  360 with a chest on the floor, close to four things that stay and that it partly hides in every view
  around  beside with a low box and five or six things in random places, which may touch it
  seen    demo with an object in mid-air: other views see everything that it hides, so nothing has to be invented
  mono    wide in small views, with a reference whose depth map is as a monocular network gives it
  behind  wide with a second object in front, which stays and hides a part of what the reference is to fill
  table   an object on the edge of a table, free space under it, some cameras low enough to look there
  corner  an object in front of the corner of a projecting wall: behind the object the depth has a step
  pair    two objects side by side, each with masks of its own, and two references
  sparse  nothing to remove; only four training views have pixels, the others are cameras
  past    demo with test views that are turned away, so that they look past what training views show
  grass   an object on a lawn in front of a hedge: thousands of blades and leaves, nothing flat
  insert  an object on the floor that only the test views and four references show, and that is to be inserted
  outpaint  the room as photographed, and a sphere beyond which references continue it
  photos  26 larger photographs and masks without poses, for structure from motion

Poses are written in a scene frame of arbitrary scale, rotation and origin, as structure from motion gives. As in
SPIn-NeRF, the COLMAP model and poses_bounds.npy are for the full resolution, 4 times that of `images_4`, and the model
names the images `<view>.jpg`. The folder `truth/` has the ground truth, which the pipeline must not read; its pictures
have the same lens as the photographs. Outside the masks, views with and without the object are equal: the object casts
no shadow, and the masks cover every pixel that the object touches.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lab.scenes.files import write_image, write_model, write_poses_bounds, write_truth_cameras
from lab.scenes.kinds import KINDS, Kind, randomness
from lab.scenes.photographs import Session, corner_shift, take_photographs
from lab.scenes.reconstruction import Frame, scene_frame, sparse_points
from lab.scenes.room import furnish
from lab.scenes.tasks import (
    SPHERE,
    bounding_region,
    choose_covering_views,
    depth,
    estimate_disparity,
    outside_sphere,
    point_on_axis,
    without_object,
)
from lab.scenes.world import World, bake

AWAY = 2.5  # distance from the middle camera to the sphere's center, metres; about the point that the cameras look at
# Largest share of the masks that may be never seen if the object hangs. Only crannies behind furniture are never seen.
MOST_NEVER_SEEN = 0.005
PROFILE = "profile: laptop # small pictures, made for it; `make profile=paper` has precedence\n"


def generate(out: Path, seed: int, kind: Kind) -> dict:
    """Write a scene to the folder `out` atomically, replacing an earlier one, and return its facts.

    Returns:
        The facts as in truth/facts.json, see `_facts`.

    Raises:
        ValueError: `out` has files that this script did not write or that have changed since; or, if the task is to
            remove an object, the mean share of the masks whose background no training view shows is below the kind's
            `least` for training or test views (for a hanging object: above `MOST_NEVER_SEEN`). An earlier scene stays
            as it is.
    """
    if out.exists() and any(out.iterdir()) and not (out / "truth/facts.json").exists():
        raise ValueError(f"{out} holds files that this generator did not write; name another folder, or empty it")
    partial = out.with_name(out.name + ".writing")
    shutil.rmtree(partial, ignore_errors=True)
    facts = _write_scene(partial, seed, kind)
    if theirs := _changed_by_hand(out, partial):
        shutil.rmtree(partial)
        raise ValueError(f"{theirs[0]} was put there or changed by hand; move it away, or name another folder")
    shutil.rmtree(out, ignore_errors=True)
    partial.rename(out)
    return facts


def _changed_by_hand(out: Path, new_scene: Path) -> list[Path]:
    """Return the files of an existing scene that somebody added or changed; [] without the stamp `.generated`."""
    sign = out / ".generated"
    files = [path for path in out.rglob("*") if path.is_file() and path != sign] if sign.exists() else []
    young = lambda path: path.stat().st_mtime > sign.stat().st_mtime
    return sorted(path for path in files if young(path) or not (new_scene / path.relative_to(out)).exists())


def _write_scene(out: Path, seed: int, kind: Kind) -> dict:
    furniture, target = furnish(seed, kind)
    world = bake(furniture, seed, kind)
    session = take_photographs(seed, kind, world, target)
    facts = _facts(seed, session)
    shares, request = [s for s in facts["never_seen_share"].values() if s is not None], f"{kind.least} or more"
    if kind.hangs:
        request = f"{MOST_NEVER_SEEN} or less"
    if kind.task == "remove" and (max(shares) > MOST_NEVER_SEEN if kind.hangs else min(shares) < kind.least):
        raise ValueError(f"seed {seed}: {facts['never_seen_share']} of the masks was never seen; it must be {request}")
    frame = scene_frame(seed)
    write_truth_cameras(out / "truth/cameras.json", kind, session.names, session.cameras, frame)
    (out / "truth/facts.json").write_text(json.dumps(facts, indent=1))
    if kind.photos:
        _write_photos(out, session)
        return facts
    _write_pictures(out, session)
    {
        "remove": _write_removal,
        "insert": _write_insertion,
        "outpaint": _write_outpainting,
        "sparse": _write_sparse_views,
    }[kind.task](out, session, kind, world, frame)
    captured = replace(world, solids=without_object(world.solids)) if kind.task == "insert" else world
    points = sparse_points(seed, kind, captured, session.cameras[kind.test :], session.photos[kind.test :])
    write_model(out / "sparse/0", kind, session.names, session.cameras, frame, points)
    write_poses_bounds(out / "poses_bounds.npy", kind, session.cameras, frame, points)
    return facts


def _facts(seed: int, session: Session) -> dict:
    """Return the facts of a scene, such as the mean masked share of pixels and the mean never seen share of masks."""
    shares = [float(h.sum() / max(m.sum(), 1)) for h, m in zip(session.hidden, session.masks, strict=True)]
    return {
        "seed": seed,
        "reference": session.names[session.middle],  # the middle view
        "mask_share": _by_split(session.masks.mean((1, 2)), session.test),
        "never_seen_share": _by_split(shares, session.test),
        "lens_shift_px": float(corner_shift(session.cameras[0])),  # of the image corners
        "shown": [session.names[k] for k in session.spread],  # training views that are far apart
    }


def _by_split(values, test: int) -> dict[str, float | None]:
    return {"train": float(np.mean(values[test:])), "test": float(np.mean(values[:test])) if test else None}


def _write_photos(out: Path, session: Session) -> None:
    for name, photo, mask in zip(session.names, session.photos, session.masks, strict=True):
        write_image(out / f"images/{name}.png", photo)
        write_image(out / f"masks/{name}.png", mask * np.uint8(255))


def _write_pictures(out: Path, session: Session) -> None:
    """Write the photographs in SPIn-NeRF's layout."""
    for name, photo in zip(session.names, session.photos, strict=True):
        write_image(out / f"images_4/{name}.png", photo)


def _write_test_masks(out: Path, session: Session, masks: Sequence[np.ndarray]) -> None:
    for k, mask in enumerate(masks):
        write_image(out / f"images_4/test_label/out_{k:05d}.png", mask * np.uint8(255))
        write_image(out / f"truth/masks_test/{session.names[k]}.png", mask * np.uint8(255))


def _write_removal(out: Path, session: Session, kind: Kind, world: World, frame: Frame) -> None:
    """Write masks of the object, or of each, and references; with `Kind.depth_error` also the training views' truth."""
    _write_test_masks(out, session, session.masks[: session.test])
    for k, name in enumerate(session.names):
        write_image(out / f"truth/never_seen/{name}.png", session.hidden[k] * np.uint8(255))
        if k < session.test:
            continue
        for own, of in session.object_masks.items():
            write_image(out / f"masks/{own}/{name}.png", of[k] * np.uint8(255))
        if not session.object_masks:
            write_image(out / f"images_4/label/{name}.png", session.masks[k] * np.uint8(1))
    if not kind.depth_error:
        # Behind a hanging object nothing has to be invented.
        references = "" if kind.hangs else _write_references(out, session)
    else:
        removed = replace(world, solids=without_object(world.solids))
        references = _write_measured(out, session, session.completions, kind, removed, frame)
        for name, picture in zip(session.names[session.test :], session.backgrounds, strict=True):
            write_image(out / f"truth/without_object/{name}.png", picture)
    (out / "scene.yaml").write_text(references + PROFILE)


def _write_references(out: Path, session: Session) -> str:
    """Write the completed views and return the lines of scene.yaml that name them as references."""
    files = ["reference.png", *(f"reference_{session.names[k]}.png" for k in list(session.completions)[1:])]
    entries = []
    for (k, picture), file in zip(session.completions.items(), files, strict=True):
        write_image(out / file, picture)
        entries.append(f"{{view: {session.names[k]}, image: {file}}}")
    if len(entries) == 1:
        return f"reference: {entries[0]}\n"
    return "reference:\n" + "".join(f"- {each}\n" for each in entries)


def _write_sparse_views(out: Path, session: Session, kind: Kind, world: World, frame: Frame) -> None:
    """Write scene.yaml: a few photographs are training views and references; other training views have no pixels."""
    shown = [session.names[k] for k in session.spread[: kind.shown]]
    references = "".join(f"- {{view: {name}, image: images_4/{name}.png}}\n" for name in shown)
    listed = lambda names: f"[{', '.join(names)}]\n"
    (out / "scene.yaml").write_text(
        f"train: {listed(shown)}clean: {listed(shown)}test: {listed(session.names[: session.test])}"
        f"cameras_only: others\nmasks: none\nreference:\n{references}{PROFILE}"
    )


def _write_insertion(out: Path, session: Session, kind: Kind, world: World, frame: Frame) -> None:
    """Write test masks, references that show the object, their depth, and a region (a sphere) around the object."""
    _write_test_masks(out, session, session.masks[: session.test])
    center, radius = bounding_region(world.solids)
    region = {"center": frame.points(center).tolist(), "radius": frame.scale * radius}
    _write_region(out, region, _write_measured(out, session, session.completions, kind, world, frame))


def _write_outpainting(out: Path, session: Session, kind: Kind, world: World, frame: Frame) -> None:
    """Write test masks, a region (all outside a sphere on the middle view's axis) and references with depth."""
    center = point_on_axis(session.cameras[session.middle], AWAY)
    masks = [outside_sphere(camera, kind, world, center, SPHERE) for camera in session.cameras[: session.test]]
    _write_test_masks(out, session, masks)
    middle = session.middle - session.test
    chosen = choose_covering_views(session.cameras[session.test :], kind, world, center, middle)
    whole = {session.test + k: session.photos[session.test + k] for k in chosen}  # photographs of training views
    sphere = {"view": session.names[session.middle], "distance": frame.scale * AWAY}
    sphere |= {"radius": frame.scale * SPHERE, "outside": True}
    _write_region(out, sphere, _write_measured(out, session, whole, kind, world, frame))


def _write_measured(
    out: Path, session: Session, pictures: dict[int, np.ndarray], kind: Kind, world: World, frame: Frame
) -> str:
    """Write pictures and their depth (disparity if `Kind.depth_error`); return the lines of scene.yaml on them."""
    entries = ["reference:\n"]
    for k, picture in pictures.items():
        name, measured = session.names[k], depth(session.cameras[k], kind, world, frame)
        write_image(out / f"references/{name}.png", picture)
        if kind.depth_error:
            (out / "truth/depth").mkdir(parents=True, exist_ok=True)
            np.save(out / f"truth/depth/{name}.npy", measured)
            draw = randomness(session.seed, f"estimate {name}")
            measured = estimate_disparity(measured, session.masks[k], kind.depth_error, draw)
        np.save(out / f"references/{name}.npy", measured)
        entries.append(f"- {{view: {name}, image: references/{name}.png, depth: references/{name}.npy}}\n")
    return "".join(entries)


def _write_region(out: Path, region: dict, references: str) -> None:
    (out / "scene.yaml").write_text(f"masks: none\nregion: {json.dumps(region)}\n{references}{PROFILE}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("data/demo"), help="folder to write")
    parser.add_argument("--seed", type=int, default=None, help="default 0; 7 for photos")
    parser.add_argument("--kind", choices=KINDS, default="demo")
    arguments = parser.parse_args()
    seed = arguments.seed if arguments.seed is not None else (7 if arguments.kind == "photos" else 0)
    facts = generate(arguments.out, seed, KINDS[arguments.kind])
    print(f"{arguments.out}: " + json.dumps(facts))


if __name__ == "__main__":
    main()
