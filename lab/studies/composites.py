"""Benchmark on real captures with synthetic objects: `python -m lab.studies.composites --places dino-ground`.

A synthetic object is drawn into the training photographs of a nerfstudio capture. The untouched photographs are the
exact truth behind the object. For each place in a capture the benchmark makes a scene and runs the whole method on it,
with the true reference unless --alone is given. A fit to the untouched photographs of the same views is the *ceiling*,
scored in the same boxes (bounding boxes of the masks).
The benchmark writes to --out composites.md, composites.json and for each place a sheet of all test views (truth, with
the object, our result, ceiling, difference) and a chart of errors against seconds. Settings of the method are chosen
only on the places that run without --report; all other places serve for reporting.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from lab.studies import compositing, drawn_places, placement, scoring
from lab.studies.jobs import run_job
from lab.studies.placement import Place
from reffusion.io.images import save_image
from report.job import draw_job
from report.job_data import load_job

# Places on which settings are chosen.
TUNING_PLACES = (
    Place("table", "garden", "frame_00097", (180, 270), 0.16, 50, 34, 8),
    Place("bear-rock", "bear", "frame_00041", (255, 395), 0.13, 100, 40, 5),
    Place("dino-ground", "dinosaur", "frame_00056", (250, 430), 0.14, 45, test=4, near=40, shape="ellipsoid"),
)
# Places that only report.
REPORT_PLACES = (
    Place("table-rim", "garden", "frame_00151", (377, 343), 0.12, 60, 34, 5),
    Place("table-vase", "garden", "frame_00120", (234, 285), 0.12, 50, 34, 8),
    Place("vase-front", "garden", "frame_00128", (290, 285), 0.12, 50, 34, 6),
    Place("bear-back", "bear", "frame_00037", (110, 390), 0.12, 90, 40, 4),
    Place("bear-rim", "bear", "frame_00061", (400, 366), 0.12, 45, 40, 4),
    Place("dino-gravel", "dinosaur", "frame_00055", (343, 423), 0.12, 60, 40, 6, near=40),
    Place("dino-plinth", "dinosaur", "frame_00019", (170, 440), 0.12, 60, 40, 6, near=40, shape="ellipsoid"),
)
# Places that run only if --places names them; no setting was chosen on them.
NAMED_PLACES = (
    Place("paving", "garden", "frame_00001", (130, 440), 0.13, 60, 34, 6, near=30),
    Place("lawn", "dinosaur", "frame_00096", (400, 400), 0.13, 50, 36, 5, near=40, shape="ellipsoid"),
    # Photographs at half size, points of our own stage `poses`. The object is drawn over the fox's head.
    Place("fox-wall", "fox", "0001", (300, 830), 0.13, 62, 40, 6, near=70),
    # LOG.md records photograph, pixel, size and shape of the following places, but not the arc, the numbers of views
    # and `near`. With these values, the numbers of photographs (10 to 30) differ by at most 5 from the recorded ones.
    Place("table-left", "garden", "frame_00056", (120, 262), 0.12, 30, 34, 6, near=30, shape="ellipsoid"),
    Place("t-right", "garden", "frame_00065", (420, 290), 0.10, 30, 34, 6, near=30),
    Place("t-small", "garden", "frame_00056", (330, 310), 0.05, 30, 34, 6, near=30),
    Place("pave2", "garden", "frame_00001", (250, 465), 0.12, 30, 34, 6, near=30, shape="ellipsoid"),
    Place("p-large", "garden", "frame_00001", (110, 455), 0.26, 30, 34, 6, near=30),
    Place("t-ref", "garden", "frame_00100", (300, 300), 0.14, 30, 34, 6, near=30, shape="ellipsoid"),
    Place("rock-left", "bear", "frame_00082", (60, 470), 0.12, 30, 34, 6, near=30),
    Place("rock-side", "bear", "frame_00091", (420, 470), 0.16, 30, 34, 6, near=30, shape="ellipsoid"),
    Place("r-small", "bear", "frame_00001", (300, 410), 0.05, 30, 34, 6, near=30, shape="ellipsoid"),
    Place("grass", "dinosaur", "frame_00028", (300, 430), 0.14, 30, 34, 6, near=30),
    Place("grass2", "dinosaur", "frame_00001", (330, 400), 0.15, 30, 34, 6, near=30, shape="ellipsoid"),
)


def make_scenes(place: Place, captures: Path, options: compositing.Options, out: Path) -> tuple[Path, Path]:
    """Make the scene of a place and the same scene without the object, in out/scenes.

    Scenes are made anew only if the place or the options have changed. All options share the scene without the object.

    Args:
        place: the place.
        captures: folder of captures.
        options: options of the scene.
        out: folder of the benchmark.

    Returns:
        Folder of the scene, and folder of the scene without the object.
    """
    scenes = out / "scenes"
    scene, untouched = scenes / (place.name + options.suffix), scenes / f"{place.name}-untouched"
    capture = None
    for folder, of in ((scene, [place, options]), (untouched, [place])):
        inputs = json.dumps([repr(part) for part in of])
        if (folder / "made.json").exists() and (folder / "made.json").read_text() == inputs:
            continue
        capture = capture or placement.load_photographs(captures / place.capture)
        if folder == scene:
            compositing.write_scene(place, capture, options, folder)
        else:
            compositing.write_untouched(place, capture, scene, folder)
        (folder / "made.json").write_text(inputs)
    return scene, untouched


def evaluate_place(
    place: Place, captures: Path, options: compositing.Options, out: Path, profile: str, variants: list[str]
) -> dict:
    """Make and run the scenes of a place, save sheets and a chart of errors against seconds; return the scores.

    Args:
        place: the place.
        captures: folder of captures.
        options: options of the scene.
        out: folder of the benchmark.
        profile: name of the profile.
        variants: names of variants to run and score as well.

    Returns:
        Row of the table: the result of `scoring.score_place`, and "place", the name of the scene.
    """
    scene, untouched = make_scenes(place, captures, options, out)
    run, ceiling = (scoring.Run.load(run_job(folder, out / "runs", profile=profile)) for folder in (scene, untouched))
    others = {
        name: scoring.Run.load_variant(run, run_job(scene, out / "runs", profile=profile, variant=name))
        for name in variants
    }
    save_image(out / f"{scene.name}.png", scoring.comparison_sheet(run, ceiling))
    for name, other in others.items():
        save_image(out / f"{scene.name}@{name}.png", scoring.comparison_sheet(other, ceiling))
    draw_job(load_job(run.folder), out / f"{scene.name}-seconds.png", ceiling.metrics["mean"]["psnr_box"])
    return {"place": scene.name, **scoring.score_place(run, ceiling, others)}


def select_places(names: str, report: bool) -> tuple[Place, ...]:
    """Return the places to run.

    Args:
        names: names of places of any set, or uses of drawn places (`drawn_places`), separated by commas; empty for a
            whole set.
        report: True for the set of places that only report, False for the set on which settings are chosen.

    Raises:
        ValueError: a name is unknown.
    """
    if not names:
        return REPORT_PLACES if report else TUNING_PLACES
    drawn = drawn_places.load_drawn_places()
    known = {place.name: (place,) for place in (*TUNING_PLACES, *REPORT_PLACES, *NAMED_PLACES, *drawn)}
    known |= {use: drawn_places.load_drawn_places(use) for use in ("judge", "mend", "sealed", "spare")}
    wrong = [name for name in names.split(",") if name not in known]
    if wrong:
        raise ValueError(f"no place is called {', '.join(wrong)}; there are {', '.join(known)}")
    return tuple(place for name in names.split(",") for place in known[name])


def run_benchmark(arguments: argparse.Namespace) -> int:
    """Run the benchmark with parsed arguments and return the exit status. Places without a capture are skipped."""
    options = compositing.Options(not arguments.alone, arguments.shadow, arguments.rough, arguments.seed)
    out, rows = arguments.out.resolve(), []
    for place in select_places(arguments.places, arguments.report):
        if not (arguments.captures / place.capture).is_dir():
            print(f"{place.name} skipped: there is no capture {arguments.captures / place.capture}")
            continue
        if arguments.make:
            print("made", *make_scenes(place, arguments.captures, options, out))
            continue
        variants = [name for name in arguments.variants.split(",") if name]
        rows.append(evaluate_place(place, arguments.captures, options, out, arguments.profile, variants))
        (out / "composites.json").write_text(json.dumps(rows, indent=1))
        (out / "composites.md").write_text(scoring.table(rows))
    if rows:
        print(scoring.table(rows))
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=Path, default=Path("../shared/data"), help="folder of nerfstudio captures")
    parser.add_argument("--places", default="", help="only these, separated by commas")
    parser.add_argument("--report", action="store_true", help="the places on which no setting was chosen")
    parser.add_argument("--out", type=Path, default=Path("runs/composites"))
    parser.add_argument("--alone", action="store_true", help="give no reference")
    parser.add_argument("--shadow", type=float, default=0.0, help="strength, 0 to 1, of a shadow that no mask contains")
    parser.add_argument("--rough", type=int, default=0, help="largest error of training masks, px")
    parser.add_argument("--seed", type=int, default=0, help="of the object's colours and the masks' faults")
    parser.add_argument("--profile", default="laptop", help="of pipeline.yaml")
    parser.add_argument(
        "--variants", default="", help="variants of pipeline.yaml, separated by commas, to score as well"
    )
    parser.add_argument("--make", action="store_true", help="only make the scenes")
    arguments = parser.parse_args()
    if not arguments.captures.is_dir():
        print(f"skipped: there are no captures at {arguments.captures}")
        return 0
    try:
        return run_benchmark(arguments)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
