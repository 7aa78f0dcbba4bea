"""An object removed from one place of a real capture and put in at another: `python -m benchmarks.studies.moving`.

The training photographs show the object where it stood, with masks; three pictures of it at the other place are the
references, each with the depth of the object, of the ground around its foot and between sparse points. The
same object drawn there into all photographs is the truth, and a fit to them the ceiling. Writes moving.json and a sheet
of all test views (truth, as photographed, ours, ceiling, difference) to --out.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import numpy as np

from benchmarks.studies import composites, drawing, judging, placing
from reffusion.io.arrays import save_json
from reffusion.io.images import save_image

ROOM_FOR_IT = 1.08  # radius of the region over that of the object
GROUND = 0.9  # of the object's height: how far around its foot the depth of the ground is told
REFERENCES = 3


def write(start: placing.Place, goal: placing.Place, capture: placing.Photographs, out: Path) -> Path:
    """The scene in out/<start>-to-<goal>, and the ceiling's beside it; its folder."""
    before, after = placing.stand(capture, start), placing.stand(capture, goal)
    after = placing.Thing(after.foot, before.height, after.axes, before.half, before.shape)
    views, pictured = placing.views_around(capture, goal, after), drawing.Pictured(capture)
    tints = np.random.default_rng(0).uniform(0.35, 0.9, (3, 3))
    scene, ceiling = (out / f"{start.name}-to-{goal.name}{end}" for end in ("", "-untouched"))
    train = [name for name in views.all if name not in views.test]
    asked = [train[k] for k in np.linspace(0, len(train) - 1, REFERENCES).round().astype(int)]
    for folder in (scene, ceiling):
        shutil.rmtree(folder, ignore_errors=True)
    for name in views.all:
        camera, photo = capture.cameras[name], drawing.photograph(capture, name) / 255
        shown, mask = drawing.drawn_into(photo, pictured, camera, after, tints)
        save_image(ceiling / f"images/{name}.png", shown)
        if name in views.test:
            save_image(scene / f"images/{name}.png", shown)
            for folder in (scene, ceiling):
                save_image(folder / f"test_masks/{name}.png", mask)
            continue
        with_it, mask = drawing.drawn_into(photo, pictured, camera, before, tints)
        save_image(scene / f"images/{name}.png", with_it)
        save_image(scene / f"masks/{name}.png", mask)
        if name in asked:
            save_image(scene / f"references/{name}.png", shown)
            np.save(scene / f"references/{name}.npy", drawing.depth(pictured, camera, after, GROUND))
    for folder in (scene, ceiling):
        drawing.write_meta(capture, views, folder)
    tested = f"test_masks: test_masks\ntest: {drawing.listed(views.test)}\n"
    (ceiling / "scene.yaml").write_text(f"masks: none\n{tested}")
    given = "".join(
        f'- {{view: "{name}", image: references/{name}.png, depth: references/{name}.npy}}\n' for name in asked
    )
    radius = ROOM_FOR_IT * float(np.linalg.norm(after.half))
    region = f"region: {{center: {after.middle.tolist()}, radius: {radius}}}\n"
    (scene / "scene.yaml").write_text(f"masks: masks\n{tested}{region}reference:\n{given}")
    return scene


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=Path, default=composites.ROOT.parent / "shared/data")
    parser.add_argument("--start", default="bear-rim")
    parser.add_argument("--goal", default="bear-rock")
    parser.add_argument("--profile", default="laptop")
    parser.add_argument("--out", type=Path, default=composites.ROOT / "runs/moving")
    given = parser.parse_args()
    (start,), (goal,) = (composites.chosen(name, False) for name in (given.start, given.goal))
    if start.capture != goal.capture:
        parser.error(
            f"{start.name} is a place of {start.capture}, {goal.name} of {goal.capture}; take two of one capture"
        )
    scene = write(start, goal, placing.load(given.captures / start.capture), given.out / "scenes")
    folders = (scene, scene.with_name(f"{scene.name}-untouched"))
    run, ceiling = (judging.Run.at(composites.job(each, given.out / "runs", given.profile)) for each in folders)
    save_image(given.out / f"{scene.name}.png", judging.sheet(run, ceiling))
    scores = judging.scores(run, ceiling)
    save_json(given.out / "moving.json", {"place": scene.name, **scores})
    print(scores)


if __name__ == "__main__":
    main()
