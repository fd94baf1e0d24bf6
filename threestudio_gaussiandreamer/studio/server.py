"""The studio's server: its page asks for what :class:`Studio` does, and is told what changes."""

import argparse
import asyncio
import contextlib
import functools
import hashlib
import http
import json
import math
import mimetypes
import os
import shutil
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Optional
from urllib.parse import unquote, urlsplit

import numpy as np

from ..core.command import run_command
from ..core.errors import UserError
from ..core.files import json_text, output_folder, write_file
from ..formats.gaussian_files import StoredCloud
from ..formats.ply import is_gaussian_ply
from ..gaussians.axes import WORLD_UP
from ..gaussians.gaussians import Gaussians
from ..gaussians.sh import rgb_to_sh0
from ..launch.options import config_folders
from ..launch.run_folder import PARSED, claim, resume_command, safe_name
from ..models.hub import FAMILIES, OPTION
from ..view import live
from ..view.render import camera_of, first_pose
from ..view.run_files import RunFiles, cloud_file, is_run, read_any, read_text, read_yaml, section
from ..view.run_index import MAX_DEPTH, config_changes, leaves, read_curves
from .jobs import LABEL, Job, Lane

WEB = Path(__file__).with_name("web")
OURS = {"/": "studio.html", "/studio.js": "studio.js", "/studio.css": "studio.css"}
POLICY = "default-src 'self'; style-src 'self' 'unsafe-inline'; base-uri 'none'"
THEIRS = "sandbox allow-scripts allow-downloads"
"""The policies of our page, and of files of runs, whose pages can't act as ours."""
LARGEST_UPLOAD = 256 * 2**20  # bytes
POLL = 0.15  # seconds between two looks for something new
HUB = Path(os.environ.get("HF_HOME", "~/.cache/huggingface")).expanduser() / "hub"


def parse(argv: Optional[Sequence[str]]) -> argparse.Namespace:
    """Parse the arguments of the command; exits as :mod:`argparse` does."""
    parser = argparse.ArgumentParser(
        prog="python -m threestudio_gaussiandreamer.studio",
        description="Serve a page that starts runs, shows them growing, and keeps their results.",
    )
    parser.add_argument("--host", default="127.0.0.1", help="address to serve on (this machine)")
    parser.add_argument("--port", type=int, default=8080, help="port to serve on (8080)")
    parser.add_argument("--output", default="outputs", help="folder of the runs (outputs)")
    return parser.parse_args(argv)


def run(args: argparse.Namespace) -> None:
    """Serve until a stop signal; the run that is in progress then writes a checkpoint."""
    live.serve_until_stopped(Studio(output_folder(args.output, "--output"), args.host, args.port))


main = functools.partial(run_command, parse, run)


class Studio:
    """The queue, the shelf of runs below ``root``, and the view of them."""

    def __init__(self, root: Path, host: str, port: int) -> None:
        self.root, self.entries = root.resolve(), None
        self.read: dict[Path, tuple[list[int], dict[str, Any]]] = {}
        self.trainings, self.tools = Lane(), Lane()
        self.do_remove = self.trainings.remove
        # a folder or file below the root; the main one may be none, for the run that grows
        self.shown: dict[str, Optional[str]] = {"main": None, "beside": None}
        self.stamp, self.grown = (0, 0), ""
        files = (file for folder in config_folders()[::-1] for file in folder.glob("*.yaml"))
        self.configs = {file.name: dict(leaves(read_yaml(file))) for file in files}
        self.counts, self.handles, self.camera, self.half = {}, {}, None, 1.0
        live.require_server(host, port)
        import viser.transforms

        self.rotation = viser.transforms.SO3
        given = host, self.respond, self.routed
        with live.own_pages_only(*given, max_size=LARGEST_UPLOAD):
            self.server = viser.ViserServer(host=host, port=port, verbose=False)
        self.server.scene.set_up_direction("+z")
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)
        self.server.on_client_connect(lambda client: client.camera.on_update(self.place))
        self.address = f"http://{host.replace('0.0.0.0', 'localhost')}:{self.server.get_port()}"
        self.looking = asyncio.run_coroutine_threadsafe(self.look(), self.server.get_event_loop())

    def close(self) -> None:
        """Stop the jobs, and serving."""
        self.looking.cancel()
        self.trainings.close()
        self.tools.close()
        self.server.stop()

    def routed(self, handler: Callable) -> Callable:
        """Return the handler of connections: of our page, and viser's."""

        async def handle(connection: Any) -> None:
            own = urlsplit(connection.request.path).path == "/studio"
            await (self.talk(connection) if own else handler(connection))

        return handle

    def respond(self, request: Any) -> Any:
        """Return the response to a request of our page; None for a connection, or viser's."""
        from websockets.datastructures import Headers
        from websockets.http11 import Response

        path = unquote(urlsplit(request.path).path)
        if "Upgrade" in request.headers or (found := self.answer(path)) is None:
            return None
        headers = {"Content-Length": str(len(found[0])), "Cache-Control": "no-cache"}
        return Response(http.HTTPStatus.OK, "OK", Headers(**headers, **found[1]), found[0])

    def answer(self, path: str) -> Optional[tuple[bytes, dict[str, str]]]:
        """Answer the request for our page, a file of a run, or the picture of the current one."""
        file, policy = self.root / path.removeprefix("/files/"), THEIRS  # any other is absolute
        if path in OURS:
            file, policy = WEB / OURS[path], POLICY
        elif path == "/picture" and (job := self.trainings.current):
            file = job.live / "picture.png"
        elif not (os.path.isfile(file) and file.resolve().is_relative_to(self.root)):
            return None
        if not file.is_file():
            return None
        kind = mimetypes.guess_type(file.name)[0] or "application/octet-stream"
        headers = {"Content-Type": kind, "X-Content-Type-Options": "nosniff"}
        return file.read_bytes(), headers | {"Content-Security-Policy": policy}

    async def talk(self, connection: Any) -> None:
        """Tell a page what has changed, and do what it asks for; bytes are an upload."""
        telling = asyncio.create_task(self.tell(connection))
        try:
            async for message in connection:
                try:
                    is_file = isinstance(message, bytes)
                    asked = {"do": "upload", "file": message} if is_file else json.loads(message)
                    act = getattr(self, f"do_{asked.pop('do')}")
                    if answer := await asyncio.to_thread(act, **asked):
                        await connection.send(json_text(answer))
                except Exception as error:  # the studio lives on
                    said = "" if isinstance(error, UserError) else f"{type(error).__name__}: "
                    await connection.send(json_text({"error": f"{said}{error}"}))
        finally:
            telling.cancel()

    async def tell(self, connection: Any) -> None:
        models = {x.config: str(self.configs[x.config].get(OPTION)) for x in FAMILIES}
        found = {path.name.removeprefix("models--") for path in HUB.glob("models--*")}
        missing = [name for name, model in models.items() if model.replace("/", "--") not in found]
        about = {"missing": missing, "limit": LARGEST_UPLOAD, "root": str(self.root)}
        await connection.send(json_text({**about, "configs": self.configs}))
        sent = ("", None)
        while True:
            state, entries = json_text(self.state()), self.entries
            if entries is not sent[1]:
                await connection.send(json_text({"shelf": entries}))
            if state != sent[0]:
                await connection.send(state)
            sent = state, entries
            await asyncio.sleep(POLL)

    def state(self) -> dict[str, Any]:
        """Return what changes while a page is open."""
        jobs = {"job": self.trainings.current, "tool": self.tools.current}
        jobs |= {"last": self.trainings.last, "last_tool": self.tools.last}
        queue = [{"id": job.number, "label": job.label[:LABEL]} for job in self.trainings.waiting]
        state = {"queue": queue, "shown": self.shown, "counts": self.counts, "grown": self.grown}
        return state | {name: job and job.shown() for name, job in jobs.items()}

    def do_upload(self, file: bytes) -> dict[str, Any]:
        """Write a file, whose first line is its name, into a folder of its own."""
        name, _, content = file.partition(b"\n")
        folder = self.root / "uploads" / hashlib.sha256(content).hexdigest()[:12]
        folder.mkdir(parents=True, exist_ok=True)
        path = Path(name.decode())
        ending = path.suffix[:12] if path.suffix[1:].isalnum() else ""
        path = folder / f"{safe_name(path.stem)}{ending}"
        write_file(path, content)
        # a PLY is a mesh, points or Gaussians
        return {"path": str(path), "gaussians": is_gaussian_ply(path)}

    def do_start(self, words: list[str], label: str) -> None:
        """Queue a run of the launcher with these arguments."""
        self.trainings.add(Job(str(label), [*map(str, words)], done=self.do_refresh))

    def do_control(self, stop: bool = False, paused: bool = False) -> None:
        """Stop the current run, let it pause, or let it go on."""
        if job := self.trainings.current:
            job.control(stop, paused)

    def do_take(self, run: str, name: str) -> None:
        """Make a file of a run that isn't there yet."""
        cloud = cloud_file(self.path_of(run))
        option = ["--gaussians"] if name == "gaussians.glb" else []
        words = [str(cloud), str(cloud.with_name(Path(name).name)), *option]
        self.tools.add(Job(name, words, "convert", self.do_refresh))

    def do_prune(self, run: str, budget: str, value: str) -> None:
        """Prune the cloud of a run, and show before and after side by side."""
        cloud = cloud_file(self.path_of(run))
        out = cloud.parent / "pruned" / f"{safe_name(f'{budget} {value}')}{cloud.suffix}"
        out.parent.mkdir(exist_ok=True)
        out.unlink(missing_ok=True)

        def done() -> None:
            self.do_refresh()
            if out.is_file():
                self.do_show(run, out.relative_to(self.root).as_posix())

        words = [str(cloud), str(out), f"--{budget}={value}"]
        self.tools.add(Job(f"prune to {budget} {value}", words, "prune", done))

    def do_delete(self, run: str) -> None:
        """Delete the folder of a run that no process trains in."""
        folder = self.path_of(run)
        if not is_run(folder):
            raise UserError(f"{run[:LABEL]!r} is no run")
        with contextlib.ExitStack() as stack:
            stack.callback(claim(folder, advice="").release)
            shutil.rmtree(folder)
        self.do_refresh()

    def do_show(self, main: Optional[str] = None, beside: Optional[str] = None) -> None:
        """Show a run, or the one that grows, and another run or file beside it."""
        for place, name in (("main", main), ("beside", beside)):
            if name is not None:
                cloud = read_any(cloud_file(self.path_of(name))).in_axes(WORLD_UP)
                self.draw(place, cloud.gaussians)
            else:
                self.draw(place, None)
            self.shown[place] = name
        self.stamp = (0, 0)

    def do_refresh(self) -> None:
        """Read the runs whose folders have changed, newest first."""
        read = {}
        for depth in range(1, MAX_DEPTH + 1):
            for folder in filter(is_run, self.root.glob("/".join("*" * depth))):
                watched = (folder, *folder.glob("*/"), *folder.glob("save/it*-export/"))
                known = self.read.get(folder, ([], {}))
                with contextlib.suppress(OSError, ValueError):  # it is being deleted, or damaged
                    stamp = [path.stat().st_mtime_ns for path in watched]
                    read[folder] = known if known[0] == stamp else (stamp, self.entry_of(folder))
        entries = sorted((entry for _, entry in read.values()), key=lambda x: x["when"])
        self.read, self.entries = read, entries[::-1]

    def path_of(self, name: str) -> Path:
        """Return a file or folder below the root; raises UserError for any other."""
        path = (self.root / name).resolve()
        if path == self.root or not path.is_relative_to(self.root):
            raise UserError(f"{name[:LABEL]!r} isn't in {self.root}")
        return path

    def entry_of(self, folder: Path) -> dict[str, Any]:
        """Return what the page shows of a run, with names of files relative to the root."""
        name = functools.partial(os.path.relpath, start=self.root)
        run, command = RunFiles(folder), read_text(folder / "cmd.txt").partition("\n")[0]
        files = sorted(filter(Path.is_file, (run.export or folder / "-").rglob("*.*")))
        files += [*sorted(run.save.glob("it*-test.mp4"))[-1:], folder / PARSED]
        curve = read_curves(folder, ["gaussians"]).get("gaussians") or [(0, 0)]
        last = run.export is None and (folder / "ckpts/last.ckpt").is_file()
        return {
            "id": name(folder),
            "prompt": run.prompt,
            "when": datetime.fromtimestamp((run.export or folder).stat().st_mtime).isoformat(),
            "picture": run.picture and name(run.picture),
            "turn": [name(path) for path in run.save.glob("it*-test.webp")][-1:],
            "scores": section(run.scores, "result"),
            "count": int(curve[-1][1]),
            "settings": [f"{key}={new}" for key, _, new in config_changes(folder / "configs")],
            "ended": run.export is not None,
            "resume": resume_command(folder, None) if last else "",
            "command": command,
            "files": [{"name": x.name, "path": name(x), "size": x.stat().st_size} for x in files],
        }

    def draw(self, name: str, gaussians: Optional[Gaussians]) -> None:
        """Show a cloud in the world's axes as ``main`` or ``beside``, or remove it."""
        count = 0 if gaussians is None else len(gaussians.means)
        with self.server.atomic():
            if not count and name in self.handles:
                self.handles.pop(name).remove()
            elif name in self.handles:
                self.handles[name].set_gaussians(**live.splats(gaussians))
            elif count:
                add = self.server.scene.add_gaussian_splats
                self.handles[name] = add(f"/{name}", **live.splats(gaussians))
                if name == "main":
                    self.half = float(np.quantile(np.abs(gaussians.means), 0.99))
                    self.look_at(gaussians)
            self.counts[name] = count
            self.place()
        self.server.flush()

    def look_at(self, gaussians: Gaussians) -> None:
        """Set the view of the browsers, and of those that connect from now on."""
        pose = first_pose(StoredCloud(gaussians))
        position = tuple(camera_of(pose, WORLD_UP)[0, :3, 3].tolist())
        cameras = [client.camera for client in self.server.get_clients().values()]
        for camera in (self.server.initial_camera, *cameras):
            camera.position, camera.look_at = position, pose.target
            camera.fov = math.radians(pose.fovy)

    def place(self, camera: Any = None) -> None:
        """Let the camera that has moved last see two clouds side by side from one direction."""
        self.camera = camera or self.camera
        if self.camera is None:
            return
        right, down, _ = self.rotation(self.camera.wxyz).as_matrix().T
        apart = (len(self.handles) - 1) * 1.2 * self.half
        angle = math.atan2(apart, np.linalg.norm(self.camera.position - self.camera.look_at))
        for name, handle in list(self.handles.items()):
            sign = -1 if name == "main" else 1
            handle.position = sign * apart * right
            handle.wxyz = self.rotation.exp(sign * angle * down).wxyz

    async def look(self) -> None:
        """Read the runs, then show the current one whenever it has changed and is watched."""
        await asyncio.to_thread(self.do_refresh)
        while True:
            job = self.trainings.current or self.trainings.last
            if job and self.shown["main"] is None and self.server.get_clients():
                with contextlib.suppress(Exception):  # it has just ended
                    await asyncio.to_thread(self.grow, job)
            await asyncio.sleep(POLL)

    def grow(self, job: Job) -> None:
        """Show the newest cloud of a run, or before it the points of its prior."""
        folder = Path(job.shown()["status"].get("folder", "/nonexistent"))
        cloud, prior = job.live / "cloud.npz", folder / "save/prior/points.npz"
        path = cloud if cloud.is_file() else prior
        stamp = (job.number, path.stat().st_mtime_ns)
        if stamp == self.stamp:
            return
        self.stamp = stamp
        with np.load(path, allow_pickle=False) as arrays:
            if path == cloud:
                gaussians = Gaussians(*(arrays[name] for name in Gaussians._fields))
            else:
                points, sh = arrays["points"], rgb_to_sh0(arrays["colors"])[:, None]
                quats = np.tile(np.eye(4)[0], (len(points), 1))
                sizes = np.full_like(points, math.log(0.012))
                gaussians = Gaussians(points, quats, sizes, 0 * sizes[:, 0] + 5, sh)
        self.draw("main", gaussians)
        self.grown = job.label[:LABEL]
