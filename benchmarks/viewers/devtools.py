"""Drive headless Chromium over a pipe with its DevTools protocol: no port, no package.

``open_page`` loads a page and records what a test wants to know: requests, messages of the console
and exceptions."""

import base64
import json
import os
import select
import shlex
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Optional

import numpy as np
import torch
from jaxtyping import Float

from benchmarks.viewers.browser import FLAGS, chromium
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud
from threestudio_gaussiandreamer.meshes.raycast import over_background
from threestudio_gaussiandreamer.metrics import psnr
from threestudio_gaussiandreamer.view.page import PageOptions
from threestudio_gaussiandreamer.view.render import Pose, render

QUIET = (
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-quic",
    "--hide-scrollbars",
)
NO_WEBGL = ("--disable-3d-apis",)
TIMEOUT = 300.0
"""Seconds that one answer may take."""


class Page:
    """A loaded page."""

    def __init__(self, send: int, receive: int) -> None:
        self._send, self._receive, self._buffer, self._number = send, receive, b"", 0
        self.session: Optional[str] = None
        self.requests: list[str] = []
        """Addresses of all requests, also those that a policy has blocked."""
        self.problems: list[str] = []
        """Messages of the console and exceptions."""

    def load(self, address: str) -> None:
        """Open ``address`` in a new tab and wait until it is loaded."""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        attached = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self.session = attached["sessionId"]
        for domain in ("Network", "Runtime", "Log", "Page"):
            self.call(f"{domain}.enable")
        self.call("Page.navigate", url=address)
        while self.evaluate("document.readyState") != "complete":
            time.sleep(0.02)

    def evaluate(self, expression: str) -> Any:
        """Return the value of a JavaScript expression, awaited if it is a promise.

        Raises:
            RuntimeError: the expression has thrown an exception.
        """
        options = {"expression": expression, "awaitPromise": True, "returnByValue": True}
        answer = self.call("Runtime.evaluate", **options)
        if "exceptionDetails" in answer:
            raise RuntimeError(json.dumps(answer["exceptionDetails"])[:2000])
        return answer["result"].get("value")

    def screenshot(self) -> bytes:
        """Return the window as a PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        """Send a command and return its result.

        Raises:
            RuntimeError: the browser has refused it, or hasn't answered in time.
        """
        self._number += 1
        message = {"id": self._number, "method": method, "params": params}
        if self.session is not None:
            message["sessionId"] = self.session
        os.write(self._send, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next_message()
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']}")
                return answer["result"]
            self._note(answer)

    def _next_message(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            if not select.select([self._receive], [], [], TIMEOUT)[0]:
                raise RuntimeError(f"the browser hasn't answered in {TIMEOUT:g} s")
            part = os.read(self._receive, 1 << 20)
            if not part:
                raise RuntimeError("the browser has ended")
            self._buffer += part
        message, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(message)

    def _note(self, event: dict[str, Any]) -> None:
        """Record an event that is a request or a message."""
        method, params = event.get("method"), event.get("params", {})
        if method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])
        elif method == "Runtime.consoleAPICalled":
            self.problems.append(str([x.get("value") for x in params["args"]]))
        elif method == "Runtime.exceptionThrown":
            self.problems.append(json.dumps(params["exceptionDetails"])[:2000])
        elif method == "Log.entryAdded":
            self.problems.append(params["entry"]["text"])


@contextmanager
def open_page(
    place: Path | str, *, size: tuple[int, int] = (800, 600), flags: tuple[str, ...] = ()
) -> Iterator[Page]:
    """Open a file in a browser of its own while the block runs.

    Args:
        place: the file, or an address.
        size: width and height of the window, pixels.
        flags: more of Chromium's flags.
    """
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        to_read, to_browser = os.pipe()
        from_browser, to_write = os.pipe()
        window = [f"--user-data-dir={profile}", f"--window-size={size[0]},{size[1]}"]
        options = [*FLAGS, *QUIET, *flags, *window, "--remote-debugging-pipe"]
        command = shlex.join([str(chromium()), *options])
        process = subprocess.Popen(
            ["bash", "-c", f"exec {command} 3<&{to_read} 4>&{to_write}"],
            pass_fds=(to_read, to_write),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=os.environ | {"HOME": profile},
        )
        os.close(to_read)
        os.close(to_write)
        try:
            page = Page(to_browser, from_browser)
            page.load(place if isinstance(place, str) else place.resolve().as_uri())
            yield page
        finally:
            process.terminate()
            process.wait()
            os.close(to_browser)
            os.close(from_browser)


# ---- our page ------------------------------------------------------------------------------------


def orbit_poses(first: Pose, count: int) -> list[Pose]:
    """Return poses around the first one's target, at several elevations and distances."""
    return [
        first._replace(
            azimuth=(first.azimuth + 360.0 * i / count) % 360,
            elevation=(-10.0, 15.0, 40.0, 75.0)[i % 4],
            distance=first.distance * (0.6, 1.0)[i % 2],
        )
        for i in range(count)
    ]


def page_picture(page: Page, pose: Pose, size: int) -> Float[np.ndarray, "size size 3"]:
    """Let our page draw a square picture; values in [0, 1]."""
    picture = f"viewer.then(v => v.picture({json.dumps(pose._asdict())}, {size}, {size}))"
    data = base64.b64decode(page.evaluate(f"{picture}.then(bytes => bytes.toBase64())"))
    rows = np.frombuffer(data, np.uint8).reshape(size, size, 4)[::-1, :, :3]
    return rows.astype(np.float32) / 255


def difference_to_ours(
    page: Page,
    cloud: StoredCloud,
    options: PageOptions,
    poses: Sequence[Pose],
    size: int,
    drawn: Optional[Sequence[Pose]] = None,
) -> list[float]:
    """Return the PSNR of the page's pictures to our own renders, dB, for each pose.

    Args:
        drawn: other poses for the page, to see that the comparison notices.
    """
    views = render(cloud, options.settings, list(poses), size)
    ours = over_background(views, torch.tensor(options.background)).clamp(0, 1)
    theirs = np.stack([page_picture(page, pose, size) for pose in drawn or poses])
    return [float(psnr(a, b)) for a, b in zip(torch.from_numpy(theirs), ours, strict=True)]
