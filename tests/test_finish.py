"""The stage `finish`: which result becomes scene.ply, and when it gets a backdrop; test views have no influence."""

from dataclasses import replace

import pytest
import torch
from scenes import wall_scene

from reffusion.background.backdrop import DISKS
from reffusion.io.arrays import load_json
from reffusion.io.ply import load_ply, save_ply
from reffusion.io.scene import load_scene, save_scene
from stages import evaluate, finish

pytestmark = pytest.mark.integration


@pytest.fixture
def fit_folders(tmp_path):
    poses, fit, _ = wall_scene.write_poses_and_fit(tmp_path, 1.0)
    return {"poses": poses, "raw_masks": poses.with_name("raw_masks"), "fit": fit}


def add_stages(folders, tmp_path):
    """Add `initialize` and `distill`, whose Gaussians differ from the fit's in number."""
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


def test_result_and_initialization_get_the_same_backdrop(fit_folders, tmp_path, monkeypatch):
    monkeypatch.setattr(finish, "MIN_UNSEEN_SHARE", 0.0)
    later = add_stages(fit_folders, tmp_path)
    facts, scene = run_finish(tmp_path / "out", later)
    assert facts["backdrop"] and facts["unseen_in_other_views"] > 0
    completed = {stage: load_ply(tmp_path / f"out/completed/{stage}.ply") for stage in ("initialize", "distill")}
    assert sorted(path.stem for path in (tmp_path / "out/completed").iterdir()) == sorted(completed)
    assert torch.equal(completed["initialize"].means[-DISKS:], completed["distill"].means[-DISKS:])
    assert len(scene) == len(completed["distill"])
    loaded = evaluate.load_stages(tmp_path / "out", {stage: later[stage] for stage in ("fit", *completed)}, "cpu")
    assert all(torch.equal(loaded[stage].means, completed[stage].means) for stage in completed)
    assert len(loaded["fit"]) == facts["gaussians"]["fit"]


def test_training_views_decide_and_not_test_views(fit_folders, tmp_path):
    """Views side by side leave a strip of the outermost unseen by all others; of one view, seen thrice, nothing."""
    scene = load_scene(fit_folders["poses"])
    found = {}
    for name, train in (("spread", scene.train), ("again", (scene.train[2],) * 3)):
        for test in (scene.test, ()):
            save_scene(fit_folders["poses"], replace(scene, train=train, test=test))
            found[name, test] = run_finish(tmp_path / f"{name}-{len(test)}", fit_folders)[0]
    assert [facts["backdrop"] for facts in found.values()] == [True, True, False, False]
    shares = [facts["unseen_in_other_views"] for facts in found.values()]
    assert shares[0] == shares[1] > 0.01 and shares[2] == shares[3] < 0.01


def test_a_scene_with_gaussians_keeps_them(fit_folders, tmp_path):
    """They may know more than the views do."""
    save_ply(fit_folders["poses"] / "gaussians.ply", load_ply(fit_folders["fit"] / "gaussians.ply"))
    facts, scene = run_finish(tmp_path / "out", fit_folders)
    assert facts["backdrop"] is False and facts["unseen_in_other_views"] is None
    assert len(scene) == facts["gaussians"]["fit"]


def test_evaluate_copies_the_scene(fit_folders, tmp_path):
    run_finish(tmp_path / "finish", fit_folders)
    (tmp_path / "evaluate").mkdir()
    evaluate.run(evaluate.Params(), tmp_path / "evaluate", **fit_folders, finish=tmp_path / "finish")
    assert (tmp_path / "evaluate/scene.ply").read_bytes() == (tmp_path / "finish/scene.ply").read_bytes()
    metrics, facts = (load_json(tmp_path / name) for name in ("evaluate/metrics.json", "finish/facts.json"))
    assert metrics["backdrop"] == facts["backdrop"] and metrics["result"] == "fit" and "seconds" not in metrics
