"""The command `reffusion-nerfbaselines RUN --output FOLDER`: a finished run in nerfbaselines' formats.

These are a checkpoint, predictions and results, from which nerfbaselines' own commands make demos, tables and pages.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from nerfbaselines.datasets import dataset_load_features
from nerfbaselines.evaluation import evaluate, render_all_images
from nerfbaselines.web._web import WebBuilder

from reffusion_nerfbaselines.ask import RefFusionError
from reffusion_nerfbaselines.dataset import load
from reffusion_nerfbaselines.method import RefFusion, checkpoint, poses_of
from reffusion_nerfbaselines.spec import DATASET, METHOD


def main() -> None:
    parser = argparse.ArgumentParser(prog="reffusion-nerfbaselines", description=__doc__)
    parser.add_argument("run", type=Path, help="runs/<scene>, or runs/<scene>@<variant>")
    parser.add_argument("--data", type=Path, help="the scene's folder, in SPIn-NeRF's layout; else the views as the "
                        "run has them")  # fmt: skip
    parser.add_argument("--page", action="store_true", help="nerfbaselines' page of results too, in OUTPUT/page")
    parser.add_argument("--output", type=Path, required=True, help="a folder that is not there yet")
    arguments = parser.parse_args()
    if arguments.output.exists():
        raise SystemExit(f"error: {arguments.output} is there already")
    try:
        print(made(arguments.run, arguments.data or poses_of(arguments.run), arguments.output))
        if arguments.page:
            pages(arguments.output / "results", arguments.output / "page")
    except (RefFusionError, FileNotFoundError) as error:
        raise SystemExit(f"error: {error}") from None


def made(run: Path, data: Path, out: Path) -> dict[str, float]:
    """Return the metrics, and write checkpoint/, predictions/ and results/<scene>.json."""
    dataset = dataset_load_features(load(str(data), "test"))
    checkpoint(run, out / "checkpoint", dataset["metadata"])
    method = RefFusion(checkpoint=str(out / "checkpoint"))
    info = {"method": METHOD, "dataset_metadata": dataset["metadata"], "color_space": "srgb", "num_iterations": 1}
    for _ in render_all_images(method, dataset, output=str(out / "predictions"), nb_info=info):
        pass
    (out / "results").mkdir()
    results = out / "results" / f"{dataset['metadata']['scene']}.json"
    return evaluate(str(out / "predictions"), str(results))["metrics"]


def pages(results: Path, out: Path) -> None:
    """Build the pages of a folder of results, as `nerfbaselines web build` does after it has fetched published ones."""
    with tempfile.TemporaryDirectory() as nothing, WebBuilder(str(results), str(out), datasets=(DATASET,)) as builder:
        builder._raw_demo_params = {"mesh": {}, "demo": {}, "dataset": {}}  # what it would fetch
        builder._tmpdir_results = nothing
        builder.build()


if __name__ == "__main__":
    main()
