"""Preference study (the paper's Table 2) as a static page: the full method's clip beside another's, in random order.

Participants watch two clips of a scene and say which one looks better and which one is more faithful to the reference.
*Attention checks* are pairs of a clip and a corrupted copy of the clip; `report.votes` excludes participants who prefer
a corrupted copy. The clips show the runs of the comparison that `make scene=X compare` made.

python -m report.study --scene X --runs runs (`make scene=X study`, `make data=FOLDER study`), after `compare`
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from reffusion.io.arrays import save_json
from reffusion.io.images import load_image, save_image, to_uint8
from reffusion.io.ply import load_ply
from reffusion.io.scene import load_scene
from reffusion.seeding import generator
from reffusion.splat import rasterizer
from report import camera_path, cli
from report.results import FOLDER_COMPARISON, FULL, Comparison, Run, load_comparison
from report.sheet import GAP, pick_evenly
from report.turntable import RATE, save_video

PAGE = Path(__file__).with_name("study.html")
FRAMES = 96  # of a clip: four seconds, repeated
VIEWS_RATE = 4  # frames per second of a clip through the test views
STILLS = 3  # views side by side, if no video can be written
MIN_CHECKS = 2  # least number of attention checks; longer studies have about one in ten trials
BLOCK_SIZE = 24  # blocks of a corrupted clip, px
KEY = "study-key.json"  # says which method made which clip; beside the study's folder, which participants receive


@dataclass(frozen=True)
class Clip:
    """Clip of one method's result on one scene.

    Attributes:
        run: the method's run on the scene.
        frames: uint8 [H, W, 3] each.
        rate: frames per second.
    """

    run: Run
    frames: list[np.ndarray]
    rate: int


def make(home: Path, methods: list[str], seed: int = 0, frames: int = FRAMES) -> Path:
    """Write the study's page and clips to `home`/study/, and the key to `home`/study-key.json; return the page's path.

    The folder study/ can be served by any static web server or opened from the disk.

    Args:
        home: folder of the comparison: runs/<scene>, or runs/compare for a folder of scenes.
        methods: methods to compare with the full method; if empty, all methods of the comparison without duplicates.
        seed: seed of the clips' random names. The page combines the seed with each participant's name into the seed of
            the order of trials.
        frames: number of frames of a clip along a camera path.

    Raises:
        ValueError: nothing was compared, a named method was not compared or is a duplicate of an earlier one, or no
            pair of clips can be made.
    """
    comparison = load_comparison(home)
    others = [method for method in comparison.distinct_methods if method != FULL]
    if unknown := [method for method in methods if method not in others]:
        raise ValueError(f"variants: {unknown[0]} was not compared; there are {', '.join(others)}")
    out, draws = home / "study", generator(seed, "study")
    (out / "clips").mkdir(parents=True, exist_ok=True)
    trials: list[dict[str, Any]] = []
    key: dict[str, Any] = {"seed": seed, "clips": {}, "pairs": {}, "checks": {}}
    for scene, pairs in _pairs(comparison, methods or others, frames):
        reference = _save_reference(comparison.runs[FULL, scene], out, _random_name(draws))
        names: dict[str, str] = {}
        for ours, theirs in pairs:
            for clip in (ours, theirs):
                if clip.run.method not in names:
                    names[clip.run.method] = _save_clip(clip.frames, clip.rate, out / "clips", _random_name(draws))
                    key["clips"][names[clip.run.method]] = {"scene": scene, "method": clip.run.method}
            trial = {
                "id": _random_name(draws),
                "clips": [names[FULL], names[theirs.run.method]],
                "reference": reference,
            }
            trials.append(trial)
            key["pairs"][trial["id"]] = {"scene": scene, "method": theirs.run.method, "full": names[FULL]}
            if len(key["checks"]) < max(MIN_CHECKS, len(trials) / 10):
                corrupted = _save_clip(
                    [_corrupt(each, draws) for each in ours.frames], ours.rate, out / "clips", _random_name(draws)
                )
                check = {"id": _random_name(draws), "clips": [names[FULL], corrupted], "reference": reference}
                trials.append(check)
                key["checks"][check["id"]] = {"right": names[FULL]}
    if not key["pairs"]:
        raise ValueError(f"{home}: no pair of finished runs; `make ... compare` runs them")
    record = {"study": _random_name(draws), "seed": seed, "trials": sorted(trials, key=lambda trial: trial["id"])}
    key["study"] = record["study"]
    page = PAGE.read_text(encoding="utf-8").replace('"STUDY"', json.dumps(record).replace("</", "<\\/"))
    (out / "index.html").write_text(page, encoding="utf-8")
    save_json(home / KEY, key)
    return out / "index.html"


def _random_name(draws: torch.Generator) -> str:
    """Return a random name of ten hexadecimal digits."""
    return f"{int(torch.randint(16**10, (1,), generator=draws)):010x}"


def _pairs(comparison: Comparison, methods: list[str], frames: int) -> Iterator[tuple[str, list[tuple[Clip, Clip]]]]:
    """Yield each scene's name with the pairs of clips (full method, another method) that can be made; may be empty."""
    for scene in comparison.scenes:
        runs = [comparison.runs[method, scene] for method in (FULL, *methods)]
        ours, *others = [run for run in runs if run.state == "done"] if runs[0].state == "done" else [runs[0]]
        path_clip, pairs = _render_path(ours, frames), []
        for run in others:
            # Both clips follow the same path if both results are Gaussians. Otherwise both show the test views in turn.
            theirs = _render_path(run, frames) if path_clip else None
            pair = (path_clip, theirs) if theirs else (_load_test_views(ours), _load_test_views(run))
            if all(pair):
                pairs.append(pair)
        yield scene, pairs


def _render_path(run: Run, frames: int) -> Clip | None:
    """Render a clip along an elliptical path; None if the run is not finished or has pictures instead of Gaussians."""
    evaluate, poses = run.folders.get("evaluate"), run.folders.get("poses")
    if not evaluate or not poses or not (evaluate / "scene.ply").exists() or "inpainter" in run.metrics:
        return None
    scene = load_scene(poses)
    gaussians = load_ply(evaluate / "scene.ply", scene.similarity)
    cameras = camera_path.ellipse_path([scene.cameras[name] for name in scene.train], scene.points, frames)
    return Clip(run, [to_uint8(rasterizer.render(gaussians, each).color.numpy()) for each in cameras], RATE)


def _load_test_views(run: Run) -> Clip | None:
    """Return a clip of the rendered test views in the order of their names; None if there are no rendered views."""
    paths = sorted((run.folders["evaluate"] / "renders").glob("*.png")) if "evaluate" in run.folders else []
    return Clip(run, [load_image(path) for path in paths], VIEWS_RATE) if paths else None


def _save_clip(frames: list[np.ndarray], rate: int, folder: Path, name: str) -> str:
    """Save a clip in `folder`, as .webm or (no encoder) a PNG of stills; return its address, clips/<file>."""
    try:
        save_video(folder / f"{name}.webm", frames, rate)
    except ValueError:  # no video encoder is available
        (folder / f"{name}.webm").unlink(missing_ok=True)
        gap = np.full((frames[0].shape[0], GAP, 3), 255, np.uint8)
        stills = [
            part
            for place in pick_evenly([str(n) for n in range(len(frames))], STILLS)
            for part in (frames[int(place)], gap)
        ]
        save_image(folder / f"{name}.png", np.concatenate(stills[:-1], 1))
        return f"clips/{name}.png"
    return f"clips/{name}.webm"


def _corrupt(picture: np.ndarray, draws: torch.Generator) -> np.ndarray:
    """Return a picture reduced to coarse blocks, a third of which have random colors."""
    high, wide = picture.shape[:2]
    rows, columns = (max(2, round(side / BLOCK_SIZE)) for side in (high, wide))
    # The result is clearly worse, so that a participant who prefers it did not pay attention.
    small = cv2.resize(picture, (columns, rows), interpolation=cv2.INTER_AREA)
    noise = torch.randint(256, (rows, columns, 3), generator=draws).numpy().astype(np.uint8)
    chosen = torch.rand(rows, columns, generator=draws).numpy() < 1 / 3
    small[chosen] = noise[chosen]
    return cv2.resize(small, (wide, high), interpolation=cv2.INTER_NEAREST)


def _save_reference(run: Run, out: Path, name: str) -> str | None:
    """Save a run's first reference for the page; return its address on the page, or None if there is no reference."""
    folder = run.folders.get("reference")
    first = next(iter(sorted((folder / "references").glob("*.png"))), None) if folder else None
    if first is None:
        return None
    save_image(out / "clips" / f"{name}.png", load_image(first))
    return f"clips/{name}.png"


@cli.command
def main() -> None:
    """Run `reffusion study`: write the page, the clips and the key of a study, and print the path of the page."""
    parser = argparse.ArgumentParser(prog="reffusion study", description=__doc__.split("\n")[0])
    parser.add_argument("--scene", type=Path, help="name of the scene, or path of its folder")
    parser.add_argument("--data", type=Path, help="a folder of scenes instead")
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    parser.add_argument("--variants", default="", help="only these, separated by commas")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if not arguments.scene and not arguments.data:
        parser.error("--scene or --data: of which comparison?")
    methods = [method for method in arguments.variants.split(",") if method]
    name = cli.name_scene(arguments.scene) if arguments.scene else FOLDER_COMPARISON
    print(make(arguments.runs / name, methods, arguments.seed))


if __name__ == "__main__":
    main()
