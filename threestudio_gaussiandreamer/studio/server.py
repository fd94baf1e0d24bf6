"""The studio's server: its page asks for what :class:`Studio` does, and is told what changes."""

import argparse
import asyncio
import contextlib
import functools
import hashlib
import json
import mimetypes
import shlex
import shutil
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Optional

import numpy as np

from ..core.command import run_command
from ..core.errors import UserError
from ..core.files import atomic_file, json_text, output_folder
from ..formats.ply import is_gaussian_ply
from ..gaussians.axes import WORLD_UP
from ..gaussians.gaussians import Gaussians
from ..launch.folder_lock import claim
from ..launch.options import config_folders
from ..launch.run_folder import PARSED, resume_command, safe_name
from ..models.hub import FAMILIES
from ..view.live import serve_until_stopped
from ..view.run_files import RunFiles, is_run, read_any, read_json, read_text, read_yaml, section
from ..view.run_index import MAX_DEPTH, config_changes, read_curves
from .jobs import LABEL, Job, Lane
from .scene import LARGEST_UPLOAD, Scene

WEB = Path(__file__).with_name("web")
OURS = {"/": "studio.html", "/studio.js": "studio.js", "/studio.css": "studio.css"}
POLICY = "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
POLICY += "img-src 'self'; connect-src 'self'; frame-src 'self'; base-uri 'none'"
"""Of our page; that of a run's page keeps it from acting as ours."""
THEIRS = "sandbox allow-scripts allow-downloads"
POLL = 0.15
"""Seconds between two looks for something new."""
TAKES = {"gaussians.sog": [], "gaussians.glb": ["--gaussians"], "mesh.glb": []}
"""Files that are made when they are asked for, with options of the command that converts."""
Entry = dict[str, Any]


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
    serve_until_stopped(Studio(output_folder(args.output, "--output"), args.host, args.port))


main = functools.partial(run_command, parse, run)


class Studio:
    """The queue, the shelf of runs below ``root``, and the view of them."""

    def __init__(self, root: Path, host: str, port: int) -> None:
        self.root, self.entries, self.version = root.resolve(), [], 0
        self.read: dict[Path, tuple[list[int], Entry]] = {}
        self.trainings, self.tools = Lane(), Lane()
        # a folder or file below the root; the main one may be none, for the run that grows
        self.shown: dict[str, Optional[str]] = {"main": None, "beside": None}
        self.captions, self.stamp = {"main": "", "beside": ""}, (0, 0)
        self.missing = list(missing_models())
        self.do_refresh()
        sockets = {"/studio": self.talk, "/upload": self.upload}
        self.scene = Scene(host, port, self.answer, sockets)
        name = "localhost" if host == "0.0.0.0" else host
        self.address = f"http://{name}:{self.scene.server.get_port()}"
        asyncio.run_coroutine_threadsafe(self.look(), self.scene.server.get_event_loop())

    def close(self) -> None:
        """Stop the jobs, and serving."""
        self.trainings.close()
        self.tools.close()
        self.scene.server.stop()

    # ---- requests and sockets --------------------------------------------------------------------

    def answer(self, path: str) -> Optional[tuple[bytes, dict[str, str]]]:
        """Answer the request for our page, a file of a run, or the picture of the current one."""
        if path in OURS:
            file, policy = WEB / OURS[path], POLICY
        elif path == "/picture" and (job := self.trainings.current):
            file, policy = job.folder / "picture.png", THEIRS
        else:
            file, policy = self.root / path.removeprefix("/files/"), THEIRS
            if not path.startswith("/files/") or not file.resolve().is_relative_to(self.root):
                return None
        if not file.is_file():
            return None
        kind = mimetypes.guess_type(file.name)[0] or "application/octet-stream"
        headers = {"Content-Type": kind, "X-Content-Type-Options": "nosniff"}
        return file.read_bytes(), headers | {"Content-Security-Policy": policy}

    async def talk(self, connection: Any, query: str) -> None:
        """Tell a page what has changed, and do what it asks for."""
        telling = asyncio.create_task(self.tell(connection))
        try:
            async for text in connection:
                try:
                    await asyncio.to_thread(self.act, **json.loads(text))
                except Exception as error:  # the studio lives on
                    await connection.send(json_text({"error": said_of(error)}))
        finally:
            telling.cancel()

    async def tell(self, connection: Any) -> None:
        about = {"missing": self.missing, "limit": LARGEST_UPLOAD}
        sent, version = json_text({"about": about}), -1
        await connection.send(sent)
        while True:
            if version != self.version:
                version = self.version
                await connection.send(json_text({"shelf": self.entries}))
            text = json_text({"state": self.state()})
            if text != sent:
                sent = text
                await connection.send(text)
            await asyncio.sleep(POLL)

    def state(self) -> dict[str, Any]:
        """Return what changes while a page is open."""
        jobs = {"job": self.trainings.current, "last": self.trainings.last}
        jobs |= {"tool": self.tools.current, "last_tool": self.tools.last}
        queue = [{"id": job.number, "label": job.label[:LABEL]} for job in self.trainings.waiting]
        state = {"queue": queue, "shown": self.shown, "captions": self.captions}
        return state | {name: job and job.shown() for name, job in jobs.items()}

    async def upload(self, connection: Any, name: str) -> None:
        """Receive one file, which is one message; a longer one than is allowed ends the socket."""
        try:
            path = await asyncio.to_thread(self.store, Path(name), await connection.recv())
            # a PLY is a mesh, points or Gaussians
            answer = {"file": str(path), "gaussians": is_gaussian_ply(path)}
        except (OSError, UserError) as error:
            answer = {"error": said_of(error)}
        await connection.send(json_text(answer))

    def store(self, name: Path, content: bytes) -> Path:
        """Write an uploaded file into a folder of its own, and return its path."""
        folder = self.root / "uploads" / hashlib.sha256(content).hexdigest()[:12]
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{safe_name(name.stem)}{safe_name(name.suffix)[-12:]}"
        with atomic_file(path) as file:
            file.write(content)
        return path

    # ---- what a page asks for --------------------------------------------------------------------

    def act(self, do: str, **given: Any) -> None:
        """Call the method ``do_<do>``; raises UserError if that isn't possible."""
        getattr(self, f"do_{do}")(**given)

    def do_start(self, words: list[str], label: str) -> None:
        """Queue a run of the launcher with these arguments."""
        self.trainings.add(Job(label, [*words, f"exp_root_dir={self.root}"], done=self.ended))

    def do_resume(self, run: str) -> None:
        """Queue the rest of a run that was stopped."""
        found = self.run_of(run)
        words = shlex.split(resume_command(found.folder, None))
        self.trainings.add(Job(found.prompt, words[words.index("--config") :], done=self.ended))

    def do_pause(self, paused: bool) -> None:
        if job := self.trainings.current:
            job.pause(paused)

    def do_stop(self) -> None:
        if job := self.trainings.current:
            job.stop()

    def do_remove(self, number: Optional[int] = None) -> None:
        self.trainings.remove(number)

    def do_take(self, run: str, name: str) -> None:
        """Make a file of a run that isn't there yet."""
        cloud = self.cloud_of(run)
        words = [str(cloud), str(cloud.with_name(name)), *TAKES[name]]
        self.tools.add(Job(name, words, "convert", lambda job: self.do_refresh()))

    def do_prune(self, run: str, budget: str, value: str) -> None:
        """Prune the cloud of a run, and show before and after side by side."""
        cloud = self.cloud_of(run)
        out = cloud.parent / "pruned" / f"{safe_name(f'{budget} {value}')}{cloud.suffix}"
        out.parent.mkdir(exist_ok=True)

        def done(job: Job) -> None:
            self.do_refresh()
            if not job.shown()["error"]:
                self.do_show(run, out.relative_to(self.root).as_posix())

        words = [str(cloud), str(out), f"--{budget}={value}"]
        self.tools.add(Job(f"prune to {budget} {value}", words, "prune", done))

    def do_delete(self, run: str) -> None:
        """Delete the folder of a run that no process trains in."""
        folder = self.run_of(run).folder
        claimed = claim(folder, advice="")
        try:
            shutil.rmtree(folder)
        finally:
            claimed.release()
        self.do_refresh()

    def do_show(self, main: Optional[str] = None, beside: Optional[str] = None) -> None:
        """Show a run, or the one that grows, and another run or file beside it."""
        for place, name in (("main", main), ("beside", beside)):
            cloud, caption = None, ""
            if name is not None:
                file = self.path_of(name)
                file = file if file.is_file() else self.cloud_of(name)
                cloud = read_any(file).in_axes(WORLD_UP).gaussians
                caption = f"{len(cloud.means):,} Gaussians"
                report = read_json(file.with_name(f"{file.name}.json"), dict)
                if "psnr_on_unseen_views" in report:
                    caption += f", {report['psnr_on_unseen_views']:.1f} dB to the one before"
            self.scene.show(place, cloud)
            self.shown[place], self.captions[place] = name, caption
        self.stamp = (0, 0)

    def do_refresh(self) -> None:
        """Read the runs whose folders have changed, newest first."""
        read = {}
        for depth in range(1, MAX_DEPTH + 1):
            for folder in filter(is_run, self.root.glob("/".join("*" * depth))):
                watched = [
                    *(folder / x for x in ("", "save", "ckpts")),
                    *folder.glob("save/it*-e*/"),
                ]
                stamp = [path.stat().st_mtime_ns for path in watched if path.exists()]
                known = self.read.get(folder, ([], {}))
                read[folder] = known if known[0] == stamp else (stamp, self.entry_of(folder))
        entries = sorted((entry for _, entry in read.values()), key=lambda x: x["when"])
        self.read, self.entries, self.version = read, entries[::-1], self.version + 1

    # ---- runs ------------------------------------------------------------------------------------

    def path_of(self, name: str) -> Path:
        """Return a file or folder below the root; raises UserError for any other."""
        path = (self.root / name).resolve()
        if path == self.root or not path.is_relative_to(self.root):
            raise UserError(f"{name[:LABEL]!r} isn't in {self.root}")
        return path

    def run_of(self, name: str) -> RunFiles:
        path = self.path_of(name)
        if not is_run(path):
            raise UserError(f"{name[:LABEL]!r} is no run")
        return RunFiles(path)

    def cloud_of(self, name: str) -> Path:
        if (cloud := self.run_of(name).cloud) is None:
            raise UserError("this run has exported no cloud yet")
        return cloud

    def entry_of(self, folder: Path) -> Entry:
        """Return what the page shows of a run, with names of files relative to the root."""

        def name(path: Optional[Path]) -> Optional[str]:
            return path and path.relative_to(self.root).as_posix()

        run, command = RunFiles(folder), read_text(folder / "cmd.txt").partition("\n")[0]
        files = sorted(path for path in (run.export or folder / "-").rglob("*.*"))
        files += [*sorted(run.save.glob("it*-test.mp4"))[-1:], folder / PARSED]
        curve = read_curves(folder, ["gaussians"]).get("gaussians") or [(0, 0)]
        words: list[str] = []
        with contextlib.suppress(ValueError):  # of a file that was edited
            words = shlex.split(command)
        return {
            "id": name(folder),
            "prompt": run.prompt,
            "when": datetime.fromtimestamp((run.export or folder).stat().st_mtime).isoformat(),
            "picture": name(run.picture),
            "turn": name(next(iter(run.save.glob("it*-test.webp")), None)),
            "scores": section(run.scores, "result"),
            "count": int(curve[-1][1]),
            "settings": [f"{key}={new}" for key, _, new in config_changes(folder / "configs")],
            "ended": run.export is not None,
            "resumable": run.export is None and (folder / "ckpts/last.ckpt").is_file(),
            "command": command,
            "words": words,
            "files": [{"name": x.name, "path": name(x), "size": x.stat().st_size} for x in files],
        }

    # ---- the run that grows ----------------------------------------------------------------------

    def ended(self, job: Job) -> None:
        """Put a run on the shelf, and show it if it was watched."""
        self.do_refresh()
        folder = Path(job.shown()["status"].get("folder", "/nonexistent")).resolve()
        if self.shown["main"] is None and is_run(folder) and RunFiles(folder).cloud:
            self.do_show(folder.relative_to(self.root).as_posix())

    async def look(self) -> None:
        """Show the current run whenever it has changed and a browser is connected."""
        while True:
            job = self.trainings.current
            if job and self.shown["main"] is None and self.scene.watched:
                with contextlib.suppress(OSError, ValueError, KeyError):  # it has just ended
                    await asyncio.to_thread(self.grow, job)
            await asyncio.sleep(POLL)

    def grow(self, job: Job) -> None:
        """Show the newest cloud of a run, or before it the points of its prior."""
        folder = Path(job.shown()["status"].get("folder", "/nonexistent"))
        cloud, prior = job.folder / "cloud.npz", folder / "save/prior/points.npz"
        path = cloud if cloud.is_file() else prior
        stamp = (job.number, path.stat().st_mtime_ns)
        if stamp == self.stamp:
            return
        self.stamp = stamp
        with np.load(path) as arrays:
            if path == prior:
                self.scene.show_points(arrays["points"], arrays["colors"])
                self.captions["main"] = f"{len(arrays['points']):,} points of the prior"
            else:
                gaussians = Gaussians(*(arrays[name] for name in Gaussians._fields))
                self.scene.show("main", gaussians)
                self.captions["main"] = f"{len(gaussians.means):,} Gaussians, growing"


def said_of(error: Exception) -> str:
    return str(error) if isinstance(error, UserError) else f"{type(error).__name__}: {error}"


def missing_models() -> Iterator[str]:
    """Yield the configurations whose model is neither a folder nor in the hub's cache; no request
    is made.
    """
    from huggingface_hub import try_to_load_from_cache

    for family in FAMILIES:
        file = next(x / family.config for x in config_folders() if (x / family.config).is_file())
        options = section(read_yaml(file), "system", "guidance")
        model = str(options.get("pretrained_model_name_or_path"))
        if not isinstance(try_to_load_from_cache(model, "model_index.json"), str):
            yield family.config
