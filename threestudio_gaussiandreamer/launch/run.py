"""One run: its folder, its parts, its trainer and the selected stage."""

import argparse
import contextlib
import errno
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Optional

import torch

from ..core.checkpoint_file import load_checkpoint
from ..core.errors import UserError, raised_in
from ..core.logs import get_rank
from ..core.options import parse_structured
from ..host import find, info, pl, warn
from ..view.live import LiveView, serve_until_stopped
from ..view.run_index import note_time, write_index
from . import run_folder
from .callbacks import AtomicCheckpointIO, LastCheckpoint, ProgressBar, RunRecord, Stopped
from .config_check import build, check_shared_views, plain
from .ddp import is_lost_process, planned_processes, trainer_options
from .live_viewer import LiveViewer, ViewerConfig

LIGHTNINGS_KEYS = ("pytorch-lightning_version", "loops", "optimizer_states")
"""Without the last two Lightning would resume at step 0 or with a new optimiser."""
WRITE_ERRORS = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EPERM),
    *(errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENAMETOOLONG),
)
MISMATCHES = ("loading state_dict", "loaded state dict", "optimizer_states", "restore training")
"""In the messages of torch and Lightning about a state that doesn't match."""


@dataclass(eq=False)
class Run:
    """A checked configuration and the stage to run on it.

    Args:
        cfg: returned by ``config.load_config`` and checked by ``config_check.check_config``.
        args: the parsed arguments.
        sources: the YAML files and their content, stored beside the results, as ``command`` is.
        n_gpus: GPUs to use; 0 for the CPU.
        callbacks: further Lightning callbacks, called before those that write checkpoints.
        records_code: copy the package's sources into the folder when training starts.
    """

    cfg: Any
    args: argparse.Namespace
    sources: Sequence[tuple[Path, bytes]]
    command: str
    n_gpus: int
    callbacks: Sequence[Any] = ()
    records_code: bool = True

    def __post_init__(self) -> None:
        self.training = self.args.stage == "train"
        self.claimed = run_folder.RunFolder(self.folder)
        self.resumed_step, self.has_trained = -1, False
        self.size_changes: list[str] = []
        self.trainer: Any = None
        self.viewer = parse_structured(ViewerConfig, self.cfg.viewer)
        self.view: Optional[LiveView] = None

    @property
    def folder(self) -> Path:
        return Path(self.cfg.trial_dir)

    @property
    def last(self) -> Path:
        """The checkpoint from which a stopped run is resumed."""
        return self.folder / "ckpts" / "last.ckpt"

    @property
    def to_resume(self) -> str:
        return f"to resume: {run_folder.resume_command(self.folder, self.args.gpu)}"

    def run(self) -> int:
        """Build everything, run the stage and return the exit code."""
        try:
            self.start()
            with lightning_errors(self.cfg.resume, self.size_changes), write_errors(self.folder):
                began, start = datetime.now(), time.perf_counter()
                self.run_stage()
                if self.has_index:
                    note_time(self.folder, self.args.stage, began, time.perf_counter() - start)
                self.report()
            if self.view is not None and self.viewer.keep_serving:
                serve_until_stopped(self.view)
        except Stopped as stop:
            print(f"stopped at step {stop.step}; {self.to_resume}", flush=True)
            return 128 + stop.signum
        except BaseException:
            self.clean_up()
            raise
        finally:
            if self.claimed.path != self.folder:  # that of a stage
                self.claimed.discard()
            self.claimed.release()
            if self.view is not None:
                self.view.close()
        return 0

    def start(self) -> None:
        """Check the checkpoint and the folder, create the folder, build the parts and trainer."""
        checkpoint = self.read_resume()
        if self.training:
            check_shared_views(self.cfg)
        run_folder.require_writable(self.folder)
        if self.viewer.enabled and self.training and not get_rank():
            self.view = LiveView(self.viewer.host, self.viewer.port, self.cfg.tag or self.cfg.name)
        self.claim_folder()
        # the same seed in all processes; streams that must differ also depend on the rank
        pl.seed_everything(self.cfg.seed, workers=True)
        self.data = find(self.cfg.data_type)(self.cfg.data)
        resumed = self.cfg.resume is not None
        self.system = find(self.cfg.system_type)(self.cfg.system, resumed=resumed)
        if checkpoint is not None and not self.training:
            self.system.set_resume_status(*checkpoint)
        self.system.set_save_dir(str(self.folder / "save"))
        self.trainer = self.build_trainer()

    def read_resume(self) -> Optional[tuple[int, int]]:
        """Check the checkpoint to resume from; return its epoch and step, None without one."""
        path, stage = self.cfg.resume, f"--{self.args.stage}"
        if path is None:
            if not self.training and "resume=auto" in self.args.overrides:
                raise UserError(f"resume=auto: there is no checkpoint to {stage}; train first")
            if not self.training:
                warn(f"no checkpoint given (resume=...): {stage} shows what training starts from")
            return None
        checkpoint = load_checkpoint(path)
        needed = LIGHTNINGS_KEYS if self.training else LIGHTNINGS_KEYS[:1]
        if missing := [key for key in needed if key not in checkpoint]:
            raise UserError(
                f"{path} isn't a training checkpoint: it has no {', '.join(missing)}, which "
                "Lightning writes unless checkpoint.save_weights_only=true"
            )
        for change in run_folder.changes_since(self.cfg):  # they may explain what is found next
            warn(f"{path} is of another run: {change}")
        if hasattr(system := find(self.cfg.system_type), "check_checkpoint"):
            system.check_checkpoint(checkpoint, path)
        if self.training:
            name = (self.cfg.system.get("optimizer") or {}).get("name", "Adam")
            check_optimizer(name, checkpoint["optimizer_states"], path)
        self.size_changes = run_folder.changes_since(self.cfg, run_folder.SIZES)
        self.resumed_step = checkpoint["global_step"]
        return checkpoint["epoch"], self.resumed_step

    def run_stage(self) -> None:
        inputs = {"datamodule": self.data, "ckpt_path": self.cfg.resume}
        if not self.training:
            name = {"export": "predict"}.get(self.args.stage, self.args.stage)
            getattr(self.trainer, name)(self.system, **inputs)
            return
        if 0 <= self.cfg.trainer.get("max_steps", -1) <= self.resumed_step:
            info(f"the checkpoint is at step {self.resumed_step}: nothing is left to train")
        self.trainer.fit(self.system, **inputs)
        self.has_trained = True
        self.trainer.test(self.system, datamodule=self.data)

    @property
    def has_index(self) -> bool:
        """Whether this process writes ``index.html``."""
        return self.trainer.is_global_zero and self.cfg.system.get("pages", True)

    def report(self) -> None:
        """Write ``index.html``, and print the system's summary, which lists its results."""
        if self.has_index:
            info(f"the run at a glance: {write_index(self.folder)}")
        summary = self.system.summary() if hasattr(self.system, "summary") else None
        if summary and self.trainer.is_global_zero:
            print(summary, flush=True)

    def build_trainer(self) -> Any:
        """Build Lightning's Trainer on the chosen device."""
        options = {"enable_model_summary": False, "enable_progress_bar": True}
        options |= plain(self.cfg.trainer)
        processes = planned_processes(self.n_gpus, options)
        at_zero = self.training and self.cfg.resume is None
        with_code = self.records_code and self.training
        record = RunRecord(self.folder, self.cfg, self.sources, self.command, with_code, at_zero)
        self.checkpoint_io = AtomicCheckpointIO(record.first_checkpoint)
        callbacks = [*self.callbacks, *([ProgressBar()] if options["enable_progress_bar"] else [])]
        if self.training:
            callbacks += [record, *self.training_callbacks()]
        elif not (self.folder / run_folder.PARSED).is_file():
            callbacks.append(record)
        options |= {
            "accelerator": "gpu" if self.n_gpus else "cpu",
            "logger": self.training
            and [
                pl.loggers.TensorBoardLogger(self.folder, name="tb_logs"),
                pl.loggers.CSVLogger(self.folder, name="csv_logs"),
                *self.system.get_loggers(),
            ],
            "callbacks": callbacks,
            "inference_mode": False,
            "default_root_dir": str(self.folder),
            **trainer_options(processes),
        }
        options["plugins"] = [self.checkpoint_io, *options.get("plugins", [])]
        return build("trainer", pl.Trainer, options)

    def training_callbacks(self) -> list:
        # without the version counter a resumed run overwrites last.ckpt
        checkpointing = {"enable_version_counter": False, **plain(self.cfg.checkpoint)}
        if checkpointing.get("save_weights_only"):
            checkpointing["save_last"] = False  # last.ckpt is LastCheckpoint's, always complete
        last = LastCheckpoint(self.last, self.checkpoint_io)
        callbacks = [
            pl.callbacks.ModelCheckpoint(dirpath=str(self.last.parent), **checkpointing),
            pl.callbacks.LearningRateMonitor(logging_interval="step"),
            last,
        ]
        if self.view is not None:
            callbacks.append(LiveViewer(self.view, lambda: bool(last.signum)))
        return callbacks

    def claim_folder(self) -> None:
        """Create and lock the folder; a stage beside a training locks one of its own in it."""
        stage = self.args.stage
        if get_rank():
            return
        if not self.training and self.folder.is_dir():
            self.claimed = run_folder.claim(
                self.folder / f".{stage}", f"another --{stage} is at work", ""
            )
        elif self.cfg.new_folder:
            self.claimed = run_folder.claim_new(self.folder)
            run_folder.renumber(self.cfg, self.claimed.path.name)
        else:
            self.claimed = run_folder.claim(self.folder)

    def clean_up(self) -> None:
        """After an error: write the page, or remove a folder without results; say how to go on."""
        step = 0 if self.trainer is None else self.trainer.global_step
        if self.has_trained:  # the turntable or an export has failed
            with contextlib.suppress(Exception):  # it would hide the first error
                self.report()
        kept = ("save/it*", "save/prior/points.npz", "ckpts/*.ckpt")
        if self.claimed.first_made is not None and step <= max(self.resumed_step, 0):
            if not any(any(self.folder.glob(name)) for name in kept):
                self.claimed.discard()
        # not the checkpoint of an earlier run, of which this one has replaced none yet
        if self.training and step and not get_rank() and self.last.is_file():
            if self.cfg.resume is not None or self.checkpoint_io.steps:
                with contextlib.suppress(OSError):  # of a closed pipe
                    print(self.to_resume, flush=True)


def check_optimizer(name: str, states: Sequence[dict[str, Any]], path: str) -> None:
    """Raise UserError if the states in a checkpoint are none, or those of another optimiser than
    ``torch.optim.<name>``, which torch's restoring doesn't notice.
    """
    kind = getattr(torch.optim, name, None)
    if kind is None:
        return
    try:
        if not states:
            raise ValueError("there is no optimiser")
        for state in states:
            groups = [list(torch.zeros(len(group["params"]), 1)) for group in state["param_groups"]]
            restored = kind([{"params": tensors} for tensors in groups], lr=0.0)
            options = list(restored.defaults)  # to which restoring may add
            restored.load_state_dict(state)
            _ = [group[option] for group in restored.param_groups for option in options]
            for moments in restored.state.values():
                ranks = [m.dim() for m in moments.values() if isinstance(m, torch.Tensor)]
                parameter = torch.zeros([1] * max(ranks, default=1))
                parameter.grad = torch.zeros_like(parameter)
                fresh = kind([parameter], lr=0.0)
                fresh.step(lambda: 0.0)
                _ = [moments[key] for key in fresh.state[parameter]]
    except Exception as error:  # torch doesn't check keys and types
        raise UserError(
            f"{path}: {name} can't resume from its optimizer_states, which may be another "
            f"optimiser's: {type(error).__name__} {error}"
        ) from error


# -- errors of a stage that a user can correct -----------------------------------------------------


@contextlib.contextmanager
def lightning_errors(checkpoint: Optional[str], changes: Sequence[str] = ()) -> Iterator[None]:
    """Convert exceptions that Lightning raises in this context to UserError: the checkpoint doesn't
    match the configuration, as ``changes`` may explain, the trainer's options are incompatible, or
    another process has ended; and its SystemExit(1) to the KeyboardInterrupt that it has caught.
    """
    try:
        yield
    except SystemExit as stop:
        if isinstance(stop.__context__, KeyboardInterrupt):
            raise KeyboardInterrupt from None
        raise
    except pl.utilities.exceptions.MisconfigurationException as error:
        raise UserError(f"trainer: {error}") from error
    except (RuntimeError, ValueError, KeyError) as error:
        if is_lost_process(error):
            raise UserError(
                "another process of this run has ended, so this one stops; the same command with "
                f"resume=auto goes on ({str(error).strip()})"
            ) from error
        if isinstance(error, ValueError) and raised_in(error, pl.__name__):
            raise UserError(f"trainer: {str(error).strip()}") from error
        of_state = any(part in str(error) for part in MISMATCHES) or raised_in(error, pl.__name__)
        if checkpoint is None or isinstance(error, UserError) or not of_state:
            raise
        raise UserError(
            f"the checkpoint {checkpoint} was made by another configuration: "
            f"{'; '.join(changes) or ' '.join(str(error).split())}"
        ) from error


@contextlib.contextmanager
def write_errors(folder: Path) -> Iterator[None]:
    """Convert OSErrors of this context, and of the loggers' threads, to UserErrors: the disk is
    full, access is denied, or another process has removed a file in ``folder``, of the results.
    """

    def said(error: Optional[BaseException]) -> str:
        """Return the message; empty if it is none of these errors."""
        if not isinstance(error, OSError) or error.errno not in WRITE_ERRORS:
            return ""
        what = error.filename or f"the results in {folder}"
        return f"cannot write {what}: {error.strerror}; make room, or choose another exp_root_dir"

    def in_a_thread(failure: Any) -> None:
        # only a warning, since the logger raises the error again when it next writes
        warn(message) if (message := said(failure.exc_value)) else earlier(failure)

    earlier, threading.excepthook = threading.excepthook, in_a_thread
    try:
        yield
    except FileNotFoundError as error:
        if folder.absolute() not in Path(str(error.filename or "/")).absolute().parents:
            raise
        raise UserError(
            f"{error.filename} has been removed while it was needed: another command works in "
            f"{folder}; run this one again when that has ended"
        ) from error
    except OSError as error:
        if message := said(error):
            raise UserError(message) from error
        raise
    finally:
        threading.excepthook = earlier
