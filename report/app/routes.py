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

from reffusion.clicks.local_segmenter import load_local_segmenter
from report import verdict
from report.app import brush, mask_step, painting, pictures, tasks
from report.app.jobs import Jobs
from report.app.mask_step import MaskStep
from report.app.scenes import OpenScene, find_scene, list_recent
from report.app.security import LocalOnly, TooLarge, read_body
from report.app.state import describe
from report.app.uploads import Upload
from report.mask_session import Session, load_capture

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
    "result": pictures.draw_result,
    "unsure": pictures.draw_unsure,
}
PERIOD, SILENCE = 1.0, 15.0  # seconds between two looks at the files, and longest time without an event


class App:
    """The scenes, jobs and processes behind the page.

    Args:
        runs: folder of all results, absolute.
        options: further arguments of the runner.
    """

    def __init__(self, runs: Path, options: tuple[str, ...] = ()):
        self.jobs, self.viewer = Jobs(runs, options), tasks.Viewer(runs)
        self.scenes: dict[str, OpenScene] = {}
        self.exports: dict[str, tasks.Export] = {}
        self.uploads: dict[str, Upload] = {}
        self.first = ""  # scene that the page shows at first

    def open(self, text: str) -> OpenScene:
        """Open the scene that a name or a path means.

        Raises:
            ValueError: there is none, or another scene of this name is open.
        """
        found = find_scene(text, self.jobs.runs)
        scene = self.scenes.setdefault(found.name, found)
        if scene.source != found.source:
            raise ValueError(f"another scene named {found.name} is open: {scene.source}; rename one folder")
        self.exports.setdefault(scene.name, tasks.Export(self.jobs.runs))
        self.jobs.renew_plan(scene)
        return scene

    def add(self, scene: OpenScene) -> None:
        """Add a scene that is ready to be shown."""
        self.scenes[scene.name], self.exports[scene.name] = scene, tasks.Export(self.jobs.runs)

    def scene(self, request: Request) -> OpenScene:
        """Return the open scene of a request. Raises LookupError if there is none of this name."""
        name = request.path_params["scene"]
        if name not in self.scenes:
            raise LookupError(f"the scene {name!r} is not open; go back to the start and choose it")
        return self.scenes[name]

    def mask_step(self, request: Request) -> MaskStep:
        """Return the mask step of a request's scene. Raises LookupError if it was not begun."""
        step = self.scene(request).mask_step
        if step is None:
            raise LookupError("the mask step is not open")
        return step

    def begin_masks(self, scene: OpenScene) -> bool:
        """Run the stages up to `fit` in the background, and open the mask step once `raw_masks` is done.

        Returns:
            True if the mask step is open.

        Raises:
            ValueError: clicks do not suit the scene's masks.
        """
        if scene.mask_step is not None:
            return True
        state = self.jobs.state(scene)
        if state["state"] not in ("running", "elsewhere") and not self.jobs.is_finished(scene, "fit"):
            self.jobs.start(scene, "fit", with_clicks=True)
        poses, fit = (scene.home / stage / "receipt.json" for stage in ("poses", "fit"))
        if not (scene.home / "raw_masks" / "receipt.json").is_file():
            return False

        def is_fitted() -> bool:
            done = self.jobs.is_finished(scene, "fit")
            return fit.is_file() and (done or fit.stat().st_mtime > poses.stat().st_mtime)

        def is_fitting() -> bool:
            return self.jobs.state(scene)["state"] in ("running", "elsewhere")

        def progress() -> dict[str, object] | None:
            state = self.jobs.state(scene)
            share, left = state["share"], state["left"]
            known = state["stage"] == "fit" and share is not None and left is not None
            return {"share": share, "left": time.strftime("%M:%S", time.gmtime(left))} if known else None

        session = Session(load_capture(scene.home), is_fitted, load_local_segmenter())
        scene.mask_step = MaskStep(
            session, is_fitting, progress, scene.name, on_save=lambda: self.jobs.renew_plan(scene)
        )
        return True

    def close(self) -> None:
        """End the viewer, and interrupt the jobs that the page started. A killed server leaves the jobs running."""
        self.viewer.stop()
        for name in self.jobs.stop_all():
            print(f"the job of {name} is interrupted; the next start goes on from its last checkpoint", flush=True)


def make_app(app: App, port: int) -> Starlette:
    """Return the web application.

    Args:
        port: port of the server.
    """
    handlers: dict[Any, Any] = dict.fromkeys((ValueError, TypeError, OSError), _refuse(400))
    handlers |= {LookupError: _refuse(404), TooLarge: _refuse(413), FileExistsError: _refuse(409)}
    return Starlette(
        routes=_make_routes(app),
        middleware=[Middleware(LocalOnly, port=port, frames=(app.viewer.port,))],
        exception_handlers=handlers,
    )


def _refuse(status: int) -> Callable[[Request, Exception], Response]:
    def answer(request: Request, error: Exception) -> Response:
        text = error.args[0] if isinstance(error, LookupError) and error.args else str(error)
        return JSONResponse({"error": str(text)}, status)

    return answer


def _make_routes(app: App) -> list[Route]:
    def static(request: Request) -> Response:
        name, kind = FILES[request.url.path]
        return FileResponse(STATIC / name, media_type=kind)

    def recent(request: Request) -> Response:
        return JSONResponse({"first": app.first, "scenes": list_recent(app.jobs.runs)})

    async def open_scene(request: Request) -> Response:
        content = await _read_json(request)
        scene = await run_in_threadpool(app.open, str(content["path"]))
        return JSONResponse({"name": scene.name})

    async def begin_upload(request: Request) -> Response:
        upload = Upload(str((await _read_json(request))["name"]))
        app.uploads[upload.name] = upload
        return JSONResponse({"name": upload.name})

    async def receive(request: Request) -> Response:
        name = request.path_params["upload"]
        if name not in app.uploads:
            raise LookupError("no such upload")
        await app.uploads[name].receive(request.path_params["file"], request.stream())
        return JSONResponse({"path": str(app.uploads[name].scene)})

    def state(request: Request) -> Response:
        scene = app.scene(request)
        return JSONResponse(describe(scene, app.jobs, app.exports[scene.name]))

    def events(request: Request) -> Response:
        return StreamingResponse(_follow(app, app.scene(request)), media_type="text/event-stream")

    async def act(request: Request) -> Response:
        scene, content = app.scene(request), await _read_json(request)
        action = ACTIONS.get(request.path_params["action"])
        if action is None:
            raise LookupError("no such action")
        return JSONResponse(await run_in_threadpool(action, app, scene, content) or {})

    def picture(request: Request) -> Response:
        scene, kind, view = app.scene(request), request.path_params["kind"], request.path_params["view"]
        if kind not in PICTURES or view not in scene.pictures():
            raise LookupError("no such picture")
        content = PICTURES[kind](scene, view)
        headers = {"Cache-Control": "private, max-age=3600"} if request.url.query else {}
        return Response(content, media_type="image/png" if content[:4] == b"\x89PNG" else "image/jpeg", headers=headers)

    def template(request: Request) -> Response:
        scene, view = app.scene(request), _paintable(request)
        return FileResponse(scene.home / verdict.TO_PAINT / f"{view}.png", filename=f"{view}.png")

    async def paint(request: Request) -> Response:
        scene, view = app.scene(request), await run_in_threadpool(_paintable, request)
        content = await read_body(request, painting.PICTURE_BYTES)
        replace = request.query_params.get("replace") == "1"
        await run_in_threadpool(painting.save_painting, scene, view, content, replace)
        app.jobs.renew_plan(scene)
        return JSONResponse({})

    def canvas(request: Request) -> Response:
        scene, view = app.scene(request), _paintable(request)
        return Response(brush.draw_canvas(scene, view), media_type="image/png")

    async def fill(request: Request) -> Response:
        scene, view = app.scene(request), await run_in_threadpool(_paintable, request)
        content, seed = await read_body(request, painting.PICTURE_BYTES), request.query_params.get("seed", "0")
        if not re.fullmatch(r"\d{1,9}", seed):
            raise ValueError("seed is a whole number")
        filled = await run_in_threadpool(brush.fill, scene, view, content, int(seed))
        return Response(filled, media_type="image/png")

    def _paintable(request: Request) -> str:
        scene, view = app.scene(request), request.path_params["view"]
        known = describe(scene, app.jobs, app.exports[scene.name])["to_paint"]
        if view not in [each["view"] for each in known]:
            raise LookupError("no such view to paint")
        return view

    def export(request: Request) -> Response:
        path = tasks.find_export(app.scene(request), request.path_params["file"])
        return FileResponse(path, filename=f"{app.scene(request).name}-{path.name}")

    scene = "/scenes/{scene}"
    return [
        *(Route(address, static) for address in FILES),
        Route("/scenes", recent),
        Route("/scenes", open_scene, methods=["POST"]),
        Route("/uploads", begin_upload, methods=["POST"]),
        Route("/uploads/{upload}/{file}", receive, methods=["POST"]),
        *mask_step.make_routes(f"{scene}/mask", app.mask_step),
        Route(f"{scene}/state", state),
        Route(f"{scene}/events", events),
        Route(f"{scene}/do/{{action}}", act, methods=["POST"]),
        Route(f"{scene}/pictures/{{kind}}/{{view}}", picture),
        Route(f"{scene}/paint/{{view}}", template),
        Route(f"{scene}/paint/{{view}}", paint, methods=["POST"]),
        Route(f"{scene}/paint/{{view}}/canvas", canvas),
        Route(f"{scene}/paint/{{view}}/fill", fill, methods=["POST"]),
        Route(f"{scene}/export/{{file}}", export),
    ]


def _begin_masks(app: App, scene: OpenScene, content: dict[str, Any]) -> dict[str, Any]:
    return {"open": app.begin_masks(scene)}


def _start(app: App, scene: OpenScene, content: dict[str, Any]) -> None:
    app.jobs.start(scene, "all")


def _stop(app: App, scene: OpenScene, content: dict[str, Any]) -> None:
    app.jobs.stop(scene)


def _show_live(app: App, scene: OpenScene, content: dict[str, Any]) -> dict[str, Any]:
    running = app.jobs.state(scene)["state"] in ("running", "elsewhere")
    app.viewer.show(scene, follow=running or not tasks.has_result(scene))
    return {"port": app.viewer.port}


def _export(app: App, scene: OpenScene, content: dict[str, Any]) -> None:
    app.exports[scene.name].start(scene)


ACTIONS: dict[str, Callable[[App, OpenScene, dict[str, Any]], dict[str, Any] | None]] = {
    "mask": _begin_masks,
    "start": _start,
    "stop": _stop,
    "live": _show_live,
    "export": _export,
}


async def _read_json(request: Request) -> dict[str, Any]:
    content = json.loads(await read_body(request) or b"{}")
    if not isinstance(content, dict):
        raise ValueError("a JSON object is expected")
    return content


async def _follow(app: App, scene: OpenScene) -> AsyncIterator[str]:
    """Yield the state of a scene as server-sent events, whenever it has changed."""
    last, since = "", 0.0
    while True:
        found = await run_in_threadpool(describe, scene, app.jobs, app.exports[scene.name])
        text = json.dumps(found)
        if text != last:
            yield f"data: {text}\n\n"
            last, since = text, time.monotonic()
        elif time.monotonic() - since > SILENCE:
            yield ": nothing new\n\n"
            since = time.monotonic()
        await asyncio.sleep(PERIOD)
