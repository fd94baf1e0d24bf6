"""CUDA kernels, in emulation, each of which is broken in some way."""

from collections.abc import Callable
from typing import NamedTuple

import torch

from tests.helpers.cuda_shim.device import HostDevice
from threestudio_gaussiandreamer.splatting.cuda import proof
from threestudio_gaussiandreamer.splatting.scene import Settings

DEFAULT, HALVED, ABSOLUTE = proof.OPTIONS


def nothing(*_) -> None:
    """Change nothing."""


def other_constants(*arguments, eps2d: float = 0.4) -> None:
    """Change what the kernel alone is given."""
    settings = settings_of(arguments)
    settings.eps2d, settings.alpha_max = eps2d, 0.5


def settings_of(arguments) -> Settings:
    (settings,) = (x for x in arguments if isinstance(x, Settings))
    return settings


def no_antialiasing(*arguments) -> None:
    settings_of(arguments).antialias = 0


def other_constants_if_halved(*arguments) -> None:
    if settings_of(arguments).downsample == 2:
        other_constants(*arguments)


def alpha_for_depth_if_halved(scene, settings, lists, images, contribution) -> None:
    if settings.downsample == 2:
        images[1], images[2] = images[2], images[1]


class Fault(NamedTuple):
    """One kernel that is given other arguments, or whose last tensor is changed after it ran."""

    kernel: str
    before: Callable[..., None] = nothing
    after: Callable[[torch.Tensor], object] = nothing
    draws: tuple[str, ...] = (DEFAULT, HALVED, ABSOLUTE)
    """Which of the comparison's draws show it."""


FAULTS = {
    "project": Fault("project", other_constants),
    "count_tiles": Fault("count_tiles", after=lambda counts: counts.clamp_(max=1)),
    "list_tiles": Fault("list_tiles", after=lambda owners: owners.zero_()),
    "find_tiles": Fault("find_tiles", after=lambda begins: begins[1].copy_(begins[0])),
    "blend": Fault("blend", other_constants),
    "blend_backward": Fault("blend_backward", other_constants, draws=(DEFAULT, HALVED)),
    "blend_backward_absolute": Fault("blend_backward_absolute", other_constants, draws=(ABSOLUTE,)),
    "sum_rows": Fault("sum_rows", after=lambda sums: sums.mul_(1.01)),
    "project_backward": Fault("project_backward", other_constants),
    "sum_cameras": Fault("sum_cameras", after=lambda viewmats: viewmats.mul_(1.01)),
    "project, antialias": Fault("project", no_antialiasing, draws=(HALVED, ABSOLUTE)),
    "project_backward, antialias": Fault(
        "project_backward", no_antialiasing, draws=(HALVED, ABSOLUTE)
    ),
    "blend, downsample": Fault("blend", alpha_for_depth_if_halved, draws=(HALVED, ABSOLUTE)),
    "blend_backward, downsample": Fault(
        "blend_backward", other_constants_if_halved, draws=(HALVED,)
    ),
    "sums of absolute values": Fault(  # the last two columns
        "blend_backward_absolute", after=lambda rows: rows[:, -2:].mul_(2), draws=(ABSOLUTE,)
    ),
}


class BrokenDevice(HostDevice):
    """Has a fault, or raises ``error`` instead."""

    def __init__(self, fault: Fault, error: Exception | None = None) -> None:
        super().__init__()
        self.fault, self.error = fault, error

    def launch(self, name: str, grid: tuple[int, int], threads: int, *arguments) -> None:
        if name != self.fault.kernel:
            super().launch(name, grid, threads, *arguments)
            return
        if self.error is not None:
            raise self.error
        self.fault.before(*arguments)
        super().launch(name, grid, threads, *arguments)
        self.fault.after(arguments[-1])
