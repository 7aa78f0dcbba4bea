"""Addresses of the page. Every name in an address is looked up in a table; no path is made of it."""

from __future__ import annotations

import asyncio
import json
import re
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, Response, StreamingResponse
from starlette.routing import Route

from report import verdict
from report.access import Access
from report.app import brush, mask_step, painting, pictures, tasks
from report.app.app import App
from report.app.scenes import OpenScene, list_recent
from report.app.security import OwnPageOnly, TooLarge, read_body
from report.app.state import list_views_to_paint
from report.app.uploads import Upload

STATIC = Path(__file__).with_name("static")
# address -> (file, type)
FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/app.css": ("app.css", "text/css"),
    "/app.js": ("app.js", "text/javascript"),
}
PICTURES: dict[str, Callable[[OpenScene, str], bytes]] = {
    "small": pictures.draw_thumbnail,
    "photo": pictures.draw_photograph,
    "fit": pictures.draw_fit,
    "result": pictures.draw_result,
    "unsure": pictures.draw_unsure,
}
PERIOD, SILENCE = 1.0, 15.0  # seconds between two looks at the files, and longest time without an event


def make_app(app: App, access: Access) -> Starlette:
    """Return the web application.

    Args:
        access: the token that every request must bring, and the port of the server.
    """
    find_step = lambda request: app.mask_step(request.path_params["scene"])
    handlers: dict[Any, Any] = dict.fromkeys((ValueError, TypeError, OSError), _refuse(400))
    handlers |= {LookupError: _refuse(404), TooLarge: _refuse(413), FileExistsError: _refuse(409)}
    return Starlette(
        routes=[*mask_step.make_routes("/scenes/{scene}/mask", find_step), *_Addresses(app, access).routes()],
        middleware=[Middleware(OwnPageOnly, access=access, frames=(app.viewer.port,))],
        exception_handlers=handlers,
    )


def _refuse(status: int) -> Callable[[Request, Exception], Response]:
    """Return a handler that answers an error with its message, as JSON with this status."""

    def answer(request: Request, error: Exception) -> Response:
        text = error.args[0] if isinstance(error, LookupError) and error.args else str(error)
        return JSONResponse({"error": str(text)}, status)

    return answer


class _Addresses:
    """What the page is answered at each address, by one method each.

    Args:
        app: the scenes, jobs and processes behind the page.
        access: the token of the page, for the viewer.
    """

    def __init__(self, app: App, access: Access):
        self.app, self.access = app, access

    def routes(self) -> list[Route]:
        """Return all routes, except those of the mask step."""
        scene = "/scenes/{scene}"
        return [
            *(Route(address, self.send_file) for address in FILES),
            Route("/scenes", self.list_scenes),
            Route("/scenes", self.open_scene, methods=["POST"]),
            Route("/uploads", self.begin_upload, methods=["POST"]),
            Route("/uploads/{upload}/{file}", self.receive_file, methods=["POST"]),
            Route(f"{scene}/state", self.send_state),
            Route(f"{scene}/events", self.send_events),
            Route(f"{scene}/live", self.show_live, methods=["POST"]),
            Route(f"{scene}/do/{{action}}", self.act, methods=["POST"]),
            Route(f"{scene}/pictures/{{kind}}/{{view}}", self.send_picture),
            Route(f"{scene}/paint/{{view}}", self.send_template),
            Route(f"{scene}/paint/{{view}}", self.receive_painting, methods=["POST"]),
            Route(f"{scene}/paint/{{view}}/painted", self.send_painting),
            Route(f"{scene}/paint/{{view}}/canvas", self.send_canvas),
            Route(f"{scene}/paint/{{view}}/fill", self.fill, methods=["POST"]),
            Route(f"{scene}/export/{{file}}", self.send_export),
        ]

    def send_file(self, request: Request) -> Response:
        """Send a file of the page itself, one of `FILES`."""
        name, kind = FILES[request.url.path]
        return FileResponse(STATIC / name, media_type=kind)

    def list_scenes(self, request: Request) -> Response:
        """Send the recent scenes, the scene to show at first, and the command that the user typed."""
        return JSONResponse(
            {"first": self.app.first, "scenes": list_recent(self.app.jobs.runs), "command": self.app.command}
        )

    async def open_scene(self, request: Request) -> Response:
        """Open the scene at a path, and send its name."""
        content = await _read_json(request)
        scene = await run_in_threadpool(self.app.open, str(content["path"]))
        return JSONResponse({"name": scene.name})

    async def begin_upload(self, request: Request) -> Response:
        """Begin a new scene with a wished name, and send the name that it gets."""
        upload = Upload(str((await _read_json(request))["name"]))
        self.app.uploads[upload.name] = upload
        return JSONResponse({"name": upload.name})

    async def receive_file(self, request: Request) -> Response:
        """Receive a file of a new scene, and send the path of the scene."""
        name = request.path_params["upload"]
        if name not in self.app.uploads:
            raise LookupError("no such upload")
        await self.app.uploads[name].receive(request.path_params["file"], request.stream())
        return JSONResponse({"path": str(self.app.uploads[name].scene)})

    def send_state(self, request: Request) -> Response:
        """Send the state of a scene."""
        return JSONResponse(self.app.describe(self._scene(request)))

    def send_events(self, request: Request) -> Response:
        """Send the state of a scene whenever it changes, as a stream of events."""
        return StreamingResponse(_follow(self.app, self._scene(request)), media_type="text/event-stream")

    async def act(self, request: Request) -> Response:
        """Do one of `ACTIONS` on a scene, and send what it returns."""
        scene, content = self._scene(request), await _read_json(request)
        action = ACTIONS.get(request.path_params["action"])
        if action is None:
            raise LookupError("no such action")
        return JSONResponse(await run_in_threadpool(action, self.app, scene, content) or {})

    async def show_live(self, request: Request) -> Response:
        """Start the 3D viewer of a scene, and send its port; an unfinished or running job is followed."""
        scene, viewer = self._scene(request), self.app.viewer
        running = self.app.jobs.state(scene)["state"] in ("running", "elsewhere")
        follow = running or not tasks.has_result(scene)
        await run_in_threadpool(viewer.show, scene, follow, self.access)
        return JSONResponse({"port": viewer.port})

    def send_picture(self, request: Request) -> Response:
        """Send the picture of a view of one of the kinds `PICTURES`; browsers keep it if the address has a query."""
        scene, kind, view = self._scene(request), request.path_params["kind"], request.path_params["view"]
        if kind not in PICTURES or view not in scene.pictures():
            raise LookupError("no such picture")
        content = PICTURES[kind](scene, view)
        headers = {"Cache-Control": "private, max-age=3600"} if request.url.query else {}
        return Response(content, media_type="image/png" if content[:4] == b"\x89PNG" else "image/jpeg", headers=headers)

    def send_template(self, request: Request) -> Response:
        """Send the picture over which a user can paint a view."""
        scene, view = self._scene(request), self._view_to_paint(request)
        return FileResponse(scene.home / verdict.TO_PAINT / f"{view}.png", filename=f"{view}.png")

    async def receive_painting(self, request: Request) -> Response:
        """Save a painting of a view, and compute the plan anew; with replace=1 over an earlier painting."""
        scene, view = self._scene(request), await run_in_threadpool(self._view_to_paint, request)
        content = await read_body(request, painting.PICTURE_BYTES)
        replace = request.query_params.get("replace") == "1"
        await run_in_threadpool(painting.save_painting, scene, view, content, replace)
        self.app.jobs.renew_plan(scene)
        return JSONResponse({})

    def send_painting(self, request: Request) -> Response:
        """Send the painting of a view; raises LookupError if there is none."""
        scene, view = self._scene(request), self._view_to_paint(request)
        path = painting.painting_path(scene, view)
        if not path.is_file():
            raise LookupError("not painted yet")
        return FileResponse(path)

    def send_canvas(self, request: Request) -> Response:
        """Send the view without the object, filled as by the job."""
        scene, view = self._scene(request), self._view_to_paint(request)
        return Response(brush.draw_canvas(scene, view), media_type="image/png")

    async def fill(self, request: Request) -> Response:
        """Send the received picture with its transparent part filled with patches of the photographs."""
        scene, view = self._scene(request), await run_in_threadpool(self._view_to_paint, request)
        content, seed = await read_body(request, painting.PICTURE_BYTES), request.query_params.get("seed", "0")
        if not re.fullmatch(r"\d{1,9}", seed):
            raise ValueError("seed is a whole number")
        filled = await run_in_threadpool(brush.fill, scene, view, content, int(seed))
        return Response(filled, media_type="image/png")

    def send_export(self, request: Request) -> Response:
        """Send an exported file for download, under the name <scene>-<file>."""
        scene = self._scene(request)
        path = tasks.find_export(scene, request.path_params["file"])
        return FileResponse(path, filename=f"{scene.name}-{path.name}")

    def _scene(self, request: Request) -> OpenScene:
        """Return the open scene that an address names; raises LookupError if there is none."""
        return self.app.scene(request.path_params["scene"])

    def _view_to_paint(self, request: Request) -> str:
        """Return the view that an address names; raises LookupError if it is not one of those to paint."""
        view = request.path_params["view"]
        if view not in [each["view"] for each in list_views_to_paint(self._scene(request))]:
            raise LookupError("no such view to paint")
        return view


def _begin_masks(app: App, scene: OpenScene, content: dict[str, Any]) -> dict[str, Any]:
    """Begin the mask step; return {"open": whether it is open}."""
    return {"open": app.begin_masks(scene)}


def _start(app: App, scene: OpenScene, content: dict[str, Any]) -> None:
    """Start the whole job of a scene."""
    app.jobs.start(scene, "all")


def _choose_quality(app: App, scene: OpenScene, content: dict[str, Any]) -> None:
    """Save `content["profile"]` as the profile of a scene."""
    app.jobs.choose_quality(scene, str(content.get("profile")))


def _stop(app: App, scene: OpenScene, content: dict[str, Any]) -> None:
    """Interrupt the job of a scene."""
    app.jobs.stop(scene)


def _export(app: App, scene: OpenScene, content: dict[str, Any]) -> None:
    """Start the export of a scene, with .sog and .html if `content["sog"]` is True."""
    app.exports[scene.name].start(scene, content.get("sog") is True)


ACTIONS: dict[str, Callable[[App, OpenScene, dict[str, Any]], dict[str, Any] | None]] = {
    "mask": _begin_masks,
    "start": _start,
    "quality": _choose_quality,
    "stop": _stop,
    "export": _export,
}


async def _read_json(request: Request) -> dict[str, Any]:
    """Return the body of a request, a JSON object; raises ValueError if it is something else."""
    content = json.loads(await read_body(request) or b"{}")
    if not isinstance(content, dict):
        raise ValueError("a JSON object is expected")
    return content


async def _follow(app: App, scene: OpenScene) -> AsyncIterator[str]:
    """Yield the state of a scene as server-sent events, whenever it has changed."""
    last, since = "", 0.0
    while True:
        found = await run_in_threadpool(app.describe, scene)
        text = json.dumps(found)
        if text != last:
            yield f"data: {text}\n\n"
            last, since = text, time.monotonic()
        elif time.monotonic() - since > SILENCE:
            yield ": nothing new\n\n"
            since = time.monotonic()
        await asyncio.sleep(PERIOD)
