"""One word and a reason for each stage, from what lies on the disk; nothing heavy is imported."""

from __future__ import annotations

import json
import os
import platform
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from runner.job import Job, ask, outside
from runner.keys import Inputs, changes, code_changes, code_of, files_below
from runner.pipeline import SCENE, Condition, Refused, has_cuda

RECEIPT = "receipt.json"
MACHINE = platform.node()


@dataclass(frozen=True)
class Decision:
    """The word for a stage.

    Attributes:
        word: run, cached, provided, skip, missing, stale or undecided.
        reason: why, in words.
        path: the artifact's folder as it stands; None where there is none or the stage is left out.
        settled: True where this artifact (or its absence) is final.
        inputs: what the artifact depends on, where that is known.
        notes: what the stage says of itself beforehand.
    """

    word: str
    reason: str
    path: Path | None = None
    settled: bool = False
    inputs: Inputs | None = None
    notes: tuple[str, ...] = ()


def receipt(folder: Path) -> dict[str, Any] | None:
    try:
        return json.loads((folder / RECEIPT).read_text())
    except (OSError, ValueError):
        return None


def decide(job: Job, stage: str, earlier: dict[str, Decision]) -> Decision:
    """The word for `stage`, given those of the stages before it."""
    spec = job.pipeline.stages[stage]
    if stage in job.broken:
        raise Refused(job.broken[stage])
    provided = spec.provided
    if provided and provided.by in job.brings and (not provided.param or _is(job, provided.param, provided.equals)):
        source = earlier[provided.artifact]
        return Decision("provided", f"the scene brings `{provided.by}`", source.path, source.settled)
    unknown_yet = []
    for condition in spec.left_out:
        if holds := _holds(job, condition, earlier):
            return Decision("skip", condition.because, settled=True)
        if holds is None:
            unknown_yet.append(f"left out if {condition.because}: known after {condition.names[0]}")
    needs = {need: earlier[need] for need in spec.takes if need != SCENE}
    for need in (need for need in spec.needs if need != SCENE):
        if needs[need].word == "skip":
            return Decision("skip", f"needs {need}, which is left out", settled=True)
        if needs[need].word == "undecided":
            unknown_yet.append(f"waits for {need}")
    if lost := _missing_weights(job, stage):
        return Decision("missing", lost)
    code = code_of(job.root, stage, job.hashes)
    if unknown_yet:
        return Decision("undecided", unknown_yet[0], _there(job, stage))
    moving = [need for need, decision in needs.items() if not decision.settled]
    if moving:
        path = _there(job, stage)
        found = path and receipt(path)
        if not found:
            return Decision("run", "no artifact yet")
        as_then = Inputs(job.params[stage], job.profile, found["needs"], found["weights"], code)
        if known := [] if job.trust else changes(found, as_then):
            return Decision("run", _listed(known), path)
        return Decision("stale", f"waits for {', '.join(moving)}; kept if the new content is the same", path)
    return _compare(job, stage, _inputs(job, stage, {need: d.path for need, d in needs.items()}, code))


def _holds(job: Job, condition: Condition, earlier: dict[str, Decision]) -> bool | None:
    """Is the condition true? None: not known yet."""
    stage, name = condition.names
    if condition.unless and condition.unless in job.brings:
        return False
    if condition.param:
        return all(_is(job, param, condition.equals) for param in condition.params)
    source = earlier[stage]
    if source.word == "skip":
        return False
    if not source.settled or source.path is None:
        return None
    if condition.empty:
        return not any(files_below(source.path / name))
    try:
        return json.loads((source.path / "facts.json").read_text())[name] == condition.equals
    except (OSError, ValueError, KeyError):
        raise Refused(f"{source.path / 'facts.json'}: has no {name!r}, which pipeline.yaml asks for") from None


def _is(job: Job, param: str, value: Any) -> bool:
    """Has `<stage>.<name>` this value?"""
    stage, name = param.split(".", 1)
    if name not in job.params.get(stage, {}):
        raise Refused(f"{job.root / 'pipeline.yaml'}: a condition asks for {param}, which is not there")
    return job.params[stage][name] == value


def _there(job: Job, stage: str) -> Path | None:
    return next((home / stage for home in (job.home, job.base) if (home / stage / RECEIPT).is_file()), None)


def _weights_folder(job: Job, name: str) -> Path | None:
    """The local folder that a weights parameter names, or None for the id of published weights."""
    path = job.root / Path(name).expanduser()
    local = path.exists() or name.startswith(("/", ".", "~")) or name.count("/") != 1
    return path if local or (job.root / name.split("/")[0]).is_dir() else None


def _missing_weights(job: Job, stage: str) -> str | None:
    for param in job.weights[stage]:
        name = job.params[stage][param]
        folder = _weights_folder(job, name) if name else None
        if folder and not folder.exists():
            return f"{stage}.{param}: no weights at {folder}; name a folder, or an id such as owner/model"
    return None


def _inputs(job: Job, stage: str, needs: dict[str, Path | None], code: dict[str, str]) -> Inputs:
    hashes = {need: path and job.hashes.folder(path) for need, path in needs.items()}
    if stage in job.reads:
        hashes[SCENE] = job.hashes.files(job.folder, job.reads[stage])
    elif SCENE in job.pipeline.stages[stage].takes:
        hashes[SCENE] = job.hashes.folder(job.folder, leave_out=("scene.yaml",))
        for path in outside(job.params[stage], job.folder):
            hashes[str(path)] = job.hashes.folder(path) if path.is_dir() else job.hashes.file(path)
    weights = {}
    for param in job.weights[stage]:
        if name := job.params[stage][param]:
            folder = _weights_folder(job, name)
            weights[param] = job.hashes.weights(folder) if folder else name
    return Inputs(job.params[stage], job.profile, hashes, weights, code)


def _compare(job: Job, stage: str, inputs: Inputs) -> Decision:
    """Cached where a receipt has this key (the variant's own, else the base's); else run, and why."""
    places = [home / stage for home in dict.fromkeys((job.home, job.base))]
    receipts = [(place, found) for place in places if (found := receipt(place))]
    for place, found in receipts:
        if found["key"] == inputs.key:
            said = [] if place.parent == job.home else [f"shared with {job.name}"]
            if job.hashes.folder(place) != found["output"]:
                said.append("its files were changed by hand since")
            return Decision("cached", "; ".join(said), place, True, inputs)
    for place, found in receipts:
        only_code = changes(found, inputs) == code_changes(found, inputs)
        if job.trust and only_code:
            said = f"trusted although {_listed(code_changes(found, inputs))}"
            return Decision("cached", said, place, True, inputs)
    begun = "; goes on where it stopped" if partial_folder(job, stage, inputs.key).exists() else ""
    why = _listed(changes(receipts[0][1], inputs)) if receipts else "no artifact yet"
    return Decision("run", why + begun, places[0] if receipts else None, False, inputs)


def _on_this_machine(job: Job, stage: str, decision: Decision) -> Decision:
    """The decision, or `missing` for work on a GPU where there is none; what is cached holds on any machine."""
    at_work = decision.word in ("run", "stale", "undecided")
    if at_work and job.params[stage].get("device") == "cuda" and not has_cuda():
        cure = f'profile=laptop, or set="{stage}.device=cpu"'
        return Decision("missing", f"{stage}.device is cuda, and this machine has no CUDA driver: {cure}")
    if not at_work:
        return decision
    lacks = [need for need in job.needed[stage] if need["problem"]]
    for need in (need for need in lacks if not need["optional"]):
        fetch = f"; `make weights profile={job.profile}` fetches it ({amount(need['bytes'])})"
        return Decision("missing", need["problem"] + (fetch if need["fetched"] else ""))
    if lacks:
        fetch = f"`make weights profile={job.profile}` fetches it ({amount(sum(need['bytes'] or 0 for need in lacks))})"
        return replace(decision, notes=(f"{lacks[0]['problem']}; {fetch}",))
    return decision


def amount(count: int | None) -> str:
    """Bytes as people read them; "size unknown" for None."""
    if count is None:
        return "size unknown"
    unit, size = next(((u, s) for u, s in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)) if count >= s), ("bytes", 1))
    return f"{count / size:.1f} {unit}" if unit == "GB" else f"{count / size:.0f} {unit}"


def partial_folder(job: Job, stage: str, key: str) -> Path:
    return job.home / f".partial-{stage}-{key}"


def _listed(said: list[str], most: int = 3) -> str:
    rest = f" and {len(said) - most} more" if len(said) > most else ""
    return ", ".join(said[:most]) + rest


# -------------------------------------------------------------------------------------------------------- the plan


def plan(job: Job, stages: list[str], done: dict[str, Decision] | None = None) -> dict[str, Decision]:
    """The words for `stages`, in order; `done` holds those already settled. Asks the stages for their notes."""
    decisions = dict(done or {})
    for stage in stages:
        if stage not in decisions:
            decisions[stage] = _on_this_machine(job, stage, decide(job, stage, decisions))
    asked = {}
    for stage in stages:
        spec = job.pipeline.stages[stage]
        needs = _previewed(job, stage, decisions)
        if decisions[stage].word in ("run", "stale", "undecided") and (
            SCENE in needs or all(needs[need] for need in spec.needs)
        ):
            paths = {need: path and str(path) for need, path in needs.items()}
            asked[stage] = {"params": job.params[stage], "takes": spec.takes, "needs": paths}
    for stage, answer in (ask(job.root, asked) if asked else {}).items():
        decisions[stage] = replace(decisions[stage], notes=(*answer["notes"], *decisions[stage].notes))
        # what it looked at is what it will be
        if answer["refusal"] and (decisions[stage].inputs or SCENE in job.pipeline.stages[stage].takes):
            decisions[stage] = replace(decisions[stage], word="missing", reason=answer["refusal"])
    job.hashes.save()
    return {stage: decisions[stage] for stage in stages}


def _previewed(job: Job, stage: str, decisions: dict[str, Decision]) -> dict[str, Path | None]:
    """What a stage may look at beforehand: its needs as they stand. One that reads the scene is asked, and may refuse,
    before its other needs are made; of these it is shown only what will not change any more."""
    takes = job.pipeline.stages[stage].takes
    others = {need: decisions[need] for need in takes if need != SCENE}
    if SCENE not in takes:
        return {need: decision.path for need, decision in others.items()}
    return {SCENE: job.folder} | {need: each.path if each.settled else None for need, each in others.items()}


def table(job: Job, decisions: dict[str, Decision]) -> str:
    """The profile and why; a line a stage: word, stage, expected time, reason, notes; what there is to download."""
    lines = [f"{job.label} (profile {job.profile}: {job.why})"]
    for stage, decision in decisions.items():
        seconds = expected_seconds(job, stage) if decision.word in ("run", "stale", "undecided") else None
        time = f"~{seconds:.0f} s" if seconds is not None else ""
        lines.append(f"  {decision.word:<9} {stage:<12} {time:>7}  {decision.reason}".rstrip())
        lines += [f"{'':33}{note}" for note in decision.notes]
    to_come = [stage for stage, decision in decisions.items() if decision.word not in ("cached", "provided", "skip")]
    needs = {need["name"]: need for stage in to_come for need in job.needed[stage] if need["problem"]}
    if sizes := [need["bytes"] or 0 for need in needs.values() if need["fetched"] and not need["optional"]]:
        lines.append(f"  weights to fetch: {amount(sum(sizes))}, by `make weights profile={job.profile}`")
    return "\n".join(lines)


def as_record(job: Job, decisions: dict[str, Decision]) -> dict[str, Any]:
    """The same for plan.json, which the report reads: stage -> word, reason, notes, artifact's folder below runs/."""
    stages = {
        stage: {
            "word": decision.word,
            "reason": decision.reason,
            "notes": list(decision.notes),
            "folder": decision.path and os.path.relpath(decision.path, job.runs),
        }
        for stage, decision in decisions.items()
    }
    return {"profile": job.profile, "stages": stages}


def expected_seconds(job: Job, stage: str) -> float | None:
    """What the stage last took for this scene, or a variant of it, on this machine with this profile."""
    places = [job.runs / job.name, *job.runs.glob(f"{job.name}@*")]
    found = [r for place in places if (r := receipt(place / stage))]
    here = [r for r in found if r["machine"] == MACHINE and r["profile"] == job.profile]
    return max(here, key=lambda r: r["date"])["seconds"] if here else None
