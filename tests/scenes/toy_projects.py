"""Small projects whose stages do arithmetic on one number, for tests of the runner and the comparison of variants."""

from __future__ import annotations

from pathlib import Path

from runner.resolve import Request

RUNNER_FILES = {
    "pipeline.yaml": """
scene_keys: {poses: [shift, gaussians]}
stages:
  poses: {needs: [scene]}
  fit: {needs: [poses], provided: {by: gaussians, artifact: poses}}
  masks:
    needs: [poses, fit]
    skip_if: [{empty: poses/masks, reason: the scene has no masks}]
  distill:
    needs: [fit, masks]
    skip_if:
      - {fact: masks.invent, equals: 0, reason: nothing to invent}
      - {param: distill.gain, equals: 0, reason: no gain}
  evaluate: {needs: [poses, fit], optional: [masks, distill]}
profiles: {laptop: {fit: {rate: 2}}, paper: {}}
variants: {strong: {distill: {gain: 5}}, same: {}}
""",
    "stages/__init__.py": "",
    "stages/poses.py": """
from pathlib import Path
from pydantic import BaseModel, ConfigDict

class Params(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    shift: int = 0
    gaussians: str | None = None

def preview(params, scene):
    if not (scene / "number.txt").exists():
        raise ValueError(f"{scene}: no number.txt; write one")
    return ["reads one number"]

def run(params: Params, out: Path, *, scene: Path) -> None:
    if (scene / "broken").exists():
        raise ValueError(f"{scene}: it is\\nbroken")
    number = abs(int((scene / "number.txt").read_text())) + params.shift
    (out / "number.txt").write_text(str(number))
    if params.gaussians:
        (out / "gaussians.ply").write_text((scene / params.gaussians).read_text())
    if not (scene / "unmasked").exists():
        (out / "masks").mkdir(exist_ok=True)
        (out / "masks" / "a.png").write_text("m")
""",
    "stages/fit.py": """
import time
from pathlib import Path
from pydantic import BaseModel, ConfigDict, Field

class Params(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    iterations: int = Field(3, ge=1, description="steps")
    rate: int = 1
    pause: float = 0.0  # seconds a step
    device: str = "cpu"

def run(params: Params, out: Path, *, poses: Path) -> None:
    from reffusion.optimize import step
    checkpoint = out / "checkpoint.pt"
    number, start = map(int, checkpoint.read_text().split()) if checkpoint.exists() else (0, 0)
    for index in range(start, params.iterations):
        number = step(number, params.rate)
        partial = out / "checkpoint.pt.writing"
        partial.write_text(f"{number} {index + 1}")
        partial.replace(checkpoint)
        time.sleep(params.pause)
    (out / "gaussians.ply").write_text(str(number + int((poses / "number.txt").read_text())))
    (out / "trace.jsonl").write_text(str(start))
    checkpoint.unlink()
""",
    "stages/masks.py": """
import ast
import json
from pathlib import Path
from pydantic import BaseModel, ConfigDict

class Params(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    threshold: int = 100

def run(params: Params, out: Path, *, poses: Path, fit: Path) -> None:
    invent = int(int((fit / "gaussians.ply").read_text()) < params.threshold)
    (out / "facts.json").write_text(json.dumps({"invent": invent}))
""",
    "stages/distill.py": """
from pathlib import Path
from pydantic import BaseModel, ConfigDict, Field

class Params(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)
    gain: int = 1
    prior: str = Field("weights", json_schema_extra={"weights": True})

def run(params: Params, out: Path, *, fit: Path, masks: Path) -> None:
    (out / "gaussians.ply").write_text(str(int((fit / "gaussians.ply").read_text()) * params.gain))
""",
    "stages/evaluate.py": """
import ast
import json
from pathlib import Path
from pydantic import BaseModel, ConfigDict

class Params(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)

def run(params, out: Path, *, poses: Path, fit: Path, masks: Path | None, distill: Path | None) -> None:
    result = int(((distill or fit) / "gaussians.ply").read_text())
    metrics = {"mean": {"psnr_box": float(result), "lpips_vgg_box": None}}
    (out / "metrics.json").write_text(json.dumps(metrics))
""",
    "reffusion/__init__.py": '"""The package."""',
    "reffusion/optimize.py": '''
"""Steps."""

def step(number, rate):
    """One step."""
    from .numbers import plus
    return plus(number, rate)  # forwards
''',
    "reffusion/numbers.py": "def plus(a, b):\n    return a + b\n",
    "reffusion/unused.py": "x = 1\n",
    "weights/model.bin": "w",
    "data/toy/number.txt": "4",
}

COMPARE_FILES = {
    "pipeline.yaml": """
scene_keys: {}
stages:
  poses: {needs: [scene]}
  distill:
    needs: [poses]
    skip_if: [{param: distill.gain, equals: 0, reason: no gain}]
  evaluate: {needs: [poses], optional: [distill]}
profiles: {laptop: {}}
variants:
  better: {distill: {gain: 3}}
  twin: {distill: {gain: 3}}
  bad: {distill: {gain: -1}}
  none: {distill: {gain: 0}}
""",
    "stages/__init__.py": "",
    "stages/common.py": """
import json, time
from pathlib import Path

VIEWS = "abcd"

def ran(out, name):
    \"\"\"A line for each stage that came to its end.\"\"\"
    with open(out.parent.parent / "ran.txt", "a") as file:
        file.write(f"{out.parent.name} {name}\\n")
""",
    "stages/poses.py": """
from pydantic import BaseModel
from stages.common import *

class Params(BaseModel, extra="forbid"):
    pass

def run(params, out, *, scene):
    from PIL import Image
    (out / "images").mkdir(exist_ok=True)
    number = int((scene / "number.txt").read_text())
    for view in VIEWS:
        Image.new("RGB", (40, 30), (number, 200, 90)).save(out / "images" / f"{view}.png")
    (out / "views.json").write_text(json.dumps({"train": [], "test": list(VIEWS), "number": number}))
    ran(out, "poses")
""",
    "stages/distill.py": """
from pydantic import BaseModel
from stages.common import *

class Params(BaseModel, extra="forbid"):
    gain: int = 1
    pause: float = 0.0

def run(params, out, *, poses):
    if params.gain < 0:
        raise ValueError("a gain below 0 | cannot be")
    time.sleep(params.pause)
    lines = [{"seconds": 2.0 ** i, "iteration": i, "reference_psnr": 20.0 + i * params.gain} for i in range(4)]
    lines[-1] |= {"reason": "finished"}
    (out / "trace.jsonl").write_text("".join(json.dumps(line) + "\\n" for line in lines))
    (out / "facts.json").write_text(json.dumps({"inpainter": "OpenCV's brush" if params.gain > 1 else "a brush"}))
    (out / "gain.txt").write_text(str(params.gain))
    ran(out, "distill")
""",
    "stages/evaluate.py": """
import csv
from pydantic import BaseModel
from stages.common import *

class Params(BaseModel, extra="forbid"):
    pass

def run(params, out, *, poses, distill):
    from PIL import Image
    number = json.loads((poses / "views.json").read_text())["number"]
    gain = int((distill / "gain.txt").read_text()) if distill else 0
    (out / "renders").mkdir()
    rows = []
    for index, view in enumerate(VIEWS):
        Image.new("RGB", (40, 30), (number, 10 * gain, 90)).save(out / "renders" / f"{view}.png")
        row = {"view": view, "left": 10, "top": 8, "right": 30, "bottom": 22}
        row |= {"psnr_box": 20 + index + gain * (1 + 0.1 * index) + number / 10, "lpips_vgg_box": None}
        row |= {"flip_box": 0.3 / (1 + gain), "ssim_box": 0.5 + gain / 10}
        rows.append(row)
    with open(out / "per_view.csv", "w") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    mean = lambda name: sum(row[name] for row in rows) / len(rows)
    metrics = {"mean": {name: mean(name) for name in ("psnr_box", "ssim_box", "flip_box")} | {"lpips_vgg_box": None}}
    metrics |= {"result": "distill", "gaussians": {"distill": 100 + gain}, "lpips_unavailable": "no weights"}
    metrics |= {"consistency": {"consistency": 0.01 * gain}}
    (out / "metrics.json").write_text(json.dumps(metrics))
    ran(out, "evaluate")
""",
    "reffusion/__init__.py": "",
    **{f"data/{name}/number.txt": text for name, text in (("toy", "10"), ("toy-1", "30"))},
}


def make_request(root: Path, scene: str = "toy", **options) -> Request:
    return Request(root, root / "runs", scene, **{"profile": "laptop", **options})


def write_files(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)


def write_project(root: Path) -> Path:
    write_files(root, COMPARE_FILES)
    return root
