"""The command `weights`, which lists the weights that stages need and downloads missing ones.

The downloads are made by a process of their own, `python -m runner.fleet.weights`, since it imports stages.
"""

import json
import sys
from typing import TYPE_CHECKING, Any

from runner.process import ask_stages, start_worker
from runner.text import format_bytes, format_error
from runner.worker import description_file, import_file

if TYPE_CHECKING:
    from runner.resolve import Request


def fetch_weights(request: "Request", offline: bool) -> int:
    """Print the weights that all stages need or could use, and download the missing ones, optional ones too.

    Args:
        request: the options. If they name a scene, its scene.yaml counts too.
        offline: True only lists the weights.

    Returns:
        Number of missing weights that are not optional and cannot be downloaded, or with `offline` are not downloaded;
        and of downloads that failed.
    """
    from runner.resolve import resolve  # not in the process of `fetch`, which may see another package reffusion

    job = resolve(request, scene=bool(request.scene))
    questions = {stage: job.weights_question(stage) for stage, info in job.stages.items() if not info.broken}
    answers = list(zip(questions, ask_stages(job.root, list(questions.values())), strict=True))
    all_needs = [(stage, need) for stage, answer in answers for need in answer.get("needed", ())]
    all_needs += [
        (f"{stage}, if asked for", need | {"optional": True})
        for stage, answer in answers
        for need in answer.get("optional", ())
    ]
    needs = {need["name"]: need for _, need in all_needs}
    users = {name: ", ".join(stage for stage, need in all_needs if need["name"] == name) for name in needs}
    missing = [need for need in needs.values() if need["problem"]]
    to_fetch = [need for need in missing if need["can_download"]]
    print(f"weights of profile {job.profile} ({job.why})")
    for name, need in needs.items():
        state = "here" if not need["problem"] else "to fetch" if need["can_download"] else "not usable"
        print(f"  {state:<10} {format_bytes(need['bytes']):>12}  {name}  ({users[name]})")
    _print_problems(missing)
    unsized = " and what has no known size" if any(need["bytes"] is None for need in to_fetch) else ""
    print(f"to fetch: about {format_bytes(sum(need['bytes'] or 0 for need in to_fetch))}{unsized}", flush=True)
    unusable = sum(not need["can_download"] and not need["optional"] for need in missing)
    if offline or not to_fetch:
        return unusable + sum(not need["optional"] for need in to_fetch)
    process = start_worker(request.root, module="runner.fleet.weights")
    process.communicate(json.dumps(questions))
    return unusable + process.returncode


def _print_problems(missing: list[dict[str, Any]]) -> None:
    """Print why missing weights (dicts of `weights.local.Need`) cannot be downloaded, and where each was searched."""
    for need in missing:
        if not need["can_download"]:
            print(f"error: {need['problem']}", file=sys.stderr)
    for places in dict.fromkeys(tuple(need.get("folders", ())) for need in missing):
        names = [need["name"] for need in missing if tuple(need.get("folders", ())) == places]
        if places:
            print(f"looked for {', '.join(names)} in {', '.join(places)}")


def fetch() -> int:
    """Download the missing weights that stages need or could use, each once.

    Reads a JSON object: stage -> {"params", "brings"}, see `describe`.

    Returns:
        Number of failed downloads of weights that stages need. Errors are printed to the standard error; for weights
        that stages only could use they are warnings.
    """
    downloads, optional = {}, set()
    for stage, question in json.load(sys.stdin).items():
        planned = import_file(description_file(stage))
        params, needs = planned.Params(**question["params"]), []
        if hasattr(planned, "needed_weights"):
            needs += planned.needed_weights(params, frozenset(question["brings"]))
        if hasattr(planned, "optional_weights"):
            more = planned.optional_weights(params)
            optional |= {need.name for need in more} - {need.name for need in needs}
            needs += more
        downloads |= {need.name: need for need in needs if need.problem and need.can_download}
    failed = 0
    for need in downloads.values():
        try:
            need.fetch()
            print(f"{need.name}: fetched", flush=True)
        except ValueError as error:
            failed += need.name not in optional
            words = ("warning", "; the job runs without it") if need.name in optional else ("error", "")
            print(f"{words[0]}: {format_error(error)}{words[1]}", file=sys.stderr, flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(fetch())
