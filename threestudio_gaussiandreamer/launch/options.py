"""Arguments of the launcher, and the choice of GPUs and files, before torch is imported."""

import argparse
import os
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Optional

from .. import __version__
from ..core.errors import UserError, unknown
from ..core.launcher import require_launcher

# how this process was started, for messages that show a command to resume the run
PROGRAM = {"launch.py": ["python", sys.argv[0]], "gaussiandreamer": ["gaussiandreamer"]}.get(
    Path(sys.argv[0]).name, ["python", "-m", f"{__package__}.experiment"]
)
LIST_PARTS = "--list-parts"
STAGES = {
    "train": "train, then render the test views",
    "validate": "render the validation views",
    "test": "render the test views and the video",
    "export": "write the cloud in the exporter's formats",
}


def parse_arguments(argv: Sequence[str]) -> argparse.Namespace:
    """Parse threestudio's options and ``overrides``; print a message and exit if it can't."""
    parser = argparse.ArgumentParser(
        prog=" ".join(PROGRAM),
        description="Turn a prior into a cloud of 3D Gaussians by score distillation.",
        epilog="Everything else is an override of the configuration: trainer.max_steps=1200 "
        "'system.prompt_processor.prompt=a fox'",
        allow_abbrev=False,
    )
    add_config(parser)
    parser.add_argument("--version", action="version", version=__version__)
    flags = {
        LIST_PARTS: "list the registered parts, with those in custom/",
        "--verbose": "more messages, and tracebacks of errors",
        "--typecheck": "check shapes and types of all calls (slow; for development)",
    }
    for flag, text in flags.items():
        parser.add_argument(flag, action="store_true", help=text)
    stages = parser.add_mutually_exclusive_group(required=True)
    for name, text in STAGES.items():
        stages.add_argument(f"--{name}", dest="stage", action="store_const", const=name, help=text)
    parser.add_argument(
        "--gpu",
        help="0, or cpu, or 0,1 for a process on each; default: GPU 0 if there is one. Ignored "
        "where CUDA_VISIBLE_DEVICES is set",
    )
    return parse_with_overrides(parser, argv)


def add_config(parser: argparse.ArgumentParser) -> None:
    """Add ``--config``, whose values :func:`find_config` takes."""
    parser.add_argument(
        "--config",
        action="append",
        required=True,
        help="a YAML file, or the name of one in the current folder, in configs/ or among the "
        "packaged ones; given several times, later ones win",
    )


def parse_with_overrides(
    parser: argparse.ArgumentParser, argv: Optional[Sequence[str]]
) -> argparse.Namespace:
    """Parse the arguments; those that ``parser`` doesn't know are ``overrides``."""
    args, args.overrides = parser.parse_known_args(argv)
    for override in args.overrides:
        if override.startswith("-"):
            parser.error(f"unrecognized option {override}")
    return args


def choose_gpu(gpu: Optional[str], overrides: Sequence[str] = ()) -> None:
    """Set which GPUs are visible to this process, before torch is imported: those of the argument
    ``--gpu``, else as many as processes on this machine, which torchrun or SLURM has started, or
    ``trainer.devices`` among the overrides asks for. Raise UserError if one of them is wrong.
    """
    require_launcher()
    if gpu is not None and not re.fullmatch(r"cpu|\d+(,\d+)*", gpu):
        raise UserError(f"--gpu {gpu}: expected cpu, or numbers of GPUs such as 0 or 0,1")
    os.environ.setdefault("CUDA_DEVICE_ORDER", "PCI_BUS_ID")
    if gpu == "cpu":
        os.environ["CUDA_VISIBLE_DEVICES"] = ""
    elif "CUDA_VISIBLE_DEVICES" not in os.environ:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpu or ",".join(map(str, range(_processes(overrides))))


def _processes(overrides: Sequence[str]) -> int:
    """Return how many processes this machine will run, as far as is known by now."""
    found = [re.fullmatch(r"trainer\.devices=(\d{1,4})", override) for override in overrides]
    asked = [match[1] for match in found if match][-1:]
    started = (os.environ.get(key, "") for key in ("LOCAL_WORLD_SIZE", "SLURM_NTASKS_PER_NODE"))
    return max(1, *(int(text) for text in (*started, *asked, "1") if text.isdecimal()))


def announce_device(gpu: Optional[str]) -> int:
    """Return the number of visible GPUs, of which ``--gpu`` may ask for more: a UserError."""
    import torch

    from ..host import info, warn

    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if gpu is None and not count:
        info("no GPU found: running on the CPU")
    visible = os.environ["CUDA_VISIBLE_DEVICES"]
    if gpu not in (None, "cpu", visible):
        warn(f"--gpu {gpu} is ignored: CUDA_VISIBLE_DEVICES={visible} is set")
    if gpu not in (None, "cpu") and count < len(visible.split(",")):
        found = f"torch {torch.__version__} can use {count} of these GPUs"
        raise UserError(f"--gpu {gpu}: {found}; run with --gpu cpu")
    return count


def find_config(name: str) -> Path:
    """Find the YAML file for ``--config name``: a path, or a bare name in :func:`config_folders`.
    Raise UserError, which lists similar names, if there is no such file.
    """
    try:
        path = Path(name).expanduser()
        folders = config_folders() if path.name == name else []
        places = [folder / file for folder in folders for file in (name, f"{name}.yaml")]
        if found := next((place for place in (path, *places) if place.is_file()), None):
            return found
    except (OSError, ValueError, RuntimeError) as error:  # NUL; "~user"
        raise UserError(f"configuration {name[:200]!r}: {str(error)[:200]}") from error
    known = sorted({file.name for folder in config_folders() for file in folder.glob("*.yaml")})
    raise unknown("configuration", name[:200], known)


def config_folders() -> list[Path]:
    """List ``./configs``, and ``configs/`` of the checkout or of the installed package."""
    package = Path(__file__).resolve().parents[1]
    folders = [Path("configs"), package / "configs"]
    if (package.parent / "launch.py").is_file():
        folders.insert(1, package.parent / "configs")
    return [folder for folder in folders if folder.is_dir()]
