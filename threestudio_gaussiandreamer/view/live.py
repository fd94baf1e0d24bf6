"""Serve a cloud of Gaussians to browsers with viser (extra ``[viewer]``), which always draws them
with a dilation of 0.3 square pixels and colours of degree 0."""

import contextlib
import http
import ipaddress
import re
import socket
import threading
from collections.abc import Callable, Iterator
from typing import Any, Optional
from urllib.parse import urlsplit

import numpy as np
from jaxtyping import Float, UInt8

from ..core.command import restore_handlers, set_handlers
from ..core.errors import UserError
from ..core.extras import require_extra
from ..formats.gaussian_files import StoredCloud
from ..gaussians.axes import WORLD_UP
from ..gaussians.gaussians import Gaussians
from ..gaussians.sh import sh0_colors
from ..gaussians.surface import covariance_matrices
from .render import Pose, camera_of, first_pose, require_gaussians

LARGEST_HALF = 6e4
"""Covariances are clipped to this, since viser stores them in half precision (65504 at most)."""


def require_server(host: str, port: int) -> None:
    """Raise UserError unless viser is installed and the port can be listened on."""
    require_extra("viewer", "viser")
    try:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except (OSError, OverflowError, TypeError, ValueError) as error:
        # OverflowError: no 16-bit port; TypeError, ValueError: a text that can't be a host's name
        reason = getattr(error, "strerror", None) or error
        raise UserError(
            f"viewer: {host}:{port} can't be served ({reason}): choose another port, such as "
            "viewer.port=8081 of a run or --port 8081, or the host 127.0.0.1"
        ) from error


class LiveView:
    """A server that shows one cloud, which may change; raises as :func:`require_server`."""

    def __init__(self, host: str, port: int, title: str) -> None:
        require_server(host, port)
        import viser

        with own_pages_only(host) as guards:
            self.server = viser.ViserServer(host=host, port=port, verbose=False)
        if not guards:
            self.server.stop()
            raise UserError("viewer: this version of viser isn't known: pip install 'viser==1.1.*'")
        self.server.scene.set_up_direction("+z")
        name = "localhost" if host == "0.0.0.0" else host
        self.address = f"http://{name}:{self.server.get_port()}"
        # viser draws Markdown with HTML: a prompt or a file's name must be neither
        self._title = re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", " ".join(title.split()))
        self._status = self.server.gui.add_markdown(self._title)
        self._splats, self._frustums = None, []

    @property
    def watched(self) -> bool:
        """Whether a browser is connected."""
        return bool(self.server.get_clients())

    def look_from_front(self, pose: Pose) -> None:
        """Set the first view of browsers that connect from now on."""
        camera = self.server.initial_camera
        camera.position = tuple(camera_of(pose, WORLD_UP)[0, :3, 3].tolist())
        camera.look_at = pose.target

    def show(self, gaussians: Gaussians, status: str = "") -> None:
        """Replace the cloud (finite arrays in the world's axes), and the line below the title."""
        with self.server.atomic():
            if self._splats is None:
                self._splats = self.server.scene.add_gaussian_splats("/cloud", **splats(gaussians))
            else:
                self._splats.set_gaussians(**splats(gaussians))
            self._status.content = f"**{self._title}**\n\n{status}"
        self.server.flush()

    def show_cameras(
        self, c2w: Float[np.ndarray, "B 4 4"], fovy: Float[np.ndarray, " B"], aspect: float
    ) -> None:
        """Show the frustums of the training cameras: OpenGL's, in the world's axes; ``fovy`` in
        radians, ``aspect`` width over height.
        """
        import viser.transforms

        if len(self._frustums) != len(c2w):
            self.remove_cameras()
            add = self.server.scene.add_camera_frustum
            names = [f"/cameras/{i}" for i in range(len(c2w))]
            self._frustums = [add(name, fov=1, aspect=1, scale=0.15) for name in names]
        for frustum, pose, angle in zip(self._frustums, c2w, fovy, strict=True):
            turned = pose[:3, :3] * (1, -1, -1)  # viser's cameras are OpenCV's
            frustum.wxyz = viser.transforms.SO3.from_matrix(turned).wxyz
            frustum.position = pose[:3, 3]
            frustum.fov, frustum.aspect = float(angle), aspect

    def remove_cameras(self) -> None:
        """Remove the frustums."""
        for frustum in self._frustums:
            frustum.remove()
        self._frustums = []

    def close(self) -> None:
        """Stop serving."""
        self.server.stop()


class Controls:
    """The buttons of a training run in a view's panel, pressed in the server's threads."""

    def __init__(self, view: LiveView) -> None:
        gui = view.server.gui
        self.paused, self.step, self.picture = (threading.Event() for _ in range(3))
        self._buttons, self._gui, self._view = [], gui, view
        self._pause = self._add("Pause", self._toggle)
        self._add("One step", self.step.set)
        self._add("Picture of the score model", self.picture.set)
        self.cameras = gui.add_checkbox("Training cameras", True)
        self.cameras.on_update(lambda _: self.cameras.value or view.remove_cameras())
        self._buttons.append(self.cameras)
        self._image: Optional[Any] = None

    def _add(self, label: str, action: Callable[[], None]) -> Any:
        self._buttons.append(button := self._gui.add_button(label))
        button.on_click(lambda _: action())
        return button

    def may_go_on(self) -> bool:
        """Return whether the next step may begin; in a pause, a press of "One step" allows one."""
        if not self.paused.is_set():
            return True
        allowed = self.step.is_set()
        self.step.clear()
        return allowed

    def show_picture(self, image: UInt8[np.ndarray, "H W 3"]) -> None:
        """Show a picture in the panel."""
        if self._image is None:
            self._image = self._gui.add_image(image, label="noisy, one step, many steps")
        else:
            self._image.image = image

    def remove(self) -> None:
        """Remove the buttons and the cameras, after the training."""
        self.paused.clear()
        self._view.remove_cameras()
        for button in self._buttons:
            button.remove()

    def _toggle(self) -> None:
        if self.paused.is_set():
            self.paused.clear()
        else:
            self.step.clear()  # pressed before the pause
            self.paused.set()
        self._pause.label = "Go on" if self.paused.is_set() else "Pause"


def is_own_page(site: Optional[str], origin: Optional[str], host: str) -> bool:
    """Return whether a request is from a page of this server, or of a program that is no browser.

    A page of another site is told by its origin. With DNS rebinding a site's name leads to this
    machine, so that origin and host agree; therefore unknown names are refused.

    Args:
        site, origin: the headers Host and Origin, which only browsers send.
        host: the name or address that the server listens on.
    """
    name = (urlsplit(f"http://{site or ''}").hostname or "").rstrip(".")
    if origin is not None and urlsplit(origin).netloc.lower() != (site or "").lower():
        return False
    known = {"localhost", host.lower(), socket.gethostname().lower()}
    if name in known or name.endswith(".localhost"):
        return True
    with contextlib.suppress(ValueError):
        return bool(ipaddress.ip_address(name))
    return False


@contextlib.contextmanager
def own_pages_only(
    host: str, answer: Any = None, routed: Any = None, **options: Any
) -> Iterator[list[Any]]:
    """Let the viser server that is started in this context refuse what isn't :func:`is_own_page`;
    yield the guards, of which an unknown viser asks for none.

    Args:
        answer: returns the response to a request, or None for viser's own.
        routed: returns the handler of connections in the place of viser's.
        options: of websockets' ``serve``.
    """
    import websockets.asyncio.server as sockets

    guards: list[Any] = []
    serve_all = sockets.serve

    def serve_own(handler: Any, *args: Any, process_request: Any = None, **kwargs: Any) -> Any:
        def check(connection: Any, request: Any) -> Any:
            headers = request.headers
            if not is_own_page(headers.get("Host"), headers.get("Origin"), host):
                reason = "viewer: only its own page, at an address or a known name, is answered\n"
                return connection.respond(http.HTTPStatus.FORBIDDEN, reason)
            if answer and (found := answer(request)):
                return found
            return process_request(connection, request) if process_request else None

        guards.append(check)
        handler = routed(handler) if routed else handler
        return serve_all(handler, *args, process_request=check, **kwargs | options)

    sockets.serve = serve_own
    try:
        yield guards
    finally:
        sockets.serve = serve_all


def splats(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """Return the arguments of viser's ``add_gaussian_splats``."""
    opacities = 1 / (1 + np.exp(-gaussians.logit_opacities.astype(np.float64)))
    return {
        "centers": gaussians.means,
        "covariances": covariance_matrices(gaussians).clip(-LARGEST_HALF, LARGEST_HALF),
        "rgbs": sh0_colors(gaussians.sh[:, 0]),
        "opacities": opacities.reshape(-1, 1),
    }


def serve(cloud: StoredCloud, host: str, port: int, title: str) -> LiveView:
    """Serve a finished cloud until the returned view is closed; raises UserError as
    :func:`require_server`, :func:`require_gaussians` and :func:`first_pose`.
    """
    require_gaussians(len(cloud.gaussians.means), title)
    upright = cloud.in_axes(WORLD_UP)
    pose = first_pose(upright)  # its errors come before the server
    view = LiveView(host, port, title)
    view.look_from_front(pose)
    view.show(upright.gaussians, f"{len(upright.gaussians.means):,} Gaussians")
    return view


def serve_until_stopped(view: LiveView) -> None:
    """Wait for a stop signal, such as Ctrl-C, then close the view and return normally."""
    stopped = threading.Event()
    earlier = set_handlers(lambda signum, frame: stopped.set())
    try:
        print(f"the viewer is at {view.address}; Ctrl-C ends it", flush=True)
        while not stopped.wait(0.1):
            pass
    finally:
        restore_handlers(earlier)
        view.close()
