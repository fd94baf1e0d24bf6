"""The base class of 3D priors, which map a prompt to a validated, coloured point cloud, with an
optional layer of ground below it.

===============  ===================================================================================
option           meaning (all priors have these)
===============  ===================================================================================
ground           add the paper's layer of randomly coloured points below the object; the object
                 grows first (Algorithm 1), as if there were no ground
ground_points    how many
ground_size      side of the square they fill, in units of the longest side of the object's box
===============  ===================================================================================

Each prior is a registered subclass of :class:`Prior` that implements :meth:`~Prior.generate`."""

import logging
from abc import abstractmethod
from dataclasses import dataclass, field
from typing import Any, ClassVar, NoReturn, Optional

import numpy as np
from jaxtyping import Float
from torch import Tensor

from ..core.errors import UserError
from ..core.options import (
    Rule,
    count_of,
    is_numbers,
    one_of,
    positive,
    require_defaults,
    required,
    satisfies,
)
from ..core.streams import numpy_generator
from ..formats.producers import PRODUCERS, producer_axes
from ..gaussians.point_cloud import PointCloud
from ..host import BaseObject, run_seed
from ..host.methods import require_method
from ..meshes.mesh import GREY, MAX_NON_FINITE
from ..prompts.prompt_processors import resolve_prompt

logger = logging.getLogger(__name__)

POINT_BYTES = 128
"""Memory per point, bytes, at least: position, colour and the parameters of its Gaussian."""


def points(low: int) -> Rule:
    """Return the rule for a number of points: ``low`` or more, and few enough for the memory."""
    return count_of("points", low, POINT_BYTES)


COLOR = satisfies(
    "null, 'grey', 'random' or [red, green, blue] in [0, 1]",
    lambda v: v in (None, "grey", "random") or is_numbers(v, 3) and all(0 <= x <= 1 for x in v),
)
SCALE = positive("world units", most=1e6)


def preflight_prior(prior: Any, keep_attributes: bool, prompt: str = "") -> None:
    """Check within seconds that a prior can run, with this prompt if it is known, and, if
    ``keep_attributes``, that every attribute of its Gaussians can be taken; other hosts' priors
    have no check. Raise UserError if not.
    """
    if hasattr(prior, "preflight"):
        require_method(type(prior), "preflight")
        prior.preflight()
    if keep_attributes and hasattr(prior, "preflight_attributes"):
        prior.preflight_attributes()
    if prompt and hasattr(prior, "preflight_prompt"):
        prior.preflight_prompt(resolve_prompt(prompt))


class Prior(BaseObject):
    """Base class of priors. ``prior(prompt)`` returns the initial points, which depend only on the
    options, the prompt and the seed.
    """

    @dataclass
    class Config(BaseObject.Config):
        ground: bool = False
        ground_points: int = field(default=20_000, metadata=points(1))
        ground_size: float = field(default=1.5, metadata=positive())
        REMOVED: ClassVar[dict[str, Any]] = {
            "ground_height": ("auto", "the ground is at the bottom of the object")
        }

    cfg: Config

    def configure(self) -> None:
        cls = type(self)
        if cls.__call__ is Prior.__call__:
            require_method(cls, "generate", "prompt", "generator")

    def preflight(self) -> None:
        """Check within seconds that ``generate`` can run; called before any long work.

        Raises:
            UserError: a requirement, such as a file, is missing; the message says what to do.
        """

    def __call__(self, prompt: str) -> PointCloud:
        """Return the points for ``prompt``: float32, finite, colours in [0, 1], z up, +x the front.

        Raises:
            UserError: the source is missing, unreadable, empty, or more than 5 % of it not finite.
        """
        cloud = self.generate(prompt, numpy_generator(run_seed(), "prior"))
        cloud = validated(cloud, type(self).__name__)
        if not self.cfg.ground:
            return cloud
        ground = ground_layer(cloud, self.cfg, numpy_generator(run_seed(), "ground"))
        return cloud.followed_by(ground)

    def ground_count(self) -> int:
        """Return the number of ground points, which are last in the cloud and aren't grown."""
        return int(self.cfg.ground_points) if self.cfg.ground else 0

    @abstractmethod
    def generate(self, prompt: str, generator: np.random.Generator) -> PointCloud:
        """Return the object's points; :meth:`__call__` validates them.

        Args:
            generator: the only source of randomness.
        """


class FilePrior(Prior):
    """Base class of priors that read a file, in axes that options or its producer name."""

    @dataclass
    class Config(Prior.Config):
        path: str = field(default="", metadata=required("this prior reads a file; set path to it"))
        up: str = "auto"
        producer: Optional[str] = field(default=None, metadata=one_of(PRODUCERS))
        scale: float = field(default=1.0, metadata=SCALE)

        @staticmethod
        def check(cfg: Any) -> None:
            if cfg.producer and (cfg.up != "auto" or getattr(cfg, "front", None)):
                said = "it says which axes the file has; give it, or up and front"
                raise UserError(f"producer: {said}")
            if getattr(cfg, "normalize", True) is None and not cfg.producer:
                unused = "without normalize or producer"
                require_defaults(FilePrior.Config, cfg, ("scale",), unused)

    cfg: Config

    @property
    def normalizes(self) -> bool:
        """Whether points are centred and scaled: ``normalize``, by default with a producer."""
        given = self.cfg.normalize
        return bool(self.cfg.producer) if given is None else given


def file_axes(cfg: Any, kind: str) -> tuple[str, Optional[str]]:
    """Return the file's axes that are up and the front, by the options or the producer, which must
    write files of this ``kind``.
    """
    return producer_axes(cfg.producer, kind) if cfg.producer else (cfg.up, cfg.front)


def chosen_colors(color: Any, count: int, rng: np.random.Generator) -> Float[np.ndarray, "P 3"]:
    """Return ``count`` colours, by an option of the rule ``COLOR``; null is grey."""
    if color == "random":
        return rng.random((count, 3), np.float32)
    same = [GREY] * 3 if color in (None, "grey") else list(color)
    return np.tile(np.float32(same), (count, 1))


def points_of(prior: Any, prompt: str) -> PointCloud:
    """Return ``prior(prompt)``, validated if the prior is another host's."""
    cloud = prior(prompt)
    return cloud if isinstance(prior, Prior) else validated(cloud, type(prior).__name__)


def validated(cloud: PointCloud, name: str) -> PointCloud:
    """Return ``cloud`` as float32 without rows that aren't finite, its colours clipped to [0, 1].

    Raises:
        UserError: it is empty or no PointCloud of arrays (P, 3) with faces among the points, more
            than 5 % of the rows are not finite, or most colours are far outside [0, 1].
    """

    def refuse(problem: str) -> NoReturn:
        raise UserError(f"{name} gave {problem}")

    if not isinstance(cloud, PointCloud):
        refuse(f"{type(cloud).__name__}; expected a PointCloud")
    try:
        points, colors = _as_array(cloud.points), _as_array(cloud.colors)
        normals = None if cloud.normals is None else _as_array(cloud.normals)
        faces = None if cloud.faces is None else _as_array(cloud.faces, None)
    except (TypeError, ValueError, RuntimeError) as error:
        refuse(f"something else than arrays: {error}")
    given = {"points": points, "colours": colors, "normals": normals}
    shapes = {kind: values.shape for kind, values in given.items() if values is not None}
    if points.ndim != 2 or set(shapes.values()) != {(len(points), 3)}:
        found = ", ".join(f"{kind} {shape}" for kind, shape in shapes.items())
        refuse(f"{found}; expected (P, 3) for all")
    if not len(points):
        refuse("no points: its source is empty")
    if faces is not None:
        faces = faces if faces.size else np.zeros((0, 3), np.int64)
        whole = faces.ndim == 2 and faces.shape[1] == 3 and faces.dtype.kind in "iu"
        if not whole or not ((faces >= 0) & (faces < len(points))).all():
            found = f"faces {faces.shape} of type {faces.dtype}"
            refuse(f"{found}; expected integers (F, 3) from 0 to {len(points) - 1}")
    finite = np.isfinite(points).all(axis=1) & np.isfinite(colors).all(axis=1)
    outside = (colors[finite] < -0.25) | (colors[finite] > 2)  # a model's may be slightly outside
    if finite.any() and outside.any(axis=1).mean() > 0.5:
        low, high = colors[finite].min(), colors[finite].max()
        refuse(f"colours from {low:g} to {high:g}; expected [0, 1]")
    if not finite.all():
        report_non_finite(int((~finite).sum()), len(points), name)
        if faces is not None:  # those all of whose corners are kept
            faces = (np.cumsum(finite) - 1)[faces[finite[faces].all(axis=1)]]
    if normals is not None:
        normals = np.nan_to_num(normals[finite])
    return PointCloud(points[finite], colors[finite].clip(0.0, 1.0), normals, faces)


def _as_array(values: Any, dtype: Any = np.float32) -> Float[np.ndarray, "..."]:
    if isinstance(values, Tensor):
        values = values.detach().float().cpu() if dtype else values.detach().cpu()
    return np.asarray(values, dtype)


def report_non_finite(bad: int, count: int, name: str) -> None:
    """Log that rows are dropped, or raise UserError if there are too many of them."""
    if bad > MAX_NON_FINITE * count:
        raise UserError(
            f"{bad} of the {count} points of {name} are NaN or infinite (at most 5 % may be): "
            "check the source"
        )
    logger.warning("%s: dropped %d of %d points that are NaN or infinite", name, bad, count)


def ground_layer(cloud: PointCloud, cfg: Any, generator: np.random.Generator) -> PointCloud:
    """Return a square of randomly coloured points, centred below ``cloud`` (paper, appendix)."""
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    side = cfg.ground_size * ((high - low).max() or 1.0)
    places = generator.uniform(-0.5, 0.5, (cfg.ground_points, 3)) * [side, side, 0.0]
    points = (low + high) / 2 + places
    points[:, 2] = low[2]
    colors = chosen_colors("random", len(points), generator)
    return PointCloud(points, colors, normals=np.tile(np.float32([0, 0, 1]), (len(points), 1)))
