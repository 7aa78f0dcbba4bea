"""Stages on a GPU give the CPU's results and do not mix tensors of two devices; without a GPU, one is simulated."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from scenes import wall_scene
from scenes.simulated_gpu import has_gpu, simulated_gpu
from scenes.stage_runs import run_masks, write_true_references

from reffusion.io.arrays import load_labels
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import load_mask_sets
from reffusion.masks import regions
from reffusion.types import PARAMETERS
from stages import fit, initialize, masks

pytestmark = pytest.mark.integration

NEAR = 1.7


@pytest.fixture(scope="module")
def reference_folders(tmp_path_factory):
    """The folders of the stages up to `reference`, for a small scene with view-dependent colors."""
    home = tmp_path_factory.mktemp("scene")
    poses, fit_folder, _ = wall_scene.write_poses_and_fit(home, NEAR)
    gaussians = load_ply(fit_folder / "gaussians.ply")
    higher = torch.zeros(len(gaussians), 3, 3)
    save_ply(fit_folder / "gaussians.ply", replace(gaussians, sh=torch.cat([gaussians.sh, higher], 1)))
    masks_folder = run_masks(poses, fit_folder, home / "masks")
    reference = write_true_references(home / "reference", masks_folder, "a2")
    return {"poses": poses, "fit": fit_folder, "masks": masks_folder, "reference": reference}


def run_on_cpu_and_gpu(tmp_path, work) -> list:
    """Run `work(device, folder)` on the CPU and on the GPU; return both folders."""
    folders = [tmp_path / "cpu", tmp_path / "cuda"]
    for folder in folders:
        folder.mkdir()
    work("cpu", folders[0])
    with simulated_gpu():
        work("cuda", folders[1])
    return folders


def test_the_stand_in_refuses_what_cuda_refuses():
    with simulated_gpu():
        cpu, gpu = torch.ones(3), torch.ones(3, device="cuda")
        assert gpu.device.type == "cuda" and not cpu.is_cuda and (gpu + 1).is_cuda and gpu[cpu > 0].is_cuda
        for mixed in (lambda: cpu + gpu, lambda: torch.where(cpu > 0, gpu, 0.0), lambda: cpu[gpu > 0]):
            with pytest.raises(RuntimeError, match="same device"):
                mixed()
        with pytest.raises(TypeError, match="numpy"):
            gpu.numpy()
        assert gpu.cpu().numpy().sum() == 3 and (gpu.to(cpu) + cpu).device.type == "cpu"


@pytest.mark.parametrize("vote", ["weight", "count"])
def test_masks_on_a_gpu(reference_folders, tmp_path, vote):
    poses, fit_folder = reference_folders["poses"], reference_folders["fit"]
    run = lambda device, out: run_masks(poses, fit_folder, out, masks.Params(device=device, vote=vote))
    cpu, cuda = run_on_cpu_and_gpu(tmp_path, run)
    assert torch.equal(load_labels(cpu / "labels.npy"), load_labels(cuda / "labels.npy"))
    before, after = (load_mask_sets(folder, wall_scene.TRAIN) for folder in (cpu, cuda))
    for name in wall_scene.TRAIN:
        for kind in ("consistent", "unobserved", "invent"):
            differs = getattr(before[name], kind) != getattr(after[name], kind)
            assert differs.mean() <= (0.01 if has_gpu() else 0), (name, kind)  # a real GPU rounds differently


def test_a_region_on_a_gpu():
    gaussians, _ = wall_scene.wall_and_square(NEAR)
    box = regions.Region((0, 0, NEAR), (0.5, 0.5, 0.1))
    with simulated_gpu():
        inside = regions.inside_region(gaussians.map(lambda p: p.to("cuda")), box)
        assert inside.is_cuda and inside.any() and torch.equal(inside.cpu(), regions.inside_region(gaussians, box))


@pytest.mark.parametrize(
    "changed",
    [{"view_dependent_color": True, "refit_steps": 2, "extra_views": 1}, {"start": "random"}, {"start": "nothing"}],
    ids=["reference", "random", "nothing"],
)
def test_initialize_on_a_gpu(reference_folders, tmp_path, changed):
    cpu, cuda = run_on_cpu_and_gpu(
        tmp_path, lambda d, out: initialize.run(initialize.Params(device=d, **changed), out, **reference_folders)
    )
    assert torch.equal(load_labels(cpu / "labels.npy"), load_labels(cuda / "labels.npy"))
    before, after = (load_ply(folder / "gaussians.ply") for folder in (cpu, cuda))
    for name in PARAMETERS:  # the GPU's kernels of SSIM and Adam round differently
        near = (getattr(before, name) - getattr(after, name)).abs() <= 2e-2  # False where a value is NaN
        assert (~near).float().mean() <= (0.01 if has_gpu() else 0), name


def test_a_fit_on_a_gpu(reference_folders, tmp_path):
    changed = {"iterations": 6, "sh.degree": 1, "densify.cap_max": 300, "holdout": 3, "densify.stop": 0.5}
    changed |= {"densify.every": 2, "densify.start": 0.1, "checkpoint_seconds": 1e-9}
    run = lambda device, out: fit.run(
        fit.Params().changed(changed | {"device": device}), out, poses=reference_folders["poses"]
    )
    cpu, cuda = run_on_cpu_and_gpu(tmp_path, run)
    before, after = (load_ply(folder / "gaussians.ply") for folder in (cpu, cuda))
    assert len(before) == len(after)
    assert all(torch.allclose(getattr(before, n), getattr(after, n), atol=2e-2) for n in PARAMETERS)
