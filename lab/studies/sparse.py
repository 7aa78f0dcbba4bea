"""Scores against the number of photographs: `make scene=demo-sparse sparse`.

A made scene of the kind `sparse` lists training views that are far apart from each other. The study takes the first 1,
2, 4 and 8 of them as photographs; all other training views are cameras without pixels. Two methods are run for each
number of photographs:

  method       the scene's own job
  plain 3DGS   only a fit to the photographs, from sparse points: the variant `remove_only`

The paper's third arm, in which the photographs only personalize the prior, needs a prior that invents (key `teach`).

Whole test views are scored. The study writes sparse.json and sparse.png to --out. Finished jobs are not run again. With
several scenes, made from several seeds, a curve is their mean.
"""

from __future__ import annotations

import argparse
import os
import shutil
from pathlib import Path

import numpy as np
import yaml

from lab.studies.jobs import ROOT, run_job
from reffusion.io.arrays import load_json, save_json, save_text
from report import charts

COUNTS = (1, 2, 4, 8)
SCORES = {"psnr_full": "PSNR (dB)", "flip_full": "FLIP"}
METHOD, PLAIN = "method", "plain 3DGS"
POINTS = "fit.few_views=fewer_harmonics"  # with this parameter the fit starts from the sparse points
METHODS = {  # method -> variant, parameters
    METHOD: ("", ""),
    PLAIN: ("remove_only", POINTS),
}
COLORS = {METHOD: charts.BLUE, PLAIN: charts.ORANGE}


def make_scene(scene: Path, count: int, folder: Path) -> Path:
    """Make a copy of a scene in which only `count` training views are photographs; its files are hard links.

    Args:
        scene: folder of a made scene.
        count: number of photographs, the first views of the list "shown" in truth/facts.json.
        folder: folder to put the copy in. An existing copy is reused, with a new scene.yaml.

    Returns:
        Folder of the copy.

    Raises:
        ValueError: the scene lists fewer than `count` views.
    """
    order = load_json(scene / "truth/facts.json").get("shown", [])
    if len(order) < count:
        raise ValueError(f"{scene / 'truth/facts.json'}: names no {count} views to show; is it a scene demo-sparse?")
    target = folder / f"{scene.name}-{count}-views"
    if not target.exists():
        shutil.copytree(scene, target, copy_function=os.link, ignore=shutil.ignore_patterns("scene.yaml", ".generated"))
    settings, names = yaml.safe_load((scene / "scene.yaml").read_text()), order[:count]
    references = [{"view": name, "image": f"images_4/{name}.png"} for name in names]
    save_text(
        target / "scene.yaml", yaml.safe_dump(settings | {"train": names, "clean": names, "reference": references})
    )
    return target


def run_method(scene: Path, way: str, runs: Path) -> dict[str, float]:
    """Run one method on a scene and return its mean scores over the test views.

    Args:
        scene: folder of the scene.
        way: the method, a key of `METHODS`.
        runs: folder in which each method has a folder of runs.

    Raises:
        ValueError: the run failed.
    """
    variant, settings = METHODS[way]
    run = run_job(scene, runs / way.replace(" ", "-"), variant=variant, settings=settings)
    mean = load_json(run / "evaluate" / "metrics.json")["mean"]
    return {name: mean[name] for name in SCORES}


def draw(scores: dict[str, dict[str, list[dict[str, float]]]], path: Path) -> None:
    """Draw the scores against the number of photographs, one panel per score and one curve per method.

    Args:
        scores: method -> number of photographs -> scores of each scene.
        path: PNG to write.
    """
    figure, grid = charts.new_figure(3.2, 1, len(SCORES))
    for axes, (score, title) in zip(grid[0], SCORES.items(), strict=True):
        for way, counts in scores.items():
            means = [np.mean([each[score] for each in scenes]) for scenes in counts.values()]
            axes.plot([int(count) for count in counts], means, "o-", color=COLORS[way], label=way)
        axes.set(xscale="log", xlabel="views with pixels", ylabel=title)
        charts.use_plain_log_ticks(axes)
        counts = sorted({int(count) for each in scores.values() for count in each})
        axes.set_xticks(counts, [str(count) for count in counts])
    grid[0, 0].legend(frameon=False, fontsize=9)
    charts.save_chart(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=Path, nargs="+", required=True)
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS)
    parser.add_argument("--ways", choices=METHODS, nargs="+", default=list(METHODS))
    parser.add_argument("--out", type=Path, default=ROOT / "runs/sparse")
    arguments = parser.parse_args()
    scores: dict[str, dict[str, list[dict[str, float]]]] = {way: {} for way in arguments.ways}
    for count in arguments.counts:
        for way in arguments.ways:
            scenes = [make_scene(scene, count, arguments.out / "scenes") for scene in arguments.scenes]
            scores[way][str(count)] = [run_method(scene, way, arguments.out) for scene in scenes]
            save_json(arguments.out / "sparse.json", scores)
    draw(scores, arguments.out / "sparse.png")
    for way, counts in scores.items():
        for count, each in counts.items():
            print(f"{way:16} {count:>2} views", *(f"{s} {np.mean([e[s] for e in each]):.3f}" for s in SCORES))


if __name__ == "__main__":
    main()
