"""``point-e-prior``: 4096 coloured points by OpenAI's Point-E, the paper's second text-to-3D model.

==================  ================================================================================
option              meaning
==================  ================================================================================
checkpoint          ``base_40m_textvec.pt`` as OpenAI publishes it, or Cap3D's
                    ``pointE_finetuned_with_330kdata.pth``; or ``toybox``, the bundled one
upsampler           ``upsample_40m.pt``; null: only the coarse points, without upsampling
clip                OpenAI's CLIP ViT-L/14 in transformers' format, a folder or an id of the hub; or
                    ``toybox``
prompt              replaces the run's prompt for Point-E
guidance_scale      of the coarse points; 1 = none, 3 in the published sampler. The upsampler isn't
                    guided
num_points          number of coarse points; 1024
num_upsampled       number of points that the upsampler adds; 3072
num_steps           noise levels of each stage; 64
sigma_min           lowest noise level of both stages; 1e-3
sigma_max           highest noise levels of the base model and of the upsampler; 120 and 160
churn               S_churn of Karras et al. for the base model and the upsampler; 3 and 0
scale               world units per unit of Point-E, whose points lie in [-0.5, 0.5]; with
                    ``normalize``: half the longest side
normalize           centre the bounding box, and make half its longest side ``scale``
front               the axis of Point-E's space that faces azimuth 0
device              ``auto``: the run's GPU, or the CPU, where it takes minutes
ground, ...         see ``priors/base.py``
==================  ================================================================================

Diffusers has no pipeline for Point-E, so the networks are implemented in ``point_e_model.py`` and
the sampler in ``karras.py``. The user downloads the files (addresses in ``docs/models.md``); they
are loaded with ``weights_only``.

The result has no faces. The axes are those of Shap-E, which was trained on renders of the same
scenes: z up and front -y, which is rotated to +x."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple, Optional

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..core.errors import UserError
from ..core.extras import require_extra
from ..core.files import existing_file
from ..core.options import in_range, is_numbers, positive, required, satisfies
from ..gaussians.point_cloud import PointCloud
from ..host import info, register
from ..models.bundled import NAME as BUNDLED
from ..models.bundled import POINTS, model_part
from ..models.clip import clip_source, load_text_encoder, load_tokenizer, text_condition
from ..models.hub import Source, locate
from ..models.loaded import loaded
from ..models.model_files import free_memory
from .base import FRONT, SCALE, Prior, chosen_device, placed, points, torch_generator
from .karras import (
    Network,
    cosine_alphas_cumprod,
    guided_denoiser,
    karras_sigmas,
    linear_alphas_cumprod,
    sample_heun,
)
from .point_e_model import CHANNELS, HEAD_CHANNELS, BaseModel, Upsampler, sizes_of
from .weights import load_exactly, read_state_dict

SCALES = torch.tensor([2.0] * 3 + [2 / 255] * 3)[:, None]
BIASES = torch.tensor([0.0] * 3 + [-1.0] * 3)[:, None]
"""Per channel (x, y, z, red, green, blue): the inputs of the networks are ``points * SCALES +
BIASES``, in [-1, 1], of positions in [-0.5, 0.5] and colours in [0, 255].
"""


class Kind(NamedTuple):
    """One of the published networks."""

    network: type
    title: str
    file: str
    projection: str
    """Name of a weight that only this network has. It projects CLIP's features, so its number of
    columns is their number.
    """


BASE = Kind(BaseModel, "Point-E base checkpoint", "base_40m_textvec.pt", "clip_embed.weight")
UPSAMPLER = Kind(
    Upsampler, "Point-E upsampler checkpoint", "upsample_40m.pt", "clip_embed.1.weight"
)
CHECKPOINT = required(
    "Point-E's weights are a file that you download; set checkpoint to base_40m_textvec.pt"
)
PAIR = satisfies(
    "two numbers of 0 or more, for the base model and for the upsampler",
    lambda value: is_numbers(value, 2) and min(value) >= 0,
)


@register("point-e-prior")
class PointEPrior(Prior):
    """Sample points for the prompt with Point-E."""

    @dataclass
    class Config(Prior.Config):
        checkpoint: str = field(default="", metadata=CHECKPOINT)
        upsampler: Optional[str] = None
        clip: str = "openai/clip-vit-large-patch14"
        prompt: Optional[str] = None
        guidance_scale: float = field(default=3.0, metadata=positive())
        num_points: int = field(default=1024, metadata=points(1))
        num_upsampled: int = field(default=3072, metadata=points(1))
        num_steps: int = field(default=64, metadata=in_range(1, 10_000))
        sigma_min: float = field(default=1e-3, metadata=positive())
        sigma_max: Any = field(default=(120.0, 160.0), metadata=PAIR)
        churn: Any = field(default=(3.0, 0.0), metadata=PAIR)
        scale: float = field(default=1.6, metadata=SCALE)
        normalize: bool = False
        front: str = field(default="-y", metadata=FRONT)
        device: str = "auto"

        @staticmethod
        def check(cfg: Any) -> None:
            if not all(value > cfg.sigma_min for value in cfg.sigma_max):
                raise UserError(
                    f"sigma_max: expected two numbers above sigma_min ({cfg.sigma_min}), got "
                    f"{list(cfg.sigma_max)}"
                )

    cfg: Config

    def preflight(self) -> None:
        existing_file(self._checkpoint(), BASE.title, (BUNDLED,))
        if self.cfg.upsampler:
            existing_file(self.cfg.upsampler, UPSAMPLER.title)
        require_extra("diffusion", "transformers")
        chosen_device(self.cfg.device, self.device)
        locate(self._clip(), download=False)

    def generate(self, prompt: str, generator: np.random.Generator) -> PointCloud:
        self.preflight()
        device, rng = chosen_device(self.cfg.device, self.device), torch_generator(generator)
        info(f"Point-E: {self.cfg.prompt or prompt!r} on {device}")
        points = self._coarse_points(self._condition(self.cfg.prompt or prompt, device), rng)
        if self.cfg.upsampler:
            points = torch.cat([points, self._upsampled_points(points, rng)], dim=-1)
        free_memory()
        rows = points[0].T.cpu().numpy()
        colors = rows[:, 3:].clip(0, 255).round() / np.float32(255)
        cfg, cloud = self.cfg, PointCloud(points=rows[:, :3], colors=colors)
        return placed(cloud, front=cfg.front, scale=cfg.scale, normalize=cfg.normalize)

    def _checkpoint(self) -> str:
        return model_part(self.cfg.checkpoint, POINTS)

    def _clip(self) -> Source:
        return clip_source(self.cfg.clip)

    def _condition(self, prompt: str, device: torch.device) -> Float[Tensor, "1 D"]:
        folder = locate(self._clip())
        key = ("Point-E text_encoder", str(folder), device)
        encoder = loaded(key, lambda: load_text_encoder(folder).to(device))
        tokenizer = loaded(("Point-E tokenizer", str(folder)), lambda: load_tokenizer(folder))
        return text_condition(tokenizer, encoder, prompt)

    def _coarse_points(
        self, condition: Float[Tensor, "1 D"], rng: torch.Generator
    ) -> Float[Tensor, "1 6 N"]:
        model = kept_network(BASE, self._checkpoint(), condition.device)
        given, expected = condition.shape[-1], model.clip_embed.in_features
        if given != expected:
            raise UserError(
                f"clip: {self.cfg.clip!r} has {given} features, but the checkpoint was trained "
                f"with {expected}: use ViT-L/14"
            )
        scale, none = self.cfg.guidance_scale, torch.zeros_like(condition)
        # with guidance a second row, the unconditional one
        conditions = condition if scale == 1 else torch.cat([condition, none])
        network = mean_of(lambda z, t: model(z, t, conditions))
        denoise = guided_denoiser(network, cosine_alphas_cumprod(), scale=scale)
        return self._sampled(denoise, self.cfg.num_points, 0, rng, condition.device)

    def _upsampled_points(
        self, coarse: Float[Tensor, "1 6 M"], rng: torch.Generator
    ) -> Float[Tensor, "1 6 N"]:
        model = kept_network(UPSAMPLER, self.cfg.upsampler, coarse.device)
        network = mean_of(lambda z, t: model(z, t, coarse))
        denoise = guided_denoiser(network, linear_alphas_cumprod())
        return self._sampled(denoise, self.cfg.num_upsampled, 1, rng, coarse.device)

    def _sampled(
        self, denoise: Any, count: int, stage: int, rng: torch.Generator, device: torch.device
    ) -> Float[Tensor, "1 6 N"]:
        """Return ``count`` points in Point-E's units: positions, and colours in [0, 255].

        Args:
            stage: 0 for the base model, 1 for the upsampler.
        """
        cfg, noise = self.cfg, torch.randn(1, CHANNELS, count, generator=rng).to(device)
        sigmas = karras_sigmas(cfg.num_steps, cfg.sigma_min, float(cfg.sigma_max[stage]))
        title, churn = ("Point-E", "Point-E upsampler")[stage], float(cfg.churn[stage])
        sample = sample_heun(denoise, noise, sigmas, churn=churn, generator=rng, progress=title)
        return (sample - BIASES.to(device)) / SCALES.to(device)


def mean_of(network: Network) -> Network:
    """Return ``network`` restricted to the mean, the first half of its output channels. The second
    half is the variance.
    """
    return lambda z, timesteps: network(z, timesteps)[:, :CHANNELS]


def kept_network(kind: Kind, path: str, device: torch.device) -> Any:
    """Return the network of :func:`load_network` on ``device``, see ``models/loaded.py``."""
    return loaded((kind.title, path, device), lambda: load_network(kind, path).to(device))


def load_network(kind: Kind, path: str) -> Any:
    """Load a network of this kind in evaluation mode. Its sizes are read from the weights' shapes.

    Raises:
        UserError: the file can't be read, or is of another model.
    """
    state = read_state_dict(path, kind.title)
    sizes, projection = sizes_of(state), state.get(kind.projection)
    fits = sizes["layers"] and sizes["width"] and sizes["width"] % HEAD_CHANNELS == 0
    if projection is None or not fits:
        raise UserError(
            f"{kind.title} {path!r} holds another model: give {kind.file} or a finetuned one "
            "of its format"
        )
    network = kind.network(**sizes, features=projection.shape[1])
    load_exactly(network, state, f"{kind.title} {path!r}")
    return network.eval().requires_grad_(False)
