"""The environment variables by which torchrun, SLURM and others number the processes of a run."""

import os
import re
from collections.abc import Mapping

from .errors import UserError

INDICES = (
    *("RANK", "LOCAL_RANK", "GROUP_RANK", "NODE_RANK", "JSM_NAMESPACE_RANK", "MASTER_PORT"),
    *("SLURM_PROCID", "SLURM_LOCALID", "SLURM_NODEID", "SLURM_JOB_ID", "PL_GLOBAL_SEED"),
)
SIZES = ("WORLD_SIZE", "LOCAL_WORLD_SIZE", "SLURM_NTASKS", "SLURM_NNODES")
TORCHRUN = ("RANK", "LOCAL_RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE")
SLURM = ("SLURM_PROCID", "SLURM_LOCALID", "SLURM_NODEID")
"""What torchrun, and SLURM's ``srun``, always tell a process."""


def require_numbers(environment: Mapping[str, str] = os.environ) -> None:
    """Raise UserError if a variable isn't a whole number, before Lightning's import reads some."""
    for name in (*INDICES, *SIZES):
        text, lowest = environment.get(name, "1"), int(name in SIZES)
        if not re.fullmatch("[0-9]{1,19}", text) or int(text) < lowest:
            expected = f"a whole number from {lowest} on, as torchrun or SLURM sets it"
            raise _wrong(name, f"is {text!r}; expected {expected}", name)


def require_launcher(environment: Mapping[str, str] = os.environ) -> None:
    """Raise UserError if a variable of a run isn't a whole number, some that belong together are
    missing, or the machines have different numbers of processes.
    """
    require_numbers(environment)
    by_torchrun = "TORCHELASTIC_RUN_ID" in environment
    by_one = by_torchrun or many_tasks(environment)
    first, names, program, sizes = "SLURM_NTASKS", SLURM, "srun", SIZES[2:]
    if by_torchrun:
        first, names, program, sizes = "TORCHELASTIC_RUN_ID", TORCHRUN, "torchrun", SIZES[:2]
    missing = [name for name in names if name not in environment]
    if missing and by_one:
        said = f"is set, but not {', '.join(missing)}: start the command with {program}"
        raise _wrong(first, said, first)
    size, step = (int(environment.get(name, 1)) for name in sizes)
    if size % step and by_one:
        said = f"is {size}, no multiple of {sizes[1]}, which is {step}"
        raise _wrong(sizes[0], f"{said}: give each machine as many processes", first)
    for name, started, hint in (
        ("RANK", by_torchrun, "start the command with torchrun"),
        ("SLURM_PROCID", by_one, "give srun --job-name and --ntasks-per-node"),
    ):
        if not started and int(environment.get(name, 0)):
            said = "but nothing says how many processes there are"
            raise _wrong(name, f"is {environment[name]}, {said}: {hint}", name)


def _wrong(name: str, said: str, unset: str) -> UserError:
    advice = f", or `unset {unset}` for a single process"
    return UserError(f"the environment variable {name} {said}{advice}")


def many_tasks(environment: Mapping[str, str] = os.environ) -> bool:
    """Return whether SLURM has several tasks for this run, and isn't an interactive shell."""
    is_shell = environment.get("SLURM_JOB_NAME") in ("bash", "interactive")  # as salloc opens
    return int(environment.get("SLURM_NTASKS", 1)) > 1 and not is_shell


def train_alone() -> None:
    """Let later runs of this process be single ones, whatever program has started it."""
    for name in ("TORCHELASTIC_RUN_ID", *INDICES, *SIZES):
        os.environ.pop(name, None)
