"""What each part of the filling is worth: `python -m lab.studies.parts SCENE... --runs runs --out runs/parts`.

Every scene is a composite (`lab.studies.composites`) or another scene whose test views show no object; its job
through the stage `initialize` must be finished in --runs. Each part (`switches.PARTS`) is left out once: the stages run
again in this process from the first one that the part can change, on the same fit, and without distillation. Where
that stage writes equal bytes, the part does not act. With --texture only the stage `reference` runs, and its picture is
compared with the true photograph (seconds a part; composites only).

--out receives a record and a picture (truth, whole, without the part) of each part and scene, and parts.md: on how many
scenes each part acts, what leaving it out costs there (LPIPS (vgg) and PSNR in the mask's box, 95 % intervals over
scenes), core-seconds, and lines of code. Finished records are not made again, so several processes can share --out.
"""

from __future__ import annotations

import argparse
import filecmp
import importlib
import inspect
import io
import shutil
import time
import tokenize
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lab.studies.scene_priors import run_study
from lab.studies.switches import PARTS, TEXTURE, Switch
from reffusion.io.arrays import load_json, save_json, save_text
from reffusion.io.images import load_image, load_mask, save_image
from reffusion.metrics import image_metrics, lpips
from report import page
from report.paired_statistics import confidence_half_width

ROOT = Path(__file__).resolve().parents[2]
STAGES = ("masks", "reference", "initialize", "finish", "evaluate")  # those that run again, in order
VOLATILE = ("receipt.json", "trace.jsonl")  # files that hold run times
WHOLE = "nothing left out"
WORTH = 0.003  # LPIPS that a part has to gain where it acts
FEW = 6  # scenes on which a part has to act for a verdict


def run_stage(
    name: str, whole: Path, scene: Path, folders: Mapping[str, Path | None], out: Path, switch: Switch
) -> None:
    """Run a stage in this process with the parameters of a finished job, and the part left out.

    Args:
        name: name of the stage.
        whole: folder of the finished job, in which other stages are found.
        scene: folder of the scene.
        folders: stages that ran again -> their new folders; None if a stage is skipped.
        out: folder in which the stage writes.
        switch: the part that is left out.
    """
    values = load_json(whole / name / "receipt.json")["params"]
    for path, value in switch.settings.items():
        stage, *keys, last = path.split(".")
        group = values
        for key in keys if stage == name else ():
            group = group[key]
        if stage == name:
            group[last] = value
    run: Callable[..., None] = importlib.import_module(f"stages.{name}").run
    params = importlib.import_module(f"reffusion.params.{name}").Params(**values)
    needs = [need for need, each in inspect.signature(run).parameters.items() if each.kind is each.KEYWORD_ONLY]
    existing = {need: whole / need if (whole / need).exists() else None for need in needs}
    out.mkdir(parents=True)
    run(params, out, **{need: {**existing, "scene": scene, "distill": None, **folders}[need] for need in needs})


def leave_out(
    switch: Switch, whole: Path, scene: Path, work: Path, last: str, always: bool = False
) -> tuple[dict[str, Path | None], dict[str, float]]:
    """Run the stages from the first one that a part can change to `last` without this part.

    Args:
        switch: how the part is left out.
        whole: folder of the finished job.
        scene: folder of the scene.
        work: folder in which the stages write.
        last: name of the last stage.
        always: whether to go on if the first stage writes equal bytes.

    Returns:
        Stage -> folder in `work`, or None for a skipped one; empty if the first stage writes equal bytes, unless
        `always`. And stage -> core-seconds.
    """
    folders: dict[str, Path | None] = {}
    seconds = {}
    with switch.applied():
        for name in STAGES[STAGES.index(switch.stage) : STAGES.index(last) + 1]:
            masks = folders.get("masks") or whole / "masks"
            if name == "reference" and not load_json(masks / "facts.json")["invent_pixels"]:
                folders[name] = None
                continue
            began = time.process_time()
            run_stage(name, whole, scene, folders, work / name, switch)
            folders[name], seconds[name] = work / name, time.process_time() - began
            if name == switch.stage and not always and has_equal_files(work / name, whole / name):
                return {}, seconds
    return folders, seconds


def has_equal_files(first: Path, second: Path) -> bool:
    """Return whether two folders of a stage hold the same files with equal bytes, except `VOLATILE` ones."""
    names, others = (
        {path.relative_to(folder) for path in folder.rglob("*") if path.is_file() and path.name not in VOLATILE}
        for folder in (first, second)
    )
    return names == others and all(filecmp.cmp(first / name, second / name, shallow=False) for name in names)


def score_pictures(
    scene: Path, reference: Path, models: Mapping[str, Any]
) -> tuple[dict[str, float | None], np.ndarray]:
    """Score the completed view of the stage `reference` in the box of its hole.

    Returns:
        Scores, and the truth beside the view, cropped to the box, uint8 [H, W, 3].
    """
    view = load_json(reference / "candidates.json")["view"]
    hole = load_mask(reference / "masks" / f"{view}.png")
    truth, ours = load_image(scene / "truth" / f"{view}.png"), load_image(reference / "references" / f"{view}.png")
    box = image_metrics.mask_box(hole)
    assert box is not None and truth.shape == ours.shape
    truth, ours = box.crop(truth), box.crop(ours)
    scores = image_metrics.score(ours, truth, image_metrics.lpips_targets(truth, dict(models)))
    return {"lpips_vgg": scores["lpips_vgg"], "psnr": scores["psnr"]}, np.concatenate([truth, ours], 1)


def score_views(evaluate: Path) -> tuple[dict[str, float | None], np.ndarray]:
    """Return the mean scores of a folder of `evaluate` in the boxes, and its middle test view (fit, truth, result)."""
    mean = load_json(evaluate / "metrics.json")["mean"]
    views = sorted((evaluate / "side_by_side").glob("*.png"))
    scores = {"lpips_vgg": mean["lpips_vgg_box"], "psnr": mean["psnr_box"]}
    return scores, load_image(views[len(views) // 2])


def measure(part: str, switch: Switch, scene: Path, whole: Path, out: Path, texture: bool) -> None:
    """Write the record and the picture of one part on one scene.

    The record has "acts", "core_seconds" of each stage that ran, and, if the part acts, the scores "lpips_vgg" and
    "psnr".

    Args:
        part: its name; `WHOLE` for the job with nothing left out, to which the others are compared.
        switch: how it is left out.
        scene: folder of the scene.
        whole: folder of the finished job.
        out: folder of the records.
        texture: whether only the stage `reference` runs.
    """
    work = out / "work" / f"{scene.name}-{part}"
    shutil.rmtree(work, ignore_errors=True)
    last = "reference" if texture else "evaluate"
    folders, seconds = leave_out(switch, whole, scene, work, last, always=part == WHOLE)
    record: dict[str, Any] = {"acts": bool(folders), "core_seconds": seconds}
    if evaluate := folders.get("evaluate"):
        scores, picture = score_views(evaluate)
    elif reference := folders.get("reference"):
        vgg = lpips.load("vgg")[0]
        scores, picture = score_pictures(scene, reference, {"vgg": vgg} if vgg else {})
    if folders:
        record |= scores
        save_image(out / "pictures" / scene.name / f"{part}.png", picture)
    save_json(out / "records" / scene.name / f"{part}.json", record)
    shutil.rmtree(work, ignore_errors=True)


def count_code_lines(files: Sequence[str]) -> int:
    """Return the number of lines with code, without comments, docstrings and blank lines, of files of `reffusion/`."""
    lines = 0
    for file in files:
        tokens = list(tokenize.generate_tokens(io.StringIO((ROOT / "reffusion" / file).read_text()).readline))
        aside = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER)
        used: set[int] = set()
        for before, token in zip([None, *tokens], tokens, strict=False):
            is_docstring = token.type == tokenize.STRING and (before is None or before.type in aside)
            if token.type not in aside and not is_docstring:
                used |= set(range(token.start[0], token.end[0] + 1))
        lines += len(used)
    return lines


def difference_of_seconds(part: Mapping[str, Any], whole: Mapping[str, Any]) -> float:
    """Return the core-seconds of a record more than those of the whole job, over the stages that both ran."""
    return sum(value - whole["core_seconds"][stage] for stage, value in part["core_seconds"].items())


def judge(losses: np.ndarray) -> str:
    """Return the verdict on a part from what leaving it out costs in LPIPS on the scenes where it acts."""
    half = confidence_half_width(losses)
    if len(losses) < FEW or half is None:
        return f"acts on fewer than {FEW}"
    if losses.mean() >= WORTH and losses.mean() - half > 0:
        return "stays"
    return "goes" if losses.mean() + half < WORTH else "undecided"


def tabulate(records: Path) -> str:
    """Return the Markdown table of all records in a folder: a row for each part."""
    found = {
        folder.name: {path.stem: load_json(path) for path in folder.glob("*.json")} for folder in records.iterdir()
    }
    whole = {scene: each[WHOLE] for scene, each in found.items() if WHOLE in each}
    rows = []
    for part, switch in PARTS.items():
        measured = {scene: found[scene][part] for scene in whole if part in found[scene]}
        acting = {scene: each for scene, each in measured.items() if each["acts"]}
        cells = [part, f"{len(acting)} of {len(measured)}"]
        losses = np.array([each["lpips_vgg"] - whole[scene]["lpips_vgg"] for scene, each in acting.items()])
        decibels = np.array([each["psnr"] - whole[scene]["psnr"] for scene, each in acting.items()])
        saved = np.array([difference_of_seconds(each, whole[scene]) for scene, each in acting.items()])
        for values, digits in ((losses, 4), (decibels, 2), (saved, 0)):
            half = confidence_half_width(values)
            spread = "" if half is None else f" ± {half:.{digits}f}"
            cells.append(f"{values.mean():+.{digits}f}{spread}" if len(values) else "")
        cells += [str(count_code_lines(switch.files)) if switch.files else "", judge(losses)]
        rows += [cells] if measured else []
    header = ["left out", "acts on", "LPIPS (vgg)", "PSNR, dB", "core-seconds", "lines", "verdict"]
    return page.markdown_table(header, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path, help="folders of scenes")
    parser.add_argument("--runs", type=Path, default=Path("runs"), help="folder of runs, with the finished jobs")
    parser.add_argument("--out", type=Path, default=Path("runs/parts"))
    parser.add_argument("--texture", action="store_true", help="only the picture of the stage reference")
    parser.add_argument("--only", nargs="*", help="names of parts; default: all")
    arguments = parser.parse_args()
    out = arguments.out.resolve()
    parts = TEXTURE if arguments.texture else PARTS
    if wrong := set(arguments.only or ()) - set(parts):
        raise ValueError(f"no part is called {', '.join(sorted(wrong))}; there are {', '.join(parts)}")
    whole = {WHOLE: Switch("reference" if arguments.texture else "masks")}
    for scene in (each.resolve() for each in arguments.scenes):
        job = arguments.runs.resolve() / scene.name
        if not (job / "initialize").exists() and not (arguments.texture and (job / "reference").exists()):
            raise ValueError(f"{job}: the job is not finished; run `reffusion run initialize --scene {scene}`")
        for part, switch in (whole | {name: parts[name] for name in arguments.only or parts}).items():
            if not (out / "records" / scene.name / f"{part}.json").exists():
                measure(part, switch, scene, job, out, arguments.texture)
                save_text(out / "parts.md", tabulate(out / "records"))
    print(tabulate(out / "records"))


if __name__ == "__main__":
    run_study(main)
