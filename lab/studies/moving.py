"""An object of a real capture moved to another place: `python -m lab.studies.moving`.

The object is synthetic and drawn into the photographs of a capture. The training photographs show the object at a first
place, with masks; it is to be removed there and inserted at a second place. The references show the object at the
second place, in as many views as are needed to show all of its surface. Each reference has a depth map: the object's
depth, and elsewhere depth interpolated between sparse points. The truth is the photographs with the object drawn at the
second place; the *ceiling* is a fit to them. Cameras stay as given, because the object was drawn with them. The study
writes moving.json and a sheet of all test views (truth, with the object at the first place, our result, ceiling,
difference) to --out.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import numpy as np

from lab.studies import composites, compositing, placement, scoring
from lab.studies.jobs import ROOT, run_job
from reffusion.io.arrays import save_json
from reffusion.io.images import save_image

REGION_FACTOR = 1.08  # radius of the region to fill, over the object's radius
COVERED = 0.995  # least share of the object's visible surface that the references must show
GRID = 12  # points along each edge of a face, by which the visibility of the object is measured


def select_references(capture: placement.Photographs, thing: placement.PlacedObject, names: list[str]) -> list[str]:
    """Select photographs greedily until they show the share `COVERED` of the surface that any of the photographs shows.

    Each step adds the photograph that improves the resolution of the surface most. The resolution of a point is that of
    the best selected photograph, relative to the best of all photographs.

    Args:
        capture: the capture.
        thing: the object at its second place.
        names: names of the photographs to choose from.

    Returns:
        Names in the order of selection.
    """
    ticks = (np.arange(GRID) + 0.5) / GRID * 2 - 1
    sides = np.stack(np.meshgrid(ticks, ticks), -1).reshape(-1, 2)
    faces = [
        (axis, end) for axis in range(3) for end in (-1, 1) if (axis, end) != (2, -1)
    ]  # without the face it stands on
    at = np.concatenate([np.insert(sides, axis, end, 1) for axis, end in faces])
    normals = np.repeat(np.array([end * thing.axes[axis] for axis, end in faces]), len(sides), 0)
    points = thing.middle + (at * thing.half) @ thing.axes
    fine = np.stack([_fineness(capture, name, points, normals) for name in names])
    fine = fine[:, fine.any(0)] / fine.max(0)[fine.any(0)]
    chosen: list[int] = []
    while (best := fine[chosen].max(0, initial=0)).astype(bool).mean() < COVERED:
        chosen.append(int(np.maximum(fine, best).sum(1).argmax()))
    return [names[k] for k in chosen]


def _fineness(capture: placement.Photographs, name: str, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return how finely a photograph shows points, [P]: sqrt(cosine of viewing angle) / depth, 0 if not shown."""
    camera = capture.cameras[name]
    image, z = capture.project(camera, points)
    framed = ((image >= 0) & (image < (capture.width, capture.height))).all(1) & (z > 0)
    ways = camera[:3, 3] - points
    facing = (ways * normals).sum(1) / np.linalg.norm(ways, axis=1)
    return np.where(framed, np.sqrt(facing.clip(0)) / np.abs(z), 0)


def write_scenes(
    start: placement.Place,
    goal: placement.Place,
    capture: placement.Photographs,
    out: Path,
) -> Path:
    """Write the scene to out/<start>-to-<goal>, and the ceiling's to the same name with -untouched; return the former.

    Existing folders are replaced. Views are selected about the second place.

    Args:
        start: first place of the object, which also gives the object's size and shape at both places.
        goal: second place of the object, in the same capture.
        capture: the capture.
        out: folder to write to.
    """
    before, after = placement.place_object(capture, start), placement.place_object(capture, goal)
    after = placement.PlacedObject(after.foot, before.height, after.axes, before.half, before.shape)
    views, pictured = placement.select_views(capture, goal, after), compositing.PixelRays(capture)
    tints = np.random.default_rng(0).uniform(0.35, 0.9, (3, 3))
    scene, ceiling = (out / f"{start.name}-to-{goal.name}{end}" for end in ("", "-untouched"))
    train = [name for name in views.all if name not in views.test]
    references = select_references(capture, after, train)
    for folder in (scene, ceiling):
        shutil.rmtree(folder, ignore_errors=True)
    for name in views.all:
        camera, photo = capture.cameras[name], compositing.load_photograph(capture, name) / 255
        picture, at_goal = compositing.composite_object(photo, pictured, camera, after, tints)
        save_image(ceiling / f"images/{name}.png", picture)
        if name in views.test:
            save_image(scene / f"images/{name}.png", picture)
            for folder in (scene, ceiling):
                save_image(folder / f"test_masks/{name}.png", at_goal)
            continue
        with_it, mask = compositing.composite_object(photo, pictured, camera, before, tints)
        save_image(scene / f"images/{name}.png", with_it)
        save_image(scene / f"masks/{name}.png", mask)
        if name in references:
            save_image(scene / f"references/{name}.png", picture)
            depth = compositing.composite_depth(pictured, camera, after)
            depth[(mask > 0) & (at_goal == 0)] = np.nan  # unknown behind the object's first place
            np.save(scene / f"references/{name}.npy", depth)
    for folder in (scene, ceiling):
        compositing.write_cameras(capture, views, folder)
    tested = (
        f"test_masks: test_masks\ntest: {compositing.yaml_list(views.test)}\nstages: {{poses: {{refine: false}}}}\n"
    )
    (ceiling / "scene.yaml").write_text(f"masks: none\n{tested}")
    entries = "".join(
        f'- {{view: "{name}", image: references/{name}.png, depth: references/{name}.npy}}\n' for name in references
    )
    radius = REGION_FACTOR * float(np.linalg.norm(after.half))
    region = f"region: {{center: {after.middle.tolist()}, radius: {radius}}}\n"
    (scene / "scene.yaml").write_text(f"masks: masks\n{tested}{region}reference:\n{entries}")
    return scene


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=Path, default=ROOT.parent / "shared/data")
    parser.add_argument("--start", default="bear-rim")
    parser.add_argument("--goal", default="bear-rock")
    parser.add_argument("--profile", default="laptop")
    parser.add_argument("--out", type=Path, default=ROOT / "runs/moving")
    arguments = parser.parse_args()
    (start,), (goal,) = (composites.select_places(name, False) for name in (arguments.start, arguments.goal))
    if start.capture != goal.capture:
        parser.error(
            f"{start.name} is a place of {start.capture}, {goal.name} of {goal.capture}; take two of one capture"
        )
    scene = write_scenes(
        start, goal, placement.load_photographs(arguments.captures / start.capture), arguments.out / "scenes"
    )
    folders = (scene, scene.with_name(f"{scene.name}-untouched"))
    jobs = [run_job(each, arguments.out / "runs", profile=arguments.profile) for each in folders]
    run, ceiling = (scoring.Run.load(job) for job in jobs)
    save_image(arguments.out / f"{scene.name}.png", scoring.comparison_sheet(run, ceiling))
    scores = scoring.score_place(run, ceiling, {})
    save_json(arguments.out / "moving.json", {"place": scene.name, **scores})
    print(scores)


if __name__ == "__main__":
    main()
