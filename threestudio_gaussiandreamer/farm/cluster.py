"""Connect to Ray, check its machines, and start the workers.

Ray gives each worker its GPU or cores, restarts a worker that was killed or whose machine is gone,
and hands it the asset again."""

import os
import socket
import tempfile
from typing import Any, NamedTuple, Optional

from .. import __version__
from ..core.errors import UserError
from ..core.extras import require_extra
from .worker import Setting, Worker

OBJECT_STORE_BYTES = 100 << 20
"""Memory for what workers send each other: little."""
LONGEST_FOLDER = 36
"""Characters of a folder for temporary files in which Ray's sockets have names that are short
enough for the operating system, which allows about 107.
"""
SECONDS_TO_ANSWER = 120
"""How long a machine or a worker may take to start."""


class Device(NamedTuple):
    """What one worker gets."""

    gpus: int
    """0 or 1."""
    cores: int


def connect(address: Optional[str]) -> Any:
    """Connect to the cluster at ``address``, or start Ray on this machine; return the module.

    Raises:
        UserError: Ray isn't installed, or no cluster answers.
    """
    require_extra("cluster", "ray")
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    import ray

    source = "--address" if address else "RAY_ADDRESS"
    address = address or os.environ.get("RAY_ADDRESS") or "local"
    options: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    if address == "local":
        options |= {"include_dashboard": False, "object_store_memory": OBJECT_STORE_BYTES}
        if len(tempfile.gettempdir()) > LONGEST_FOLDER and os.path.isdir("/tmp"):
            os.environ.setdefault("RAY_TMPDIR", "/tmp")
    try:
        require_answer(address)
        ray.init(address=address, **options)
    except (OSError, ValueError, RuntimeError, OverflowError, ray.exceptions.RayError) as error:
        raise _out_of_reach(source, address, error) from error
    return ray


def require_answer(address: str) -> None:
    """Raise an error unless something accepts connections at ``address`` within seconds: Ray's own
    attempt takes minutes.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if "://" in address.removeprefix("ray://"):
        raise ValueError("expected host:port, such as that which `ray start --head` prints")
    if host:  # else "local", or "auto", which Ray resolves by itself
        socket.create_connection((host.strip("[]"), int(port)), timeout=5).close()


def _out_of_reach(source: str, address: str, error: Exception) -> UserError:
    said = (str(error).strip().splitlines() or [type(error).__name__])[0][:300]
    if address == "local":
        return UserError(f"Ray can't be started on this machine: {said}")
    leave = "leave --address out" if source == "--address" else "`unset RAY_ADDRESS`"
    return UserError(
        f"{source} {address}: no Ray cluster answers there ({said}); start one with "
        f"`ray start --head`, or {leave} to run on this machine"
    )


# Machines
# --------------------------------------------------------------------------------------------------


def require_same_version(ray: Any) -> None:
    """Check the package on every machine of the cluster.

    Raises:
        UserError: a machine has none or another version, or doesn't answer.
    """
    at = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy
    probe = ray.remote(num_cpus=0, max_retries=0)(installed_version)
    asked = [
        probe.options(scheduling_strategy=at(node["NodeID"], soft=False)).remote()
        for node in ray.nodes()
        if node["Alive"]
    ]
    try:
        found = ray.get(asked, timeout=SECONDS_TO_ANSWER)
    except ray.exceptions.RayError as error:
        raise UserError(f"a machine of the cluster doesn't answer: {error}") from error
    for host, version in found:
        if version != __version__:
            has = f"has threestudio-gaussiandreamer {version}" if version else "doesn't have it"
            raise UserError(
                f"the worker {host} {has}; this is {__version__}, and all assets of a farm are "
                f"made with one version: pip install threestudio-gaussiandreamer=={__version__} "
                "there"
            )


def installed_version() -> tuple[str, Optional[str]]:
    """Return this machine's name and the version of the package on it; None without one."""
    import socket

    try:
        from threestudio_gaussiandreamer import __version__ as version
    except ImportError:
        version = None
    return socket.gethostname(), version


# so that Ray sends the function itself: a machine without the package couldn't import it
installed_version.__module__ = "__main__"


def choose_device(resources: dict[str, float], gpus: Optional[int], cores: int) -> Device:
    """Return what one worker gets: a GPU where the cluster has some, else ``cores``.

    Args:
        gpus: how many are asked for; None for all that there are.

    Raises:
        UserError: the cluster has fewer GPUs or cores.
    """
    there, cpus = int(resources.get("GPU", 0)), int(resources.get("CPU", 0))
    if gpus is not None and gpus > there:
        most = f"has {there} GPUs; give at most that" if there else "has no GPU; give none"
        raise UserError(f"--gpus {gpus}: the cluster {most}")
    if cores > cpus:
        raise UserError(f"--cores {cores}: the cluster has {cpus} cores; give fewer")
    return Device(1 if (there if gpus is None else gpus) else 0, cores)


def count_workers(
    resources: dict[str, float], device: Device, gpus: Optional[int], workers: Optional[int]
) -> int:
    """Return the number of workers that fit into the cluster, or fewer where fewer are asked for.

    Raises:
        UserError: more are asked for than fit.
    """
    fits = int(resources.get("CPU", 0)) // device.cores
    if device.gpus:
        fits = min(fits, int(resources["GPU"]) if gpus is None else gpus)
    if workers is not None and workers > fits:
        what = "1 GPU" if device.gpus else f"{device.cores} cores"
        raise UserError(f"--workers {workers}: with {what} each, {fits} fit into the cluster")
    return workers or fits


# Actors
# --------------------------------------------------------------------------------------------------


def start_workers(ray: Any, settings: list[Setting], device: Device) -> list[Any]:
    """Start a worker per setting and wait until all are ready.

    Raises:
        UserError: a worker can't start.
    """
    environment = {"OMP_NUM_THREADS": str(device.cores), "OMP_WAIT_POLICY": "passive"}
    if not device.gpus:
        environment["CUDA_VISIBLE_DEVICES"] = ""
    actor = ray.remote(
        num_cpus=device.cores,
        num_gpus=device.gpus,
        max_restarts=-1,
        max_task_retries=-1,  # Ray also counts attempts to reach a process that is restarting
        runtime_env={"env_vars": environment},
    )(Worker)
    workers = [actor.remote() for _ in settings]
    greetings = [w.hello.remote(setting) for w, setting in zip(workers, settings, strict=True)]
    try:
        ray.get(greetings, timeout=SECONDS_TO_ANSWER)
    except ray.exceptions.RayError as error:
        raise UserError(f"a worker can't start: {getattr(error, 'cause', error)}") from error
    return workers
