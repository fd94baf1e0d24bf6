"""Guidance ``exact-score-guidance``: the optimal denoiser of a mesh's pictures, in closed form; no
weights, no prompt.

It replaces a diffusion model to measure or demonstrate the pipeline offline, and says nothing about
the quality of a real one. The data are ray-cast pictures of the mesh on the render's own background
(formulas and limits: ``diffusion/exact_score.py``).

==================  ================================================================================
option              meaning
==================  ================================================================================
mesh                path of the mesh, or the bare name of a bundled one; up, front: as in
                    ``meshes.load_mesh``
mode                ``view-exact``: the picture from this very camera (reconstruction: an upper
                    bound, not generation); ``direction-bins``: the bank views on the camera's side
                    (front, side, back, overhead), what view-dependent prompts can know;
                    ``view-agnostic``: all bank views (multi-face without a prior)
space               ``pixel``: sharp, posteriors of one picture; ``latent``: pooling and a colour
                    matrix at unit variance on the bank, where as in a real latent several pictures
                    compete
image_size          height of the pictures that are compared, pixels; 0 = as rendered; the render is
                    resized to it
latent_size         height of the latent in pixels (image_size is a multiple)
bank_*              number of views, their ranges (degrees, world units) and their seed; the bank
                    stands for all views, so the camera's own is one of them, with the weight of
                    any other
supersample         rays per pixel and axis; max_cached_targets: pictures of view-exact kept in
                    memory (4 bytes a pixel)
guidance_scale      1 = none (the default here); otherwise the unconditional mixture is the bank,
                    with this view in it
==================  ================================================================================

A mixture over the bank doesn't depend on the camera's distance either: to measure multi-face alone,
give cameras and bank the same single distance and angle of view."""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Optional, Tuple

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from ..cameras import OrbitRanges, camera_pool
from ..core.errors import UserError
from ..core.options import at_least, count_of, in_range, interval, one_of, require_memory, required
from ..core.tensors import given_gradient
from ..diffusion import sds
from ..diffusion.exact_score import (
    COLOR_MATRIX,
    LinearLatent,
    denoise,
    expanded_distances,
    images_per_chunk,
    squared_distances,
    weighted_sum,
)
from ..host import parse_structured, register
from ..meshes.load import AXES, load_mesh, mesh_file
from ..meshes.raycast import MeshCaster, TargetCache
from ..prompts.view_prompts import direction_indices, view_directions
from ..splatting.cpu import backend as cpu_kernel
from .base import GUIDANCE_SCALE, ScoreDistillation, needs_unconditional, variant_class
from .types import Latents, Residual, Timesteps
from .variants.sds import SDS

MODES = ("view-exact", "direction-bins", "view-agnostic")
SPACES = ("pixel", "latent")
BANK_BYTES = 16
"""Memory per pixel of the bank while it is cast, bytes."""
MAX_MODE_BYTES = 2**31
"""Largest memory of a bank in the space of pixels; over backgrounds of pixels, of each item's."""
BANK_ELEVATIONS = (-10.0, 60.0)
"""Degrees."""
Size = tuple[int, int]
"""Height and width, pixels."""


class MeshTruth:
    """Ray casts a mesh, and caches the pictures of recent cameras.

    Args:
        mesh: casts rays at the mesh.
        supersample: rays per pixel and axis.
        max_cached: largest number of cached pictures, which are stored as uint8.
        prefetch_size: maps a render's size to that of the picture that training needs for it.
    """

    def __init__(
        self,
        mesh: MeshCaster,
        supersample: int,
        max_cached: int,
        prefetch_size: Callable[[int, int], Size],
    ) -> None:
        self.mesh, self._prefetch_size = mesh, prefetch_size
        self.pictures = TargetCache(mesh, supersample, max_cached)

    @torch.no_grad()
    def render(
        self,
        batch: dict[str, Any],
        background: Optional[Tensor] = None,
        *,
        size: Optional[Size] = None,
    ) -> Float[Tensor, "B H W 3"]:
        """Render the ground truth from the views of a batch.

        Args:
            batch: has ``c2w``, ``fovy``, ``height`` and ``width``.
            background: (B, 1, 1, 3) or (B, H, W, 3); None for black.
            size: (height, width) of the pictures, pixels; None for the batch's size.
        """
        height, width = size or (batch["height"], batch["width"])
        rgba = self.pictures(batch["c2w"], batch["fovy"], height, width)
        background = background_of(background, len(rgba), rgba.device)
        return composite(rgba, background).movedim(1, -1)

    @torch.no_grad()
    def prefetch(
        self, c2w: Float[Tensor, "V 4 4"], fovy: Float[Tensor, " V"], height: int, width: int
    ) -> None:
        """Plan to cast these views, which training will need, at once, if the cache holds all."""
        if len(c2w) <= self.pictures.capacity:
            self.pictures.plan(c2w, fovy, *self._prefetch_size(height, width))


def background_of(
    background: Optional[Tensor], batch: int, device: torch.device
) -> Float[Tensor, "B bh bw 3"]:
    """Return the background of the renders, detached, or black if it is None."""
    if background is None:
        return torch.zeros(batch, 1, 1, 3, device=device)
    return background.detach().float().expand(batch, -1, -1, -1)


def composite(
    rgba: UInt8[Tensor, "B H W 4"], background: Float[Tensor, "#B bh bw 3"]
) -> Float[Tensor, "B 3 H W"]:
    """Composite premultiplied pictures over the background, which is resized to their size."""
    background = background.movedim(-1, 1)
    if background.shape[-2:] != (1, 1):
        background = resized(background, tuple(rgba.shape[1:3]))
    rgba = rgba.movedim(-1, 1).contiguous().to(background).div_(255)
    return ((1 - rgba[:, 3:]) * background).add_(rgba[:, :3])


def resized(images: Float[Tensor, "B c H W"], size: tuple[int, int]) -> Float[Tensor, "B c h w"]:
    """Resize images: average blocks if the sizes divide evenly, else bilinear with antialiasing."""
    height, width = images.shape[-2:]
    if (height, width) == size:
        return images
    if height % size[0] == 0 and width % size[1] == 0:
        return F.avg_pool2d(images, (height // size[0], width // size[1]))
    return F.interpolate(images, size, mode="bilinear", align_corners=False, antialias=True)


class Pictures(NamedTuple):
    """Encoded pictures, each a linear combination of its layers: channel c of picture k is
    ``sum_l mixing[c, l] layers[k, l]``. Over a colour, the layers are the picture over black and
    the share of the colour in each pixel: a bank needn't be composited on the colour of each item.
    """

    layers: Float[Tensor, "K l h w"]
    products: Float[Tensor, "K l l"]
    """Scalar products of each picture's layers, float64."""

    @staticmethod
    def of(layers: Float[Tensor, "K l h w"]) -> "Pictures":
        wide = [part.double() for part in _chunks(layers)]
        return Pictures(layers, torch.cat([part @ part.mT for part in wide]))


class Bank(NamedTuple):
    """Pictures of the mesh from random views around it, at one size."""

    rgba: UInt8[Tensor, "K H W 4"]
    """Premultiplied."""
    pictures: Pictures
    """Over a colour."""
    latent: LinearLatent

    @staticmethod
    def of(
        rgba: UInt8[Tensor, "K H W 4"], pooled: Float[Tensor, "K 4 h w"], latent: LinearLatent
    ) -> "Bank":
        """Encode pictures, which ``pooled`` has as averages over the latent's pixels, in [0, 1]."""
        # pooling and compositing commute
        layers = torch.cat([latent.encode_pooled(pooled[:, :3]), 1 - pooled[:, 3:]], dim=1)
        return Bank(rgba, Pictures.of(layers), latent)


class Mixture(NamedTuple):
    """The modes of one item's mixture distribution: the view of its camera, and pictures."""

    own: Float[Tensor, "c h w"]
    """The view of the camera, encoded; the first mode."""
    pictures: Optional[Pictures] = None
    mixing: Optional[Float[Tensor, "c l"]] = None
    """Of the pictures' layers."""
    log_prior: Optional[Float[Tensor, " K"]] = None
    """0 for the modes of the conditional mixture, -inf for others."""


def scores(
    z: Float[Tensor, "B d"], abar: Float[Tensor, " B"], mixtures: list[Mixture]
) -> tuple[Float[Tensor, "B d"], Float[Tensor, " B"], Callable[[], Float[Tensor, "B d"]]]:
    """Return the conditional prediction of the noise in z, the perplexity of its responsibilities,
    and what computes the unconditional prediction, for mixtures that have the same pictures.
    """
    own = torch.stack([mixture.own for mixture in mixtures]).flatten(1)
    pictures = mixtures[0].pictures
    if pictures is None:  # the responsibility of a single mode is 1 at any distance
        distances = z.new_zeros((len(z), 1), dtype=torch.float64)
        mean_of, log_prior = own.mul, None
    else:
        mixing = torch.stack([mixture.mixing for mixture in mixtures])
        log_prior = torch.stack([mixture.log_prior for mixture in mixtures])
        wide, double = z.double(), mixing.double()
        of_layers = (double.mT @ wide.unflatten(1, (mixing.shape[1], -1))).flatten(1)
        parts = [of_layers @ part.flatten(1).double().mT for part in _chunks(pictures.layers)]
        norms = torch.einsum("bcl,klm,bcm->bk", double, pictures.products, double)
        of_pictures = expanded_distances(wide, abar, norms, torch.cat(parts, dim=1))
        distances = torch.cat([squared_distances(z, own[:, None], abar), of_pictures], dim=1)

        def mean_of(weights: Float[Tensor, "B K"]) -> Float[Tensor, "B d"]:
            layers = weighted_sum(weights[:, 1:], pictures.layers.flatten(1))
            found = mixing.to(layers) @ layers.unflatten(1, (mixing.shape[2], -1))
            return weights[:, :1] * own + found.flatten(1)

    eps, perplexity = denoise(z, abar, distances, mean_of, log_prior)
    return eps, perplexity, lambda: denoise(z, abar, distances, mean_of)[0]


def mixture_of(
    own: Float[Tensor, "c h w"],
    members: Bool[Tensor, " K"],
    background: Float[Tensor, "bh bw 3"],
    bank: Bank,
    whole: bool,
) -> Mixture:
    """Return a mixture whose conditional modes are the camera's view and ``members`` of a bank.

    Args:
        background: what the bank is composited on: one colour (1, 1, 3) or pixels (H', W', 3).
        whole: whether the unconditional mixture, the whole bank, is needed too.
    """
    if background.shape[:2] == (1, 1):
        pictures, mixing = bank.pictures, _mixing_of_color(bank.latent, background)
    else:
        rows = torch.arange(len(members)) if whole else members.nonzero().flatten()
        members = members[rows]
        chunks = rows.to(bank.rgba.device).split(
            images_per_chunk(bank.rgba[0].numel(), rows.device)
        )
        rgba = (bank.rgba.index_select(0, some) for some in chunks)
        latents = [bank.latent.encode(composite(some, background[None])) for some in rgba]
        pictures = Pictures.of(torch.cat(latents))
        mixing = torch.eye(pictures.layers.shape[1], device=background.device)
    conditional = torch.cat([torch.ones(1, dtype=torch.bool), members])
    log_prior = torch.where(conditional, 0.0, -torch.inf).to(background.device)
    return Mixture(own, pictures, mixing, log_prior)


def _mixing_of_color(latent: LinearLatent, color: Float[Tensor, "1 1 3"]) -> Float[Tensor, "c l"]:
    """Return how a colour is added to a picture over black: by its difference to black."""
    color = color.reshape(1, 3, 1, 1)
    tint = (latent.encode_pooled(color) - latent.encode_pooled(torch.zeros_like(color)))[0, :, :, 0]
    return torch.cat([torch.eye(len(tint), device=tint.device), tint], dim=1)


def _chunks(layers: Float[Tensor, "K l h w"]) -> tuple[Float[Tensor, "k l p"], ...]:
    return layers.flatten(2).split(images_per_chunk(layers[:1].numel(), layers.device))


@register("exact-score-guidance")
class ExactScoreGuidance(ScoreDistillation):
    @dataclass
    class Config(ScoreDistillation.Config):
        guidance_scale: float = field(default=1.0, metadata=GUIDANCE_SCALE)
        mesh: str = field(default="", metadata=required("give the mesh that is the truth"))
        up: str = field(default="auto", metadata=one_of(("auto", *AXES)))
        front: Optional[str] = field(default=None, metadata=one_of(AXES))
        mode: str = field(default="view-exact", metadata=one_of(MODES))
        space: str = field(default="pixel", metadata=one_of(SPACES))
        image_size: int = field(default=0, metadata=in_range(0, 16_384, "pixels"))
        latent_size: int = field(default=32, metadata=in_range(1, 4096, "pixels"))
        bank_views: int = field(default=200, metadata=count_of("views", 1, 4096))
        bank_seed: int = 0
        bank_distance_range: Tuple[float, float] = field(
            default=(1.5, 4.0), metadata=interval(1e-6, 1e6, "world units")
        )
        bank_fovy_range: Tuple[float, float] = field(
            default=(40.0, 70.0), metadata=interval(1e-3, 179.999, "degrees")
        )
        supersample: int = field(default=2, metadata=in_range(1, 64, "rays a pixel each way"))
        max_cached_targets: int = field(default=512, metadata=at_least(1))

        REMOVED = {
            **ScoreDistillation.Config.REMOVED,
            "latent_channels": (4, "a latent has 4"),
            "color_matrix": (True, "a latent has 4 mixed channels"),
            "temperature": (1.0, "the responsibilities are exact"),
            "scale": (1.0, "the mesh's longest side has 2 world units"),
            "bank_elevation_range": ([*BANK_ELEVATIONS], "it is [-10, 60]"),
            "std": (0.0, "each mode is one picture, without width"),
            "bank_includes_view": (True, "the bank includes the camera's own view"),
        }

        @staticmethod
        def check(cfg: Any) -> None:
            ScoreDistillation.Config.check(cfg)
            size, views = cfg.image_size, cfg.bank_views
            what = f"{views} pictures of {size} x {size} pixels"
            require_memory("image_size", BANK_BYTES * views * size**2, what)
            if cfg.space == "latent" and size:
                pooling_factor(size, size, cfg.latent_size)

        @staticmethod
        def check_render_size(cfg: Any, height: int, width: int) -> None:
            """Check that renders of this size can be compared, see :func:`picture_size`."""
            picture_size(cfg, needs_unconditional(cfg, variant_class(cfg)), height, width)

    cfg: Config
    REPORTS = ("perplexity",)
    KNOWS_TRUTH = True

    def configure(self) -> None:
        super().configure()
        cfg = self.cfg
        mesh = MeshCaster(load_mesh(cfg.mesh, up=cfg.up, front=cfg.front))
        self.truth = MeshTruth(mesh, cfg.supersample, cfg.max_cached_targets, self._picture_size)
        self._bank: Optional[Bank] = None
        self._size: Optional[tuple[int, int]] = None
        self._perplexity = 1.0
        ranges = OrbitRanges(
            BANK_ELEVATIONS, (-180.0, 180.0), cfg.bank_distance_range, cfg.bank_fovy_range
        )
        self.bank_orbit = camera_pool(cfg.bank_views, ranges, cfg.bank_seed, "bank")

    @classmethod
    def preflight(cls, cfg: Any) -> None:
        super().preflight(cfg)
        mesh_file(parse_structured(cls.Config, cfg).mesh)

    @classmethod
    def is_text_guided(cls, cfg: Any) -> bool:
        return cfg.mode != "view-agnostic"

    def __call__(
        self, rgb: Float[Tensor, "B H W c"], prompt_utils: Any = None, **options: Any
    ) -> dict[str, Any]:
        """See :meth:`ScoreDistillation.__call__`; one pass over the pixels where there can be."""
        found = self._in_one_pass(rgb.detach(), **options)
        if found is None:
            return super().__call__(rgb, prompt_utils, **options)
        gradient, squares, error = found
        self.evaluations, self._perplexity = 0, 1.0
        self.bad_steps.clear()
        loss = given_gradient(rgb, gradient, 0.5 * squares.sum().float() / max(len(rgb), 1))
        result = self._result(loss, squares.sqrt().float(), torch.zeros(()))
        return result | {"error_to_truth": error}

    @torch.no_grad()
    def _in_one_pass(
        self,
        rgb: Float[Tensor, "B H W c"],
        *,
        c2w: Tensor,
        fovy: Tensor,
        comp_rgb_bg: Optional[Tensor] = None,
        rgb_as_latents: bool = False,
        guidance_eval: bool = False,
        **batch: Any,
    ) -> Optional[tuple[Float[Tensor, "B H W 3"], Float[Tensor, " B"], float]]:
        """Return the gradient of the renders, the sum of the squares of the latents' per item, and
        the mean squared error of the renders, where the score is that of one picture per item, of
        the render's pixels, and nothing but its weight is applied to it; else, or if values aren't
        finite, None.
        """
        if rgb_as_latents:
            raise UserError("exact-score compares pictures: it can't take rgb_as_latents")
        cfg, size = self.cfg, tuple(rgb.shape[1:3])
        background = background_of(comp_rgb_bg, len(rgb), rgb.device)
        is_one_picture = (
            (cfg.mode, cfg.space, type(self.variant)) == ("view-exact", "pixel", SDS)
            and self._picture_size(*size) == size
            and background.shape[1:3] == (1, 1)
            and self.grad_clip is None
            and not (self.needs_unconditional or guidance_eval)
        )
        if not is_one_picture or rgb.device.type != "cpu" or cpu_kernel.unavailable():
            return None
        self._size = size
        pictures = self.truth.pictures.planes(c2w, fovy, *size)
        _, abar = self.draw_timesteps(rgb)
        weight = sds.WEIGHTS[self.cfg.weighting_strategy](abar).float()
        background, scale = background[:, 0, 0].contiguous(), (abar / (1 - abar)).sqrt().float()
        found = cpu_kernel.known_gradient(rgb, pictures, background, scale, weight)
        # the latents' gradient is 2 weight scale (render - picture); plain numbers are faster
        squares = [] if found is None else found[1].tolist()
        if not squares or not math.isfinite(sum(squares)):
            return None
        factors = zip(squares, weight.tolist(), scale.tolist(), strict=True)
        return *found, sum(square / (2 * w * s) ** 2 for square, w, s in factors) / rgb.numel()

    def encode(self, rgb: Float[Tensor, "B 3 H W"], **batch: Any) -> Latents:
        self._size = self._picture_size(*rgb.shape[-2:])
        return self._latent().encode(resized(rgb, self._size))

    def decode(self, latents: Latents) -> Float[Tensor, "B 3 H W"]:
        return self._latent().decode(latents)

    def condition(
        self,
        prompt_utils: Any = None,
        *,
        comp_rgb_bg: Optional[Tensor] = None,
        c2w: Tensor,
        fovy: Tensor,
        **batch: Any,
    ) -> list[Mixture]:
        """Return the mixture of each item, for pictures of the size that ``encode`` has set."""
        background = background_of(comp_rgb_bg, len(c2w), c2w.device)
        rgba = self.truth.pictures(c2w, fovy, *self._size)
        own = self._latent().encode(composite(rgba, background))
        members = self._members(batch, len(c2w))
        if not self.needs_unconditional and not members.any():
            return [Mixture(view) for view in own]
        bank = self.bank(*self._size)
        items = zip(own, members, background, strict=True)
        return [mixture_of(*item, bank, self.needs_unconditional) for item in items]

    def predict(
        self, z: Latents, t: Timesteps, condition: list[Mixture]
    ) -> tuple[Latents, Optional[Latents]]:
        by_pictures = itertools.groupby(condition, lambda mixture: id(mixture.pictures))
        groups = [list(group) for _, group in by_pictures]
        parts = (values.split([*map(len, groups)]) for values in (z.flatten(1), self.abar_of(t)))
        found = [scores(*part) for part in zip(*parts, groups, strict=True)]
        conditional, perplexities, unconditional = zip(*found, strict=True)
        self._perplexity = float(torch.cat(perplexities).mean())
        self.evaluations += len(z) * (2 if self.needs_unconditional else 1)
        uncond = None
        if self.needs_unconditional:
            uncond = torch.cat([predict() for predict in unconditional]).view_as(z)
        return torch.cat(conditional).view_as(z), uncond

    def conditional(self, z: Latents, t: Timesteps, condition: list[Mixture]) -> Latents:
        self.evaluations -= len(z) * self.needs_unconditional  # one counts as of a network
        return super().conditional(z, t, condition)

    def unconditional(self, z: Latents, t: Timesteps, condition: list[Mixture]) -> Latents:
        self.evaluations -= len(z) * self.needs_unconditional
        return super().unconditional(z, t, condition)

    def known_residual(self, latents: Latents, condition: list[Mixture]) -> Optional[Residual]:
        """Return sqrt(abar / (1 - abar)) (x - x_1) of one picture each, where the noise cancels."""
        if any(mixture.pictures is not None for mixture in condition):
            return None
        _, abar = self.draw_timesteps(latents)
        self._perplexity = 1.0
        difference = latents - torch.stack([mixture.own for mixture in condition])
        return difference.mul_(sds.per_item((abar / (1 - abar)).sqrt(), difference)), abar

    def report(self) -> dict[str, float]:
        """Return the perplexity of the responsibilities, the effective number of modes."""
        return {"perplexity": self._perplexity}

    def _members(self, batch: dict[str, Any], count: int) -> Bool[Tensor, "B K"]:
        """Return a mask of the bank's views in the conditional mixture of each item."""
        mode, views = self.cfg.mode, self.cfg.bank_views
        if mode != "direction-bins":
            return torch.full((count, views), mode == "view-agnostic")
        orbit, directions = self.bank_orbit, view_directions()
        bank = direction_indices(directions, orbit.elevation, orbit.azimuth, orbit.azimuth)
        angles = batch["elevation"].cpu(), batch["azimuth"].cpu()
        members = bank == direction_indices(directions, *angles, angles[1])[:, None]
        # if no view of the bank has this direction, as overhead below 60 degrees, take all
        return torch.where(members.any(dim=1, keepdim=True), members, torch.ones_like(members))

    def bank(self, height: int, width: int) -> Bank:
        """Return the bank at a picture size, in pixels; the bank of the last size is cached."""
        if self._bank and self._bank.rgba.shape[1:3] == (height, width):
            return self._bank
        cameras = zip(self.bank_orbit.c2w.numpy(), self.bank_orbit.fovy.tolist(), strict=True)
        images = self.truth.mesh.render_views(
            cameras, height, width, supersample=self.cfg.supersample, progress="bank of views"
        )
        images = torch.from_numpy(images).to(self.device)
        pooled, latent = images.movedim(-1, 1), LinearLatent()
        if self.cfg.space == "latent":
            factor = pooling_factor(height, width, self.cfg.latent_size)
            pooled = F.avg_pool2d(pooled, factor)
            latent = LinearLatent(factor, COLOR_MATRIX).normalised(pooled[:, :3])
        self._bank = Bank.of((images * 255).round().byte(), pooled, latent)
        return self._bank

    def _latent(self) -> LinearLatent:
        return LinearLatent() if self.cfg.space == "pixel" else self.bank(*self._size).latent

    def _picture_size(self, height: int, width: int) -> tuple[int, int]:
        """Return the size of the compared pictures for a render of this size."""
        return picture_size(self.cfg, self.needs_unconditional, height, width)


def picture_size(cfg: Any, unconditional: bool, height: int, width: int) -> tuple[int, int]:
    """Return the size of the compared pictures for a render of this size: ``image_size`` high, with
    the render's aspect. Raise UserError if a bank of them, which the ``unconditional`` prediction
    needs too, is too large for the memory, or they can't be pooled to the latent.
    """
    size = cfg.image_size
    height, width = (size, max(1, round(width * size / height))) if size else (height, width)
    if cfg.space == "latent":
        pooling_factor(height, width, cfg.latent_size)
        return height, width
    needed = 12 * cfg.bank_views * height * width
    if (cfg.mode != "view-exact" or unconditional) and needed > MAX_MODE_BYTES:
        raise UserError(
            f"a bank of {cfg.bank_views} views of {height}x{width} pixels needs "
            f"up to {needed / 2**30:.1f} GiB for each item:"
            " use system.guidance.space=latent, or a smaller system.guidance.image_size"
        )
    return height, width


def pooling_factor(height: int, width: int, latent_size: int) -> int:
    """Return the pixels each way of a latent pixel; raise UserError if that is no whole number."""
    factor = height // latent_size
    if factor * latent_size != height or width % max(factor, 1):
        raise UserError(
            f"pictures of {height}x{width} can't be pooled to a latent {latent_size} high: give a "
            "system.guidance.image_size that is a multiple of system.guidance.latent_size"
        )
    return factor
