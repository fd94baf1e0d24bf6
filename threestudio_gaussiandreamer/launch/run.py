"""One run: its folder, its parts, its trainer and the selected stage.

``outputs/<name>/<tag>@<time>/{ckpts, configs/{raw,parsed}.yaml, code, save, tb_logs, csv_logs,
cmd.txt}``"""

import argparse
import contextlib
import time
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Optional

import torch

from ..core.checkpoint_file import load_checkpoint
from ..core.errors import UserError
from ..core.logs import get_rank
from ..core.options import parse_structured
from ..host import find, info, pl, warn
from ..view.live import LiveView, serve_until_stopped
from ..view.run_index import note_time, write_index
from .callbacks import AtomicCheckpointIO, LastCheckpoint, ProgressBar, RunRecord, Stopped
from .config_check import build, check_shared_views, plain
from .ddp import environment_plugins, planned_processes, trainer_options
from .folder_lock import RunFolder, claim, claim_new, require_writable
from .live_viewer import LiveViewer, ViewerConfig
from .run_folder import PARSED, SIZES, changes_since, renumber, resume_command
from .stage_errors import lightning_errors, write_errors

# Lightning refuses a checkpoint without the first key; without the others it would resume at step 0
# or with a new optimiser
LIGHTNINGS_KEYS = ("pytorch-lightning_version", "loops", "optimizer_states")


class Run:
    """A checked configuration and the stage to run on it.

    Args:
        cfg: returned by ``config.load_config`` and checked by ``config_check.check_config``.
        args: the parsed arguments; ``stage`` is "train", "validate", "test" or "export".
        sources: the YAML files and their content, stored beside the results.
        command: the command line, stored beside the results.
        n_gpus: GPUs to use; 0 for the CPU.
        callbacks: further Lightning callbacks, called before those that write checkpoints.
        records_code: copy the package's sources into the folder when training starts.
    """

    def __init__(
        self,
        cfg: Any,
        args: argparse.Namespace,
        sources: Sequence[tuple[Path, bytes]],
        command: str,
        n_gpus: int,
        *,
        callbacks: Sequence[Any] = (),
        records_code: bool = True,
    ) -> None:
        self.cfg, self.args, self.n_gpus = cfg, args, n_gpus
        self.callbacks, self.records_code = list(callbacks), records_code
        self.sources, self.command = sources, command
        self.training = args.stage == "train"
        self.claimed = RunFolder(self.folder)
        self.resumed_step, self.has_trained = -1, False
        self.size_changes: list[str] = []
        self.trainer: Any = None
        self.viewer = parse_structured(ViewerConfig, cfg.viewer)
        self.view: Optional[LiveView] = None

    @property
    def folder(self) -> Path:
        return Path(self.cfg.trial_dir)

    @property
    def last(self) -> Path:
        """The checkpoint from which a stopped run is resumed."""
        return self.folder / "ckpts" / "last.ckpt"

    def run(self) -> int:
        """Build everything, run the stage and return the exit code.

        Raises:
            UserError: an error that the user can correct. A folder that was created for this run
                and has no results is removed.
        """
        try:
            self.start()
            with lightning_errors(self.cfg.resume, self.size_changes), write_errors(self.folder):
                began, start = datetime.now(), time.perf_counter()
                self.run_stage()
                if self.has_index:
                    seconds = time.perf_counter() - start
                    note_time(self.folder, self.args.stage, began, seconds)
                self.report()
            if self.view is not None and self.viewer.keep_serving:
                serve_until_stopped(self.view)
        except Stopped as stop:
            command = resume_command(self.folder, self.args.gpu)
            print(f"stopped at step {stop.step}; to resume: {command}", flush=True)
            return 128 + stop.signum
        except BaseException:
            if self.has_trained:  # the turntable or an export has failed
                with contextlib.suppress(Exception):  # it would hide the first error
                    self.report()
            self.discard_if_unused()
            self.print_resume_command()
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
        require_writable(self.folder)
        if self.viewer.enabled and self.training and not get_rank():
            self.view = LiveView(self.viewer.host, self.viewer.port, self.cfg.tag or self.cfg.name)
        self.claim_folder()
        # the same seed in all processes; streams that must differ also depend on the rank
        pl.seed_everything(self.cfg.seed, workers=True)
        self.data = find(self.cfg.data_type)(self.cfg.data)
        self.system = find(self.cfg.system_type)(
            self.cfg.system, resumed=self.cfg.resume is not None
        )
        if checkpoint is not None and not self.training:
            self.system.set_resume_status(*checkpoint)
        self.system.set_save_dir(str(self.folder / "save"))
        self.trainer = self.build_trainer()

    def read_resume(self) -> Optional[tuple[int, int]]:
        """Return the epoch and step of the checkpoint to resume from; None without one. The file is
        read completely, so that damage is found before any work.
        """
        path, stage = self.cfg.resume, self.args.stage
        if path is None:
            if not self.training and "resume=auto" in self.args.overrides:
                raise UserError(
                    f"resume=auto: there is no checkpoint to --{stage}; train first, or check name "
                    "and tag"
                )
            if not self.training:
                warn(
                    f"no checkpoint given (resume=...): --{stage} shows what training would start "
                    "from"
                )
            return None
        checkpoint = load_checkpoint(path)
        needed = LIGHTNINGS_KEYS if self.training else LIGHTNINGS_KEYS[:1]
        missing = [key for key in needed if key not in checkpoint]
        if missing:
            raise UserError(
                f"{path} isn't a training checkpoint: it has no {', '.join(missing)}, which "
                "Lightning writes unless checkpoint.save_weights_only=true"
            )
        for change in changes_since(self.cfg):  # they may explain what is found next
            warn(f"{path} is of another run: {change}")
        check_checkpoint = getattr(find(self.cfg.system_type), "check_checkpoint", None)
        if check_checkpoint is not None:
            check_checkpoint(checkpoint, path)
        if self.training:
            name = (self.cfg.system.get("optimizer") or {}).get("name", "Adam")
            check_optimizer(name, checkpoint["optimizer_states"], path)
        self.size_changes = changes_since(self.cfg, SIZES)
        self.resumed_step = checkpoint["global_step"]
        return checkpoint["epoch"], self.resumed_step

    def run_stage(self) -> None:
        inputs = {"datamodule": self.data, "ckpt_path": self.cfg.resume}
        if not self.training:
            name = {"export": "predict"}.get(self.args.stage, self.args.stage)
            getattr(self.trainer, name)(self.system, **inputs)
            return
        if 0 <= self.cfg.trainer.get("max_steps", -1) <= self.resumed_step:
            info(
                f"the checkpoint is at step {self.resumed_step} of "
                f"{self.cfg.trainer.max_steps}: nothing is left to train"
            )
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

    # -- the trainer -------------------------------------------------------------------------------

    def build_trainer(self) -> Any:
        """Build Lightning's Trainer on the chosen device."""
        options = {
            "enable_model_summary": False,
            "enable_progress_bar": True,
            **plain(self.cfg.trainer),
        }
        at_zero = self.training and self.cfg.resume is None
        with_code = self.records_code and self.training
        record = RunRecord(self.folder, self.cfg, self.sources, self.command, with_code, at_zero)
        self.checkpoint_io = AtomicCheckpointIO(record.first_checkpoint)
        callbacks = self.callbacks + ([ProgressBar()] if options["enable_progress_bar"] else [])
        if self.training:
            callbacks += [record, *self.training_callbacks()]
        elif not (self.folder / PARSED).is_file():
            callbacks.append(record)
        processes = planned_processes(self.n_gpus, options)
        required = {
            "accelerator": "gpu" if self.n_gpus else "cpu",
            "logger": self.build_loggers() if self.training else False,
            "callbacks": callbacks,
            "plugins": [self.checkpoint_io, *environment_plugins(processes)],
            "inference_mode": False,
            "default_root_dir": str(self.folder),
        }
        required |= trainer_options(processes)
        return build("trainer", pl.Trainer, options | required)

    def build_loggers(self) -> list:
        folder = str(self.folder)
        loggers = [
            pl.loggers.TensorBoardLogger(folder, name="tb_logs"),
            pl.loggers.CSVLogger(folder, name="csv_logs"),
        ]
        return loggers + list(self.system.get_loggers())

    def training_callbacks(self) -> list:
        # without the version counter a resumed run overwrites last.ckpt instead of adding
        # last-v1.ckpt
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
            callbacks.append(LiveViewer(self.view, self.viewer, lambda: bool(last.signum)))
        return callbacks

    # -- the folder --------------------------------------------------------------------------------

    def claim_folder(self) -> None:
        """Create the run's folder if it doesn't exist, and lock it against other trainings. In one
        that is there, other stages lock a folder of their own, to run beside a training.
        """
        stage = self.args.stage
        if get_rank():
            return
        if not self.training and self.folder.is_dir():
            self.claimed = claim(self.folder / f".{stage}", f"another --{stage} is at work", "")
        elif self.cfg.new_folder:
            self.claimed, number = claim_new(self.folder)
            if number > 1:
                renumber(self.cfg, number)
        else:
            self.claimed = claim(self.folder)

    def discard_if_unused(self) -> None:
        """Remove the folder if this run created it, has made no step and has written no results."""
        if self.claimed.first_made is None:  # nor can a name that is too long be looked into
            return
        trained = self.trainer is not None and self.trainer.global_step > max(self.resumed_step, 0)
        kept = ("save/it*", "save/prior/points.npz", "ckpts/*.ckpt")
        if not trained and not any(path for name in kept for path in self.folder.glob(name)):
            self.claimed.discard()

    def print_resume_command(self) -> None:
        """Print how to go on after an error, if this run has trained and has a checkpoint."""
        if not self.training or self.trainer is None or not self.trainer.global_step or get_rank():
            return
        # not the checkpoint of an earlier run, of which this one has replaced none yet
        if self.last.is_file() and (self.cfg.resume is not None or self.checkpoint_io.steps):
            with contextlib.suppress(OSError):  # of a closed pipe, which would hide the first error
                print(f"to resume: {resume_command(self.folder, self.args.gpu)}", flush=True)


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
            sizes = [len(group["params"]) for group in state["param_groups"]]
            restored = kind([{"params": list(torch.zeros(n, 1))} for n in sizes], lr=0.0)
            options = list(restored.defaults)  # to which restoring may add
            restored.load_state_dict(state)
            for group in restored.param_groups:
                _ = [group[option] for option in options]
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
