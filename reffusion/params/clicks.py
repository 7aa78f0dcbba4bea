"""The key `clicks` of scene.yaml: clicks on the object, from which the stage `masks` makes masks."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

CLICKS = "clicks.json"  # file in a scene's folder with the clicks made on the mask page; no stage reads it


def _click(value: Any) -> Any:
    """Return a click [x, y] or [x, y, sign] as (x, y, sign), by default "+" (on the object), else raise ValueError."""
    if not isinstance(value, list | tuple) or len(value) not in (2, 3):
        raise ValueError("a click is [x, y, +] on the object, [x, y, -] on what is not")
    return (*value, "+") if len(value) == 2 else value


Click = Annotated[
    tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)], Literal["+", "-"]], BeforeValidator(_click)
]
Clicked = dict[str, list[Click]]  # view name -> clicks (x, y, sign), in px from the photograph's upper left corner
