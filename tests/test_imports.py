"""The structure of the code: which package imports which, and which modules open files."""

from __future__ import annotations

import ast
import graphlib
import importlib
import inspect
import os
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from runner.pipeline import load_pipeline

ROOT = Path(__file__).resolve().parent.parent
# Heavy or special dependencies, and the only modules that may import them: one module for each dependency, and for
# transformers one for priors and one for other networks.
DOORS = {
    "pycolmap": ("reffusion/capture/sfm.py",),
    "diffusers": ("reffusion/prior/model.py",),
    "peft": ("reffusion/prior/lora.py",),
    "transformers": ("reffusion/prior/model.py", "reffusion/weights/transformers_model.py"),
    "huggingface_hub": ("reffusion/weights/download.py",),
    "onnxruntime": ("reffusion/onnx.py",),
    "gsply": ("reffusion/io/compressed.py",),
    "ray": ("runner/fleet/ray_engine.py",),
    "submitit": ("runner/fleet/slurm_engine.py",),
}
OPENERS = {"open", "read_text", "write_text", "read_bytes", "write_bytes", "imread", "imwrite", "imsave", "savez"}
MAY_OPEN = ("reffusion/io/", "reffusion/capture/", "reffusion/trace.py")
COMPILER = "reffusion/kernels/compiled.py"
OWN_FILES = (
    "reffusion/prior/model.py",
    "reffusion/prior/lora.py",
    "reffusion/metrics/lpips.py",
    "reffusion/weights/local.py",
    "reffusion/weights/download.py",
    "reffusion/weights/lpips_package.py",
    "reffusion/weights/npm_package.py",
    "reffusion/weights/painters.py",
    "reffusion/weights/segmenters.py",
    "reffusion/capture/sfm.py",
    COMPILER,
)  # these modules read or write weights, databases, pipes or compiled kernels
PURE = (
    "geometry",
    "types",
    "depth/alignment",
    "splat/",
    "gaussians/",
    "distill/sds",
    "distill/discriminator",
    "distill/terms/",
    "prior/windows",
)  # these modules use tensors and plain numbers only
# what the pipeline computes with, and report/ does not
METHODS = (
    "stages.",
    "reffusion.fit.reconstruction",
    *(f"reffusion.{each}." for each in ("depth", "distill", "gaussians", "initialize", "masks", "metrics", "shadows")),
)


def sources(*folders: str) -> list[Path]:
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


@cache
def imports(path: Path, top_only: bool = False) -> frozenset[str]:
    """Return the dotted names that a file imports, as absolute names, without those in TYPE_CHECKING blocks.

    Args:
        top_only: Leave out imports inside functions.
    """
    tree = ast.parse(path.read_text(encoding="utf-8"))
    package = path.relative_to(ROOT).parts[:-1]
    found = set()
    for node in _nodes(tree, top_only):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join((*base, *filter(None, [node.module])))
            found |= {f"{module}.{alias.name}" for alias in node.names}
    return frozenset(found)


def _nodes(tree: ast.AST, top_only: bool) -> Iterator[ast.AST]:
    for child in ast.iter_child_nodes(tree):
        if isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            continue
        if top_only and isinstance(child, ast.FunctionDef):
            continue
        yield child
        yield from _nodes(child, top_only)


def foreign_packages(path: Path, allowed: set[str], top_only: bool = False) -> set[str]:
    """Return the top-level packages that `path` imports, without the standard library and the packages `allowed`."""
    return {name.split(".")[0] for name in imports(path, top_only)} - allowed - set(sys.stdlib_module_names)


def relative_path(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def test_runner_knows_nothing_of_3d():
    allowed = {"runner", "reffusion", "pydantic", "yaml"}
    command = {f"reffusion.command.{name}" for name in ("is_installed", "scene_name", "scene_path", "workplace")}
    for path in sources("runner"):
        clusters = {name for name, doors in DOORS.items() if relative_path(path) in doors}
        assert foreign_packages(path, allowed | clusters) == set(), path
        own = {name for name in imports(path) if name.split(".")[0] == "reffusion"}
        assert own <= {"reffusion.command", *command}, path


def test_only_the_command_line_knows_the_fleet():
    """What plans and runs one scene on one machine imports nothing of runner/fleet/."""
    core = [path for path in sources("runner") if path.parent.name == "runner" and path.stem != "__main__"]
    assert not [path for path in core if any(name.startswith("runner.fleet") for name in imports(path))]


def test_stages_import_the_library_only():
    for path in sources("stages"):
        names = imports(path)
        assert foreign_packages(path, {"reffusion", "numpy", "torch"}) == set() and "argparse" not in names, path
        assert imports(path, top_only=True) == names, f"{path}: imports stand at the top"


@pytest.mark.parametrize("stage", [path.stem for path in sources("stages/plan") if path.stem != "__init__"])
def test_plan_modules_import_nothing_heavy(stage):
    """Heavy imports would make the command `plan` slow to answer."""
    code = f"import sys, stages.plan.{stage}; print(*sorted(set(sys.argv[1:]) & set(sys.modules)))"
    command = [sys.executable, "-c", code, "torch", "scipy", "numba", "cv2", "diffusers", "transformers"]
    assert subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip() == ""


@pytest.mark.parametrize(("stage", "needs"), [(n, s.all_needs) for n, s in load_pipeline(ROOT).stages.items()])
def test_previews_take_the_needs_of_their_stage(stage, needs):
    described = importlib.import_module(f"stages.plan.{stage}") if (ROOT / f"stages/plan/{stage}.py").exists() else None
    if preview := getattr(described, "preview", None):
        inspect.signature(preview).bind(None, **dict.fromkeys(needs))


def test_there_are_no_import_cycles():
    """Neither modules nor packages of the library import each other in a cycle, so the layers have an order."""
    paths = sources("reffusion", "stages", "runner", "report")
    modules = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in paths}
    owner = lambda name: name if name in modules else name.rpartition(".")[0]
    needs = {name: {owner(other) for other in imports(path)} & set(modules) for name, path in modules.items()}
    tuple(graphlib.TopologicalSorter(needs).static_order())  # raises CycleError, which names the cycle
    room = lambda name: ".".join(name.split(".")[: 2 if name.count(".") > 1 else 3])
    library = {name: others for name, others in needs.items() if name.startswith("reffusion.")}
    rooms: dict[str, set[str]] = {}
    for name, others in library.items():
        rooms.setdefault(room(name), set()).update({room(other) for other in others} - {room(name)})
    tuple(graphlib.TopologicalSorter(rooms).static_order())


def test_init_files_are_empty():
    """A stage depends on the modules that it imports; code in an __init__.py would add hidden dependencies."""
    for folder in {path.parent for path in sources("reffusion")}:
        assert folder.name == "reffusion" or not (folder / "__init__.py").read_text().strip(), folder


def test_library_imports_no_upper_layer():
    for path in sources("reffusion"):
        names = {name.split(".")[0] for name in imports(path)}
        assert not names & {"stages", "runner", "report", "yaml", "argparse"}, path
        for package, doors in DOORS.items():
            assert package not in names or relative_path(path) in doors, f"{path}: only {doors} import {package}"


def test_command_imports_only_the_standard_library():
    assert foreign_packages(ROOT / "reffusion" / "command.py", set()) == set()


def test_report_runs_no_method_of_the_pipeline():
    """It reads results and draws them. Only its page lets the runner make new ones."""
    for path in sources("report"):
        names = {name for name in imports(path) if name.startswith(METHODS)}
        names |= {name for name in imports(path) if name.startswith("runner.") and path.parent.name != "app"}
        assert not names, f"{path}: {names}"


def test_files_are_opened_in_io_and_trace():
    others = ("np.load", "np.save", "numpy.load", "torch.load", "torch.save", "json.load", "json.dump")
    for path in sources("reffusion"):
        if relative_path(path).startswith((*MAY_OPEN, *OWN_FILES)):
            continue
        calls = [n.func for n in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(n, ast.Call)]
        opened = {f.attr if isinstance(f, ast.Attribute) else getattr(f, "id", "") for f in calls} & OPENERS
        assert opened | {text for f in calls if (text := ast.unparse(f)) in others} == set(), path


def test_pure_modules_take_no_paths_and_no_params():
    for path in sources("reffusion"):
        if relative_path(path).removeprefix("reffusion/").startswith(PURE) and relative_path(path) != COMPILER:
            assert not {name.split(".")[0] for name in imports(path)} & {"pathlib", "pydantic", "os", "io"}, path


def test_the_benchmark_sets_one_thread_before_numpy_and_torch_are_loaded():
    """NumPy and PyTorch read the number once. With two threads, CPU seconds would include time spent waiting."""
    probe = """
import os, sys
class Watch:
    def find_spec(self, name, *_):
        if name in ("numpy", "torch"):
            print(name, os.environ.get("OMP_NUM_THREADS"), os.environ.get("OPENBLAS_NUM_THREADS"))
sys.meta_path.insert(0, Watch())
import lab.bench.__main__
"""
    others = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", probe], cwd=ROOT, env=others, capture_output=True, text=True, check=True
    )
    assert sorted(set(done.stdout.splitlines())) == ["numpy 1 1", "torch 1 1"]
