"""Generates synthetic scenes with known truth: `python data/generate.py --out data/demo --seed 0 --kind demo`.

A furnished room is ray-cast with and without one object. Kinds:
  demo    100 views in SPIn-NeRF's layout: 40 test views without the object, 60 training views with it
  mini    the same, 3 + 8 views of 64 x 48 px, for tests
  wide    demo with cameras +-50 degrees around the object
  360     demo with cameras all around an object that lies on the floor
  seen    demo with an object that hangs in mid-air: other views see all that it hides, nothing is to be invented
  behind  wide with an object that stays in front, and hides a part of what is to be filled from the reference
  table   an object on the edge of a table, free space under it, some cameras low enough to look there
  corner  an object in front of the corner of a wall that juts out: behind it the depth has a step
  pair    two objects side by side, each with masks of its own, and two references
  sparse  nothing to remove; only four training views have pixels, the others are cameras
  grass   an object on a lawn in front of a hedge: thousands of blades and leaves, nothing flat
  insert  the reverse: an object on the floor, only in the test views and four references; it is to be inserted
  outpaint  the room as photographed, and a sphere beyond which references continue it
  photos  26 larger photographs and masks without poses, for structure from motion

Poses are written in a scene frame of arbitrary scale, rotation and origin, as SfM leaves it. As in SPIn-NeRF the
COLMAP model and poses_bounds.npy belong to the full resolution, 4 times `images_4`; the model names `<view>.jpg`.
`truth/` holds what the pipeline must not read, every picture with the photographs' lens. Outside the masks, views with
and without the object are equal: it casts no shadow, and masks hold every pixel it touches.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from files import write_image, write_model, write_poses_bounds, write_truth_cameras
from kinds import KINDS, Kind
from photographs import Session, corner_shift, take_photographs
from reconstruction import Frame, scene_frame, sparse_points
from room import furnish
from tasks import SPHERE, bounding_region, choose_covering_views, depth, outside_sphere, point_on_axis, without_object
from world import World, bake

AWAY = 2.5  # metres from the middle camera to the sphere's centre, about where the views look
MOST_NEVER_SEEN = 0.005  # share of the masks, where the object hangs: crannies behind furniture
PROFILE = "profile: laptop # small pictures, made for it; `make profile=paper` has precedence\n"


def generate(out: Path, seed: int, kind: Kind) -> dict:
    """Write the scene to `out` atomically, and return its facts.

    Raises:
        ValueError: `out` holds something that this script did not write, or that was changed since; or less than the
            kind's share of the masks hides background that no training view sees (for a hanging object: or too much
            does).
    """
    if out.exists() and any(out.iterdir()) and not (out / "truth/facts.json").exists():
        raise ValueError(f"{out} holds files that data/generate.py did not write; name another folder, or empty it")
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
    """Files of `out` that are not in the new scene, or that are younger than the stamp of their generation."""
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
    shares = [float(h.sum() / max(m.sum(), 1)) for h, m in zip(session.hidden, session.masks, strict=True)]
    return {
        "seed": seed,
        "reference": session.names[session.middle],
        "mask_share": _by_split(session.masks.mean((1, 2)), session.test),
        "never_seen_share": _by_split(shares, session.test),
        "lens_shift_px": float(corner_shift(session.cameras[0])),
        "shown": [session.names[k] for k in session.spread],
    }


def _by_split(values, test: int) -> dict[str, float | None]:
    return {"train": float(np.mean(values[test:])), "test": float(np.mean(values[:test])) if test else None}


def _write_photos(out: Path, session: Session) -> None:
    for name, photo, mask in zip(session.names, session.photos, session.masks, strict=True):
        write_image(out / f"images/{name}.png", photo)
        write_image(out / f"masks/{name}.png", mask * np.uint8(255))


def _write_pictures(out: Path, session: Session) -> None:
    """Photographs, in SPIn-NeRF's layout."""
    for name, photo in zip(session.names, session.photos, strict=True):
        write_image(out / f"images_4/{name}.png", photo)


def _write_test_masks(out: Path, session: Session, masks: Sequence[np.ndarray]) -> None:
    for k, mask in enumerate(masks):
        write_image(out / f"images_4/test_label/out_{k:05d}.png", mask * np.uint8(255))
        write_image(out / f"truth/masks_test/{session.names[k]}.png", mask * np.uint8(255))


def _write_removal(out: Path, session: Session, kind: Kind, world: World, frame: Frame) -> None:
    """Write masks of the object, or of each object, and the references if something has to be invented."""
    _write_test_masks(out, session, session.masks[: session.test])
    for k, name in enumerate(session.names):
        write_image(out / f"truth/never_seen/{name}.png", session.hidden[k] * np.uint8(255))
        if k < session.test:
            continue
        for own, of in session.object_masks.items():
            write_image(out / f"masks/{own}/{name}.png", of[k] * np.uint8(255))
        if not session.object_masks:
            write_image(out / f"images_4/label/{name}.png", session.masks[k] * np.uint8(1))
    (out / "scene.yaml").write_text(("" if kind.hangs else _write_references(out, session)) + PROFILE)


def _write_references(out: Path, session: Session) -> str:
    """Write the completed views; returns the lines of scene.yaml that name them."""
    files = ["reference.png", *(f"reference_{session.names[k]}.png" for k in list(session.completions)[1:])]
    entries = []
    for (k, picture), file in zip(session.completions.items(), files, strict=True):
        write_image(out / file, picture)
        entries.append(f"{{view: {session.names[k]}, image: {file}}}")
    if len(entries) == 1:
        return f"reference: {entries[0]}\n"
    return "reference:\n" + "".join(f"- {each}\n" for each in entries)


def _write_sparse_views(out: Path, session: Session, kind: Kind, world: World, frame: Frame) -> None:
    """Name a few photographs as training views and references; the other training views are cameras only."""
    shown = [session.names[k] for k in session.spread[: kind.shown]]
    references = "".join(f"- {{view: {name}, image: images_4/{name}.png}}\n" for name in shown)
    listed = lambda names: f"[{', '.join(names)}]\n"
    (out / "scene.yaml").write_text(
        f"train: {listed(shown)}clean: {listed(shown)}test: {listed(session.names[: session.test])}"
        f"cameras_only: others\nmasks: none\nreference:\n{references}{PROFILE}"
    )


def _write_insertion(out: Path, session: Session, kind: Kind, world: World, frame: Frame) -> None:
    """Write references that show the object, with depth, and a sphere that contains it."""
    _write_test_masks(out, session, session.masks[: session.test])
    center, radius = bounding_region(world.solids)
    region = {"center": frame.points(center).tolist(), "radius": frame.scale * radius}
    _write_region(out, region, _write_measured(out, session, session.completions, kind, world, frame))


def _write_outpainting(out: Path, session: Session, kind: Kind, world: World, frame: Frame) -> None:
    """Write a sphere on the middle view's optical axis, and whole pictures of some views with depth."""
    center = point_on_axis(session.cameras[session.middle], AWAY)
    masks = [outside_sphere(camera, kind, world, center, SPHERE) for camera in session.cameras[: session.test]]
    _write_test_masks(out, session, masks)
    middle = session.middle - session.test
    chosen = choose_covering_views(session.cameras[session.test :], kind, world, center, middle)
    whole = {session.test + k: session.photos[session.test + k] for k in chosen}
    sphere = {"view": session.names[session.middle], "distance": frame.scale * AWAY}
    sphere |= {"radius": frame.scale * SPHERE, "outside": True}
    _write_region(out, sphere, _write_measured(out, session, whole, kind, world, frame))


def _write_measured(
    out: Path, session: Session, pictures: dict[int, np.ndarray], kind: Kind, world: World, frame: Frame
) -> str:
    """Write pictures of views and their depth; returns the lines of scene.yaml that name them."""
    entries = ["reference:\n"]
    for k, picture in pictures.items():
        name = session.names[k]
        write_image(out / f"references/{name}.png", picture)
        np.save(out / f"references/{name}.npy", depth(session.cameras[k], kind, world, frame))
        entries.append(f"- {{view: {name}, image: references/{name}.png, depth: references/{name}.npy}}\n")
    return "".join(entries)


def _write_region(out: Path, region: dict, references: str) -> None:
    (out / "scene.yaml").write_text(f"masks: none\nregion: {json.dumps(region)}\n{references}{PROFILE}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    parser.add_argument("--seed", type=int, default=None, help="default 0; 7 for photos")
    parser.add_argument("--kind", choices=KINDS, default="demo")
    arguments = parser.parse_args()
    seed = arguments.seed if arguments.seed is not None else (7 if arguments.kind == "photos" else 0)
    facts = generate(arguments.out, seed, KINDS[arguments.kind])
    print(f"{arguments.out}: " + json.dumps(facts))


if __name__ == "__main__":
    main()
