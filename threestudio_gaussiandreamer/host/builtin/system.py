"""The base systems: LightningModules that build, update and export the parts of a run."""

from dataclasses import dataclass, field
from typing import Any, Optional

import lightning.pytorch as pl

from ...core.checkpoint_file import load_module_weights
from ...core.errors import UserError
from ...core.options import parse_structured
from ...core.schedule import C
from .base import Updateable, find, load_parameters
from .models import Exporter
from .savers import LoggerOptions, SaverMixin


class BaseSystem(pl.LightningModule, Updateable, SaverMixin):
    """Parses its options, calls ``configure``, and updates dataset and parts around every batch."""

    @dataclass
    class Config:
        loggers: LoggerOptions = field(default_factory=LoggerOptions)
        loss: dict = field(default_factory=dict)
        optimizer: dict = field(default_factory=dict)
        scheduler: Optional[dict] = None
        weights: Optional[str] = None

        REMOVED = {
            "weights_ignore_modules": (None, "weights are loaded where names agree"),
            "cleanup_after_validation_step": (False, "memory is kept for the next step"),
            "cleanup_after_test_step": (False, "memory is kept for the next step"),
        }

    cfg: Config

    def __init__(self, cfg: Any, resumed: bool = False) -> None:
        super().__init__()
        self.cfg = parse_structured(self.Config, cfg, "system.")
        self._save_dir = None
        self.resumed = resumed  # whether a checkpoint will be loaded after construction
        self._resumed_eval: Optional[tuple[int, int]] = None
        self.create_loggers(self.cfg.loggers)
        self.configure()
        if self.cfg.weights is not None:
            self.load_weights(self.cfg.weights)
        self.post_configure()

    def configure(self) -> None:
        """Build the parts."""

    def post_configure(self) -> None:
        """Hook that is called after ``weights`` are loaded."""

    def load_weights(self, weights: str) -> None:
        """Load the parameters of a checkpoint; names that don't exist here are skipped."""
        state_dict, epoch, global_step = load_module_weights(weights)
        load_parameters(self, state_dict, weights, strict=False)
        self.do_update_step(epoch, global_step, on_load_weights=True)

    def set_resume_status(self, current_epoch: int, global_step: int) -> None:
        """Set the epoch and step of the checkpoint that is evaluated, for which Lightning has 0."""
        self._resumed_eval = current_epoch, global_step

    @property
    def true_current_epoch(self) -> int:
        """The epoch of training, or of the checkpoint that is evaluated."""
        return self._resumed_eval[0] if self._resumed_eval else self.current_epoch

    @property
    def true_global_step(self) -> int:
        """The finished steps of training, or of the checkpoint that is evaluated."""
        return self._resumed_eval[1] if self._resumed_eval else self.global_step

    def C(self, value: Any) -> float:
        """Return the value of a schedule at the current epoch and step."""
        return C(value, self.true_current_epoch, self.true_global_step)

    def preprocess_data(self, batch: dict, stage: str) -> None:
        """Change a batch of "train", "validation", "test" or "predict" in place."""

    def on_train_batch_start(self, batch: dict, *rest: Any) -> None:
        self._before_batch(batch, "train", self.trainer.train_dataloader)

    def on_validation_batch_start(self, batch: dict, *rest: Any) -> None:
        self._before_batch(batch, "validation", self.trainer.val_dataloaders)

    def on_test_batch_start(self, batch: dict, *rest: Any) -> None:
        self._before_batch(batch, "test", self.trainer.test_dataloaders)

    def on_predict_batch_start(self, batch: dict, *rest: Any) -> None:
        self._before_batch(batch, "predict", self.trainer.predict_dataloaders)

    def on_train_batch_end(self, *rest: Any) -> None:
        if isinstance(self.dataset, Updateable):
            self.dataset.do_update_step_end(self.true_current_epoch, self.true_global_step)
        self.do_update_step_end(self.true_current_epoch, self.true_global_step)

    on_validation_batch_end = on_test_batch_end = on_predict_batch_end = on_train_batch_end

    def _before_batch(self, batch: dict, stage: str, loader: Any) -> None:
        self.preprocess_data(batch, stage)
        self.dataset = loader.dataset
        if isinstance(self.dataset, Updateable):
            self.dataset.do_update_step(self.true_current_epoch, self.true_global_step)
        self.do_update_step(self.true_current_epoch, self.true_global_step)


class BaseLift3DSystem(BaseSystem):
    """Builds the parts by their names in the registry, and exports through an exporter."""

    @dataclass
    class Config(BaseSystem.Config):
        geometry_type: str = ""
        geometry: dict = field(default_factory=dict)
        material_type: str = "no-material"
        material: dict = field(default_factory=dict)
        background_type: str = "solid-color-background"
        background: dict = field(default_factory=dict)
        renderer_type: str = ""
        renderer: dict = field(default_factory=dict)
        guidance_type: str = ""
        guidance: dict = field(default_factory=dict)
        prompt_processor_type: str = ""
        prompt_processor: dict = field(default_factory=dict)
        exporter_type: str = "dummy-exporter"
        exporter: dict = field(default_factory=dict)

    cfg: Config

    def configure(self) -> None:
        self.geometry = find(self.cfg.geometry_type)(self.cfg.geometry)
        self.material = find(self.cfg.material_type)(self.cfg.material)
        self.background = find(self.cfg.background_type)(self.cfg.background)
        self.renderer = self._drawing("renderer")

    def _drawing(self, kind: str) -> Any:
        """Build a part that is given the others: the renderer or the exporter."""
        others = {name: getattr(self, name) for name in ("geometry", "material", "background")}
        return find(getattr(self.cfg, f"{kind}_type"))(getattr(self.cfg, kind), **others)

    def on_predict_start(self) -> None:
        self.exporter: Exporter = self._drawing("exporter")

    def predict_step(self, batch: dict, batch_idx: int) -> None:
        if self.exporter.cfg.save_video:
            self.test_step(batch, batch_idx)

    def on_predict_epoch_end(self) -> None:
        if self.exporter.cfg.save_video:
            self.on_test_epoch_end()
        for output in self.exporter():
            save = getattr(self, f"save_{output.save_type}", None)
            if save is None:
                who = f"{type(self).__name__} has no save_{output.save_type}"
                raise UserError(f"{who}, which {type(self.exporter).__name__} asks for")
            save(f"it{self.true_global_step}-export/{output.save_name}", **output.params)
