"""Stages on a GPU give what they give on the CPU; a stand-in for one, which refuses to mix tensors of two devices
(tests/other_device.py)."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from other_device import gpu, there_is_one
from scenes import wall_scene

from reffusion.io.arrays import load_labels
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import load_mask_sets, save_references
from reffusion.masks import regions
from reffusion.types import PARAMETERS, Reference
from stages import fit, initialize, masks

NEAR = 1.7


@pytest.fixture(scope="module")
def ready(tmp_path_factory):
    """A small scene, whose colours may change with the direction, up to a reference."""
    home = tmp_path_factory.mktemp("scene")
    poses, fitted, _ = wall_scene.write_poses_and_fit(home, NEAR)
    gaussians = load_ply(fitted / "gaussians.ply")
    higher = torch.zeros(len(gaussians), 3, 3)
    save_ply(fitted / "gaussians.ply", replace(gaussians, sh=torch.cat([gaussians.sh, higher], 1)))
    (home / "masks").mkdir()
    masks.run(masks.Params(), home / "masks", poses=poses, raw_masks=poses.with_name("raw_masks"), fit=fitted)
    hole = load_mask_sets(home / "masks", ["a2"])["a2"].invent
    save_references(
        home / "reference", [Reference(wall_scene.CAMERAS["a2"], wall_scene.photo(wall_scene.CAMERAS["a2"]), hole)]
    )
    return SimpleNamespace(home=home, poses=poses, fit=fitted)


def both(tmp_path, work) -> list:
    """The folders that `work(device, folder)` fills on the CPU and on the GPU."""
    folders = [tmp_path / "cpu", tmp_path / "cuda"]
    for folder in folders:
        folder.mkdir()
    work("cpu", folders[0])
    with gpu():
        work("cuda", folders[1])
    return folders


def test_the_stand_in_refuses_what_cuda_refuses():
    with gpu():
        here, there = torch.ones(3), torch.ones(3, device="cuda")
        assert there.device.type == "cuda" and not here.is_cuda and (there + 1).is_cuda and there[here > 0].is_cuda
        for mixed in (lambda: here + there, lambda: torch.where(here > 0, there, 0.0), lambda: here[there > 0]):
            with pytest.raises(RuntimeError, match="same device"):
                mixed()
        with pytest.raises(TypeError, match="numpy"):
            there.numpy()
        assert there.cpu().numpy().sum() == 3 and (there.to(here) + here).device.type == "cpu"


@pytest.mark.parametrize("vote", ["weight", "count"])
def test_masks_on_a_card(ready, tmp_path, vote):
    run = lambda device, out: masks.run(
        masks.Params(device=device, vote=vote),
        out,
        poses=ready.poses,
        raw_masks=ready.poses.with_name("raw_masks"),
        fit=ready.fit,
    )
    cpu, cuda = both(tmp_path, run)
    assert torch.equal(load_labels(cpu / "labels.npy"), load_labels(cuda / "labels.npy"))
    before, after = (load_mask_sets(folder, wall_scene.TRAIN) for folder in (cpu, cuda))
    for name in wall_scene.TRAIN:
        for kind in ("consistent", "unobserved", "invent"):
            differs = getattr(before[name], kind) != getattr(after[name], kind)
            assert differs.mean() <= (0.01 if there_is_one() else 0), (name, kind)  # a GPU rounds otherwise


def test_a_box_on_a_card():
    gaussians, _ = wall_scene.wall_and_square(NEAR)
    box = regions.Region((0, 0, NEAR), (0.5, 0.5, 0.1))
    with gpu():
        there = regions.inside_region(gaussians.map(lambda p: p.to("cuda")), box)
        assert there.is_cuda and there.any() and torch.equal(there.cpu(), regions.inside_region(gaussians, box))


@pytest.mark.parametrize(
    "changed",
    [{"view_dependent_color": True, "refit_steps": 2, "extra_views": 1}, {"start": "random"}, {"start": "nothing"}],
    ids=["reference", "random", "nothing"],
)
def test_initialize_on_a_card(ready, tmp_path, changed):
    needs = {"poses": ready.poses, "fit": ready.fit, "masks": ready.home / "masks"}
    needs |= {"reference": ready.home / "reference"}
    cpu, cuda = both(tmp_path, lambda d, out: initialize.run(initialize.Params(device=d, **changed), out, **needs))
    assert torch.equal(load_labels(cpu / "labels.npy"), load_labels(cuda / "labels.npy"))
    before, after = (load_ply(folder / "gaussians.ply") for folder in (cpu, cuda))
    for name in PARAMETERS:  # settling takes other kernels of SSIM and Adam there, which round otherwise
        near = (getattr(before, name) - getattr(after, name)).abs() <= 2e-2  # not where one is NaN
        assert (~near).float().mean() <= (0.01 if there_is_one() else 0), name


def test_a_fit_on_a_card(ready, tmp_path):
    changed = {"iterations": 6, "sh.degree": 1, "densify.cap_max": 300, "holdout": 3, "densify.stop": 0.5}
    changed |= {"densify.every": 2, "densify.start": 0.1, "checkpoint_seconds": 1e-9}
    run = lambda device, out: fit.run(fit.Params().changed(changed | {"device": device}), out, poses=ready.poses)
    cpu, cuda = both(tmp_path, run)
    before, after = (load_ply(folder / "gaussians.ply") for folder in (cpu, cuda))
    assert len(before) == len(after)
    assert all(torch.allclose(getattr(before, n), getattr(after, n), atol=2e-2) for n in PARAMETERS)
