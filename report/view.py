"""Viewer of a finished scene in a browser: `python -m report.view --scene demo` (`make scene=X view`).

The machine that runs the viewer also renders each visitor's camera, with the same rasterizer as all stages. So pictures
look as in the stage `evaluate`, and the browser needs no GPU. While the camera moves, pictures are small; at rest they
have full size. A *visitor* is a browser window connected to the viewer.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from reffusion.io.images import load_image, to_uint8
from reffusion.io.scene import has_photograph, load_scene, load_views
from reffusion.splat import rasterizer
from reffusion.types import Camera, Gaussians, Scene
from report import camera_path, cli, unseen_overlay
from report.access import Access
from report.gaussian_layers import finish_command, load_layers
from report.sheet import scene_home, stage_folder
from report.viewer_server import start_viewer_server

PORT = 8080
MOVING, STILL = 180, 480  # picture heights in px while the camera moves, and at rest
FRUSTUM_SCALE = 0.04  # size of a drawn camera, in units of the scene's extent (1)
# Width in px of the picture in the frustum, color, and thickness of the lines.
FRUSTUM_STYLES = {
    "cameras": (160, (20, 20, 20), FRUSTUM_SCALE / 40),
    "references": (480, (230, 120, 0), FRUSTUM_SCALE / 15),
}
RENDER_LOCK = threading.Lock()  # the rasterizer uses all threads for one picture, so pictures are rendered in turn


def visitor_camera(place: Any, height: int) -> Camera:
    """Return the pinhole camera of a visitor, with an image of `height` px.

    Args:
        place: the visitor's camera in viser. Used are `position` [3], `wxyz` [4] (quaternion, camera to world), `fov`
            (vertical, radians) and `aspect` (width over height).
        height: image height, px.
    """
    from scipy.spatial.transform import Rotation

    pose, focal = np.eye(4), height / (2 * np.tan(place.fov / 2))
    pose[:3, :3] = Rotation.from_quat(place.wxyz, scalar_first=True).as_matrix().T
    pose[:3, 3] = -pose[:3, :3] @ place.position
    width = max(1, round(height * place.aspect))
    return Camera("visitor", width, height, focal, focal, width / 2, height / 2, pose)


def render_picture(gaussians: Gaussians, camera: Camera) -> np.ndarray:
    """Render Gaussians from a camera as uint8 [H, W, 3]."""
    with RENDER_LOCK:
        return to_uint8(rasterizer.render(gaussians, camera).color.numpy())


def move_to_view(place: Any, camera: Camera, target: np.ndarray) -> None:
    """Give a visitor's camera the position, the viewing direction and the vertical field of view of another camera.

    The roll is not copied; it follows the visitor's up direction. The visitor's camera then turns about the point on
    the optical axis at the distance of `target` [3] from the camera.

    Args:
        place: the visitor's camera in viser, or the initial camera of new visitors; changed in place.
        camera: the camera of a training view or a reference.
        target: a point in the scene.
    """
    place.position = camera.center
    place.look_at = camera.center + camera.world_to_camera[2, :3] * np.linalg.norm(target - camera.center)
    place.fov = vertical_fov(camera)


def vertical_fov(camera: Camera) -> float:
    """Return the vertical field of view in radians, as if the principal point were the image center."""
    return float(2 * np.arctan(camera.height / (2 * camera.fy)))


class Visitors:
    """The visitors of a viewer, each with a thread that renders the visitor's latest camera.

    Args:
        server: the viser server.
        render: returns the picture, uint8 [H, W, 3], of a camera and of the visitor's camera in viser.
    """

    def __init__(self, server: Any, render: Callable[[Camera, Any], np.ndarray]):
        self.server, self.render, self.open = server, render, True
        self.requests: dict[int, threading.Event] = {}
        server.on_client_connect(self.serve)
        server.on_client_disconnect(lambda client: self._request_picture(client.client_id))

    def serve(self, client: Any) -> None:
        """Render pictures for a new visitor, a client of viser, in a new thread until the visitor leaves."""
        self.requests[client.client_id] = threading.Event()
        threading.Thread(target=self._render_loop, args=(client,), daemon=True).start()
        client.camera.on_update(lambda _: self._request_picture(client.client_id))
        self._request_picture(client.client_id)

    def refresh(self) -> None:
        """Request a new picture for every visitor, which the visitor's thread renders."""
        for visitor in list(self.requests):
            self._request_picture(visitor)

    def _request_picture(self, visitor: int) -> None:
        """Ask the thread of a visitor for a new picture; nothing happens if the visitor has left."""
        if visitor in self.requests:
            self.requests[visitor].set()

    def _render_loop(self, client: Any) -> None:
        """Render pictures for one visitor until the visitor leaves."""
        request = self.requests[client.client_id]
        while self.open and client.client_id in self.server.get_clients():
            request.wait(1.0)
            # A small picture answers at once. One of full size follows unless another request has arrived.
            for height in (MOVING, STILL) if request.is_set() else ():
                request.clear()
                picture = self.render(visitor_camera(client.camera, height), client.camera)
                client.scene.set_background_image(picture, format="jpeg", jpeg_quality=90)
                if request.is_set():
                    break
        self.requests.pop(client.client_id, None)


class Viewer:
    """Viewer of one scene: a web server that renders the latest camera of each visitor.

    The server listens on the loopback interface only, and runs in the background from the construction of the viewer
    until `close`.

    Args:
        home: runs/<scene> or runs/<scene>@<variant>, finished.
        port: port to listen on; if it is in use, the next free one is taken.
        access: the token that requests must bring.

    Raises:
        ValueError: viser is not installed, or the scene is not finished.
    """

    def __init__(self, home: Path, port: int, access: Access):
        poses = scene_home(home) / "poses"
        if not poses.is_dir():
            raise ValueError(f"{poses} is missing; {finish_command(home)} makes it")
        scene = load_scene(poses)
        self.layers = load_layers(home, scene.similarity)
        self.seen_by = unseen_overlay.load_seen_views(home, scene)
        self.gaussians, self.marks_unseen = next(reversed(self.layers.states.values()))[0], True
        self.server = start_viewer_server(home.name, port, access)
        self.visitors = Visitors(self.server, self._render_for)
        self._add_controls()
        self._add_cameras(home, scene)

    def _add_controls(self) -> None:
        """Add controls that select the state (from initialization to result) and the layers of Gaussians to show."""
        gui, titles = self.server.gui, list(self.layers.states)
        last = len(titles) - 1
        marks = tuple((k, title if k in (0, last) else "") for k, title in enumerate(titles))
        hint = "from the initialization to the result"
        slider = gui.add_slider("distillation", 0, max(last, 1), 1, last, marks=marks, hint=hint, visible=last > 0)
        state = gui.add_markdown("")
        kept, added = (gui.add_checkbox(f"what was {kind}", True) for kind in ("kept", "added"))
        removed = gui.add_checkbox("what was removed", False, visible=len(self.layers.removed) > 0)
        words = "no photograph shows it; when the camera is at rest"
        note = gui.add_checkbox("hatch what was never seen", False, hint=words, visible=len(self.seen_by) > 0)

        def changed(_: Any = None) -> None:
            title = titles[min(int(slider.value), last)]
            state.content = title if last else ""
            self.gaussians = self.layers.select(title, kept.value, added.value, removed.value)
            self.marks_unseen = note.value and not removed.value and bool(self.seen_by)
            self.visitors.refresh()

        for choice in (slider, kept, added, removed, note):
            choice.on_update(changed)
        changed()

    def _add_cameras(self, home: Path, scene: Scene) -> None:
        """Add camera frusta of the training views and the references; a click moves the visitor's camera there."""
        train, poses = [scene.cameras[name] for name in scene.train], scene_home(home) / "poses"
        photographed = load_views(poses, [name for name in scene.train if has_photograph(poses, name)])
        photos = {name: photographed.get(name) for name in scene.train}
        target = camera_path.focus_point(train, scene.points)
        self.server.scene.set_up_direction(-np.mean([camera.world_to_camera[1, :3] for camera in train], 0))
        move_to_view(self.server.initial_camera, camera_path.find_central_view(train, scene.points), target)
        folder = stage_folder(home, "reference") / "references"
        references = {
            path.stem: load_image(path) for path in sorted(folder.glob("*.png")) if path.stem in scene.cameras
        }
        for kind, pictures in (("cameras", photos), ("references", references)):
            checkbox = self.server.gui.add_checkbox(kind, False, visible=bool(pictures))
            frusta = [self._add_frustum(kind, scene.cameras[name], p, target) for name, p in pictures.items()]
            checkbox.on_update(lambda _, frusta=frusta, box=checkbox: _set_visible(frusta, box.value))

    def _add_frustum(self, kind: str, camera: Camera, image: np.ndarray | None, target: np.ndarray) -> Any:
        """Add a frustum, hidden at first, that shows `image` (uint8 [H, W, 3]) if given; return its handle in viser."""
        width, color, thickness = FRUSTUM_STYLES[kind]
        step = max(1, camera.width // width)
        small = image[::step, ::step] if image is not None else None
        place = {"wxyz": _quaternion(camera.world_to_camera[:3, :3].T), "position": camera.center}
        lens = {"fov": vertical_fov(camera), "aspect": camera.width / camera.height}
        look = {"scale": FRUSTUM_SCALE, "thickness": thickness, "color": color}
        add = self.server.scene.add_camera_frustum
        frustum = add(f"/{kind}/{camera.name}", **lens, **place, **look, image=small, visible=False)
        frustum.on_click(lambda event: move_to_view(event.client.camera, camera, target))
        return frustum

    def _render_for(self, camera: Camera, place: Any) -> np.ndarray:
        """Render a visitor's picture, uint8 [H, W, 3]; `place` is the visitor's camera in viser."""
        gaussians = self.gaussians
        picture = render_picture(gaussians, camera)
        # In full size, parts that no photograph shows are hatched, unless switched off or removed Gaussians are shown.
        if camera.height == STILL and self.marks_unseen:
            with RENDER_LOCK:
                picture = unseen_overlay.hatch_unseen(picture, gaussians, visitor_camera(place, MOVING), self.seen_by)
        return picture

    def close(self) -> None:
        """Stop the server and the rendering."""
        self.visitors.open = False
        self.server.stop()


def _set_visible(things: list[Any], visible: bool) -> None:
    """Show or hide objects of viser."""
    for thing in things:
        thing.visible = visible


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return the quaternion [4], wxyz, of a rotation matrix [3, 3]."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotation).as_quat(scalar_first=True)


@cli.command
def main() -> None:
    """Run `reffusion view`: serve the viewer of one scene until Ctrl-C, and print its address."""
    parser = cli.scene_parser("view", __doc__)
    parser.add_argument("--port", type=int, default=PORT, help="if it is in use, the next free one is taken")
    arguments = parser.parse_args()
    access = Access(arguments.port)
    window = Viewer(cli.run_folder(arguments), arguments.port, access)
    print(f"{access.link(f'http://127.0.0.1:{window.server.get_port()}/')}  (Ctrl-C ends)", flush=True)
    try:
        window.server.sleep_forever()
    except KeyboardInterrupt:
        window.close()


if __name__ == "__main__":
    main()
