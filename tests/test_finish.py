"""The stage `finish`: which Gaussians become scene.ply, and when a backdrop (a distant background sphere) is added."""

import pytest
import torch
from scenes import wall_scene

from reffusion.background.backdrop import DISKS
from reffusion.io.arrays import load_json
from reffusion.io.ply import load_ply, save_ply
from stages import evaluate, finish

pytestmark = pytest.mark.integration


@pytest.fixture
def fit_folders(tmp_path):
    poses, fit, _ = wall_scene.write_poses_and_fit(tmp_path, 1.0)
    return {"poses": poses, "fit": fit}


def add_stages(folders, tmp_path):
    """Write `initialize` and `distill` with one and two Gaussians fewer than the fit; return all folders."""
    gaussians = load_ply(folders["fit"] / "gaussians.ply")
    for count, stage in enumerate(("initialize", "distill"), start=1):
        folders = folders | {stage: tmp_path / stage}
        save_ply(folders[stage] / "gaussians.ply", gaussians.map(lambda p, n=count: p[n:]))
    return folders


def run_finish(out, fit_folders, **params):
    out.mkdir()
    finish.run(finish.Params(**params), out, **fit_folders)
    return load_json(out / "facts.json"), load_ply(out / "scene.ply")


def test_the_last_stage_is_the_result(fit_folders, tmp_path):
    count = len(load_ply(fit_folders["fit"] / "gaussians.ply"))
    facts, scene = run_finish(tmp_path / "alone", fit_folders, backdrop=False)
    assert facts["result"] == "fit" and len(scene) == count
    later = add_stages(fit_folders, tmp_path)
    facts, scene = run_finish(tmp_path / "two", later | {"distill": None}, backdrop=False)
    assert facts["result"] == "initialize" and len(scene) == count - 1
    facts, scene = run_finish(tmp_path / "three", later, backdrop=False)
    assert facts["result"] == "distill" and len(scene) == count - 2
    assert facts["gaussians"] == {"fit": count, "initialize": count - 1, "distill": count - 2}
    assert facts["backdrop"] is False and not (tmp_path / "three" / "completed").exists()


def test_result_and_initialization_get_the_same_backdrop(fit_folders, tmp_path):
    later = add_stages(fit_folders, tmp_path)
    facts, scene = run_finish(tmp_path / "out", later)
    assert facts["backdrop"]
    completed = {stage: load_ply(tmp_path / f"out/completed/{stage}.ply") for stage in ("initialize", "distill")}
    assert sorted(path.stem for path in (tmp_path / "out/completed").iterdir()) == sorted(completed)
    assert torch.equal(completed["initialize"].means[-DISKS:], completed["distill"].means[-DISKS:])
    assert len(scene) == len(completed["distill"])
    loaded = evaluate.load_stages(tmp_path / "out", {stage: later[stage] for stage in ("fit", *completed)}, "cpu")
    assert all(torch.equal(loaded[stage].means, completed[stage].means) for stage in completed)
    assert len(loaded["fit"]) == facts["gaussians"]["fit"]


def test_a_scene_with_gaussians_keeps_them(fit_folders, tmp_path):
    """If the capture came with Gaussians, `finish` adds no backdrop: the file may show more than the views."""
    save_ply(fit_folders["poses"] / "gaussians.ply", load_ply(fit_folders["fit"] / "gaussians.ply"))
    facts, scene = run_finish(tmp_path / "out", fit_folders)
    assert facts["backdrop"] is False
    assert len(scene) == facts["gaussians"]["fit"]


def test_evaluate_copies_the_scene(fit_folders, tmp_path):
    run_finish(tmp_path / "finish", fit_folders)
    (tmp_path / "evaluate").mkdir()
    folders = fit_folders | {"raw_masks": fit_folders["poses"].with_name("raw_masks"), "finish": tmp_path / "finish"}
    evaluate.run(evaluate.Params(), tmp_path / "evaluate", **folders)
    assert (tmp_path / "evaluate/scene.ply").read_bytes() == (tmp_path / "finish/scene.ply").read_bytes()
    metrics, facts = (load_json(tmp_path / name) for name in ("evaluate/metrics.json", "finish/facts.json"))
    assert metrics["backdrop"] == facts["backdrop"] and metrics["result"] == "fit" and "seconds" not in metrics
