"""The base class of guidances by text-to-image diffusion models: it loads the network and the noise
schedule, and evaluates all prompts in one forward pass.

==================================  ================================================================
option                              meaning
==================================  ================================================================
pretrained_model_name_or_path       the model, the prompt processor's: a folder or a hub id;
                                    ``revision`` of a hub id
guidance_scale                      of classifier-free guidance; 1 is none (threestudio's 100 is 101
                                    here). Networks that take it need one evaluation per view
..._step_percent, grad_clip,        see ``guidance/base.py``
weighting_strategy, ...
view_dependent_prompting            use the prompt of each view's direction
view_contrast                       move the conditional prediction away from that for the opposite
                                    view's prompt, by this factor of their difference; 0: none
image_size                          height and width that the model sees, pixels; none = what it was
                                    trained with
half_precision_weights              half precision on a GPU; images, latents, gradients and
                                    splatting stay float32
half_precision_type                 float16 or bfloat16, whose range is that of float32
half_precision_on_cpu               with half_precision_weights: bfloat16 on a CPU too, if it has
                                    instructions that multiply it; faster, and half of the memory
enable_channels_last_format         lay the weights out channels last; not in bfloat16 on a CPU
enable_torch_compile                compile the network on its first use
enable_attention_slicing            attention in slices: less memory, slower
enable_sequential_cpu_offload       keep the network's weights in the CPU's memory: least memory,
                                    much slower
enable_vae_slicing                  let the VAE, where there is one, encode one image at a time, and
                                    once more in the backward pass: needs the memory of a single
                                    image, and the time of a second encoding
==================================  ================================================================

View contrast is eps_c' = eps_c + view_contrast (eps_c - eps_o), where o is the prompt of the view
from the other side of the object: the negation of a concept as in composable diffusion (Liu et al.
2022, arXiv:2206.01714). It costs one more evaluation of each view at or above the share
``CONTRAST_FROM`` of the timesteps, which decide the view; outside of ``guidance_interval`` none.

A UNet with ``time_cond_proj_dim`` takes the guidance scale as an input (Meng et al. 2023,
arXiv:2210.03142), such as that of a latent consistency model (Luo et al. 2023, arXiv:2310.04378),
and predicts the noise with guidance in one evaluation.
"""

from abc import abstractmethod
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Optional

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from ..core.errors import UserError, unknown
from ..core.extras import require_extra
from ..core.options import in_range, one_of
from ..diffusion.sds import PREDICTIONS, perp_neg
from ..host import info, parse_structured, warn
from ..models.hub import STABLE_DIFFUSION as FAMILY
from ..models.hub import Family, find_model
from ..models.model_files import load_network, load_settings, loaded
from ..prompts.prompt_processors import STABLE_DIFFUSION
from .base import ScoreDistillation
from .types import Condition, Embeddings, Latents, Timesteps, view_of_row
from .variants.vsd import LoRAParticles

USUAL_SCALES = (0, 200)
"""Guidance scales beyond these are worth a warning."""
TERMINAL_ABAR = 2.0**-24
"""Replaces an abar of 0, of schedules with zero terminal SNR: its root is divided by."""
CONTRAST_FROM = 0.4
"""Smallest timestep, as a share of all, at which view contrast is applied."""
TAKEN_SCALES = (1, 20)
"""Those that a network which takes the scale may know; latent consistency models' are 3 to 15."""
HALF_TYPES = {"float16": torch.float16, "bfloat16": torch.bfloat16}


def weights_type(cfg: Any, device: torch.device) -> torch.dtype:
    """Return the number type of a network's weights, float32 unless half precision is chosen."""
    if not cfg.half_precision_weights:
        return torch.float32
    if device.type == "cuda":
        return HALF_TYPES[cfg.half_precision_type]
    native = cfg.half_precision_on_cpu and cpu_multiplies_bfloat16()
    return torch.bfloat16 if native else torch.float32


def cpu_multiplies_bfloat16() -> bool:
    """Return whether the CPU multiplies bfloat16; others, which convert it, are slower with it."""
    has = getattr(torch.cpu, "get_capabilities", dict)()  # older torch doesn't report any
    return any(has.get(name, False) for name in ("avx512_bf16", "amx_bf16"))


class TextToImageDistillation(ScoreDistillation):
    """Score distillation from a network that is conditioned on text embeddings."""

    @dataclass
    class Config(ScoreDistillation.Config):
        pretrained_model_name_or_path: str = STABLE_DIFFUSION
        revision: Optional[str] = None
        view_dependent_prompting: bool = True
        view_contrast: float = field(default=0.0, metadata=in_range(0, 100))
        image_size: Optional[int] = field(default=None, metadata=in_range(1, 4096, "pixels"))
        half_precision_weights: bool = True
        half_precision_type: str = field(default="float16", metadata=one_of(HALF_TYPES))
        half_precision_on_cpu: bool = False
        enable_channels_last_format: bool = False
        enable_torch_compile: bool = False
        enable_attention_slicing: bool = False
        enable_sequential_cpu_offload: bool = False
        enable_vae_slicing: bool = False

        REMOVED = {
            **ScoreDistillation.Config.REMOVED,
            "view_contrast_from": (CONTRAST_FROM, f"it is {CONTRAST_FROM}"),
            "enable_memory_efficient_attention": (lambda on: True, "torch's attention is so"),
            "enable_vae_tiling": (False, "images are encoded as a whole"),
        }

        @staticmethod
        def check(cfg: Any) -> None:
            ScoreDistillation.Config.check(cfg)
            if cfg.view_contrast and not cfg.view_dependent_prompting:
                said = "set view_dependent_prompting=true, or view_contrast=0"
                raise UserError(f"view_contrast compares the prompts of opposite views: {said}")

    cfg: Config
    components: ClassVar[tuple[str, ...]] = ("unet", "scheduler")
    family: ClassVar[Family] = FAMILY
    """The models that this guidance takes."""
    INPUTS: ClassVar[tuple[tuple, ...]] = ((None, None), (None, "text"))
    """Kinds of embeddings beside the tokens that the network may have: of classes, and of more."""
    scale_width: Optional[int] = None
    """Width of the guidance scale's embedding; None if the network doesn't take the scale."""
    # guidance_interval also limits view contrast and Perp-Neg, which need no scale
    UNGUIDED_IGNORES = ("recon_std_rescale",)

    @classmethod
    def preflight(cls, cfg: Any) -> None:
        cfg = parse_structured(cls.Config, cfg)
        super().preflight(cfg)
        cls._find(cfg, download=False)

    @classmethod
    def _find(cls, cfg: Any, **options: Any) -> Optional[Path]:
        require_extra("diffusion", "diffusers", "transformers")
        name, revision = cfg.pretrained_model_name_or_path, cfg.revision
        return find_model(name, cls.components, family=cls.family, revision=revision, **options)

    def configure(self) -> None:
        super().configure()
        self.dtype = weights_type(self.cfg, self.device)
        folder = self._find(self.cfg, half=self.dtype != torch.float32)
        name, kind = self.cfg.pretrained_model_name_or_path, str(self.dtype).split(".")[-1]
        info(f"loading {name} in {kind}")
        self.set_schedule(folder)
        self.load_denoiser(folder)
        self.load(folder)
        low, high = USUAL_SCALES if self.scale_width is None else TAKEN_SCALES
        if not low <= self.cfg.guidance_scale <= high:
            given = f"system.guidance.guidance_scale={self.cfg.guidance_scale:g}"
            warn(f"{given}: expected {low} to {high} (1: none) for {name}")

    def set_schedule(self, folder: Path) -> None:
        """Read the noise schedule of the model's training and the prediction type of its UNet."""
        from diffusers import DDPMScheduler

        scheduler = load_settings(DDPMScheduler, folder, "scheduler")
        settings = DDPMScheduler.load_config(folder, subfolder="scheduler")
        if not settings.keys() & {"beta_schedule", "trained_betas"}:
            name = self.cfg.pretrained_model_name_or_path
            raise UserError(f"the scheduler of {name} has no beta_schedule")
        self.prediction_type = scheduler.config.prediction_type
        if self.prediction_type not in PREDICTIONS:
            what = "prediction_type of the model's scheduler"
            raise unknown(what, self.prediction_type, PREDICTIONS)
        self.set_alphas_cumprod(torch.cumprod(1 - scheduler.betas.double(), dim=0))

    def set_alphas_cumprod(self, abar: Float[Tensor, " T"]) -> None:
        """Set abar by timestep, float64."""
        self.alphas_cumprod = torch.where(abar > 0, abar, TERMINAL_ABAR)
        self._abar = self.alphas_cumprod.to(self.device)
        self.update_step(0, 0)

    @property
    def denoiser(self) -> nn.Module:
        """The network that predicts the noise."""
        return self.unet

    @abstractmethod
    def load(self, folder: Path) -> None:
        """Load further networks, and set ``image_size``."""

    def load_denoiser(self, folder: Path, **options: Any) -> None:
        """Load the network that predicts the noise, and set ``text_width`` and ``scale_width``."""
        from diffusers import UNet2DConditionModel

        prepare = self.prepare_denoiser
        self.unet = self.network(UNet2DConditionModel, folder, "unet", prepare, **options)
        self.scale_width = self.unet.config.time_cond_proj_dim
        self.text_width = self.unet.config.encoder_hid_dim or self.unet.config.cross_attention_dim

    def size_of_images(self, factor: int = 1) -> int:
        """Return the height and width of images: ``image_size``, or ``factor`` times the latent
        size of the model's training. Warn if they differ.
        """
        cfg, trained = self.cfg, self.denoiser.config.sample_size
        size = trained * factor if isinstance(trained, int) else None
        if size is None and cfg.image_size is None:
            said = f"{cfg.pretrained_model_name_or_path} has sample_size {trained}"
            raise UserError(f"{said}: set system.guidance.image_size, pixels")
        if None not in (size, cfg.image_size) and cfg.image_size != size:
            warn(
                f"system.guidance.image_size={cfg.image_size}: {cfg.pretrained_model_name_or_path} "
                f"was trained on images of {size} x {size} and may draw poor ones of another size"
            )
        return cfg.image_size or size

    def require_text_to_image(self, channels: int) -> None:
        """Raise UserError if the network has other inputs than latents and a text."""
        names = ("in_channels", "class_embed_type", "addition_embed_type")
        given = tuple(self.denoiser.config.get(name) for name in names)
        if given not in [(channels, *kinds) for kinds in self.INPUTS]:
            said = ", ".join(f"{name} {value}" for name, value in zip(names, given, strict=True))
            raise UserError(
                f"{self.cfg.pretrained_model_name_or_path} needs other inputs than text ({said}), "
                "like models for inpainting, depth or upscaling: use a model that makes images "
                "from text alone"
            )

    def network(
        self,
        network_class: Any,
        folder: Path,
        component: str,
        prepare: Callable[[nn.Module], nn.Module],
        *,
        dtype: Optional[torch.dtype] = None,
        read: Callable[..., nn.Module] = load_network,
        key: tuple[Hashable, ...] = (),
    ) -> nn.Module:
        """Load one frozen network of the model, or return a kept one (:func:`.loaded`); ``prepare``
        moves it to its device, and depends on ``key`` and options that begin with ``enable_``.
        """
        dtype = dtype or self.dtype

        def load() -> nn.Module:
            half = self.dtype != torch.float32
            network = read(network_class, folder, component, half=half, torch_dtype=dtype)
            network.requires_grad_(False)
            is_cpu_half = (self.device.type, dtype) == ("cpu", torch.bfloat16)
            if self.cfg.enable_channels_last_format and not is_cpu_half:  # slower there
                network.to(memory_format=torch.channels_last)
            return prepare(network)

        chosen = sorted(name for name, on in vars(self.cfg).items() if name[:7] == "enable_" and on)
        return loaded((component, str(folder), dtype, self.device, *chosen, *key), load)

    def prepare_denoiser(self, network: nn.Module) -> nn.Module:
        """Move the network that predicts the noise to its device, and apply this part's options."""
        # the transformer of Stable Diffusion 3 has no such method
        if self.cfg.enable_attention_slicing and hasattr(network, "set_attention_slice"):
            network.set_attention_slice(1)
        if self.cfg.enable_sequential_cpu_offload:
            require_extra("diffusion", "accelerate")
            from accelerate import cpu_offload

            # the weights of each layer are copied to the device while it computes
            cpu_offload(network, execution_device=self.device)
        else:
            network.to(self.device)
        return torch.compile(network) if self.cfg.enable_torch_compile else network

    def condition(self, prompt_utils: Any, **batch: Any) -> Condition:
        """Return the text embeddings of the batch's views.

        Args:
            prompt_utils: a :class:`.view_prompts.PromptEmbeddings`, or threestudio's
                ``PromptProcessorOutput``.
        """
        elevation, azimuth = batch["elevation"], batch["azimuth"]
        more = (batch["camera_distances"], self.cfg.view_dependent_prompting)
        views, other = (elevation, azimuth, *more), None
        if self.cfg.view_contrast:
            opposite = prompt_utils.get_text_embeddings(elevation, azimuth + 180, *more)
            other = opposite[: len(azimuth)].to(self.device)
        if getattr(prompt_utils, "use_perp_neg", False):
            embeddings, weights = prompt_utils.get_text_embeddings_perp_neg(*views)
            weights = weights.to(self.device)
        else:
            embeddings, weights = prompt_utils.get_text_embeddings(*views), None
        if embeddings.shape[-1] != self.text_width:
            raise UserError(
                f"the text embeddings have {embeddings.shape[-1]} channels, "
                f"{self.cfg.pretrained_model_name_or_path} takes {self.text_width}: "
                "give system.prompt_processor and system.guidance the same "
                "pretrained_model_name_or_path"
            )
        # threestudio's prompts can't make an empty one
        make = getattr(prompt_utils, "empty", None) if self.variant.NEEDS_EMPTY_PROMPT else None
        empty = make().to(self.device) if make else None
        return Condition(embeddings.to(self.device), weights, empty, other)

    def select(self, condition: Condition, rows: Int[Tensor, " R"]) -> Condition:
        return condition.select(rows)

    def conditional(self, z: Latents, t: Timesteps, condition: Condition) -> Latents:
        return self.predict_rows(z, t, condition.embeddings[: len(z)])

    def unconditional(self, z: Latents, t: Timesteps, condition: Condition) -> Latents:
        return self.predict_rows(z, t, condition.embeddings[len(z) : 2 * len(z)])

    def empty_prompt(self, z: Latents, t: Timesteps, condition: Condition) -> Optional[Latents]:
        if condition.empty is None:
            return None
        return self.predict_rows(z, t, condition.empty.expand(len(z), -1, -1))

    def particle_model(self, options: Any) -> LoRAParticles:
        return LoRAParticles(self.unet, options.rank, options.lr)

    def guided_at_once(
        self, z: Latents, t: Timesteps, condition: Condition, scale: float, rescale: float
    ) -> Optional[Latents]:
        takes_scale = self.scale_width is not None and scale > 1 and not rescale
        if condition.negative_weights is not None or not (takes_scale or scale == 1):
            return None
        eps = self.predict_rows(z, t, condition.embeddings[: len(z)], scale)
        return self._contrasted(eps, z, t, condition, scale)

    def predict(
        self, z: Latents, t: Timesteps, condition: Condition
    ) -> tuple[Latents, Optional[Latents]]:
        batch, perp = len(z), condition.negative_weights
        everything = self.needs_unconditional or perp is not None
        rows = len(condition.embeddings) if everything else batch
        eps = self.predict_rows(z, t, condition.embeddings[:rows])
        cond, uncond = eps[:batch], eps[batch : 2 * batch] if rows > batch else None
        if perp is None:
            return self._contrasted(cond, z, t, condition), uncond
        return perp_neg(cond, uncond, eps[2 * batch :].unflatten(0, (batch, 2)), perp), uncond

    def _contrasted(
        self, eps: Latents, z: Latents, t: Timesteps, condition: Condition, scale: float = 1.0
    ) -> Latents:
        """Add view contrast, if any, to conditional predictions with this guidance scale."""
        if condition.opposite is None:
            return eps
        rows = (t >= CONTRAST_FROM * len(self.alphas_cumprod)).nonzero()[:, 0]
        if not len(rows):
            return eps
        other = self.predict_rows(z[rows], t[rows], condition.opposite[rows], scale)
        return eps.index_add(0, rows, eps[rows] - other, alpha=self.cfg.view_contrast)

    def predict_rows(
        self, z: Latents, t: Timesteps, embeddings: Embeddings, scale: float = 1.0
    ) -> Float[Tensor, "kB c h w"]:
        """Predict the noise, float32, for each row of ``embeddings`` and the latent of its view, in
        one forward pass of the network.

        Args:
            scale: of guidance, for a network that takes it; 1 for none.
        """
        self.evaluations += len(embeddings)
        rows = view_of_row(len(z), len(embeddings), z.device)
        z, t = z[rows], t[rows]
        output = self.run_network(z, t, embeddings, **self.scale_input(scale, len(z))).float()
        # models may also predict the variance of the reverse step, in further channels
        return PREDICTIONS[self.prediction_type](output[:, : z.shape[1]], z, self._abar[t])

    def run_network(
        self, z: Latents, t: Timesteps, embeddings: Embeddings, **inputs: Tensor
    ) -> Latents:
        """Return the output of the network, for as many rows of embeddings as of latents."""
        tokens = embeddings.to(self.dtype)
        return self.unet(z.to(self.dtype), t, encoder_hidden_states=tokens, **inputs).sample

    def scale_input(self, scale: float, count: int) -> dict[str, Float[Tensor, "B width"]]:
        """Return the input of a UNet that takes the scale, for so many latents; none for others."""
        if self.scale_width is None:
            return {}
        from diffusers.models.embeddings import get_timestep_embedding

        w = 1000.0 * torch.full((count,), scale - 1.0)
        embedding = get_timestep_embedding(w, self.scale_width, downscale_freq_shift=1)
        return {"timestep_cond": embedding.to(self.device, self.dtype)}


def resized(images: Float[Tensor, "B 3 H W"], size: int) -> Float[Tensor, "B 3 s s"]:
    """Resize to the model's size, with antialiasing if images shrink by more than a factor of 2."""
    if images.shape[-2:] == (size, size):
        return images
    antialias = max(images.shape[-2:]) > 2 * size
    return F.interpolate(
        images, (size, size), mode="bilinear", align_corners=False, antialias=antialias
    )
