"""One page on what a scene's job did: errors against time, seconds, pictures, what was left out and why.

python -m report.job --scene X --runs runs          runs/X/report.html, one file
python -m report.job --data FOLDER --runs runs      runs/report/index.html, of all scenes in the folder
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from tempfile import TemporaryDirectory

from reffusion.io.arrays import load_json
from reffusion.io.scene import load_warnings
from report import before, command, covered, curves, drawn, inside, page, scenes, settings
from report.loading import Job, load_job

WORDS = {
    "skip": "left\u00a0out", "provided": "brought", "cached": "done", "run": "to\u00a0run", "stale": "to\u00a0run",
    "missing": "cannot\u00a0run", "pending": "pending",
}  # fmt: skip
STYLE = """
.grid { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(14rem, 46%), 1fr)); gap: .6rem }
.grid figure { margin: 0; break-inside: avoid } .grid img { width: 100%; margin: 0 }
figcaption { overflow-wrap: anywhere }
img.chart { max-width: none; width: max(100%, 40rem) } summary { cursor: pointer; padding: .4rem 0; color: #0a5a8c }
td.bar { background: linear-gradient(#bcd9ec, #bcd9ec) no-repeat left; min-width: 6rem; print-color-adjust: exact }
@media print { img.chart { width: 100% } .wide { overflow: visible } }
"""
RESULTS = {
    "evaluate/scene.ply": "the result as Gaussians, in the scene's own frame",
    "evaluate/renders": "renders of the result",
    "evaluate/metrics.json": "scores, with their protocol",
    "evaluate/per_view.csv": "scores of every view",
    "evaluate/side_by_side": "with the object, ground truth, result",
    "reference/references": "the references",
    "personalize/pytorch_lora_weights.safetensors": "LoRA of the prior",
    "fit/gaussians.ply": "the scene with the object, normalised frame",
}


def make(home: Path) -> Path:
    """Write runs/<scene>/report.html, which needs no other file; gives back its path."""
    job = load_job(home)
    title = f"{home.name}: what was done"
    seconds = sum(receipt["seconds"] for receipt in job.receipts.values())
    done = f"{page.duration(seconds)} in {len(job.receipts)} stages"
    parts = [page.heading(title, 1), page.paragraph(f"{done}. {outcome(job)}"), *unfinished(job), *said(job)]
    parts += before.section(job) + drawn.masks(job) + drawn.references(job) + drawn.depths(job) + covered.section(job)
    with TemporaryDirectory() as charts:
        parts += whole(job, Path(charts)) + stages(job, Path(charts))
    parts += left_out(job) + settings.section(job) + receipts(job) + settings.command(job) + artifacts(job)
    path = home / "report.html"
    path.write_text(page.document(title, parts, STYLE + before.STYLE, before.SCRIPT), encoding="utf-8")
    return path


def outcome(job: Job) -> str:
    """The result in a sentence."""
    mean, counts = job.metrics.get("mean", {}), job.metrics.get("gaussians", {})
    if not job.metrics:
        return "It is not evaluated yet."
    count = counts.get(job.metrics.get("result"))
    gaussians = f"{count:,} Gaussians" if count else "The result"
    if mean.get("psnr_box") is None:
        return f"{gaussians}; no ground truth, so no scores."
    suspects = ", ".join(job.metrics.get("suspects") or ())
    but = f"; photographs of these contradict their poses: {suspects}" if suspects else ""
    return f"{gaussians}; {mean['psnr_box']:.2f} dB and FLIP {mean['flip_box']:.3f} in the box of the test views{but}."


# --------------------------------------------------------------------------------------------------------- sections


def unfinished(job: Job) -> list[str]:
    """The stages that are still to run."""
    due = [stage for stage, told in job.plan.items() if told["word"] not in ("cached", "skip", "provided")]
    if not job.plan:
        due = [stage for stage in ("poses", "fit", "evaluate") if stage not in job.folders]
    return [page.paragraph(f"Still to run, or to run again: {', '.join(due)}.")] if due else []


def said(job: Job) -> list[str]:
    """Which frames of a video were taken, how structure from motion went, and what was odd about the photographs."""
    record = job.home.with_name(job.home.name.split("@")[0]) / "frames" / "frames.json"
    lines = [load_json(record)["said"]] if record.is_file() else []
    if "poses" in job.folders:
        solved = job.folders["poses"] / "sfm.json"
        lines += [load_json(solved)["summary"]] if solved.is_file() else []
    for stage in ("poses", "raw_masks"):
        lines += load_warnings(job.folders[stage]) if stage in job.folders else []
    return [page.bullets(lines)] if lines else []


def whole(job: Job, out: Path) -> list[str]:
    """The whole job against the clock, and the scores of initialization and result."""
    draw(job, out / "job.png")
    parts = [page.heading("The whole job"), inside.chart(out / "job.png", "PSNR and stages against seconds")]
    if any(stage in job.traces for stage in ("fit", "distill")):
        words = (
            "Curves: each stage's own error, on training views or references. Test views are only scored at the end."
        )
        parts.append(page.paragraph(words, quiet=True))
    return parts + scores(job)


def draw(job: Job, path: Path, ceiling: float | None = None) -> None:
    """PSNR and stages against seconds; `ceiling`: see `curves.job_chart`."""
    seconds = {stage: receipt["seconds"] for stage, receipt in job.receipts.items()}
    lines = {stage: series.get("", []) for stage, series in job.traces.items()}
    result = job.metrics.get("result", "")
    box = {"initialize": job.metrics.get("initialize", {}).get("psnr_box")}
    box |= {result: job.metrics.get("mean", {}).get("psnr_box")}
    curves.job_chart(seconds, {stage: own for stage, own in lines.items() if own}, box, path, ceiling)


def scores(job: Job) -> list[str]:
    """The mean metrics, those of the initialization beside them."""
    after, before = job.metrics.get("mean", {}), job.metrics.get("initialize", {})
    names = [name for name, value in after.items() if value is not None]
    if not names:
        return []
    lines = [
        [title, *(page.number(values.get(n), 2 if "psnr" in n else 4) for n in names)]
        for title, values in (("initialization", before), ("result", after))
        if any(values.get(name) is not None for name in names)
    ]
    return [page.table(["mean over test views", *names], lines)]


def stages(job: Job, out: Path) -> list[str]:
    """A chart for each stage with a trace."""
    parts = []
    for stage, series in job.traces.items():
        path = out / f"{stage}.png"
        if names := curves.stage_chart(stage, series, path):
            parts += [page.heading(f"{stage}: error against seconds"), inside.chart(path, ", ".join(names))]
    parts += [page.paragraph(f"Not drawn: {why}", quiet=True) for why in job.unread]
    return parts


def left_out(job: Job) -> list[str]:
    """The runner's words for stages that are not simply done."""
    if not job.plan:
        return []
    rows = [
        [stage, WORDS.get(said["word"], said["word"]), "; ".join([said["reason"], *said["notes"]])]
        for stage, said in job.plan.items()
        if said["word"] != "cached" or said["reason"]
    ]
    parts = [page.heading("What was left out or taken over, and why")]
    return parts + ([page.table(["stage", "", "because"], rows, text=(1, 2))] if rows else [page.paragraph("Nothing.")])


def receipts(job: Job) -> list[str]:
    """Seconds, memory and where it ran; versions once."""
    total = sum(receipt["seconds"] for receipt in job.receipts.values())
    rows = []
    for stage, r in job.receipts.items():
        share = f"{100 * r['seconds'] / total:.0f}%" if total else "–"
        resumed = "last try only" if r.get("resumed") else ""
        place = [r.get("device", "cpu"), r.get("machine", ""), r["profile"], r.get("date", "")[:16].replace("T", " ")]
        rows.append([stage, f"{r['seconds']:.1f}", share, f"{r['peak_memory_mb']:,}", *place, resumed])
    header = ["stage", "seconds", "share", "peak MB", "device", "machine", "profile", "made", ""]
    versions = {name: v for r in job.receipts.values() for name, v in r.get("versions", {}).items()}
    said = ", ".join(f"{name} {version}" for name, version in versions.items())
    table = page.table(header, rows, text=(4, 5, 6, 7, 8))
    return [page.heading("Receipts"), table, page.paragraph(f"With {said}.", quiet=True) if said else ""]


def artifacts(job: Job) -> list[str]:
    there = {"turntable.webm: a way around the capture": "turntable.webm"}
    there = there if (job.home / "turntable.webm").is_file() else {}
    for name, words in RESULTS.items():
        stage, rest = name.split("/")
        path = job.folders.get(stage, Path()) / rest
        if stage in job.folders and path.exists():
            there[f"{name}: {words}"] = os.path.relpath(path, job.home)
    return [page.heading("Files"), page.links(there)]


def main() -> None:
    parser = argparse.ArgumentParser(prog="reffusion report", description=__doc__.split("\n")[0])
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--scene", type=Path, help="its name, or the path of its folder")
    what.add_argument("--data", type=Path, help="a folder of scenes")
    parser.add_argument("--variant", default="", help="of the scene")
    parser.add_argument("--runs", type=Path, default=Path("runs"))
    arguments = parser.parse_args()
    suffix = f"@{arguments.variant}" if arguments.variant else ""
    try:
        if arguments.scene:
            print(make(command.home(arguments)))
            return
        folders = sorted(path for path in arguments.data.iterdir() if path.is_dir()) if arguments.data.is_dir() else []
        homes = [home for path in folders if (home := arguments.runs / (path.name + suffix)).is_dir()]
        if not homes:
            raise ValueError(f"data={arguments.data}: none of its scenes has a folder in {arguments.runs}")
        print(scenes.make([load_job(home) for home in homes], arguments.runs / f"report{suffix}"))
    except ValueError as error:
        raise SystemExit(f"error: {error}") from None


if __name__ == "__main__":
    main()
