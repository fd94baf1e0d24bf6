"""Ray's cluster: workers, which asset each makes, what became of it, and those that hang."""

import contextlib
import os
import socket
import sys
import tempfile
import time
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Optional

from tqdm import tqdm

from .. import __version__
from ..core.errors import UserError
from ..core.extras import require_extra
from .board import Beat
from .place import ASSETS, FAILED, FAILURE, FINISHED, STOPPED
from .recipe import Job, repeat_command
from .worker import BLOCKED, NO_MEMORY, REFUSED, Setting, Worker

LONGEST_FOLDER = 36
"""Characters of a temporary folder; the names of Ray's sockets then fit into the system's 107."""
POLL = 0.5
"""Seconds between two reads of the board, and longest wait for an outcome."""
SAME_ERRORS = 3
"""The farm ends if its first assets, this many, all fail with the same message."""


def connect(address: Optional[str]) -> Any:
    """Connect to the cluster at ``address``, or start Ray on this machine; return the module."""
    require_extra("cluster", "ray")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import ray

    source, leave = "--address", "leave --address out"
    if not address:
        source, leave = "RAY_ADDRESS", "`unset RAY_ADDRESS`"
    address = address or os.environ.get("RAY_ADDRESS") or "local"
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address == "local":
        options |= {"include_dashboard": False, "object_store_memory": 100 << 20}
        if len(tempfile.gettempdir()) > LONGEST_FOLDER and os.path.isdir("/tmp"):
            os.environ.setdefault("RAY_TMPDIR", "/tmp")
    try:
        host, _, port = (place := address.removeprefix("ray://")).rpartition(":")
        if "://" in place:
            raise ValueError("expected host:port, such as that which `ray start --head` prints")
        if host:  # else "local" or "auto"; Ray's own attempt takes minutes
            socket.create_connection((host.strip("[]"), int(port)), timeout=5).close()
        ray.init(address=address, **options)
    except Exception as error:  # Ray raises many kinds
        if address == "local":
            what, advice = "Ray can't be started on this machine", ""
        else:
            what = f"{source} {address}: no Ray cluster answers there"
            advice = f"; start one with `ray start --head`, or {leave} to run on this machine"
        raise UserError(f"{what} ({first_line(error)}){advice}") from error
    return ray


def first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:500]


def plan_workers(
    resources: Mapping[str, float], gpus: Optional[int], cores: int, workers: Optional[int]
) -> tuple[int, int]:
    """Return how many workers are asked for, or fit into the cluster, and the GPUs of each."""
    there, cpus = int(resources.get("GPU", 0)), int(resources.get("CPU", 0))
    if gpus is not None and gpus > there:
        most = f"has {there} GPUs; give at most that" if there else "has no GPU; give none"
        raise UserError(f"--gpus {gpus}: the cluster {most}")
    if cores > cpus:
        raise UserError(f"--cores {cores}: the cluster has {cpus} cores; give fewer")
    gpus = there if gpus is None else gpus
    fits = min(cpus // cores, gpus) if gpus else cpus // cores
    if workers is not None and workers > fits:
        what = "1 GPU" if gpus else f"{cores} cores"
        raise UserError(f"--workers {workers}: with {what} each, {fits} fit into the cluster")
    return workers or fits, int(gpus > 0)


def start_workers(ray: Any, count: int, gpus: int, setting: Setting) -> list[Any]:
    """Start workers with so many GPUs each, and wait until all are ready."""
    cores = setting.recipe.cores
    environment = {"OMP_NUM_THREADS": str(cores), "OMP_WAIT_POLICY": "passive"}
    if not gpus:
        environment["CUDA_VISIBLE_DEVICES"] = ""
    # Ray also counts attempts to reach a process that is restarting
    endless = {"max_restarts": -1, "max_task_retries": -1}
    resources = {"num_cpus": cores, "num_gpus": gpus, "runtime_env": {"env_vars": environment}}
    actor = ray.remote(**resources, **endless)(Worker)
    workers = [actor.remote() for _ in range(count)]
    try:
        ray.get([worker.hello.remote(setting) for worker in workers], timeout=120)
    except ray.exceptions.RayError as error:
        needed = f"each machine needs threestudio-gaussiandreamer {__version__}: {error}"
        said = getattr(error, "cause", None) or needed
        raise UserError(f"a worker can't start: {said}") from error
    return workers


@dataclass
class Driver:
    """Gives the assets that are left, ``jobs``, to idle workers."""

    ray: Any  # the module, connected to a cluster
    workers: list[Any]
    setting: Setting
    jobs: Iterator[Job]
    hang: float  # seconds without a finished step after which a worker is restarted
    total: int  # number of assets of the farm, ``done`` of which were finished before
    done: int

    def __post_init__(self) -> None:
        self.idle = deque(range(len(self.workers)))
        self.running: dict[Any, tuple[int, Job]] = {}
        self.again: deque[Job] = deque()
        self.killed: dict[int, Beat] = {}
        self.counts: Counter = Counter()
        self.errors: list[str] = []
        self.obstacle: Optional[str] = None
        self.began = time.monotonic()
        # only on terminals; elsewhere a line per asset
        self.bar = tqdm(total=self.total, initial=self.done, unit="asset", disable=None, ncols=110)

    def run(self) -> None:
        """Make the assets; raises UserError for an obstacle, and Ctrl-C after the checkpoints."""
        due = 0.0
        try:
            self.fill()
            while self.running:
                self.collect_ready()
                if not self.obstacle:
                    self.fill()
                if time.monotonic() >= due:
                    self.look_after_workers()
                    due = time.monotonic() + POLL
        except (KeyboardInterrupt, SystemExit):
            print("\nstopping: the workers write checkpoints; once more to stop at once")
            self.tell_board_to_stop()
            deadline = time.monotonic() + 60  # to write the checkpoints
            while self.running and time.monotonic() < deadline:
                self.collect_ready()
            raise
        finally:
            self.bar.close()
        if self.obstacle:
            raise UserError(self.obstacle)

    def collect_ready(self) -> None:
        """Wait up to :data:`POLL` seconds for an outcome, and note all that are there."""
        handles = list(self.running)
        ready, _ = self.ray.wait(handles, timeout=POLL)
        if ready:  # each wait takes longer the more workers there are
            ready, _ = self.ray.wait(handles, num_returns=len(handles), timeout=0)
        for handle in ready:
            self.collect(handle)

    def fill(self) -> None:
        """Give an asset to each worker that has none."""
        while self.idle:
            job = self.again.popleft() if self.again else next(self.jobs, None)
            if job is None:
                return
            job = job._replace(handed_out=time.time())
            number = self.idle.popleft()
            handle = self.workers[number].make.remote(job, number, self.setting)
            self.running[handle] = number, job

    def collect(self, handle: Any) -> None:
        """Note the outcome of an asset."""
        number, job = self.running.pop(handle)
        self.idle.append(number)
        try:
            outcome = self.ray.get(handle)
        except self.ray.exceptions.RayError as error:  # its worker can't be restarted
            outcome = {"state": FAILED, "error": f"its worker is lost: {first_line(error)}"}
        state = outcome["state"]
        if state == FINISHED:
            self.note(job, FINISHED, f"{outcome.get('seconds', 0):.1f} s")
            return
        job, error = job._replace(spent=job.worker_seconds(time.time())), outcome["error"]
        again = state == NO_MEMORY and self.setting.recipe.low_memory and not job.saves_memory
        if state in (FAILED, REFUSED) or state == NO_MEMORY and not again:
            if state != REFUSED:  # else the record is the other row's
                self.record(job, FAILED, error)
            self.note(job, FAILED, error)
            self.errors.append(error)
            if not self.done + self.counts[FINISHED] and self.errors == [error] * SAME_ERRORS:
                same = f"the first {SAME_ERRORS} assets have failed alike, so the farm ends"
                self.block(f"{same}: {error}")
            return
        # noted too, so that after any stop every machine makes it so
        job = job._replace(saves_memory=job.saves_memory or bool(again))
        self.record(job, STOPPED, error)
        if again:
            self.note(job, "again with less memory", error)
            self.again.append(job)
            self.ray.kill(self.workers[number], no_restart=False)
        elif state == BLOCKED:
            self.block(error)
        elif not self.obstacle:  # a signal that was only for its worker
            self.again.append(job)

    def record(self, job: Job, state: str, error: str) -> None:
        """Write the record of an attempt that ended without a result."""
        record = {"state": state, "key": job.row.key, "error": error}
        record |= {"command": repeat_command(self.setting.recipe, job)}
        record |= {"worker_seconds": job.spent, "saves_memory": job.saves_memory}
        try:
            self.setting.place.write(f"{ASSETS}/{job.row.name}/{FAILURE}", record)
        except UserError as problem:  # such as a full disk
            self.block(str(problem))

    def block(self, error: str) -> None:
        """Hand out no more assets, and let the workers write checkpoints, and end with an error."""
        self.obstacle = self.obstacle or error
        self.tell_board_to_stop()

    def note(self, job: Job, state: str, text: str) -> None:
        """Count and print the outcome of an asset, and off terminals how much is left."""
        self.counts[state] += 1
        made = self.counts[FINISHED] + self.counts[FAILED]
        self.bar.update(self.done + made - self.bar.n)
        left = self.total - self.done - made
        if self.bar.disable and made and left:
            seconds = (time.monotonic() - self.began) / made * left
            text += f" ({self.done + made} of {self.total}, {tqdm.format_interval(seconds)} left)"
        self.bar.write(f"{job.row.name}: {state}: {text}", file=sys.stderr)

    def look_after_workers(self) -> None:
        """Show what the workers do; restart those that hang, with the same asset."""
        try:
            beats = self.ray.get(self.setting.board.read.remote(), timeout=2)
        except self.ray.exceptions.RayError:
            return  # the board's process is being restarted
        shown = [f"{beat.name} {beat.stage} {beat.step}/{beat.steps}" for beat, _ in beats.values()]
        self.bar.set_postfix_str(f"{self.counts[FAILED]} failed, {', '.join(shown)}")
        for number, job in self.running.values():
            beat, seconds = beats.get(number, (None, 0.0))
            hangs = beat is not None and beat.name == job.row.name and seconds > self.hang
            if hangs and self.killed.get(number) != beat:
                self.killed[number] = beat
                reason = f"no step for {seconds:.0f} s ({beat.stage} {beat.step})"
                self.note(job, "restarted", reason)
                self.ray.kill(self.workers[number], no_restart=False)

    def tell_board_to_stop(self) -> None:
        # while it is being restarted, the workers are stopped without checkpoints
        with contextlib.suppress(self.ray.exceptions.RayError):
            self.ray.get(self.setting.board.stop.remote(), timeout=5)
