"""Base classes of the parts of a system, and the host's own minimal parts."""

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, Tuple

import torch
from torch import Tensor, nn

from .base import BaseModule, BaseObject, register


class BaseGeometry(BaseModule):
    """Base class of geometries: the optimised parameters."""


class BaseMaterial(BaseModule):
    """Base class of materials: features to colours; Gaussians have their own colours."""


@register("no-material")
class NoMaterial(BaseMaterial):
    """Pass colours through a sigmoid."""

    @dataclass
    class Config(BaseMaterial.Config):
        n_output_dims: int = 3

        REMOVED = {"color_activation": ("sigmoid", "it is the sigmoid")}

    cfg: Config
    SECTION = "system.material."

    def forward(self, features: Tensor, **kwargs: Any) -> Tensor:
        return features.sigmoid()


class BaseBackground(BaseModule):
    """Base class of backgrounds: ray directions (B,H,W,3) to colours (B,H,W,C) in [0,1]."""

    @abstractmethod
    def forward(self, dirs: Tensor) -> Tensor:
        raise NotImplementedError(f"{type(self).__name__}.forward")


@register("solid-color-background")
class SolidColorBackground(BaseBackground):
    """One colour for all pixels, fixed or learned."""

    @dataclass
    class Config(BaseBackground.Config):
        n_output_dims: int = 3
        color: Tuple = (1.0, 1.0, 1.0)
        learned: bool = False

        REMOVED = {
            "random_aug": (False, "gaussiandreamer-background has random colours (mode)"),
            "random_aug_prob": (lambda value: True, "see random_aug"),
        }

    cfg: Config

    def configure(self) -> None:
        color = torch.tensor(list(self.cfg.color), dtype=torch.float32)
        if self.cfg.learned:
            self.env_color = nn.Parameter(color)
        else:
            self.register_buffer("env_color", color)

    def forward(self, dirs: Tensor) -> Tensor:
        return self.env_color.to(dirs).expand(*dirs.shape[:-1], self.cfg.n_output_dims)


class HasSubModules:
    """Refers to the system's parts by threestudio's names; in a tuple they aren't registered."""

    def configure(
        self, geometry: BaseGeometry, material: BaseMaterial, background: BaseBackground
    ) -> None:
        self.sub_modules = geometry, material, background

    geometry = property(lambda self: self.sub_modules[0])
    material = property(lambda self: self.sub_modules[1])
    background = property(lambda self: self.sub_modules[2])


class Rasterizer(HasSubModules, BaseModule):
    """Renderers return ``comp_rgb`` (B,H,W,3), ``opacity`` (B,H,W,1), ... in a dict."""

    @dataclass
    class Config(BaseModule.Config):
        radius: float = 1.0

    cfg: Config

    def configure(self, *parts: Any, **named: Any) -> None:
        super().configure(*parts, **named)
        corners = torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])
        self.register_buffer("bbox", self.cfg.radius * corners)


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
