"""The 3D view of the studio: one or two clouds, which all browsers see, drawn by viser."""

import contextlib
from collections.abc import Callable, Iterator
from http import HTTPStatus
from typing import Any, Optional
from urllib.parse import unquote, urlsplit

import numpy as np
from jaxtyping import Float

from ..formats.gaussian_files import StoredCloud
from ..gaussians.axes import WORLD_UP
from ..gaussians.gaussians import Gaussians
from ..view.live import is_own_page, own_pages_only, require_server, splats
from ..view.render import camera_of, first_pose

LARGEST_UPLOAD = 256 * 2**20
"""Bytes of one file."""
APART = 0.6
"""Distance of two clouds from the middle between them, in sizes of the larger one."""
FARTHER = 1.6
"""Times as far away is the camera from two clouds."""


class Scene:
    """A server of viser, which also answers our own pages and sockets.

    Args:
        answer: returns content and headers for the path of a request, or None.
        sockets: coroutine functions by the path of their socket, called with the connection and
            the query of its address.
    """

    def __init__(
        self, host: str, port: int, answer: Callable, sockets: dict[str, Callable]
    ) -> None:
        require_server(host, port)
        import viser

        with own_routes(host, answer, sockets), own_pages_only(host):
            self.server = viser.ViserServer(host=host, port=port, verbose=False)
        self.server.scene.set_up_direction("+z")
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server.on_client_connect(lambda client: client.camera.on_update(self._turn))
        self._shown: dict[str, Any] = {}
        self._right, self._half = np.array([0.0, 1.0, 0.0]), 1.0
        self._points: Optional[Any] = None

    @property
    def watched(self) -> bool:
        """Whether a browser is connected."""
        return bool(self.server.get_clients())

    def show(self, name: str, gaussians: Optional[Gaussians]) -> None:
        """Show a cloud in the world's axes as ``main`` or ``beside``, or remove it."""
        pair = len(self._shown) == 2
        with self.server.atomic():
            if self._points is not None:
                self._points = self._points.remove()
            if gaussians is None or not len(gaussians.means):
                if handle := self._shown.pop(name, None):
                    handle.remove()
            elif name in self._shown:
                self._shown[name].set_gaussians(**splats(gaussians))
            else:
                add = self.server.scene.add_gaussian_splats
                self._shown[name] = add(f"/{name}", **splats(gaussians))
            if gaussians is not None and name == "main":
                self._half = float(np.quantile(np.abs(gaussians.means), 0.99))
            self._place()
            if pair != (len(self._shown) == 2):
                for client in self.server.get_clients().values():
                    client.camera.position *= 1 / FARTHER if pair else FARTHER
        self.server.flush()

    def show_points(self, points: Float[np.ndarray, "P 3"], colors: Any) -> None:
        """Show the points of a prior, float (P, 3), with their colours, in place of the clouds."""
        self.show("beside", None)
        self.show("main", None)
        self._points = self.server.scene.add_point_cloud(
            "/points", points=points, colors=colors, point_size=0.02, point_shape="circle"
        )

    def look_at(self, gaussians: Gaussians) -> None:
        """Set the first view of browsers that connect from now on."""
        pose, camera = first_pose(StoredCloud(gaussians)), self.server.initial_camera
        camera.position = tuple(camera_of(pose, WORLD_UP)[0, :3, 3].tolist())
        camera.look_at = pose.target

    def _turn(self, camera: Any) -> None:
        """Keep two clouds side by side for the camera that has moved last."""
        import viser.transforms

        self._right = viser.transforms.SO3(camera.wxyz).as_matrix()[:, 0]
        self._place()

    def _place(self) -> None:
        shift = 2 * APART * self._half * self._right if len(self._shown) == 2 else 0 * self._right
        for name, handle in list(self._shown.items()):
            handle.position = -shift if name == "main" else shift


@contextlib.contextmanager
def own_routes(host: str, answer: Callable, sockets: dict[str, Callable]) -> Iterator[None]:
    """Let the viser server that is started in this context answer further requests and sockets,
    and accept messages of :data:`LARGEST_UPLOAD`: viser has no option for it.
    """
    import websockets.asyncio.server as module
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    serve_all = module.serve

    def serve(handler: Callable, *args: Any, process_request: Any, **kwargs: Any) -> Any:
        async def handle(connection: Any) -> None:
            address = urlsplit(connection.request.path)
            own = sockets.get(address.path)
            await (own(connection, unquote(address.query)) if own else handler(connection))

        def check(connection: Any, request: Any) -> Any:
            own = is_own_page(request.headers.get("Host"), request.headers.get("Origin"), host)
            is_page = own and "Upgrade" not in request.headers
            found = answer(unquote(urlsplit(request.path).path)) if is_page else None
            if found is None:
                return process_request(connection, request)
            content, headers = found
            headers = {"Content-Length": str(len(content)), "Cache-Control": "no-cache"} | headers
            return Response(HTTPStatus.OK, "OK", Headers(**headers), content)

        options = kwargs | {"max_size": LARGEST_UPLOAD, "process_request": check}
        return serve_all(handle, *args, **options)

    module.serve = serve
    try:
        yield
    finally:
        module.serve = serve_all
