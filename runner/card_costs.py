"""What a job's stages would take on a card, as they say themselves; for `plan`."""

from __future__ import annotations

from runner import Refused
from runner.plan import SETTLED, Decision
from runner.resolve import Job, ask, has_cuda


def costs(job: Job, decisions: dict[str, Decision], card: str | None) -> str:
    """Lines for those that would run, on the card that is named (this machine's where none is); "" where nothing is
    known. Raises Refused for a card that nobody knows."""
    left = [stage for stage, decision in decisions.items() if decision.word not in SETTLED]
    on_card = [stage for stage in left if job.params.get(stage, {}).get("device") == "cuda"]
    if not (on_card and (card or has_cuda())):
        return f"  card={card}: no stage of this plan runs on CUDA" if card else ""
    told, asked = [], [job.question(stage) | {"card": card or ""} for stage in on_card]
    for stage, answer in zip(on_card, ask(job.root, asked), strict=True):
        if "unknown card" in answer:
            raise Refused(answer["unknown card"])
        if answer.get("cost"):
            told.append((stage, answer["cost"]))
    if not told:
        return ""
    lines = [f"    {stage:<12} {span(cost['seconds']):>8} {cost['gb']:6.1f} GB" for stage, cost in told]
    total = sum(cost["seconds"] for _, cost in told)
    head = f"  on {told[0][1]['card']}: {told[0][1]['basis']}"
    return "\n".join([head, *lines, f"    {'together':<12} {span(total):>8}"])


def span(seconds: float) -> str:
    """Seconds as people say them."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"
