"""Diagrams of personalization by steps, rank and learning rate: as recorded in LOG.md, and (slowly) measured again."""

from __future__ import annotations

from pathlib import Path

import yaml

from benchmarks.bench.points import Diagram, Point

ROOT = Path(__file__).resolve().parents[2]
# (curve, setting) -> (CPU seconds of one thread, PSNR in the reference's hole in dB) on the scene demo, where a whole
# view of 64 px is painted from noise. From LOG.md, "Prior, personalization, SDS", 2026-11-21. The prior before
# personalization has 15.4 dB.
RECORDED = {
    ("rank 16, rectangles, 16 x 32 px", "120 steps"): (136.0, 16.8),
    ("rank 16, rectangles, 16 x 32 px", "400 steps"): (395.0, 17.8),
    ("rank 64, half whole views", "150 steps"): (115.0, 18.4),
    ("rank 64, whole views, the hole masked", "250 steps of 64 px"): (201.0, 22.7),
    ("rank 64, whole views, the hole masked", "500 steps of 48 px"): (237.0, 24.5),
    ("rank 64, a quarter local windows", "600 steps"): (290.0, 21.8),
}
STEPS, RANKS, RATES = (50, 100, 200, 400), (8, 16, 64), (1.25e-3, 2.5e-3, 5e-3)


def recorded_diagram() -> Diagram:
    """Return the diagram of the recorded values: RMS error in the reference's hole, filled from noise, and seconds."""
    points = [
        Point(curve, setting, 0.0, 10 ** (-psnr / 20), seconds)
        for (curve, setting), (seconds, psnr) in RECORDED.items()
    ]
    return Diagram(
        "personalization-recorded",
        "Personalization on demo, as recorded in LOG.md (not measured now)",
        "RMS error in the reference's hole, painted from noise",
        ("rank 64, whole views, the hole masked", "500 steps of 48 px"),
        points,
        why="The laptop profile takes 120 such steps since 2026-11-26; before, 150.",
    )


def diagram(run: Path, out: Path) -> Diagram:
    """Personalize with several numbers of steps, and with several ranks and learning rates at 200 steps, and measure.

    The error is the held-out squared error of the clean latent at the end. The seconds are the wall time of the whole
    personalization without measurements. With the rank, the LoRA's alpha changes; with the UNet's learning rate, that
    of the text encoder. All other parameters are those of the laptop profile. Finished personalizations in `out` are
    not run again, and interrupted ones continue.

    Args:
        run: runs/<scene>, with the stage `reference`.
        out: folder of the benchmark.

    Raises:
        ValueError: the run has no stage `reference`.
    """
    from reffusion import trace
    from stages import personalize

    if not (run / "reference" / "receipt.json").exists():
        raise ValueError(f"{run}/reference is missing: run `make scene={run.name} reference` first")
    usual = yaml.safe_load((ROOT / "pipeline.yaml").read_text())["profiles"]["laptop"]["personalize"]
    needs = {name: run / name for name in ("poses", "raw_masks", "reference")}
    choices = [("steps", {"steps": n}) for n in STEPS]
    choices += [("rank, 200 steps", {"steps": 200, "lora": {"rank": n, "alpha": n}}) for n in RANKS]
    rates = [{"lr_unet": r, "lr_text": r / 5} for r in RATES]
    choices += [("learning rate, 200 steps", {"steps": 200, "optimizer": rate}) for rate in rates]
    points = []
    for curve, changed in choices:
        grouped = {name: usual[name] | value for name, value in changed.items() if isinstance(value, dict)}
        single = {"steps": changed["steps"]} | changed.get("lora", {}) | changed.get("optimizer", {})
        name = ", ".join(f"{key} {value:g}" for key, value in single.items() if key not in ("alpha", "lr_text"))
        folder = out / "personalization" / name.replace(", ", "_").replace(" ", "")
        if not (folder / "pytorch_lora_weights.safetensors").exists():  # an interrupted personalization continues
            folder.mkdir(parents=True, exist_ok=True)
            personalize.run(personalize.Params(**{**usual, **changed, **grouped}), folder, **needs)
        last = trace.read_trace(folder / "trace.jsonl")[-1]
        points.append(Point(curve, name, 0.0, last["clean_latent_mse"], last["seconds"]))
    return Diagram(
        "personalization",
        f"Personalization on {run.name}, laptop profile",
        "squared error of the clean latent, held out",
        ("steps", "steps 400"),
        points,
        tolerance=1.1,
        why="Wall clock of one thread.",
    )
