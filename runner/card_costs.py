"""Expected time and memory of a job's stages on a GPU, as the stages report them; printed by `plan`."""

from __future__ import annotations

from runner import Refused
from runner.plan import FINAL, Decision
from runner.process import ask_stages
from runner.resolve import Job, has_cuda
from runner.text import format_seconds


def cost_table(job: Job, decisions: dict[str, Decision], card: str | None) -> str:
    """A line for each stage that would run on CUDA, for the named card or else this machine's; "" where none is known.

    Raises:
        Refused: the card is unknown.
    """
    left = [stage for stage, decision in decisions.items() if decision.status not in FINAL]
    on_card = [stage for stage in left if job.params.get(stage, {}).get("device") == "cuda"]
    if not (on_card and (card or has_cuda())):
        return f"  card={card}: no stage of this plan runs on CUDA" if card else ""
    rows, questions = [], [job.question(stage) | {"card": card or ""} for stage in on_card]
    for stage, answer in zip(on_card, ask_stages(job.root, questions), strict=True):
        if "unknown card" in answer:
            raise Refused(answer["unknown card"])
        if answer.get("cost"):
            rows.append((stage, answer["cost"]))
    if not rows:
        return ""
    lines = [f"    {stage:<12} {format_seconds(cost['seconds']):>8} {cost['gb']:6.1f} GB" for stage, cost in rows]
    total = sum(cost["seconds"] for _, cost in rows)
    head = f"  on {rows[0][1]['card']}: {rows[0][1]['basis']}"
    return "\n".join([head, *lines, f"    {'together':<12} {format_seconds(total):>8}"])
