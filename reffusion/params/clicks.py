"""The key `clicks` of scene.yaml."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

CLICKS = "clicks.json"  # in a scene's folder: what the mask page keeps for itself, and no stage reads


def _click(value: Any) -> Any:
    """Complete a click: YAML reads an unquoted + or - as text, and a click without either is on the object."""
    if not isinstance(value, list | tuple) or len(value) not in (2, 3):
        raise ValueError("a click is [x, y, +] on the object, [x, y, -] on what is not")
    return (*value, "+") if len(value) == 2 else value


Click = Annotated[
    tuple[Annotated[float, Field(ge=0)], Annotated[float, Field(ge=0)], Literal["+", "-"]], BeforeValidator(_click)
]
Clicked = dict[str, list[Click]]  # view -> clicks, in pixels of its photograph from the upper left corner
