"""A plan as text, which `plan` prints, and `run` before it starts."""

from collections import Counter

from runner.durations import format_total_time, seconds_by_stage
from runner.plan import Decision
from runner.resolve import ResolvedJob
from runner.text import format_bytes, format_seconds, join_names


def plan_table(job: ResolvedJob, decisions: dict[str, Decision]) -> str:
    """Format a plan as text.

    The text has a line with the profile and the reason for it, a line per stage with status, expected time and reason,
    the notes of the stages, the expected time of all that is to run, the weights to fetch, and the folders outside
    the scene's folder from which files are read.
    """
    lines = [f"{job.home.name} (profile {job.profile}: {job.why})"]
    expected = seconds_by_stage(job, decisions)
    for stage, decision in decisions.items():
        seconds = expected.get(stage)
        time = f"~{format_seconds(seconds)}" if seconds is not None else ""
        lines.append(f"  {decision.status:<9} {stage:<12} {time:>7}  {decision.reason}".rstrip())
        lines += [f"{'':33}{note}" for note in decision.notes]
    if total := format_total_time(expected):
        lines.append(f"  together about {total}" + (f"; GPU: {job.gpu}" if job.gpu else ""))
    rest = dict.fromkeys(line for decision in decisions.values() for line in decision.lacks[1:])
    lines += [f"  besides, {line}" for line in rest]
    needs = {need["name"]: need for decision in decisions.values() for need in decision.needed if need["problem"]}
    if sizes := [need["bytes"] or 0 for need in needs.values() if need["can_download"] and not need["optional"]]:
        lines.append(f"  weights to fetch: {format_bytes(sum(sizes))}, by `make weights profile={job.profile}`")
    paths = {path for stage in decisions for path in job.paths_outside(stage)}
    folders = Counter(str(path if path.is_dir() else path.parent) for path in sorted(paths))
    if named := [f"{path} ({count} file{'s' * (count > 1)})" for path, count in folders.items()]:
        lines.append(f"  read outside the scene's folder: {join_names(named)}")
    return "\n".join(lines)
