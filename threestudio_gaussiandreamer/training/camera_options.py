"""The options of the data module; ``data.py`` describes them."""

from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, ClassVar, List, Tuple

from ..core.errors import UserError
from ..core.memory import count_of, require_memory
from ..core.options import Rule, at_least, in_range, interval, is_list, is_whole, satisfies

MAX_SIDE = 16_384
"""Pixels of a picture each way."""
WORLD = (1e-6, 1e6)
"""Distances of cameras and lights, world units: float32 keeps places to some digits in it."""
FOVY = (1e-3, 179.999)
LISTED = ("height", "width", "batch_size")
TRAIN_BYTES, EVAL_BYTES, CAMERA_BYTES = 64, 32, 256
"""What a pixel of a training view, a pixel of an evaluated view, and a camera take at least."""
ELEVATIONS = interval(-90, 90, "degrees")
AZIMUTHS = interval(-36_000, 36_000, "degrees")
DISTANCES, LIGHT_DISTANCES = interval(*WORLD, "world units"), interval(0, WORLD[1], "world units")
FOVYS = interval(*FOVY, "degrees")
LENGTH = in_range(0, WORLD[1], "world units")
ONE_VIEW = satisfies("1: views are evaluated one at a time", lambda count: count == 1)


def whole_numbers(high: int) -> Rule:
    """Return the rule for whole numbers from 1 to ``high``, or lists of such."""

    def holds(value: Any) -> bool:
        values = value if is_list(value) else [value]
        return len(values) > 0 and all(is_whole(v) and 1 <= v <= high for v in values)

    return satisfies(f"whole numbers from 1 to {high}", holds)


SIDE, BATCH = whole_numbers(MAX_SIDE), whole_numbers(4096)


@dataclass
class CameraConfig:
    height: Any = field(default=64, metadata=SIDE)
    width: Any = field(default=64, metadata=SIDE)
    batch_size: Any = field(default=1, metadata=BATCH)
    resolution_milestones: List[int] = field(default_factory=list)
    eval_height: int = field(default=512, metadata=in_range(1, MAX_SIDE, "pixels"))
    eval_width: int = field(default=512, metadata=in_range(1, MAX_SIDE, "pixels"))
    eval_batch_size: int = field(default=1, metadata=ONE_VIEW)
    n_val_views: int = field(default=1, metadata=count_of("views", 1, CAMERA_BYTES))
    n_test_views: int = field(default=120, metadata=count_of("views", 1, CAMERA_BYTES))
    elevation_range: Tuple[float, float] = field(default=(-10, 60), metadata=ELEVATIONS)
    azimuth_range: Tuple[float, float] = field(default=(-180, 180), metadata=AZIMUTHS)
    camera_distance_range: Tuple[float, float] = field(default=(1.5, 4.0), metadata=DISTANCES)
    fovy_range: Tuple[float, float] = field(default=(40, 70), metadata=FOVYS)
    camera_perturb: float = field(default=0.0, metadata=LENGTH)
    center_perturb: float = field(default=0.0, metadata=LENGTH)
    up_perturb: float = field(default=0.0, metadata=LENGTH)
    light_position_perturb: float = field(default=1.0, metadata=LENGTH)
    light_distance_range: Tuple[float, float] = field(default=(0.8, 1.5), metadata=LIGHT_DISTANCES)
    eval_elevation_deg: float = field(default=15.0, metadata=in_range(-90, 90, "degrees"))
    eval_camera_distance: float = field(default=4.0, metadata=in_range(*WORLD, "world units"))
    eval_fovy_deg: float = field(default=70.0, metadata=in_range(*FOVY, "degrees"))
    batch_uniform_azimuth: bool = True
    progressive_until: int = field(default=0, metadata=at_least(0, "steps"))
    rays_d_normalize: bool = True
    train_views: int = field(default=0, metadata=count_of("views", 0, CAMERA_BYTES))
    rays: bool = False
    n_view: int = field(default=1, metadata=in_range(1, 64, "views"))

    REMOVED: ClassVar[dict[str, Any]] = {"hold_steps": (1, "each step has its own cameras")}

    @staticmethod
    def check(cfg: Any) -> None:
        """Raise UserError where options don't fit each other, or the pictures the memory."""
        milestones, listed = list(cfg.resolution_milestones), False
        if any(later <= earlier for earlier, later in pairwise([0, *milestones])):
            raise UserError(
                f"resolution_milestones: expected increasing steps above 0, got {milestones}"
            )
        for name in LISTED:
            count = len(values) if is_list(values := getattr(cfg, name)) else 1
            listed |= count > 1
            if count not in (1, len(milestones) + 1):
                raise UserError(
                    f"{name}: {count} entries need {count - 1} resolution_milestones, the steps at "
                    f"which the next entry applies, got {len(milestones)}"
                )
        if milestones and not listed:
            needed = f"{len(milestones) + 1} entries"
            raise UserError(f"resolution_milestones: give height, width or batch_size {needed}")
        if cfg.n_view > 1 and cfg.train_views:
            raise UserError("train_views: a fixed pool of views has no groups: set n_view=1")
        if cfg.progressive_until and cfg.train_views:
            raise UserError(
                "progressive_until: the angles of a fixed pool of views don't widen: set "
                "train_views=0"
            )
        for height, width, batch in sizes_of_stages(cfg):
            if batch % cfg.n_view:
                expected = f"expected multiples of n_view={cfg.n_view}"
                raise UserError(f"batch_size: {expected}, got {batch}")
            what = f"{batch} views of {height} x {width} pixels"
            require_memory("batch_size", TRAIN_BYTES * height * width * batch, what)
        what = f"pictures of {cfg.eval_height} x {cfg.eval_width} pixels"
        require_memory("eval_height", EVAL_BYTES * cfg.eval_height * cfg.eval_width, what)


def sizes_of_stages(cfg: Any) -> list[tuple[int, int, int]]:
    """Return height, width and number of the views in a step of each stage."""
    stages = range(len(cfg.resolution_milestones) + 1)
    sizes = [v if is_list(v) else [v] for v in (cfg.height, cfg.width, cfg.batch_size)]
    return [tuple(values[min(i, len(values) - 1)] for values in sizes) for i in stages]
