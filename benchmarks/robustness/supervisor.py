"""A small training run in a process of its own that can be killed and started again."""

import hashlib
import math
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import torch

from threestudio_gaussiandreamer.core.checkpoint_file import load_checkpoint, newest_readable

ROOT = Path(__file__).resolve().parents[2]
SCENE = [
    "name=long", "tag=run", "data.width=24", "data.height=24", "data.batch_size=2",
    "data.train_views=16", "data.eval_width=24", "data.eval_height=24", "data.n_test_views=2",
    "system.geometry.prior.num_points=160", "system.geometry.prior.color_smoothing=0",
    "system.geometry.grow.num_candidates=20000", "system.geometry.grow.radius=0.05",
    "system.geometry.grow.max_points=40", "system.geometry.budget=null",
    "system.evaluation.views=2", "system.evaluation.size=16",
    "system.geometry.densify.enabled=true", "system.geometry.densify.grad_threshold=2e-3",
    "system.geometry.max_gaussians=400", "trainer.enable_progress_bar=false",
    "trainer.log_every_n_steps=50", "checkpoint.save_top_k=1",
]  # fmt: skip
LOOK_EVERY = 0.02  # seconds


class Segment(NamedTuple):
    """One process of the run, from its start to its end or kill."""

    seconds: float
    killed: bool
    started_from: int
    """The step from which it resumed; 0 if it started from the prior."""
    reached: int
    """The step of the newest complete checkpoint at its end."""


class Sample(NamedTuple):
    seconds: float
    step: int
    """Of the newest checkpoint."""
    megabytes: float
    """Anonymous resident memory; pages of libraries vary with the machine."""


class Supervisor:
    """Starts the run in ``folder``, watches it, kills it, and reads its files."""

    def __init__(self, folder: Path, steps: int, every: int, deadline: float) -> None:
        self.folder, self.steps, self.deadline = folder, steps, deadline
        middle = steps // 2
        schedule = [
            f"trainer.max_steps={steps}", f"trainer.val_check_interval={10 * every}",
            f"checkpoint.every_n_train_steps={every}",
            f"system.guidance.max_step_percent=[{middle},0.98,0.55,{middle + 1}]",
            f"system.geometry.densify.stop={middle}", "system.geometry.densify.start=10",
            f"system.geometry.densify.every={2 * every}",
        ]  # fmt: skip
        options = [f"exp_root_dir={folder}", "resume=auto", *SCENE, *schedule]
        self.command = [
            sys.executable,
            str(ROOT / "launch.py"),
            "--config",
            "demo.yaml",
            "--train",
            "--gpu",
            "cpu",
            *options,
        ]

    def start(self) -> subprocess.Popen:
        environment = {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive", **os.environ}
        with open(self.folder / "output.txt", "wb") as output:
            return subprocess.Popen(
                self.command, stdout=output, stderr=subprocess.STDOUT, cwd=ROOT, env=environment
            )

    def run_segment(self, kill_after: float = math.inf, at_latest: float = math.inf) -> Segment:
        """Run one process: to its end, or until it is killed after so many seconds or at a step.

        Raises:
            RuntimeError: the process failed, or the deadline has passed.
        """
        started, before = time.monotonic(), self.newest_step()
        process = self.start()
        end = min(started + kill_after, self.deadline)
        while process.poll() is None:
            if time.monotonic() > end or last_written(self.folder) >= at_latest:
                process.send_signal(signal.SIGKILL)
                process.wait()
            time.sleep(LOOK_EVERY)
        if time.monotonic() > self.deadline:
            raise RuntimeError("not finished within the time limit")
        if process.returncode not in (0, -signal.SIGKILL):
            raise RuntimeError(f"the run failed ({process.returncode}):\n{self.output()[-3000:]}")
        return Segment(
            time.monotonic() - started,
            process.returncode != 0,
            self.resumed_step(before),
            self.newest_step(),
        )

    def output(self) -> str:
        return (self.folder / "output.txt").read_text(errors="replace")

    def resumed_step(self, before: int) -> int:
        """Return the step from which the process resumed, from its output; ``before`` if it was
        killed before it printed one.
        """
        chosen = re.search(r"resume=auto: resuming from (.*) \(step (\d+)\)", self.output())
        if chosen:
            return int(chosen[2])
        return 0 if "starting from the prior" in self.output() else before

    def newest_step(self) -> int:
        return self.newest()[1]

    def newest(self) -> tuple[Path, int]:
        """Return the complete checkpoint with most steps, and its step; 0 without any."""
        found = [newest_readable(folder) for folder in self.folder.glob("long/*/ckpts")]
        return max(filter(None, found), key=lambda entry: entry[1], default=(self.folder, 0))

    def digest(self) -> str:
        """Return a hash of the training state: parameters, statistics, moments and the step."""
        checkpoint = load_checkpoint(self.newest()[0])
        digest = hashlib.sha256(str(checkpoint["global_step"]).encode())
        states = checkpoint["optimizer_states"][0]["state"]
        tensors = {
            **checkpoint["state_dict"],
            **{
                f"{i}.{name}": value for i, state in states.items() for name, value in state.items()
            },
        }
        for name in sorted(tensors):
            value = torch.as_tensor(tensors[name])
            digest.update(
                f"{name} {tuple(value.shape)} {value.dtype}".encode() + value.numpy().tobytes()
            )
        return digest.hexdigest()

    def leftovers(self) -> list[str]:
        return [str(path.relative_to(self.folder)) for path in self.folder.glob("long/*/ckpts/.*")]


def last_written(folder: Path) -> int:
    """Return the step of the newest checkpoint, from its file name."""
    names = [path.stem for path in folder.glob("long/*/ckpts/epoch=*-step=*.ckpt")]
    return max((int(name.rpartition("=")[2]) for name in names), default=0)
