"""Several processes that train one cloud: how many there are, and Lightning's strategy for them.

Every process has a copy of the cloud and renders its share of a step's views. The system averages
the gradients: DistributedDataParallel would keep the parameters that densification replaces."""

import importlib
import os
import re
from collections.abc import Mapping
from datetime import timedelta
from typing import Any, NamedTuple, Optional

import torch

from ..core import launcher
from ..core.distributed import is_active
from ..core.errors import UserError, raised_in
from ..core.options import is_whole
from ..host import pl, warn

LONGEST_WAIT = timedelta(hours=12)
"""A process waits so long for the others, for instance while the first one renders results."""
LOST_CONNECTION = re.compile(
    r"\bpeer\b|\bconnection\b|\bsocket\b|\bremote\b|timed out|broken pipe|pair closure", re.I
)
"""In the messages of Gloo and NCCL about a process that no longer answers."""


class Processes(NamedTuple):
    """The processes that train one cloud."""

    devices: int  # on each machine
    nodes: int
    started_by: Optional[str] = None  # None is Lightning

    @property
    def total(self) -> int:
        return self.devices * self.nodes


class ReplicatedStrategy(pl.strategies.DDPStrategy):
    """Launch and connect processes as DDP does, without wrapping the module."""

    def _setup_model(self, model: torch.nn.Module) -> torch.nn.Module:
        return model

    def configure_ddp(self) -> None:
        """Leave the module unwrapped, and register no communication hooks."""


def planned_processes(n_gpus: int, trainer: Mapping[str, Any]) -> Processes:
    """Return the processes that torchrun or SLURM has started, else those that ``trainer.devices``
    (by default one for each of the ``n_gpus`` visible GPUs) and ``trainer.num_nodes`` ask for;
    raise UserError if the options contradict the launcher, or there are too few GPUs.
    """
    asked = {n: trainer[n] for n in ("devices", "num_nodes") if trainer.get(n) is not None}
    for name, value in asked.items():
        if not (is_whole(value) and value > 0):
            raise UserError(f"trainer.{name}: expected a whole number from 1 on, got {value!r}")
    found = Processes(asked.get("devices", max(n_gpus, 1)), asked.get("num_nodes", 1))
    if "TORCHELASTIC_RUN_ID" in os.environ:
        local = int(os.environ["LOCAL_WORLD_SIZE"])
        found = Processes(local, int(os.environ["WORLD_SIZE"]) // local, "torchrun")
    elif launcher.many_tasks():
        tasks, nodes = (int(os.environ.get(f"SLURM_{key}", 1)) for key in ("NTASKS", "NNODES"))
        found = Processes(tasks // nodes, nodes, "SLURM")
    for name, there in (("devices", found.devices), ("num_nodes", found.nodes)):
        if asked.get(name, there) != there:
            raise UserError(
                f"trainer.{name} is {asked[name]}, but {found.started_by} has started "
                f"{found.nodes} x {found.devices} processes (machines x processes): leave it out"
            )
    if n_gpus and found.devices > n_gpus:
        raise UserError(
            f"{found.devices} processes on a machine need as many GPUs, and {n_gpus} can be seen: "
            "list them (--gpu 0,1; for SLURM --gpus-per-node), or run with --gpu cpu"
        )
    return found


def is_lost_process(error: Exception) -> bool:
    """Return whether torch.distributed says that another process of this run doesn't answer."""
    from_torch = isinstance(error, RuntimeError) and raised_in(error, "torch.distributed")
    return is_active() and from_torch and bool(LOST_CONNECTION.search(str(error)))


def trainer_options(processes: Processes) -> dict[str, Any]:
    """Return the trainer's options for the processes. In a SLURM job with a single task, Lightning
    would wait for SLURM to start them: a plugin lets it start them itself.
    """
    options: dict[str, Any] = {"devices": processes.devices, "num_nodes": processes.nodes}
    tasks, alone = os.environ.get("SLURM_NTASKS", "1"), processes.started_by is None
    if alone and int(tasks) > processes.total:  # else ``many_tasks`` would have counted them
        warn(
            f"SLURM has {tasks} tasks, which a shell (SLURM_JOB_NAME="
            f"{os.environ['SLURM_JOB_NAME']}) doesn't start: the number of processes that train "
            f"is {processes.total}; for all: srun --job-name train --ntasks-per-node ..."
        )
    environments = importlib.import_module(f"{pl.__name__}.plugins.environments")
    by_srun = all(name in os.environ for name in launcher.SLURM)
    if environments.SLURMEnvironment.detect() and alone and (processes.total > 1 or not by_srun):
        options["plugins"] = [environments.LightningEnvironment()]
    if processes.total > 1:
        strategy = ReplicatedStrategy(timeout=LONGEST_WAIT)
        # the first process renders all views of validation and test, since it alone writes results
        options |= {"use_distributed_sampler": False, "strategy": strategy}
    return options
