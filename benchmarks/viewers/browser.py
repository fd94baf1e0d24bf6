"""Images of clouds from viewers in headless Chromium, which gets pages from a local web server and
posts the pixels back.

Install outside the repository:

    apt-get install chromium
    npm install @sparkjsdev/spark three     # in a folder of your own
"""

import json
import os
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, NamedTuple, Optional

import numpy as np
from jaxtyping import Float, UInt8

SPARK_PAGE = Path(__file__).with_name("spark.html")
THREE_PAGE = Path(__file__).with_name("three.html")
DRAWING = Path(__file__).with_name("page.js")
"""What both pages import."""
CHROMIUM_NAMES = ("chromium", "chromium-browser", "google-chrome")
THREE = "three/build/three.module.js"
MODULES = ("@sparkjsdev/spark/dist/spark.module.js", THREE)
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--no-first-run",
    "--disable-dev-shm-usage",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)
UNTURNED = (0.0, 0.0, 0.0, 1.0)
HALF_TURN_ABOUT_X = (1.0, 0.0, 0.0, 0.0)
"""Quaternion xyzw by which Spark's examples bring files that are -y up into three's y-up scene."""
TIMEOUT = 1200
"""Seconds that a page has for all of its pictures; a busy machine takes 20 s for one."""


class Camera(NamedTuple):
    """A pinhole camera with square images in the axes of the rendered scene."""

    c2w: Float[np.ndarray, "4 4"]
    """OpenGL: the columns are right, up, back, position."""
    fovy: float
    """Radians."""

    def as_json(self) -> dict[str, Any]:
        return {"c2w": np.ravel(self.c2w).tolist(), "fovy": float(np.degrees(self.fovy))}


def chromium() -> Optional[str]:
    """Return the path of the browser."""
    return next(filter(None, map(shutil.which, CHROMIUM_NAMES)), None)


def missing(modules: Path, names: Sequence[str] = MODULES) -> Optional[str]:
    """Return what is missing for images from viewers, or None.

    Args:
        modules: the folder ``node_modules`` with the npm packages.
        names: the files of packages that are needed.
    """
    if chromium() is None:
        return f"none of {', '.join(CHROMIUM_NAMES)} is installed"
    lacking = [name for name in names if not (modules / name).is_file()]
    return f"{modules} has no {lacking[0]}" if lacking else None


def draw_with_spark(
    cloud: Path,
    cameras: Sequence[Camera],
    size: int,
    modules: Path,
    *,
    options: Mapping[str, Any] = {},
    rotation: Sequence[float] = UNTURNED,
) -> UInt8[np.ndarray, "V S S 3"]:
    """Draw the file ``cloud`` on white from every camera.

    Args:
        options: of ``SparkRenderer``, such as ``preBlurAmount``, the dilation in square pixels.
        rotation: quaternion xyzw that turns the file's axes into those of the cameras.

    Raises:
        RuntimeError: the page failed, or wasn't done in time.
    """
    job = {
        "size": size,
        "cloud": f"/cloud{cloud.suffix}",
        "cameras": [camera.as_json() for camera in cameras],
        "options": dict(options),
        "rotation": list(rotation),
    }
    files = {
        "/": SPARK_PAGE.read_bytes(),
        "/page.js": DRAWING.read_bytes(),
        "/job.json": json.dumps(job).encode(),
        job["cloud"]: cloud.read_bytes(),
    }
    return _canvases(Exchange(files, modules, len(cameras)), size)


def draw_with_three(
    mesh: Path, cameras: Sequence[Camera], size: int, modules: Path
) -> UInt8[np.ndarray, "V S S 3"]:
    """Draw a GLB with three.js on white from every camera, without lights.

    Raises:
        RuntimeError: as :func:`draw_with_spark`.
    """
    job = {
        "size": size,
        "mesh": "/mesh.glb",
        "cameras": [camera.as_json() for camera in cameras],
    }
    files = {
        "/": THREE_PAGE.read_bytes(),
        "/page.js": DRAWING.read_bytes(),
        "/job.json": json.dumps(job).encode(),
        job["mesh"]: mesh.read_bytes(),
    }
    return _canvases(Exchange(files, modules, len(cameras)), size)


def _canvases(exchange: "Exchange", size: int) -> UInt8[np.ndarray, "V S S 3"]:
    """Return the pictures of a page that posts the rows of its canvas from the bottom up."""
    rows = [np.frombuffer(posted, np.uint8) for posted in pictures_of(exchange, size)]
    return np.stack([values.reshape(size, size, 4) for values in rows])[:, ::-1, :, :3]


# ---- the server and the browser ------------------------------------------------------------------


@dataclass
class Exchange:
    """The input of a page, and its result: ``count`` images or a failure."""

    files: dict[str, bytes]
    modules: Path
    count: int
    pictures: dict[str, bytes] = field(default_factory=dict)
    failure: Optional[str] = None
    finished: threading.Event = field(default_factory=threading.Event)

    def receive(self, path: str, body: bytes) -> None:
        """Store what was posted to ``/picture/<number>`` or ``/failed``."""
        if path == "/failed":
            self.failure = body.decode(errors="replace")
        else:
            self.pictures[path] = body
        if self.failure is not None or len(self.pictures) == self.count:
            self.finished.set()


def pictures_of(exchange: Exchange, size: int) -> list[bytes]:
    """Show the page in a window of about ``size`` pixels and wait for its images.

    Raises:
        RuntimeError: the page failed, or took too long.
    """
    with served(exchange) as address, browser(f"{address}/", size):
        exchange.finished.wait(TIMEOUT)
    if exchange.failure is not None:
        raise RuntimeError(f"the page failed: {exchange.failure}")
    if len(exchange.pictures) < exchange.count:
        found = f"{len(exchange.pictures)} of {exchange.count} pictures"
        raise RuntimeError(f"the page made {found} in {TIMEOUT} s")
    return [exchange.pictures[f"/picture/{number}"] for number in range(exchange.count)]


class Handler(SimpleHTTPRequestHandler):
    """Serves the files of an exchange and the npm packages, and stores what is posted."""

    extensions_map = SimpleHTTPRequestHandler.extensions_map | {".wasm": "application/wasm"}

    def __init__(self, exchange: Exchange, *args: Any) -> None:
        self.exchange = exchange
        super().__init__(*args, directory=str(exchange.modules.parent))

    def do_GET(self) -> None:
        if self.path not in self.exchange.files:
            super().do_GET()
            return
        kind = "text/html" if self.path == "/" else self.guess_type(self.path)
        self.reply(self.exchange.files[self.path], kind)

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        self.reply(b"", "text/plain")
        self.exchange.receive(self.path, body)

    def reply(self, content: bytes, kind: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *args: Any) -> None:
        pass


@contextmanager
def served(exchange: Exchange) -> Iterator[str]:
    """Serve on a free local port in this context; yield the address."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, exchange))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()
        server.server_close()


@contextmanager
def browser(address: str, size: int) -> Iterator[None]:
    """Keep a headless Chromium open on ``address`` in this context.

    Its window, toolbars included, has at least 640 pixels each way, the smallest that it supports.
    """
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        options = [f"--user-data-dir={profile}", f"--window-size={max(size, 640)},{max(size, 640)}"]
        process = subprocess.Popen(
            [chromium(), *FLAGS, *options, address],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"HOME": profile},
        )
        try:
            yield
        finally:
            process.terminate()
            process.wait()
