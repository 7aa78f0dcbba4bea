"""The step in which the user marks the object: the requests of report/mask.html, answered from a `Session`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from PIL import Image
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route

from report.app.security import read_body
from report.mask_session import Session

PAGE = Path(__file__).parent.with_name("mask.html")
THUMBNAIL = 160  # longer side, px
OBJECT_TINT, IGNORED_TINT = (255, 0, 160), (10, 124, 255)
ACTIONS = ("mark", "remove", "resize", "clear", "undo", "save")


@dataclass
class MaskStep:
    """The marks and masks of a scene, and the fit that runs meanwhile.

    Attributes:
        session: marks and masks that the page shows and changes.
        is_fitting: returns whether the stage `fit` runs.
        progress: returns {"share": done in [0, 1], "left": remaining time as text} of the fit, or None.
        scene: name of the scene, for the link to the next step.
        on_save: called after the masks were written.
    """

    session: Session
    is_fitting: Callable[[], bool] = lambda: False
    progress: Callable[[], dict[str, object] | None] = lambda: None
    scene: str = ""
    on_save: Callable[[], None] = lambda: None

    def state(self) -> dict[str, Any]:
        """Return the JSON state of the page: that of `Session.state`, with "fitting", "fit_progress" and "scene"."""
        fitting = self.is_fitting()
        progress = self.progress() if fitting else None
        return self.session.state() | {"fitting": fitting, "fit_progress": progress, "scene": quote(self.scene)}

    def change(self, action: str, request: dict[str, Any]) -> dict[str, Any]:
        """Apply a request of the page, one of `ACTIONS`, and return the answer.

        That of "undo" has "changed" beside the state: a view whose marks have changed.

        Raises:
            ValueError, LookupError, TypeError: the request is wrong, see `Session`.
        """
        session = self.session
        if action == "save":
            saved = session.save()
            self.on_save()
            return saved
        if action == "mark":
            points = [(float(x), float(y)) for x, y in request["points"]]
            ignores = request.get("ignores") is True
            session.mark(str(request["view"]), points, request["sign"] == "+", float(request["radius"]), ignores)
        elif action == "undo":
            changed = session.undo()
            return self.state() | {"changed": changed}
        elif action == "remove":
            session.remove(int(request["index"]))
        elif action == "resize":
            session.resize(int(request["index"]), str(request["size"]))
        else:
            session.clear(str(request["view"]))
        return self.state()


def make_routes(prefix: str, find: Callable[[Request], MaskStep]) -> list[Route]:
    """Return the routes of the mask page below a path.

    Args:
        prefix: the path, e.g. "/scenes/{scene}/mask".
        find: returns the step of a request; raises LookupError if there is none.
    """

    def show(request: Request) -> Response:
        find(request)
        return FileResponse(PAGE, media_type="text/html; charset=utf-8")

    def state(request: Request) -> Response:
        return JSONResponse(find(request).state())

    def picture(request: Request) -> Response:
        kind, name, session = request.path_params["kind"], request.path_params["view"], find(request).session
        if kind in ("photo", "small") and name in session.images:
            return Response(to_jpeg(session.images[name], THUMBNAIL if kind == "small" else 0), media_type="image/jpeg")
        if kind == "mask" and name in session.masks:
            return Response(draw_mask(session.masks[name], OBJECT_TINT), media_type="image/png")
        if kind == "ignored" and name in session.capture.ignore:
            return Response(draw_mask(session.ignored_pixels(name), IGNORED_TINT), media_type="image/png")
        raise LookupError("no such picture")

    async def change(request: Request) -> Response:
        content, step = json.loads(await read_body(request) or b"{}"), find(request)
        if request.path_params["action"] not in ACTIONS:
            raise LookupError("no such page")
        return JSONResponse(await run_in_threadpool(step.change, request.path_params["action"], content))

    return [
        Route(f"{prefix}/", show),
        Route(f"{prefix}/state", state),
        Route(f"{prefix}/{{kind}}/{{view}}", picture),
        Route(f"{prefix}/{{action}}", change, methods=["POST"]),
    ]


def to_jpeg(image: np.ndarray, longest: int = 0) -> bytes:
    """Return a picture, uint8 [H, W, 3], as JPEG bytes; its longer side is at most `longest` px, unless that is 0."""
    picture, file = Image.fromarray(image), BytesIO()
    if longest:
        picture.thumbnail((longest, longest))
    picture.save(file, "JPEG", quality=80 if longest else 92)
    return file.getvalue()


def to_png(image: np.ndarray) -> bytes:
    """Return a picture, uint8 [H, W, 3] or with alpha [H, W, 4], as PNG bytes."""
    file = BytesIO()
    Image.fromarray(image).save(file, "PNG", compress_level=1)
    return file.getvalue()


def draw_mask(mask: np.ndarray, tint: tuple[int, int, int]) -> bytes:
    """Return a mask, bool [H, W], as PNG bytes: translucent inside, with an opaque border, transparent elsewhere."""
    inner = mask.copy()
    inner[1:-1, 1:-1] = mask[1:-1, 1:-1] & mask[:-2, 1:-1] & mask[2:, 1:-1] & mask[1:-1, :-2] & mask[1:-1, 2:]
    overlay = np.zeros((*mask.shape, 4), np.uint8)
    overlay[mask] = (*tint, 110)
    overlay[mask & ~inner] = (*tint, 255)
    return to_png(overlay)
