"""Base classes of the parts of a system, and the host's own minimal parts."""

from abc import abstractmethod
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Optional, Tuple

import torch
from torch import Tensor, nn

from ...core.distributed import draw_shared
from ...core.options import one_of
from ...core.streams import generator
from .base import BaseModule, BaseObject, run_seed
from .registry import register


class BaseGeometry(BaseModule):
    """Base class of geometries: the optimised parameters."""


class BaseMaterial(BaseModule):
    """Base class of materials: features to colours; Gaussians have their own colours."""


COLOR_ACTIVATIONS = {"sigmoid": torch.sigmoid, "none": lambda x: x}


@register("no-material")
class NoMaterial(BaseMaterial):
    """Pass colours through a sigmoid; without ``input_feature_dims`` there are no parameters."""

    @dataclass
    class Config(BaseMaterial.Config):
        n_output_dims: int = 3
        color_activation: str = field(default="sigmoid", metadata=one_of(COLOR_ACTIVATIONS))

    cfg: Config
    SECTION = "system.material."

    def forward(self, features: Tensor, **kwargs: Any) -> Tensor:
        return COLOR_ACTIVATIONS[self.cfg.color_activation](features)


class BaseBackground(BaseModule):
    """Base class of backgrounds: ray directions (B,H,W,3) to colours (B,H,W,C) in [0,1]."""

    @abstractmethod
    def forward(self, dirs: Tensor) -> Tensor:
        raise NotImplementedError(f"{type(self).__name__}.forward")


@register("solid-color-background")
class SolidColorBackground(BaseBackground):
    """One colour for all pixels, fixed or learned; ``random_aug`` replaces it in some steps of
    training by a random one for each view, both as functions of (seed, step).
    """

    @dataclass
    class Config(BaseBackground.Config):
        n_output_dims: int = 3
        color: Tuple = (1.0, 1.0, 1.0)
        learned: bool = False
        random_aug: bool = False
        random_aug_prob: float = 0.5

    cfg: Config

    def configure(self) -> None:
        color = torch.tensor(list(self.cfg.color), dtype=torch.float32)
        if self.cfg.learned:
            self.env_color = nn.Parameter(color)
        else:
            self.register_buffer("env_color", color)
        self.step = 0

    def update_step(self, epoch: int, global_step: int, on_load_weights: bool = False) -> None:
        self.step = global_step

    def forward(self, dirs: Tensor) -> Tensor:
        shape = (*dirs.shape[:-1], self.cfg.n_output_dims)
        if self.training and self.cfg.random_aug:
            rng = generator(run_seed(), "background", self.step)
            if torch.rand((), generator=rng) < self.cfg.random_aug_prob:
                own = (1, 1, self.cfg.n_output_dims)
                colors = draw_shared(len(dirs), lambda n: torch.rand(n, *own, generator=rng))
                return colors.to(dirs).expand(shape)
        return self.env_color.to(dirs).expand(shape)


class SubModules(NamedTuple):
    """References to parts that belong to the system, kept out of ``nn.Module``'s registration."""

    geometry: BaseGeometry
    material: Optional[BaseMaterial]
    background: Optional[BaseBackground]


class HasSubModules:
    """Refers to the system's parts, under the names that threestudio gives them."""

    def configure(
        self, geometry: BaseGeometry, material: BaseMaterial, background: BaseBackground
    ) -> None:
        self.sub_modules = SubModules(geometry, material, background)

    @property
    def geometry(self) -> BaseGeometry:
        return self.sub_modules.geometry

    @property
    def material(self) -> Optional[BaseMaterial]:
        return self.sub_modules.material

    @property
    def background(self) -> Optional[BaseBackground]:
        return self.sub_modules.background


class Rasterizer(HasSubModules, BaseModule):
    """Base class of renderers: ``renderer(**batch)`` returns a dict with ``comp_rgb`` (B,H,W,3),
    ``opacity`` (B,H,W,1), ...
    """

    @dataclass
    class Config(BaseModule.Config):
        radius: float = 1.0

    cfg: Config

    def configure(
        self, geometry: BaseGeometry, material: BaseMaterial, background: BaseBackground
    ) -> None:
        super().configure(geometry, material, background)
        self.register_buffer(
            "bbox", self.cfg.radius * torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
        )


@dataclass
class ExporterOutput:
    """One file to write: the system calls ``save_<save_type>(save_name, **params)``."""

    save_name: str
    save_type: str
    params: dict[str, Any]


class Exporter(HasSubModules, BaseObject):
    """Base class of exporters, which turn the trained parts into a list of files."""

    @dataclass
    class Config(BaseObject.Config):
        save_video: bool = False

    cfg: Config

    def __call__(self, *args: Any, **kwargs: Any) -> list[ExporterOutput]:
        raise NotImplementedError(f"{type(self).__name__}.__call__")


@register("dummy-exporter")
class DummyExporter(Exporter):
    """Write nothing."""

    def __call__(self, *args: Any, **kwargs: Any) -> list[ExporterOutput]:
        return []
