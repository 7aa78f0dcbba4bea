"""reffusion plan|run|compare|batch|weights|verify|clean|gc --scene NAME: what the Makefile calls (or python -m runner).
Pages of what was made: reffusion report|compare-page|view|turntable|sheet, each with --help."""

import argparse
import os
import signal
import sys
from dataclasses import replace
from pathlib import Path

from reffusion.command import workplace
from runner import Failed, Refused
from runner.worker import INTERRUPTED
from runner.compare import By, batch, compare, show_results
from runner.card_costs import costs
from runner.engine import ENGINES, chosen
from runner.execute import Work, run_scene, weights
from runner.files import told, write_json
from runner.plan import as_record, plan, table
from runner.resolve import Request, resolve
from runner.sweep import sweep
from runner.maintenance import clean, verify

SOME_FAILED = 3  # compare: done, but for some variants


def main() -> int:
    arguments = _parser().parse_args()
    arguments.set = " ".join(arguments.set)
    root = arguments.root.resolve()
    runs = (arguments.runs or workplace(root) / "runs").resolve()
    names = ("scene", "profile", "variant", "trust", "set", "budget", "keep")
    request = Request(root, runs, *(getattr(arguments, name) for name in names))
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # told to end: as Ctrl-C
    try:
        if arguments.command == "plan":
            job = resolve(request)
            decisions = plan(job, job.pipeline.closure(arguments.stage))
            if arguments.record:
                unset = resolve(replace(request, set="", budget=None), job.hashes)
                write_json(job.home / "plan.json", as_record(job, decisions, unset))
            else:
                print("\n".join(filter(None, [table(job, decisions), costs(job, decisions, arguments.card)])))
        elif arguments.command == "run":
            by = _by(arguments, request)
            request, work = replace(request, cuda=by.engine.cuda), Work(by.engine, by.cores)
            stage, folder = list(run_scene(request, arguments.stage, None, work).items())[-1]
            show_results(stage, folder, request)
        elif arguments.command == "compare":
            by = _by(arguments, request)
            request = replace(request, cuda=by.engine.cuda)
            return SOME_FAILED if compare(request, arguments.variants, arguments.seeds, arguments.data, by) else 0
        elif arguments.command == "batch":
            by = _by(arguments, request)
            request = replace(request, cuda=by.engine.cuda)
            return 1 if batch(request, arguments.data or Path("data"), by) else 0
        elif arguments.command == "weights":
            return 1 if weights(request, arguments.offline) else 0
        elif arguments.command == "verify":
            return 1 if verify(request) else 0
        elif arguments.command == "gc":
            sweep(request, arguments.yes)
        else:
            clean(request)
    except KeyboardInterrupt:
        print("\nstopped; the same command goes on from here", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # as in `plan | head`: who read the output is gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (Refused, Failed, OSError) as error:
        print(f"error: {told(error)}", file=sys.stderr)
        return 2
    return 0


def _by(arguments: argparse.Namespace, request: Request) -> By:
    if arguments.cores is not None and arguments.cores < 1:
        raise Refused(f"cores={arguments.cores}: of each stage; 1 or more")
    return By(chosen(arguments.engine, arguments.address, request.root, request.runs), arguments.cores)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="reffusion", description=__doc__)
    parser.add_argument("command", choices=["plan", "run", "compare", "batch", "weights", "verify", "clean", "gc"])
    parser.add_argument("stage", nargs="?", default="all", help="run this stage and what it needs; `all` (default)")
    parser.add_argument("--scene", default="", help="a name under data/, or a path")
    parser.add_argument("--data", type=Path, help="batch, compare: a folder of scenes; batch takes data/")
    parser.add_argument("--profile", help="auto, or a profile of pipeline.yaml: laptop, paper, best, paper-terms")
    parser.add_argument("--variant", help="a variant of pipeline.yaml")
    parser.add_argument("--variants", default="", help="compare: these only, with commas between")
    parser.add_argument("--seeds", type=int, default=1, help="compare: on so many scenes: X, X-1, X-2 ...")
    parser.add_argument("--record", action="store_true", help="plan: write it to runs/<scene>/plan.json")
    parser.add_argument("--card", help="plan: seconds and GB of each stage on this card, like rtx-4090, a100, h100")
    parser.add_argument("--trust", action="store_true", help="accept artifacts made by older code")
    parser.add_argument("--keep", action="store_true", help="go on with artifacts as people changed them, from now on")
    parser.add_argument("--budget", help="time for the whole job, like 5m: sets the number of steps")
    parser.add_argument("--cores", type=int, help="of each stage; all, for several scenes an equal part for each")
    parser.add_argument("--engine", help=f"where stages run: local (default), {', '.join(ENGINES)}")
    parser.add_argument("--address", help="of the engine: ray://HOST:10001 or HOST:6379; a partition of Slurm")
    parser.add_argument("--offline", action="store_true", help="weights: only say what is missing")
    parser.add_argument("--set", action="append", default=[], help="stage.parameter=value ...")
    parser.add_argument("--yes", action="store_true", help="gc: remove what it lists, without asking")
    parser.add_argument("--root", type=Path, default=Path(__file__).parent.parent, help="where pipeline.yaml is")
    parser.add_argument("--runs", type=Path, help="where artifacts go; root/runs, installed ./runs")
    return parser


if __name__ == "__main__":
    sys.exit(main())
