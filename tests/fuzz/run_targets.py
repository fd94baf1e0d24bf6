"""Fuzz targets: checkpoints, configurations and command lines."""

import contextlib
import io
import logging
import os
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

from tests.fuzz import checkpoint_content, oracles
from tests.fuzz.cloud_targets import some_gaussians
from tests.fuzz.target import ROOT, cloud_of, require, require_picture, strictly
from threestudio_gaussiandreamer.core.checkpoint_file import load_checkpoint, save_file
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch import config, experiment
from threestudio_gaussiandreamer.launch.config_check import check_config
from threestudio_gaussiandreamer.launch.run import Run

# ---- checkpoints ---------------------------------------------------------------------------------


def checkpoints() -> list[bytes]:
    """One as a run writes it, with its checksum, and one of plain torch."""
    torch.manual_seed(0)
    geometry = cloud_of(some_gaussians(10, 0))
    optimizer = torch.optim.Adam(geometry.parameter_groups(), lr=1e-3)
    require_picture(geometry)
    optimizer.step()
    content = {
        "epoch": 0, "global_step": 7, "pytorch-lightning_version": "2.6.6", "callbacks": {},
        "lr_schedulers": [],
        "state_dict": {f"geometry.{key}": value for key, value in geometry.state_dict().items()},
        "optimizer_states": [optimizer.state_dict()],
        "loops": {"fit_loop": {"state_dict": {}, "epoch_progress": {"total": {"ready": 1}}}},
    }  # fmt: skip
    plain = io.BytesIO()
    torch.save(content, plain)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "last.ckpt")
        save_file(path, content)
        return [path.read_bytes(), plain.getvalue()]


def exercise_checkpoint(path: Path) -> None:
    """Read, put into a cloud and drawn; nothing is read whose checksums don't hold, or that the
    file is too small for.
    """
    checkpoint = load_checkpoint(path)
    strictly(oracles.checked_archive, path)
    tensors = list(_tensors(checkpoint))
    stored = sum(
        {t.untyped_storage().data_ptr(): t.untyped_storage().nbytes() for t in tensors}.values()
    )
    require(
        stored <= path.stat().st_size,
        f"{stored} bytes of tensors from a file of {path.stat().st_size}",
    )
    require(
        all(t.numel() * t.element_size() <= path.stat().st_size for t in tensors),
        "a tensor is larger than the file",
    )
    geometry = checkpoint_content.geometry_of(checkpoint, path)
    if len(geometry):
        require_picture(geometry)


def _tensors(value: Any) -> Iterator[torch.Tensor]:
    if isinstance(value, torch.Tensor):
        yield value
    elif isinstance(value, (dict, list, tuple)):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _tensors(item)


# ---- configurations and command lines ------------------------------------------------------------


def configurations() -> list[bytes]:
    """Those that say everything, or all but the prompt."""
    sources = [
        (ROOT / "configs" / f"{name}.yaml").read_bytes() for name in ("demo", "gaussiandreamer")
    ]
    return [source.replace(b"???", b'"a fox: red"') for source in sources]


def exercise_configuration(path: Path) -> None:
    """What is accepted, written and read again is the same run."""
    check_same_run(config.load_config(path), path)


def check_same_run(cfg: Any, path: Path) -> None:
    check_config(cfg)
    parsed = path.with_name("parsed.yaml")
    config.dump_config(parsed, cfg)
    again = config.load_config(parsed)
    ours, theirs = (config.OmegaConf.to_container(c, resolve=False) for c in (cfg, again))
    for key in ("resume", "new_folder"):  # of this run alone
        ours[key] = theirs[key] = None
    require(repr(ours) == repr(theirs), "parsed.yaml isn't the same run")


COMMANDS = [
    "--config\ndemo.yaml\n--train\n--gpu\ncpu\ntrainer.max_steps=1200\n"
    "system.prompt_processor.prompt=a fox: red, 1984\nseed=3\ntag=t",
    "--config\ndemo.yaml\n--config\ndemo-draft.yaml\n--export\n"
    "resume=outputs/demo/x/ckpts/last.ckpt\nsystem.geometry.prior_type=random-prior\n"
    "data.elevation_range=[-10,60]\nsystem.geometry.densify={enabled: true, start: 9, stop: 99}",
    "--config\ngaussiandreamer\n--test\n--verbose\nsystem.prompt_processor.prompt=1984\nname=a "
    "b\nuse_timestamp=false\n"
    "system.guidance.max_step_percent=[0,0.98,0.5,500]\n"
    "system.geometry.lr_means=1e-4\nsystem.exporter.formats=[ply,points]\n"
    "checkpoint.save_last=true\n"
    "data.batch_size=${seed}\nseed=2",
]


def exercise_command(path: Path) -> None:
    """Exit code 2 with one message, or 0 where nothing but the work itself would follow."""
    arguments = path.read_bytes().decode("utf-8", errors="surrogateescape").split("\n")
    arguments = [argument for argument in arguments if not argument.startswith("--typecheck")]
    out, err, environ = io.StringIO(), io.StringIO(), dict(os.environ)
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), no_work():
            code = experiment.main(arguments)
    finally:
        os.environ.clear()
        os.environ.update(environ)
    require(code in (0, 2), f"exit code {code}")
    if code == 2:
        require(
            sum("error: " in line for line in err.getvalue().splitlines()) >= 1,
            "exit code 2 without a message",
        )
        raise UserError(err.getvalue())


@contextlib.contextmanager
def no_work() -> Iterator[None]:
    """Runs end where the work would begin, and leave the process's logging and warnings as they
    were.
    """
    run, logger = Run.run, logging.getLogger("threestudio_gaussiandreamer")
    handlers, propagate, level = list(logger.handlers), logger.propagate, logger.level
    Run.run = lambda self: 0
    try:
        with warnings.catch_warnings():
            yield
    finally:
        Run.run = run
        logger.handlers[:], logger.propagate = handlers, propagate
        logger.setLevel(level)
