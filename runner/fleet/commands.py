"""The commands beside `plan` and `run`: many scenes, variants or machines, weights, and results of earlier runs."""

import argparse
from dataclasses import replace
from pathlib import Path

from runner.execute import Execution
from runner.fleet.compare import batch, call_report, compare
from runner.fleet.engine import ENGINES, expected_memory_mb, make_engine
from runner.fleet.garbage import collect_garbage
from runner.fleet.maintenance import clean, verify
from runner.fleet.weights import fetch_weights
from runner.resolve import Request
from runner.text import display_path

SOME_FAILED = 3  # exit code of `compare` if it finished and some runs failed; `batch` exits with 1


def choose_engine(request: Request, arguments: argparse.Namespace) -> tuple[Request, Execution]:
    """Return the request, with the engine's GPUs noted in `cuda`, and the execution by the engine of the arguments."""
    engine = make_engine(arguments.engine, arguments.address, request.root, request.runs)
    return replace(request, cuda=engine.cuda), Execution(engine, arguments.cores, memory_mb=expected_memory_mb)


def _compare(request: Request, arguments: argparse.Namespace) -> int:
    """Run a comparison, draw its page (even if some runs failed), and return the exit code."""
    request, execution = choose_engine(request, arguments)
    data = arguments.data
    failed = compare(request, arguments.variants, arguments.seeds, data, execution)
    what = f"--data={data}" if data else f"--scene={request.scene}"
    return call_report("compare", what, f"--runs={display_path(request.runs)}") or (SOME_FAILED if failed else 0)


def _batch(request: Request, arguments: argparse.Namespace) -> int:
    """Run a batch, draw its page (even if some scenes failed), and return the exit code."""
    request, execution = choose_engine(request, arguments)
    failed = batch(request, arguments.data or Path("data"), execution)
    options = f"--runs={display_path(request.runs)}", f"--variant={request.variant or ''}"
    return call_report("batch", *options) or int(failed > 0)


def _collect_garbage(request: Request, arguments: argparse.Namespace) -> int:
    """Remove artifacts that no plan uses (`collect_garbage`); return 0."""
    collect_garbage(request, arguments.yes)
    return 0


def _clean(request: Request, arguments: argparse.Namespace) -> int:
    """Remove the results of a scene (`clean`); return 0."""
    clean(request)
    return 0


COMMANDS = {
    "compare": _compare,
    "batch": _batch,
    "weights": lambda request, arguments: int(fetch_weights(request, arguments.offline) > 0),
    "verify": lambda request, arguments: int(verify(request) > 0),
    "clean": _clean,
    "gc": _collect_garbage,
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of `COMMANDS`, and those that name an engine."""
    parser.add_argument("--data", type=Path, help="batch, compare: a folder of scenes; default of batch: data/")
    parser.add_argument("--variants", default="", help="compare: only these, separated by commas")
    parser.add_argument("--seeds", type=int, default=1, help="compare: number of scenes: X, X-1, X-2 ...")
    parser.add_argument("--engine", help=f"where stages run: local (default), {', '.join(ENGINES)}")
    parser.add_argument("--address", help="of the engine: ray://HOST:10001 or HOST:6379; a partition of Slurm")
    parser.add_argument("--offline", action="store_true", help="weights: only list what is missing")
    parser.add_argument("--yes", action="store_true", help="gc: remove what it lists, without a question")
