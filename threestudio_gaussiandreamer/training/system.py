"""System ``gaussiandreamer-system``: take Gaussians from a prior, train them by score distillation,
then render, measure and export them.

In the host's order: ``configure_optimizers`` builds prompt processor and guidance and runs the
prior; ``training_step`` renders, gets the losses from the guidance, steps the optimiser, then
densifies and prunes; validation saves a row of pictures, test a turntable. If the guidance knows a
mesh as ground truth, held-out views are scored.

=============  =====================================================================================
option         meaning
=============  =====================================================================================
loss.lambda_*  weight of each loss, a number or a schedule: ``sds`` and every other ``loss_*`` of
               the guidance; ``sparsity`` mean sqrt(alpha^2 + 0.01); ``opaque`` entropy of alpha,
               which pushes it to 0 or 1; ``tv`` total variation, see ``losses.py``
optimizer      name (a torch optimiser) and args; geometry and background have the learning rates;
               those of other packages' parts are params, such as ``{background: {lr: 0.01}}``
evaluation     views, size (pixels), supersample, every (steps; 0: only at start and end): PSNR and
               SSIM on held-out views
prune          options of a second, pruned export. Its budget is one of count; bytes (of the SPZ
               file if it is exported, else of the PLY); psnr (dB, to the unpruned cloud); within
               (dB that may be lost against the ground truth); auto (dB: twice as many would gain
               less). quality, size and steps are as in the prune command; eps2d and antialias by
               default the renderer's
pages          write a page that shows the cloud in a browser, and more: see ``export.py``
=============  =====================================================================================
"""

import contextlib
from collections import ChainMap, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Optional

import torch
from torch import Tensor

from ..core.devices import flush_reads
from ..core.distributed import average_gradients, is_active, rank
from ..core.errors import UserError
from ..core.schedule import parse_schedule, validate_schedule
from ..gaussians.gaussians import SHAPES, require_cloud
from ..guidance import external
from ..guidance.external import truth_of
from ..host import BaseLift3DSystem, C, find, info, parse_structured, register, warn
from ..host.methods import require_class_method
from ..metrics import psnr_of_error
from ..priors.base import preflight_prior
from ..priors.cache import cached_cloud
from ..prune import PruneOptions
from . import events, export, finite
from .density import MeanError, density_rule
from .held_out import EvaluationConfig, HeldOut, Measurements
from .losses import check_losses, loggable, logged_names, require_gradients, total, weighted_losses
from .optimizer import PartRates, check_optimizer, make_optimizer, restore_arguments

Outputs, Batch, Losses = Mapping[str, Any], dict[str, Any], dict[str, Tensor]
GUIDANCE_LR = 1e-4
"""Learning rate of parameters that a guidance trains itself, such as the LoRA of VSD."""
OURS = {"geometry": "gaussiandreamer-cloud", "renderer": "gaussiandreamer-splatting"}
"""Parts whose methods, options or outputs the system uses beyond those of the host's."""


@register("gaussiandreamer-system")
class GaussianDreamerSystem(export.GaussianSavers, BaseLift3DSystem):
    @dataclass
    class Config(BaseLift3DSystem.Config):
        exporter_type: str = "gaussiandreamer-exporter"
        evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)
        prune: PruneOptions = field(default_factory=PruneOptions)
        pages: bool = True

        REMOVED: ClassVar[dict[str, Any]] = {
            **getattr(BaseLift3DSystem.Config, "REMOVED", {}),  # threestudio's has none
            "image_targets": (
                lambda stage: not (isinstance(stage, Mapping) and stage.get("stop")),
                "pictures of the 2D model as targets brought nothing (reports/tried.md)",
            ),
        }

        @staticmethod
        def check(cfg: Any) -> None:
            check_parts(cfg)
            for name, weight in cfg.loss.items():
                validate_schedule(weight, f"loss.{name}")
            check_losses(find(cfg.guidance_type), cfg.loss)
            check_optimizer(cfg.optimizer, cfg.scheduler)

    cfg: Config
    SECTION = "system."

    @staticmethod
    def logged(cfg: Any) -> Optional[set[str]]:
        """Return the names that a run logs, for ``checkpoint.monitor``; None if unknown."""
        return logged_names(find(cfg.guidance_type), cfg.loss)

    @staticmethod
    def check_checkpoint(checkpoint: dict[str, Any], what: str) -> None:
        """Raise UserError if the cloud of a checkpoint, ``what``, is empty or malformed."""
        if "geometry.means" in checkpoint["state_dict"]:
            names = {name: f"geometry.{name}" for name in SHAPES}
            require_cloud(checkpoint["state_dict"], names, what)

    # -- start -------------------------------------------------------------------------------------

    def configure(self) -> None:
        weights = self.cfg.loss.items()
        self.loss_weights = {k.removeprefix("lambda_"): parse_schedule(v) for k, v in weights}
        self.part_rates = PartRates(self.cfg.optimizer)
        super().configure()
        self.density = density_rule(self.geometry)
        self.automatic_optimization = False
        self.__dict__["guidance"] = self.measurements = self.prompt_utils = None
        self.skipped_steps, self.step_log = 0, events.StepLog()
        self.recent_losses: deque[tuple[int, Losses]] = deque(maxlen=finite.CHECK_EVERY)
        self._learnt: Optional[dict[str, Tensor]] = None

    def configure_optimizers(self) -> torch.optim.Optimizer:
        of_parts = self.part_rates.groups(self)
        preflight_parts(self.geometry, self.cfg)
        self.prepare_guidance()
        self.ensure_cloud()
        of_guidance = external.trainable_groups(self.guidance, GUIDANCE_LR)
        groups = self.geometry.parameter_groups() + of_parts + of_guidance
        return make_optimizer(self.cfg.optimizer, groups)

    def prepare_guidance(self) -> None:
        """Build prompt processor and guidance; before the prior runs, to report missing weights."""
        self.prompt_processor = find(self.cfg.prompt_processor_type)(self.cfg.prompt_processor)
        self.prompt_utils = self.prompt_processor()
        # not registered as a submodule, so that its frozen weights stay out of the checkpoint
        self.__dict__["guidance"] = find(self.cfg.guidance_type)(self.cfg.guidance)
        if self._learnt is not None:
            external.restore_learnt(self.guidance, self._learnt)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        # before the file of an earlier, good state is replaced
        flush_reads(self.step_log, self.guidance)
        self.require_finite()
        if self.measurements:  # the prior's cloud isn't in this file, so score it now
            scores = self.measurements.score_postponed()
            events.log_scores(self.loggers, scores, self.cfg.evaluation.views)
        super().on_save_checkpoint(checkpoint)
        checkpoint["guidance"] = external.learnt_weights(self.guidance)

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        super().on_load_checkpoint(checkpoint)
        self._learnt = checkpoint.get("guidance")
        checkpoint["state_dict"].pop("image_targets.pictures", None)  # of earlier versions

    def require_finite(self) -> None:
        """Check parameters and optimiser state; see :mod:`.finite`."""
        finite.require_optimised(self.geometry, self.trainer.optimizers)
        tensors = list(self.named_parameters())
        for optimizer in self.trainer.optimizers:
            tensors += finite.optimizer_tensors(optimizer)
        finite.require_finite(tensors, self.true_global_step, self.recent_losses)

    def ensure_cloud(self) -> None:
        """Run the prior, unless the cloud has been loaded from a checkpoint."""
        if len(self.geometry):
            return

        def first_state() -> dict[str, Tensor]:
            make = find(self.cfg.prompt_processor_type)
            prompt = self.prompt_utils or make(self.cfg.prompt_processor)
            self.geometry.initialize(
                str(getattr(prompt, "prompt", "")),
                lambda prior, text: cached_cloud(prior, text, self._save_dir),
            )
            return {name: value.cpu() for name, value in self.geometry.state_dict().items()}

        # one process runs the prior: on a GPU two runs may differ in their last bits
        states = [None if rank() else first_state()]
        if is_active():
            torch.distributed.broadcast_object_list(states)
        if rank():
            self.geometry.load_state_dict(states[0])
        info(f"the cloud starts with {len(self.geometry)} Gaussians")

    def on_fit_start(self) -> None:
        super().on_fit_start()
        mesh = getattr(truth_of(self.guidance), "mesh", None)
        if mesh is not None and self._save_dir is not None and not rank():
            held_out = HeldOut(self.cfg.evaluation, mesh)
            self.measurements = Measurements(held_out, Path(self._save_dir))

    def on_train_start(self) -> None:
        restore_arguments(self.optimizers().optimizer)
        self.require_finite()
        if problem := self.density.schedule_problem(self.global_step, self.trainer.max_steps):
            warn(problem)
        if self.global_step == 0 and self._save_dir is not None:
            export.save_first_cloud(self)
        if self.measurements:
            if self.global_step == 0:
                self.measurements.begin(self.renderer)
            self.measurements.start_clock()
        events.prefetch_truth(self)

    # -- one step ----------------------------------------------------------------------------------

    def forward(self, batch: dict[str, Any]) -> Mapping[str, Any]:
        return self.renderer(**batch)

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        """Render, score, sum the losses, differentiate, optimise, densify and prune, log."""
        optimizer = self.optimizers()
        self.set_learning_rates(optimizer)
        out = self(batch)
        guided = self.guide(out, batch)
        self.density.before_backward(out, self.global_step, self.error_of(out, batch, guided))
        losses = self.losses(guided, out)
        self.manual_backward(total(losses))
        self.optimize(optimizer, out, batch, losses)
        self.control_density(optimizer)
        self.report(out, batch, guided, losses)

    def optimize(
        self, optimizer: torch.optim.Optimizer, out: Outputs, batch: Batch, losses: Losses
    ) -> None:
        """Reduce the gradients over the processes, and step the optimiser."""
        finite.warn_if_invisible(out["opacity"], self.global_step)
        require_gradients(self.geometry, losses)
        average_gradients(p for group in optimizer.param_groups for p in group["params"])
        scale = finite.loss_scale(self.trainer)
        self.density.after_backward(out["rasterized"], batch["width"], batch["height"], scale)
        with self.geometry.steps_by_size():
            optimizer.step()
        self.geometry.clamp_colors()
        if finite.loss_scale(self.trainer) < scale:
            self.skipped_steps += 1
            warn(
                f"step {self.global_step}: gradients overflowed at the loss scale {scale:g}, so "
                "its update was skipped; schedules continue"
            )
            self.step_log.write(self.trainer, {"train/skipped_steps": self.skipped_steps})
        if self.global_step % finite.CHECK_EVERY == 0:
            self.require_finite()
        optimizer.zero_grad()

    def control_density(self, optimizer: torch.optim.Optimizer) -> None:
        """Densify and prune on schedule; log what a round of ``budget: auto`` found."""
        before = len(self.geometry)
        # the torch optimiser in Lightning's wrapper, since the rows of its state are changed
        needed = self.density.after_step(optimizer.optimizer, self.global_step)
        if needed and needed.gain >= 0:
            self.step_log.write(self.trainer, {"prune/gain": needed.gain})
            changed = f"{before} -> {len(self.geometry)} Gaussians"
            info(f"step {self.global_step}: {changed}: {needed}")

    def error_of(self, out: Outputs, batch: Batch, guided: dict[str, Any]) -> Optional[MeanError]:
        """Return what computes the mean squared error to the ground truth, if there is one."""
        if "error_to_truth" in guided:
            return lambda: torch.tensor(guided["error_to_truth"], dtype=torch.float64)
        if truth_of(self.guidance) is None:
            return None
        rgb = out["comp_rgb"].detach()
        return lambda: (
            (rgb - events.true_views(self.guidance, batch, out)).square().mean((2, 3)).mean()
        )

    def set_learning_rates(self, optimizer: torch.optim.Optimizer) -> None:
        now = self.true_current_epoch, self.true_global_step
        self.geometry.set_learning_rates(optimizer, *now)
        self.part_rates.set(optimizer, *now)

    def losses(self, guided: dict[str, Any], out: Outputs) -> Losses:
        """Return the weighted losses of the guidance, and of regularisers of renders and cloud."""
        now = self.true_current_epoch, self.true_global_step
        weights = {name: C(weight, *now) for name, weight in self.loss_weights.items()}
        losses = weighted_losses(guided, ChainMap(out, self.geometry.drawn()), weights)
        detached = {name: loss.detach() for name, loss in losses.items()}
        self.recent_losses.append((self.global_step, detached))
        return losses

    def guide(self, out: Outputs, batch: Batch, **options: Any) -> dict[str, Any]:
        """Call the guidance with renders, batch, background, and the outputs that it names."""
        options |= {name: out[name].detach() for name in getattr(self.guidance, "renders", ())}
        options["comp_rgb_bg"] = out["comp_rgb_bg"]
        inputs = self.guidance, out["comp_rgb"], self.prompt_utils, batch
        with external.own_randomness(self.true_global_step):
            return external.call_guidance(*inputs, **options)

    def report(self, out: Outputs, batch: Batch, guided: dict[str, Any], losses: Losses) -> None:
        """Log the guidance's numbers, losses, number of Gaussians, and PSNR to a ground truth."""
        every = self.trainer.log_every_n_steps
        if not every or self.global_step % every:
            return
        numbers, loss = loggable(guided, losses), sum(losses.values()).detach()
        shown = {"loss": loss, "gaussians": len(self.geometry)}
        if error := self.error_of(out, batch, guided):
            shown["dB"] = psnr_of_error(error())
        self.step_log.write(self.trainer, numbers | shown, shown)

    def on_train_batch_end(self, outputs: Any, batch: Any, batch_idx: int) -> None:
        super().on_train_batch_end(outputs, batch, batch_idx)
        self.step_log.reads.poll()
        every = self.cfg.evaluation.every
        if every and self.global_step % every == 0:
            self.score("curve")

    # -- measuring ---------------------------------------------------------------------------------

    def score(self, key: str) -> None:
        """Score the cloud on the held-out views, if the ground truth is a mesh."""
        if self.measurements:
            flush_reads(self.step_log)
            scores = self.measurements.score(key, self.renderer, self.global_step)
            events.log_scores(self.loggers, scores, self.cfg.evaluation.views)

    def on_train_end(self) -> None:
        flush_reads(self.step_log, self.guidance)
        self.require_finite()
        if self.measurements:
            self.measurements.stop_clock()

    def on_fit_end(self) -> None:
        # not in on_train_end, which isn't called for a run that is resumed at its last step
        super().on_fit_end()
        self.score("result")

    def summary(self) -> str:
        """List the files of results and the scores; printed at the end of a run."""
        folder = Path(self._save_dir or ".")
        lines = [str(path) for name in export.SUMMARY for path in sorted(folder.glob(name))]
        lines += ["", self.density.summary()]
        return "\n".join([*lines, *(["", self.measurements.table()] if self.measurements else [])])

    # -- pictures ----------------------------------------------------------------------------------

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        if rank():  # only the first process renders, scores and exports results
            return
        with self.measurements.paused_clock() if self.measurements else contextlib.nullcontext():
            events.save_pictures(self, batch)

    def on_validation_epoch_end(self) -> None:
        """Do nothing; threestudio's raises an error."""

    def test_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        if not rank():
            name = f"{export.turntable_name(self)}/{int(batch['index'][0])}.png"
            panels = [events.rgb_panel(self(batch)["comp_rgb"][0])]
            self.save_image_grid(name, panels, name="test_step", step=self.true_global_step)

    def on_test_epoch_end(self) -> None:
        if not rank():
            export.write_turntable(self)
            if self.guidance is not None:
                export.export(self)

    def on_validation_start(self) -> None:
        self.ensure_cloud()
        self.require_finite()

    def on_test_start(self) -> None:
        self.on_validation_start()
        if not rank():
            export.discard_turntable(self)

    def on_predict_start(self) -> None:
        self.on_validation_start()
        super().on_predict_start()
        if not rank() and self.exporter.cfg.save_video:
            export.discard_turntable(self)

    def on_predict_epoch_end(self) -> None:
        if not rank():
            if self.exporter.cfg.save_video:
                self.on_test_epoch_end()
            export.export(self)


# -- the parts of a configuration ------------------------------------------------------------------


def check_parts(cfg: Any) -> None:
    """Raise UserError if a part that the system needs is missing or isn't of the needed class."""
    for name in ("geometry", "renderer", "guidance", "prompt_processor"):
        if not getattr(cfg, f"{name}_type"):
            raise UserError(f"{name}_type is empty: name a registered part")
    for name, ours in OURS.items():
        part, base = getattr(cfg, f"{name}_type"), find(ours)
        if not issubclass(find(part), base):
            raise UserError(
                f"{name}_type is {part!r}: gaussiandreamer-system needs {ours}, or a class that is "
                f"derived from {base.__module__}.{base.__name__}"
            )


def preflight_parts(geometry: Any, cfg: Any) -> None:
    """Check what the parts of a run need from outside, such as files, before any long work: the
    prior, if the cloud is empty, the guidance, and last, since it makes a folder, the prompt
    processor. The UserError for what is missing names the part's section.
    """
    checks: dict[str, Callable[[], None]] = {}
    if not len(geometry):
        keep, prompt = geometry.cfg.keep_attributes, cfg.prompt_processor.get("prompt") or ""
        checks["geometry.prior"] = lambda: preflight_prior(geometry.prior(), keep, prompt)
    for name in ("guidance", "prompt_processor"):
        part = find(getattr(cfg, f"{name}_type"))
        if hasattr(part, "preflight"):
            require_class_method(part, "preflight")
            options = parse_structured(part.Config, getattr(cfg, name), f"system.{name}.")
            checks[name] = partial(part.preflight, options)
    for name, check in checks.items():
        try:
            check()
        except UserError as error:
            if f"system.{name}" in str(error):
                raise
            raise UserError(f"system.{name}: {error}") from error
