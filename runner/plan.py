"""The second step: one word and a reason for each stage, from what lies on the disk; nothing heavy is imported."""

import json
import os
import string
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from runner import Refused
from runner.artifacts import Wear, listed, wear
from runner.files import MACHINE, RECEIPT, files_below, read_receipt
from runner.keys import Inputs, changes, code_changes, code_of, digest, elsewhere, leaves, outside
from runner.pipeline import SCENE, Condition
from runner.resolve import Job, ask, has_cuda

TO_DO, SETTLED = ("run", "stale", "undecided"), ("cached", "provided", "skip")


@dataclass(frozen=True)
class Decision:
    """The word for a stage: run, cached, provided, skip, missing, stale or undecided."""

    word: str
    reason: str
    path: Path | None = None  # the artifact as it stands; None where there is none or the stage is left out
    settled: bool = False  # this artifact, or its absence, is final
    inputs: Inputs | None = None  # what the artifact depends on, where that is known
    notes: tuple[str, ...] = ()  # what the stage says of itself beforehand
    needed: tuple[dict[str, Any], ...] = ()  # the weights it will work with: reffusion.weights.Need
    lacks: tuple[str, ...] = ()  # what this machine has not, for a stage on CUDA: a line each, with what mends it


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
            return Decision("skip", _because(condition, earlier), settled=True)
        if holds is None:
            unknown_yet.append(f"left out if {condition.because.split(':')[0]}: known after {condition.names[0]}")
    needs = {need: earlier[need] for need in needs_in_use(job, stage) if need != SCENE}
    for need in (need for need in spec.needs if need != SCENE):
        if needs[need].word == "skip":
            return Decision("skip", f"needs {need}, which is left out", settled=True)
        if needs[need].word == "undecided":
            unknown_yet.append(f"waits for {need}")
    for param, _, folder in _weights(job, stage):
        if folder and not folder.exists():
            return Decision("missing", f"{stage}.{param}: no weights at {folder}; name a folder, a file or owner/model")
    code = code_of(job.root, stage, job.hashes)
    if unknown_yet:
        return Decision("undecided", unknown_yet[0], _there(job, stage))
    moving = [need for need, decision in needs.items() if not decision.settled]
    if moving:
        path = _there(job, stage)
        found = path and read_receipt(path)
        if not path or not found:
            return Decision("run", "no artifact yet")
        own = job.stages[stage]
        as_then = Inputs(own.params, found["needs"], found["weights"], code, own.unkeyed, own.unavailable)
        if known := ([] if job.trust else changes(found, as_then)) or _harm(job, wear(path, job.hashes)):
            return Decision("run", listed(known), path)
        return Decision("stale", f"waits for {', '.join(moving)}; kept if the new content is the same", path)
    return _compare(job, stage, _inputs(job, stage, {need: d.path for need, d in needs.items()}, code))


def needs_in_use(job: Job, stage: str) -> list[str]:
    """The needs of a stage, without one that its parameters leave unread."""
    spec = job.pipeline.stages[stage]
    unread = spec.unread and _is(job, spec.unread.param, spec.unread.equals) and spec.unread.need
    return [need for need in spec.takes if need != unread]


def _holds(job: Job, condition: Condition, earlier: dict[str, Decision]) -> bool | None:
    """Is the condition true? None: not known yet."""
    stage, name = condition.names
    if job.brings.intersection(condition.unless):
        return False
    if not all(_is(job, param, value) for param, value in condition.only.items()):
        return False
    if condition.param:
        return all(_is(job, param, condition.equals) for param in condition.param)
    source = earlier[stage]
    if source.word == "skip":
        return False
    if not source.settled or source.path is None:
        return None
    if condition.empty:
        return not any(files_below(source.path / name))
    return _fact(source.path, name) == condition.equals


def _fact(folder: Path, name: str) -> Any:
    try:
        return json.loads((folder / "facts.json").read_text())[name]
    except (OSError, ValueError, KeyError):
        raise Refused(f"{folder / 'facts.json'}: has no {name!r}, which pipeline.yaml asks for; `verify` it") from None


def _because(condition: Condition, earlier: dict[str, Decision]) -> str:
    """The reason, with the facts that it names."""
    names = [name for _, name, _, _ in string.Formatter().parse(condition.because) if name]
    folder = earlier[condition.names[0]].path if names else None
    return condition.because.format(**{name: _fact(folder, name) for name in names}) if folder else condition.because


def _is(job: Job, param: str, value: Any) -> bool:
    """Has `<stage>.<name>` this value?"""
    params = leaves(job.params)
    if param not in params:
        raise Refused(f"{job.root / 'pipeline.yaml'}: a condition asks for {param}, which is not there")
    return params[param] == value


def _there(job: Job, stage: str) -> Path | None:
    return next((home / stage for home in (job.home, job.base) if (home / stage / RECEIPT).is_file()), None)


def _weights(job: Job, stage: str) -> Iterator[tuple[str, str, Path | None]]:
    """Parameter that names weights, its value, and the local folder this is, or None for the id of published ones."""
    for param in job.stages[stage].weights:
        if name := leaves(job.params[stage])[param]:
            path = job.root / Path(name).expanduser()
            local = path.exists() or name.startswith(("/", ".", "~")) or name.count("/") != 1
            yield param, name, path if local or (job.root / name.split("/")[0]).is_dir() else None


def _inputs(job: Job, stage: str, needs: dict[str, Path | None], code: dict[str, str]) -> Inputs:
    own = job.stages[stage]
    hashes = {need: path and job.hashes.folder(path) for need, path in needs.items()}
    hashes |= {f"{SCENE}: {name}": digest(json.dumps(fact)) for name, fact in own.facts.items()}
    hashes |= {f"machine: {name}": fact for name, fact in own.machine.items()}
    if own.reads is not None:
        hashes[SCENE] = job.hashes.files(job.folder, map(Path, own.reads))
    elif SCENE in job.pipeline.stages[stage].takes:
        hashes[SCENE] = job.hashes.folder(job.folder, leave_out=("scene.yaml",))
        for path in outside(own.params, job.folder):
            if job.folder.is_relative_to(path):
                raise Refused(f"{stage}: {path} is named in scene.yaml, and holds the scene itself; name one beside it")
            hashes[str(path)] = job.hashes.folder(path) if path.is_dir() else job.hashes.file(path)
    weights = {param: job.hashes.weights(folder) if folder else name for param, name, folder in _weights(job, stage)}
    return Inputs(own.params, hashes, weights, code, own.unkeyed, own.unavailable)


def _compare(job: Job, stage: str, inputs: Inputs) -> Decision:
    """Cached where a receipt differs in nothing (the variant's own, else the base's), and the artifact not from it;
    else run, and why."""
    places = [home / stage for home in dict.fromkeys((job.home, job.base))]
    receipts = [(place, changes(found, inputs), found) for place in places if (found := read_receipt(place))]
    whys = []
    for place, differs, found in sorted(receipts, key=lambda receipt: bool(receipt[1])):
        said, worn = [] if place.parent == job.home else [f"shared with {job.base.name}"], wear(place, job.hashes)
        if differs and not (job.trust and differs == code_changes(found, inputs)):
            whys.append(differs)
        elif harm := _harm(job, worn):
            whys.append(harm)
        else:
            said = [f"trusted although {listed(differs)}"] if differs else said
            return Decision("cached", "; ".join([*said, *worn.words()]), place, True, inputs)
    begun = "; goes on where it stopped" if partial_folder(job, stage, inputs.key).exists() else ""
    why = listed(whys[0]) if whys else "no artifact yet"
    return Decision("run", why + begun, receipts[0][0] if receipts else None, False, inputs)


def _harm(job: Job, worn: Wear) -> list[str]:
    """What makes an artifact unfit, in words: files that are missing, or not as they were made."""
    changed = f"{listed(worn.changed)} changed since (keep=1 keeps it)"
    return [f"{listed(worn.missing)} missing"] * bool(worn.missing) + [changed] * bool(worn.changed and not job.keep)


def _with_device(job: Job, stage: str, decision: Decision) -> Decision:
    """The decision, or `missing` for work on a GPU where there is none; what is cached holds on any machine."""
    if decision.word not in TO_DO or job.params[stage].get("device") != "cuda":
        return decision
    if has_cuda() if job.cuda is None else job.cuda:
        return decision
    cure = f'profile=laptop, or set="{stage}.device=cpu"'
    where = "this machine has no CUDA driver" if job.cuda is None else "no machine of the cluster has a card"
    return Decision("missing", f"{stage}.device is cuda, and {where}: {cure}")


def amount(count: int | None) -> str:
    """Bytes as people read them; "size unknown" for None."""
    if count is None:
        return "size unknown"
    unit, size = next(((u, s) for u, s in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)) if count >= s), ("bytes", 1))
    return f"{count / size:.1f} {unit}" if unit == "GB" else f"{count / size:.0f} {unit}"


def partial_folder(job: Job, stage: str, key: str) -> Path:
    return job.home / f".partial-{stage}-{key}"


def plan(job: Job, stages: list[str], done: dict[str, Decision] | None = None) -> dict[str, Decision]:
    """The words for `stages`, in order; `done` holds those already settled. Asks those that may run, each time anew,
    for their notes and the weights they need."""
    decisions = dict(done or {})
    for stage in stages:
        if stage not in decisions:
            decisions[stage] = _with_device(job, stage, decide(job, stage, decisions))
    asked = [_question(job, stage, decisions) for stage in stages if decisions[stage].word not in SETTLED]
    for question, answer in zip(asked, ask(job.root, asked), strict=True):
        if "broken" in answer and not done:  # while a job runs, it may be mended before its turn comes
            raise Refused(answer["broken"])
        decisions[question["stage"]] = _answered(job, question, decisions[question["stage"]], answer)
    job.hashes.save()
    return {stage: decisions[stage] for stage in stages}


def _question(job: Job, stage: str, decisions: dict[str, Decision]) -> dict[str, Any]:
    """See `child.describe`. What may run is shown its needs as they stand, for a preview. One that reads the scene is
    asked, and may refuse, before its other needs are made; of these it is shown only what will not change any more."""
    spec, question = job.pipeline.stages[stage], job.question(stage)
    others = {need: decisions[need] for need in spec.takes if need != SCENE}
    needs = {need: each.path for need, each in others.items() if each.settled or SCENE not in spec.takes}
    needs |= {SCENE: job.folder} if SCENE in spec.takes else {}
    if decisions[stage].word in TO_DO and (SCENE in needs or all(map(needs.get, spec.needs))):
        question["needs"] = {need: str(path) if (path := needs.get(need)) else None for need in spec.takes}
    return question


def _answered(job: Job, question: dict[str, Any], decision: Decision, answer: dict[str, Any]) -> Decision:
    """The decision with what the stage says of itself; `missing` where it refuses, or something is unavailable."""
    needed, notes = (tuple(answer.get(name, ())) for name in ("needed", "notes"))
    if decision.word not in TO_DO:
        return replace(decision, needed=needed)
    if job.cuda is None and (absent := tuple(answer.get("lacks", ()))):  # of this machine
        reason = f"{question['stage']}.device is cuda, and {absent[0]}"
        return Decision("missing", reason, needed=needed, lacks=absent)
    cure, lacks = f"`make weights profile={job.profile}` fetches it", [need for need in needed if need["problem"]]
    for need in (need for need in lacks if not need["optional"]):
        fetch = f"; {cure} ({amount(need['bytes'])})" if need["fetched"] else ""
        return Decision("missing", need["problem"] + fetch, needed=needed)
    if lacks:
        notes += (f"{lacks[0]['problem']}; {cure} ({amount(sum(need['bytes'] or 0 for need in lacks))})",)
    if "refusal" in answer and (decision.inputs or SCENE in question["takes"]):  # it looked at what will be
        decision = replace(decision, word="missing", reason=answer["refusal"])
    return replace(decision, notes=notes, needed=needed)


def table(job: Job, decisions: dict[str, Decision]) -> str:
    """The profile and why; a line a stage: word, stage, expected time, reason, notes; what there is to download."""
    lines = [f"{job.home.name} (profile {job.profile}: {job.why})"]
    for stage, decision in decisions.items():
        seconds = expected_seconds(job, stage) if decision.word in TO_DO else None
        time = f"~{seconds:.0f} s" if seconds is not None else ""
        lines.append(f"  {decision.word:<9} {stage:<12} {time:>7}  {decision.reason}".rstrip())
        lines += [f"{'':33}{note}" for note in decision.notes]
    rest = dict.fromkeys(line for decision in decisions.values() for line in decision.lacks[1:])
    lines += [f"  besides, {line}" for line in rest]
    needs = {need["name"]: need for decision in decisions.values() for need in decision.needed if need["problem"]}
    if sizes := [need["bytes"] or 0 for need in needs.values() if need["fetched"] and not need["optional"]]:
        lines.append(f"  weights to fetch: {amount(sum(sizes))}, by `make weights profile={job.profile}`")
    if paths := _read_elsewhere(job, list(decisions)):
        folders = Counter(str(path if path.is_dir() else path.parent) for path in paths)
        named = [f"{path} ({count} file{'s' * (count > 1)})" for path, count in folders.items()]
        lines.append(f"  read outside the scene's folder: {listed(named)}")
    return "\n".join(lines)


def _read_elsewhere(job: Job, stages: list[str]) -> list[Path]:
    """What the stages read that scene.yaml or the capture's own files name, and the scene's folder does not hold."""
    there = [stage for stage in stages if stage in job.stages and SCENE in job.pipeline.stages[stage].takes]
    reads = [path for stage in there for path in elsewhere(job.stages[stage].reads or (), job.folder)]
    named = [
        path for stage in there if job.stages[stage].reads is None for path in outside(job.params[stage], job.folder)
    ]
    return sorted({*reads, *named})


def as_record(job: Job, decisions: dict[str, Decision], unset: Job) -> dict[str, Any]:
    """The same for plan.json, which the report reads: stage -> word, reason, notes, artifact's folder below runs/; and
    the parameters of the job as it is without `set=` and `budget=`."""
    folder = lambda path: path and os.path.relpath(path, job.runs)
    words = lambda d: {"word": d.word, "reason": d.reason, "notes": list(d.notes), "folder": folder(d.path)}
    stages = {stage: words(decision) for stage, decision in decisions.items()}
    return {"profile": job.profile, "stages": stages, "params": unset.params}


def expected_seconds(job: Job, stage: str) -> float | None:
    """What the stage last took for this scene, or a variant of it, on this machine with this profile."""
    places = [job.runs / job.base.name, *job.runs.glob(f"{job.base.name}@*")]
    found = [r for place in places if (r := read_receipt(place / stage))]
    here = [r for r in found if r.get("machine") == MACHINE and r.get("profile") == job.profile]
    return max(here, key=lambda r: r["date"])["seconds"] if here else None
