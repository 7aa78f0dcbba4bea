"""The runner's commands: reffusion plan|run|compare|batch|weights|verify|clean|gc --scene NAME.

Other commands (report, check, view, turntable, sheet, export ...) have a --help of their own.
"""

import argparse
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

from reffusion.command import workplace
from runner import Failed, Refused
from runner.execute import Execution, run_scene
from runner.files import write_json
from runner.fleet.compare import batch, compare
from runner.fleet.engine import ENGINES, expected_memory_mb, make_engine
from runner.fleet.garbage import collect_garbage
from runner.fleet.maintenance import clean, verify
from runner.fleet.weights import fetch_weights
from runner.plan import plan
from runner.plan_table import plan_table
from runner.process import ThisMachine
from runner.resolve import Request, resolve
from runner.results import call_report, plan_record, show_results
from runner.text import display_path, format_error
from runner.worker import INTERRUPTED

SOME_FAILED = 3  # exit code of `compare` if it finished and some runs failed


def main() -> int:
    arguments = _parser().parse_args()
    arguments.set = " ".join(arguments.set)
    root = arguments.root.resolve()
    runs = (arguments.runs or workplace(root) / "runs").resolve()
    names = ("scene", "profile", "variant", "trust", "set", "budget", "keep")
    request = Request(root, runs, *(getattr(arguments, name) for name in names), gpu=arguments.gpu)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # SIGTERM is handled like Ctrl-C
    try:
        return _COMMANDS[arguments.command](request, arguments)
    except KeyboardInterrupt:
        print("\nstopped; the same command goes on from here", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of the output has ended, as in `plan | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (Refused, Failed, OSError) as error:
        print(f"error: {format_error(error)}", file=sys.stderr)
        return 2


def _plan(request: Request, arguments: argparse.Namespace) -> int:
    job = resolve(request)
    decisions = plan(job, job.pipeline.closure(arguments.stage))
    if arguments.record:
        unset = resolve(replace(request, set="", budget=None), job.hashes)
        write_json(job.home / "plan.json", plan_record(job, decisions, unset))
    else:
        print(plan_table(job, decisions))
    return 0


def _run(request: Request, arguments: argparse.Namespace) -> int:
    alone = not (arguments.engine or arguments.address)
    request, execution = _choose_engine(request, arguments, ThisMachine() if alone else None)
    stage, folder = list(run_scene(request, arguments.stage, None, execution).items())[-1]
    show_results(stage, folder, request)
    return 0


def _compare(request: Request, arguments: argparse.Namespace) -> int:
    """Run a comparison, draw its page (even if some runs failed), and return the exit code."""
    request, execution = _choose_engine(request, arguments)
    data = arguments.data
    failed = compare(request, arguments.variants, arguments.seeds, data, execution)
    what = f"--data={data}" if data else f"--scene={request.scene}"
    return call_report("compare", what, f"--runs={display_path(request.runs)}") or (SOME_FAILED if failed else 0)


def _batch(request: Request, arguments: argparse.Namespace) -> int:
    """Run a batch, draw its page (even if some scenes failed), and return the exit code."""
    request, execution = _choose_engine(request, arguments)
    failed = batch(request, arguments.data or Path("data"), execution)
    options = f"--runs={display_path(request.runs)}", f"--variant={request.variant or ''}"
    return call_report("batch", *options) or int(failed > 0)


def _collect_garbage(request: Request, arguments: argparse.Namespace) -> int:
    collect_garbage(request, arguments.yes)
    return 0


def _clean(request: Request, arguments: argparse.Namespace) -> int:
    clean(request)
    return 0


_COMMANDS = {
    "plan": _plan,
    "run": _run,
    "compare": _compare,
    "batch": _batch,
    "weights": lambda request, arguments: int(fetch_weights(request, arguments.offline) > 0),
    "verify": lambda request, arguments: int(verify(request) > 0),
    "clean": _clean,
    "gc": _collect_garbage,
}


def _choose_engine(
    request: Request, arguments: argparse.Namespace, this_machine: ThisMachine | None = None
) -> tuple[Request, Execution]:
    """Return the request and the execution on `this_machine`, or else on the engine that the arguments name."""
    if arguments.cores is not None and arguments.cores < 1:
        raise Refused(f"cores={arguments.cores}: cores must be at least 1; it is the number of cores of each stage")
    if this_machine:
        return request, Execution(this_machine, arguments.cores)
    engine = make_engine(arguments.engine, arguments.address, request.root, request.runs)
    execution = Execution(engine, arguments.cores, memory_mb=expected_memory_mb)
    return replace(request, cuda=engine.cuda), execution


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="reffusion", description=__doc__)
    parser.add_argument("command", choices=list(_COMMANDS))
    parser.add_argument("stage", nargs="?", default="all", help="run this stage and what it needs; default: all")
    parser.add_argument("--scene", default="", help="a name under data/, or a path")
    parser.add_argument("--data", type=Path, help="batch, compare: a folder of scenes; default of batch: data/")
    names = "laptop, fine, laptop-terms, paper, paper-terms, best, fast"
    parser.add_argument("--profile", help=f"auto, or a profile of pipeline.yaml: {names}")
    parser.add_argument("--variant", help="a variant of pipeline.yaml")
    parser.add_argument("--variants", default="", help="compare: only these, separated by commas")
    parser.add_argument("--seeds", type=int, default=1, help="compare: number of scenes: X, X-1, X-2 ...")
    parser.add_argument("--record", action="store_true", help="plan: write it to runs/<scene>/plan.json")
    parser.add_argument("--gpu", help="plan: expected time on this GPU: rtx-3090, rtx-4090, a100, h100, h200")
    parser.add_argument("--trust", action="store_true", help="accept artifacts made by older code")
    parser.add_argument("--keep", action="store_true", help="accept artifacts that people changed, from now on")
    parser.add_argument("--budget", help="time for the whole job, such as 5m: sets the number of steps")
    parser.add_argument(
        "--cores", type=int, help="for each stage; default: all (on a cluster 1), or an equal part for each scene"
    )
    parser.add_argument("--engine", help=f"where stages run: local (default), {', '.join(ENGINES)}")
    parser.add_argument("--address", help="of the engine: ray://HOST:10001 or HOST:6379; a partition of Slurm")
    parser.add_argument("--offline", action="store_true", help="weights: only list what is missing")
    parser.add_argument("--set", action="append", default=[], help="stage.parameter=value ...")
    parser.add_argument("--yes", action="store_true", help="gc: remove what it lists, without a question")
    parser.add_argument("--root", type=Path, default=Path(__file__).parent.parent, help="where pipeline.yaml is")
    parser.add_argument("--runs", type=Path, help="folder of artifacts; default: root/runs, installed ./runs")
    return parser


if __name__ == "__main__":
    sys.exit(main())
