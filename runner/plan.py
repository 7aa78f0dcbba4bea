"""The second step of the runner: gives each stage a status and a reason, from the files on disk.

Terms are explained in `runner`. This module imports nothing heavy.
"""

import json
import string
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from runner import Refused, keys
from runner.artifacts import ArtifactDiff, diff_artifact
from runner.files import list_files, read_receipt
from runner.keys import Inputs, digest, flatten_params
from runner.pipeline import SCENE, Condition
from runner.process import ask_stages
from runner.resolve import ResolvedJob, has_cuda
from runner.text import format_bytes, join_names

TO_DO, FINAL = ("run", "stale", "pending"), ("cached", "provided", "skip")  # statuses: may run, and will not run


@dataclass(frozen=True)
class Decision:
    """The decision of a plan about one stage.

    The status is one of:

    - `run`: the stage must run.
    - `cached`: its artifact is up to date.
    - `provided`: a file of the scene replaces the stage.
    - `skip`: the stage is not needed.
    - `missing`: the stage cannot run, because something that it needs is not there.
    - `stale`: the artifact is up to date so far, but some of its needs run first. The stage runs if their contents
      change.
    - `pending`: whether the stage runs is only known after an earlier stage has run.

    Attributes:
        status: see above.
        reason: the reason for the status, in words.
        path: folder of the current artifact, which may be out of date; None if there is none or the stage is skipped.
        is_final: True if this artifact, or its absence, will not change in this run.
        inputs: everything that the artifact depends on; None if not yet known.
        notes: notes of the stage's preview.
        needed: the weights that the stage will use, as fields of reffusion.weights.local.Need.
        lacks: what this machine lacks for CUDA, a line each with the remedy.
    """

    status: str
    reason: str
    path: Path | None = None
    is_final: bool = False
    inputs: Inputs | None = None
    notes: tuple[str, ...] = ()
    needed: tuple[dict[str, Any], ...] = ()
    lacks: tuple[str, ...] = ()


def decide(job: ResolvedJob, stage: str, earlier: dict[str, Decision]) -> Decision:
    """Decide about one stage, without asking the stage itself and without a check for a GPU (see `plan`).

    Args:
        job: the job.
        stage: name of the stage.
        earlier: decisions about all earlier stages.

    Raises:
        Refused: the stage's file is broken, or a condition of pipeline.yaml cannot be evaluated.
    """
    spec = job.pipeline.stages[stage]
    if job.stages[stage].broken:
        raise Refused(job.stages[stage].broken)
    own = spec.provided
    if own and own.by in job.brings and _have_values(job, own.expected):
        source = earlier[own.artifact]
        return Decision("provided", f"the scene brings `{own.by}`", source.path, source.is_final)
    open_questions: list[str] = []
    for condition in spec.skip_if:
        if holds := _is_true(job, condition, earlier):
            return Decision("skip", _format_reason(condition, earlier), is_final=True)
        if holds is None:
            open_questions.append(f"left out if {condition.reason.split(':')[0]}: known after {condition.names[0]}")
    needs = {need: earlier[need] for need in used_needs(job, stage) if need != SCENE}
    for need in (need for need in spec.needs if need != SCENE):
        if needs[need].status == "skip":
            return Decision("skip", f"needs {need}, which is left out", is_final=True)
        if needs[need].status == "pending":
            open_questions.append(f"waits for {need}")
    for param, _, folder in _weights(job, stage):
        if folder and not folder.exists():
            return Decision("missing", f"{stage}.{param}: no weights at {folder}; name a folder, a file or owner/model")
    code = keys.code_fingerprints(job.root, stage, job.hashes)
    if open_questions:
        return Decision("pending", open_questions[0], next(iter(_receipts(job, stage)), None))
    return _compare_receipts(job, stage, needs, code)


def used_needs(job: ResolvedJob, stage: str) -> list[str]:
    """Return the names of a stage's needs, `scene` included, without those that the parameters say to ignore."""
    spec = job.pipeline.stages[stage]
    return [need for need in spec.all_needs if need not in spec.ignore or not _have_values(job, spec.ignore[need])]


def _is_true(job: ResolvedJob, condition: Condition, earlier: dict[str, Decision]) -> bool | None:
    """Evaluate a condition of pipeline.yaml; None if an earlier stage must run before the answer is known."""
    stage, name = condition.names
    if job.brings.intersection(condition.unless) or not _have_values(job, condition.expected):
        return False
    if condition.param:
        return True
    source = earlier[stage]
    if source.status == "skip":
        return False
    if not source.is_final or source.path is None:
        return None
    if condition.empty:
        return not any(list_files(source.path / name))
    return _fact(source.path, name) == condition.equals


def _fact(folder: Path, name: str) -> Any:
    """Return the value `name` of an artifact's facts.json. Raises Refused if there is no such value."""
    try:
        return json.loads((folder / "facts.json").read_text())[name]
    except (OSError, ValueError, KeyError):
        raise Refused(f"{folder / 'facts.json'}: has no {name!r}, which pipeline.yaml asks for; `verify` it") from None


def _format_reason(condition: Condition, earlier: dict[str, Decision]) -> str:
    """Return a condition's reason, in which the names of facts in braces are replaced by their values."""
    names = [name for _, name, _, _ in string.Formatter().parse(condition.reason) if name]
    folder = earlier[condition.names[0]].path if names else None
    return condition.reason.format(**{name: _fact(folder, name) for name in names}) if folder else condition.reason


def _have_values(job: ResolvedJob, expected: dict[str, Any]) -> bool:
    """Return whether all parameters `<stage>.<name>` have these values. Raises Refused if one does not exist."""
    params = flatten_params(job.params)
    for name in (name for name in expected if name not in params):
        raise Refused(f"{job.root / 'pipeline.yaml'}: a condition asks for {name}, which is not there")
    return expected.items() <= params.items()


def _receipts(job: ResolvedJob, stage: str) -> dict[Path, dict[str, Any]]:
    """Return the stage's artifacts, maybe out of date, of the job and of the scene's own run, with their receipts."""
    return {home / stage: found for home in (job.home, job.base) if (found := read_receipt(home / stage))}


def _weights(job: ResolvedJob, stage: str) -> Iterator[tuple[str, str, Path | None]]:
    """Yield (name, value, path) of a stage's set weights parameters; the path is None for a published model's id."""
    for param in job.stages[stage].weights:
        if name := flatten_params(job.params[stage])[param]:
            path = job.root / Path(name).expanduser()  # may not exist
            local = path.exists() or name.startswith(("/", ".", "~")) or name.count("/") != 1
            yield param, name, path if local or (job.root / name.split("/")[0]).is_dir() else None


def _inputs(job: ResolvedJob, stage: str, needs: dict[str, Path | None], code: dict[str, str]) -> Inputs:
    """Return everything on which a stage's artifact depends; skipped needs are None; `code`: file -> fingerprint."""
    own = job.stages[stage]
    hashes = {need: job.hashes.folder(path) if path else None for need, path in needs.items()}
    hashes |= {f"{SCENE}: {name}": digest(json.dumps(fact)) for name, fact in own.facts.items()}
    hashes |= {f"machine: {name}": fact for name, fact in own.machine.items()}
    if own.reads is not None:
        hashes[SCENE] = keys.hash_listing(job.hashes.listing(job.folder, map(Path, own.reads)))
    elif SCENE in job.pipeline.stages[stage].all_needs:
        hashes[SCENE] = job.hashes.folder(job.folder, exclude=("scene.yaml",))
        for path in job.paths_outside(stage):
            if job.folder.is_relative_to(path):
                raise Refused(f"{stage}: {path} is named in scene.yaml, and holds the scene itself; name one beside it")
            hashes[str(path)] = job.hashes.folder(path) if path.is_dir() else job.hashes.file(path)
    weights = {param: job.hashes.weights(folder) if folder else name for param, name, folder in _weights(job, stage)}
    return Inputs(own.params, hashes, weights, code, own.unkeyed, own.unavailable)


def _compare_receipts(job: ResolvedJob, stage: str, needs: dict[str, Decision], code: dict[str, str]) -> Decision:
    """Return `cached` or `stale` if a receipt, of the variant or the scene, agrees with inputs and files, else `run`.

    A need that may still change is assumed to have the content that it had at the time of the receipt.
    """
    changing = [need for need, each in needs.items() if not each.is_final]
    inputs = _inputs(job, stage, {need: each.path for need, each in needs.items() if each.is_final}, code)
    receipts, reasons = _receipts(job, stage), []
    for place, found in receipts.items():
        assumed = replace(inputs, needs=inputs.needs | {need: found["needs"].get(need) for need in changing})
        diff, code_changes = diff_artifact(place, job.hashes), keys.list_code_changes(found, assumed)
        differences = keys.list_changes(found, assumed) + ([] if job.trust else code_changes)
        if differences := differences or _damage(job, diff):
            reasons.append(join_names(differences))
        elif changing:
            return Decision("stale", f"waits for {', '.join(changing)}; kept if the new content is the same", place)
        else:
            shared = [f"shared with {job.base.name}"] if place.parent != job.home else []
            notes = [f"trusted although {join_names(code_changes)}"] if code_changes else shared
            return Decision("cached", "; ".join([*notes, *diff.describe()]), place, True, inputs)
    decision = Decision("run", reasons[0] if reasons else "not run yet", next(iter(receipts), None))
    if changing:
        return decision
    resumes = "; goes on where it stopped" if partial_folder(job, stage, inputs.key).exists() else ""
    return replace(decision, reason=decision.reason + resumes, inputs=inputs)


def _damage(job: ResolvedJob, diff: ArtifactDiff) -> list[str]:
    """Return why an artifact cannot be used, as phrases: missing files and, without `keep`, changed files; else []."""
    found = [f"{join_names(diff.missing)} missing"] if diff.missing else []
    if diff.changed and not job.keep:
        found.append(f"{join_names(diff.changed)} changed since (keep=1 keeps it)")
    return found


def partial_folder(job: ResolvedJob, stage: str, key: str) -> Path:
    """Return the folder in which a stage works until it is finished. A run with the same key resumes there."""
    return job.home / f".partial-{stage}-{key}"


def plan(job: ResolvedJob, stages: list[str], done: dict[str, Decision] | None = None) -> dict[str, Decision]:
    """Decide about stages, and ask those that may run for notes, needed weights and missing hardware.

    The answers of the stages are not cached.

    Args:
        job: the job.
        stages: the stages, in order.
        done: decisions that are already made, while the job runs; they are returned unchanged. None before it runs.

    Returns:
        Stage -> decision, in the order of `stages`.

    Raises:
        Refused: a stage is broken or a condition cannot be evaluated. Other problems give the status `missing`.
    """
    decisions = dict(done or {})
    for stage in stages:
        if stage not in decisions:
            decisions[stage] = decide(job, stage, decisions)
    questions = [_stage_question(job, stage, decisions) for stage in stages if decisions[stage].status not in FINAL]
    for question, answer in zip(questions, ask_stages(job.root, questions), strict=True):
        if "broken" in answer and not done:  # while a job runs, the user may still repair the stage
            raise Refused(answer["broken"])
        decisions[question["stage"]] = _apply_answer(job, question, decisions[question["stage"]], answer)
    job.hashes.save()
    return {stage: decisions[stage] for stage in stages}


def _stage_question(job: ResolvedJob, stage: str, decisions: dict[str, Decision]) -> dict[str, Any]:
    """Build a stage's question (`worker.describe`); if the stage may run, the paths of its needs ask for a preview."""
    spec, question = job.pipeline.stages[stage], job.weights_question(stage)
    # A stage that reads the scene is asked before its other needs have run, so that it can refuse the scene early.
    reads_scene = SCENE in spec.all_needs
    others = {need: decisions[need] for need in spec.all_needs if need != SCENE}
    needs = {need: each.path if each.is_final or not reads_scene else None for need, each in others.items()}
    needs |= {SCENE: job.folder} if reads_scene else {}
    if decisions[stage].status in TO_DO and (reads_scene or all(map(needs.get, spec.needs))):
        question["needs"] = {need: path and str(path) for need, path in needs.items()}
    return question


def _apply_answer(job: ResolvedJob, question: dict[str, Any], decision: Decision, answer: dict[str, Any]) -> Decision:
    """Add a stage's answer to its decision: `missing` if CUDA or needed weights are absent, or the stage refuses."""
    stage, needed, notes = question["stage"], tuple(answer.get("needed", ())), tuple(answer.get("notes", ()))
    if decision.status not in TO_DO:
        return replace(decision, needed=needed)
    if absent := _missing_for_cuda(job, stage, answer):
        return Decision("missing", f"{stage}.device is cuda, and {absent[0]}", needed=needed, lacks=absent)
    cure = f"`make weights profile={job.profile}` fetches it"
    lacks = [need for need in needed if need["problem"]]
    for need in (need for need in lacks if not need["optional"]):
        fetch = f"; {cure} ({format_bytes(need['bytes'])})" if need["can_download"] else ""
        return Decision("missing", need["problem"] + fetch, needed=needed)
    if lacks:
        notes += (f"{lacks[0]['problem']}; {cure} ({format_bytes(sum(need['bytes'] or 0 for need in lacks))})",)
    if "refusal" in answer and (decision.inputs or SCENE in question["takes"]):  # the needs are final
        decision = replace(decision, status="missing", reason=answer["refusal"])
    return replace(decision, notes=notes, needed=needed)


def _missing_for_cuda(job: ResolvedJob, stage: str, answer: dict[str, Any]) -> tuple[str, ...]:
    """Return what the machines lack for a stage on CUDA, a line each with the remedy; () for a stage on the CPU."""
    if job.params[stage].get("device") != "cuda":
        return ()
    cure = f'profile=laptop, or set="{stage}.device=cpu"'
    if job.cuda is None:  # stages run on this machine
        return tuple(answer.get("lacks", ())) if has_cuda() else (f"this machine has no CUDA driver: {cure}",)
    return () if job.cuda else (f"no machine of the cluster has a GPU: {cure}",)
