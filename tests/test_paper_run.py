"""The profile `paper` from the masks to the scores, every term on, with small random models of the real architectures."""

from __future__ import annotations

import importlib
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import small_scene as small
import torch
from test_monocular import small_model

from benchmarks.gpu import full_size
from reffusion.depth import monocular
from reffusion.io.arrays import load_json, load_labels, save_json
from reffusion.io.images import load_image
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import load_mask_sets, load_references, load_scene
from reffusion.io.traces import read_trace
from reffusion.params.base import Settings
from reffusion.prior.model import pipeline
from runner.resolve import Request, resolve

ROOT = Path(__file__).resolve().parent.parent
STAGES = {
    "masks": ("poses", "fit"),
    "reference": ("scene", "poses", "fit", "masks"),
    "personalize": ("poses", "reference"),
    "initialize": ("poses", "fit", "masks", "reference"),
    "distill": ("poses", "fit", "masks", "reference", "personalize", "initialize"),
    "evaluate": ("poses", "fit", "masks", "reference", "personalize", "initialize", "distill"),
}
# All that differs from the profile: sizes, numbers of steps, where to compute and where the weights lie.
CHANGED = {
    "reference.sampler.steps": 2,
    "reference.candidates": 2,
    "personalize.steps": 3,
    "personalize.optimizer.batch": 2,
    "distill.iterations": 18,
    "distill.densify.every": 4,
    "distill.depth.steps": 2,
    "distill.adversarial.patches": 4,
    "distill.adversarial.size": 16,
    "distill.adversarial.width": 4,
}
WHERE = ("device", "dtype", "prior", "depth.model")


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Folders of an SD2, an SDXL and a Depth Anything, as the libraries write them."""
    folder = tmp_path_factory.mktemp("weights")
    for name, shape in (("sd2", full_size.SD2), ("sdxl", full_size.SDXL)):
        prior = full_size.build(full_size.shrunk(shape), torch.float32)
        pipeline(replace(prior, zero_empty=True)).save_pretrained(folder / name)
    network_of_the_ramp().save_pretrained(folder / "depth")
    return folder


def network_of_the_ramp() -> torch.nn.Module:
    """A random Depth Anything that happens to say, roughly, how the tilted wall lies."""
    wanted = -np.mgrid[: small.HEIGHT, : small.WIDTH][0].ravel()
    for seed in range(40):
        model = small_model(seed=seed)
        network = monocular.make_network(model)
        said = [monocular.disparity(network, picture(view)).numpy().ravel() for view in small.CAMERAS.values()]
        if min(np.corrcoef(answer, wanted)[0, 1] for answer in said) > 0.5:
            return model
    raise AssertionError("no such network among 40")


def picture(view) -> torch.Tensor:
    return torch.from_numpy(small.photo(view)).permute(2, 0, 1) / 255


def tilted(fit: Path) -> None:
    """The wall leans, as seen from the middle: a wall parallel to the views would not fix the scale of a depth."""
    gaussians = load_ply(fit / "gaussians.ply")
    means = gaussians.means / (1 - 0.2 * gaussians.means[:, 1:2] / small.WALL)
    save_ply(fit / "gaussians.ply", replace(gaussians, means=means))


@pytest.fixture(scope="module")
def made(weights, tmp_path_factory):
    """Every stage's folder, and its parameters."""
    home = tmp_path_factory.mktemp("paper")
    paths = {name: home / name for name in ("scene", "poses", "fit", *STAGES)}
    small.write(home, 1.5)
    tilted(paths["fit"])
    small.write_photos(paths["scene"], paths["poses"], small.CAMERAS)
    where = {
        "reference": {"prior": weights / "sdxl"},
        "personalize": {"prior": weights / "sd2"},
        "initialize": {"depth.model": weights / "depth"},
        "distill": {"prior": weights / "sd2", "depth.model": weights / "depth"},
    }
    params = parameters(where)
    for stage, needs in STAGES.items():
        paths[stage].mkdir(exist_ok=True)
        module = importlib.import_module(f"stages.{stage}")
        import time; b=time.time()
        module.run(params[stage], paths[stage], **{need: paths[need] for need in needs})
        print('TIME',stage,time.time()-b)
    return paths, params


def parameters(where: dict[str, dict[str, Path]]) -> dict[str, Settings]:
    """stage -> the profile's parameters but for `CHANGED` and `WHERE`."""
    said = resolve(Request(ROOT, ROOT / "runs", "", profile="paper"), scene=False).params
    params = {}
    for stage in STAGES:
        profile = importlib.import_module(f"reffusion.params.{stage}").Params(**said[stage])
        sizes = {name.split(".", 1)[1]: value for name, value in CHANGED.items() if name.startswith(f"{stage}.")}
        places = {name: str(path) for name, path in where.get(stage, {}).items()}
        on_cpu = {k: v for k, v in {"device": "cpu", "dtype": "float32"}.items() if k in said[stage]}
        params[stage] = profile.changed(sizes | places | on_cpu)
    return params


def test_it_runs(made):
    paths, params = made
    print({p.name: load_json(p/"facts.json") for p in paths.values() if (p/"facts.json").exists()})
    for line in read_trace(paths["distill"] / "trace.jsonl"): print(line)
    print(load_json(paths["evaluate"] / "metrics.json"))
