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
from runner.fleet.commands import COMMANDS, add_options, choose_engine
from runner.plan import plan
from runner.plan_table import plan_table
from runner.resolve import Request, resolve
from runner.results import plan_record, show_results
from runner.text import format_error
from runner.worker import INTERRUPTED


def main() -> int:
    """Run the command of the command line; return its exit code: 2 for an error, INTERRUPTED after Ctrl-C."""
    arguments = _parser().parse_args()
    arguments.set = " ".join(arguments.set)
    root = arguments.root.resolve()
    runs = (arguments.runs or workplace(root) / "runs").resolve()
    names = ("scene", "profile", "variant", "trust", "set", "budget", "keep")
    request = Request(root, runs, *(getattr(arguments, name) for name in names), gpu=arguments.gpu)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # SIGTERM is handled like Ctrl-C
    try:
        if arguments.cores is not None and arguments.cores < 1:
            raise Refused(f"cores={arguments.cores}: cores must be at least 1; it is the number of cores of each stage")
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
    """Print the plan of a stage and what it needs, or with --record write it to plan.json; return 0."""
    job = resolve(request)
    decisions = plan(job, job.pipeline.closure(arguments.stage))
    if arguments.record:
        unset = resolve(replace(request, set="", budget=None), job.hashes)
        write_json(job.home / "plan.json", plan_record(job, decisions, unset))
    else:
        print(plan_table(job, decisions))
    return 0


def _run(request: Request, arguments: argparse.Namespace) -> int:
    """Run a stage and what it needs, and print its results; return 0."""
    execution = Execution(cores=arguments.cores)
    if arguments.engine or arguments.address:
        request, execution = choose_engine(request, arguments)
    stage, folder = list(run_scene(request, arguments.stage, None, execution).items())[-1]
    show_results(stage, folder, request)
    return 0


_COMMANDS = {"plan": _plan, "run": _run} | COMMANDS


def _parser() -> argparse.ArgumentParser:
    """Return the parser of the options of all commands of the runner."""
    parser = argparse.ArgumentParser(prog="reffusion", description=__doc__)
    parser.add_argument("command", choices=list(_COMMANDS))
    parser.add_argument("stage", nargs="?", default="all", help="run this stage and what it needs; default: all")
    parser.add_argument("--scene", default="", help="a name under data/, or a path")
    names = "laptop, fine, laptop-terms, paper, paper-terms, best, fast"
    parser.add_argument("--profile", help=f"auto, or a profile of pipeline.yaml: {names}")
    parser.add_argument("--variant", help="a variant of pipeline.yaml")
    parser.add_argument("--record", action="store_true", help="plan: write it to runs/<scene>/plan.json")
    parser.add_argument("--gpu", help="plan: expected time on this GPU: rtx-3090, rtx-4090, a100, h100, h200")
    parser.add_argument("--trust", action="store_true", help="accept artifacts made by older code")
    parser.add_argument("--keep", action="store_true", help="accept artifacts that people changed, from now on")
    parser.add_argument("--budget", help="time for the whole job, such as 5m: sets the number of steps")
    parser.add_argument(
        "--cores", type=int, help="for each stage; default: all (on a cluster 1), or an equal part for each scene"
    )
    parser.add_argument("--set", action="append", default=[], help="stage.parameter=value ...")
    add_options(parser)
    parser.add_argument("--root", type=Path, default=Path(__file__).parent.parent, help="where pipeline.yaml is")
    parser.add_argument("--runs", type=Path, help="folder of artifacts; default: root/runs, installed ./runs")
    return parser


if __name__ == "__main__":
    sys.exit(main())
