"""Scenes skip work that they do not need: imports of libraries, negligible pixels, and spherical harmonics."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scenes import wall_scene
from scenes.settings import with_changes
from scenes.stage_runs import run_masks

from reffusion.capture import image_detail
from reffusion.fit.preparation import limit_sh_degree
from reffusion.io.arrays import load_json
from reffusion.io.scene import load_mask_sets, load_scene
from reffusion.params.distill import Params
from stages import fit, masks
from stages.plan import distill as plan_distill

ROOT = Path(__file__).resolve().parent.parent
# Libraries for diffusion, structure from motion, the viewer, clusters and LPIPS, which the stages below do not need.
UNUSED = ("diffusers", "transformers", "peft", "tokenizers", "pycolmap", "torchvision", "viser", "ray", "gsplat")


RUN_STAGES = """
import sys
from pathlib import Path
from stages import evaluate, finish, initialize, masks
home = Path(sys.argv[1])
given, raw_masks = {"poses": home / "poses", "fit": home / "fit"}, home / "raw_masks"
for name in ("masks", "initialize", "finish", "evaluate"):
    (home / name).mkdir()
masks.run(masks.Params(negligible=0.2), home / "masks", **given, raw_masks=raw_masks)
given["masks"] = home / "masks"
initialize.run(initialize.Params(), home / "initialize", **given, reference=None)
made = {"poses": home / "poses", "fit": home / "fit", "initialize": home / "initialize"}
finish.run(finish.Params(), home / "finish", **made)
made |= {"raw_masks": raw_masks, "masks": home / "masks", "finish": home / "finish"}
evaluate.run(evaluate.Params(), home / "evaluate", **made)
print(sorted({name.split(".")[0] for name in sys.modules} & set(sys.argv[2].split())))
"""


@pytest.mark.integration
def test_a_scene_whose_background_is_seen_imports_no_diffusion(tmp_path):
    wall_scene.write_poses_and_fit(tmp_path, 0.8)  # 1.2 before the wall, so other views show nearly all
    command = [sys.executable, "-c", RUN_STAGES, str(tmp_path), " ".join(UNUSED)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert load_json(tmp_path / "masks/facts.json")["invent_pixels"] == 0
    assert done.stdout.splitlines()[-1] == "[]"
    assert load_json(tmp_path / "evaluate/metrics.json")["result"] == "initialize"


def test_the_pipeline_leaves_diffusion_out_where_nothing_is_to_be_invented():
    stages = yaml.safe_load((ROOT / "pipeline.yaml").read_text())["stages"]
    for name in ("reference", "personalize", "distill"):
        facts = [c.get("fact") for c in stages[name]["skip_if"]]
        assert "masks.invent_pixels" in facts, name


def test_only_the_profile_laptop_leaves_sds_out():
    """Personalization follows: a prior that no term asks need not be there."""
    pipeline = yaml.safe_load((ROOT / "pipeline.yaml").read_text())
    runs = {name: profile["distill"].get("sds", {}).get("run") for name, profile in pipeline["profiles"].items()}
    assert runs == dict.fromkeys(runs) | {"laptop": "never", "fine": "never", "laptop-terms": "always"}
    nothing = with_changes(Params(), sds={"run": "never"}, depth={"weight": 0})
    assert plan_distill.needed_weights(nothing, frozenset()) == []
    assert plan_distill.needed_weights(with_changes(nothing, sds={"run": "always"}), frozenset()) != []


def test_few_unseen_pixels_are_negligible_and_it_can_be_forced(tmp_path):
    poses, fitted, _ = wall_scene.write_poses_and_fit(tmp_path, 0.8)

    def classified(**params):
        out = run_masks(poses, fitted, tmp_path / "-".join(map(str, params.values())), masks.Params(**params))
        return load_mask_sets(out, wall_scene.TRAIN).values(), load_json(out / "facts.json")

    sets, facts = classified(negligible=0.0)
    assert 0 < facts["unobserved_share"] < 0.1 and facts["invent_pixels"] > 0
    sets, few = classified(negligible=0.1)
    assert few["invent_pixels"] == 0 and few["unobserved_share"] == facts["unobserved_share"]
    assert not any(each.invent.any() for each in sets) and any(each.unobserved.any() for each in sets)
    sets, _ = classified(invent="consistent")
    assert all((each.invent == each.consistent).all() and each.invent.any() for each in sets)


@pytest.mark.parametrize("filter_", [cv2.INTER_LINEAR, cv2.INTER_CUBIC, cv2.INTER_LANCZOS4])
def test_enlarged_pictures_are_told_from_sharp_ones(filter_):
    rng = np.random.default_rng(0)
    # Photographs have about equal energy in each octave, like noise whose amplitude is 1 / frequency.
    frequency = np.hypot(np.fft.fftfreq(96)[:, None], np.fft.fftfreq(128)[None]).clip(1 / 128)
    fields = [np.fft.ifft2(np.fft.fft2(rng.normal(size=(96, 128))) / frequency).real for _ in range(3)]
    sharp = [np.clip(128 + 45 * field / field.std(), 0, 255).astype(np.uint8) for field in fields]
    sharp = [np.repeat(picture[..., None], 3, -1) for picture in sharp]
    twice = [cv2.resize(picture, None, fx=2, fy=2, interpolation=filter_) for picture in sharp]
    assert not image_detail.is_enlarged(sharp, 0.1)
    assert image_detail.is_enlarged(twice, 0.1)
    assert not image_detail.is_enlarged(twice, 0.0)  # a threshold of 0 turns the check off
    assert not image_detail.is_enlarged([np.full((64, 64, 3), 7, np.uint8)], 0.1)  # a plain picture gives no evidence


def test_no_more_harmonics_than_views():
    cameras = [wall_scene.front_camera(f"c{k}", 0.01 * k) for k in range(20)]
    point, behind = np.array([[0.0, 0.0, wall_scene.WALL]]), np.array([[0.0, 0.0, -wall_scene.WALL]])
    for count, degree in ((1, 0), (3, 0), (4, 1), (8, 1), (9, 2), (16, 3), (20, 3)):
        assert image_detail.choose_sh_degree(point, cameras[:count], 3) == (degree, count)
    assert image_detail.choose_sh_degree(point, cameras, 1)[0] == 1
    assert image_detail.choose_sh_degree(behind, cameras, 3) == (0, 0)
    assert image_detail.choose_sh_degree(np.zeros((0, 3)), cameras[:9], 3) == (2, 9)


def test_fit_takes_the_degree_that_the_views_support(tmp_path):
    poses, _, _ = wall_scene.write_poses_and_fit(tmp_path, 0.8)  # five training views
    scene = load_scene(poses)
    assert limit_sh_degree(fit.Params(), scene).sh.degree == 1
