"""What the live view costs a training, and that the result is the same with it.

    python -m benchmarks.viewers.live [--rounds 3] [--steps 1200]

Trains the demo, each time in a new process: without the viewer, with it but without a browser, with
headless Chromium connected from the first step on, and connected after half of the steps. Each
round has all four, in another order. CPU seconds are those from the first step to the end of the
training: of the whole process, of the training's own thread, of that thread within updates, and of
the viewer's server. Rows are appended to docs/charts/live.csv.
"""

import argparse
import contextlib
import hashlib
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, Optional

from benchmarks.quality.runs import append_rows
from benchmarks.viewers.browser import browser, chromium
from threestudio_gaussiandreamer.host import pl
from threestudio_gaussiandreamer.launch import experiment
from threestudio_gaussiandreamer.launch.live_viewer import LiveViewer
from threestudio_gaussiandreamer.launch.options import parse_arguments

ROOT = Path(__file__).resolve().parents[2]
OFF, UNWATCHED, WATCHED, LATE = "off", "no browser", "browser", "browser, from half on"
MODES = (OFF, UNWATCHED, WATCHED, LATE)
CONNECTING, LOADING = 120.0, 3.0
"""Seconds that a browser has to connect, and then to load its page."""
LEAN = ("pages=false", "evaluation.views=1", "evaluation.size=32", "exporter.save_video=false")
"""Options of the system without which the rest of the run would take longer than the training."""
MEASURED = ("steps", "gaussians", "updates", "process_s", "thread_s", "update_s", "server_s")
COLUMNS = ("viewer", "round", *MEASURED, "cloud", "machine", "commit")


# ---- in the process of a run ---------------------------------------------------------------------


class Meter(pl.Callback):
    """Measure the CPU seconds of the steps and of the updates, and open the browser."""

    def __init__(self, mode: str, window: contextlib.ExitStack) -> None:
        self.mode, self.window = mode, window
        self.viewer: Optional[LiveViewer] = None
        self.updates, self.update_s, self.result = 0, 0.0, {}

    def on_train_start(self, trainer: Any, pl_module: Any) -> None:
        viewers = [found for found in trainer.callbacks if isinstance(found, LiveViewer)]
        self.viewer = viewers[0] if viewers else None
        if self.viewer is not None:
            self.viewer._show_if_due = self.counted(self.viewer._show_if_due)

    def on_train_batch_start(self, trainer: Any, *others: Any) -> None:
        if trainer.global_step == 0:
            if self.mode == WATCHED:
                self.open_browser()
                self.wait_for_browser()
            self.start = self.seconds()
        if self.mode == LATE and trainer.global_step == trainer.max_steps // 2:
            self.open_browser()

    def on_train_end(self, trainer: Any, pl_module: Any) -> None:
        found = {name: end - self.start[name] for name, end in self.seconds().items()}
        arrays = [values.detach().numpy().tobytes() for values in pl_module.geometry.parameters()]
        self.result = {
            "steps": trainer.global_step,
            "gaussians": len(pl_module.geometry),
            "updates": self.updates,
            "update_s": self.update_s,
            "cloud": hashlib.sha256(b"".join(arrays)).hexdigest()[:16],
            **found,
        }

    def seconds(self) -> dict[str, float]:
        server = self.viewer.view.server_seconds() if self.viewer else 0.0
        return {
            "process_s": time.process_time(),
            "thread_s": time.thread_time(),
            "server_s": server,
        }

    def open_browser(self) -> None:
        self.window.enter_context(browser(self.viewer.view.address, 640))

    def wait_for_browser(self) -> None:
        end = time.monotonic() + CONNECTING
        while not self.viewer.view.watched:
            assert time.monotonic() < end, "the browser hasn't connected"
            time.sleep(0.1)
        time.sleep(LOADING)

    def counted(self, show: Any) -> Any:
        def counting(*arguments: Any) -> bool:
            start = time.thread_time()
            shown = show(*arguments)
            self.updates += shown
            self.update_s += time.thread_time() - start
            return shown

        return counting


def train(mode: str, steps: int, folder: str) -> dict[str, Any]:
    """Train the demo in this process; return what :class:`Meter` has measured."""
    experiment.limit_openmp_spin()
    viewer = [] if mode == OFF else ["enabled=true", f"port={free_port()}", "keep_serving=false"]
    overrides = [
        *(f"exp_root_dir={folder}", "use_timestamp=false", "tag=run", "data.n_test_views=1"),
        *(f"trainer.max_steps={steps}", "trainer.limit_val_batches=0"),
        *(f"system.{option}" for option in LEAN),
        *(f"viewer.{option}" for option in viewer),
    ]
    argv = ["--config", str(ROOT / "configs/demo.yaml"), "--train", "--gpu", "cpu", *overrides]
    with contextlib.ExitStack() as window:
        meter = Meter(mode, window)
        prepared = experiment.prepare(parse_arguments(argv), argv, callbacks=[meter])
        prepared.run()
    return meter.result


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


# ---- in the main process -------------------------------------------------------------------------


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--run", choices=MODES, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if chromium() is None:
        parser.error("no Chromium is installed")
    if arguments.run:
        with tempfile.TemporaryDirectory() as folder:
            print(json.dumps(train(arguments.run, arguments.steps, folder)))
        return
    for number in range(arguments.rounds):
        for mode in (*MODES[number % 4 :], *MODES[: number % 4]):
            row = {"viewer": mode, "round": number, **run(mode, arguments.steps)}
            print(row, flush=True)
            append_rows("live", list(COLUMNS), [row])


def run(mode: str, steps: int) -> dict[str, Any]:
    """Train in a process of its own, on one thread."""
    command = [sys.executable, "-m", __spec__.name, "--run", mode, "--steps", str(steps)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(f"{mode}: {done.stderr[-3000:]}")
    measured = json.loads(done.stdout.splitlines()[-1])
    return {k: round(v, 3) if isinstance(v, float) else v for k, v in measured.items()}


if __name__ == "__main__":
    main()
