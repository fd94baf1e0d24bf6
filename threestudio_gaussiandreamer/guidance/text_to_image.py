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
view_contrast, view_contrast_from   see ``guidance/view_contrast.py``
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
enable_memory_efficient_attention   torch's own attention is so already; accepted for threestudio's
                                    configurations
==================================  ================================================================
"""

from collections.abc import Callable, Hashable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Optional

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from ..core.errors import UserError, unknown
from ..core.extras import require_extra
from ..core.options import in_range, one_of
from ..diffusion.noise_prediction import PREDICTIONS, perp_neg
from ..host import debug, info, parse_structured, warn
from ..models.families import STABLE_DIFFUSION, Family
from ..models.hub import find_model
from ..models.loaded import keep_on_cpu, loaded
from ..models.model_files import load_network, load_settings
from .base import ScoreDistillation
from .half_precision import HALF_TYPES, channels_last, weights_type
from .lora import LoRAParticles, check_adaptable
from .model_images import size_of_images
from .particles import ParticleModel
from .scale_input import scale_input, scale_width
from .text_condition import Condition, Embeddings, Latents, Timesteps, view_of_row
from .variants.base import require_unset
from .view_contrast import check_view_contrast, contrasted, opposite

USUAL_SCALES = 200
"""Guidance scales above this, twice the paper's, are worth a warning."""
TERMINAL_ABAR = 2.0**-24
"""Replaces an ``abar`` of exactly 0, which schedules with zero terminal SNR have at the last step,
since ``predict_x0`` divides by its square root.
"""


class TextToImageDistillation(ScoreDistillation):
    """Score distillation from a network that is conditioned on text embeddings. Subclasses define
    how images are encoded.
    """

    @dataclass
    class Config(ScoreDistillation.Config):
        pretrained_model_name_or_path: str = ""
        revision: Optional[str] = None
        view_dependent_prompting: bool = True
        view_contrast: float = field(default=0.0, metadata=in_range(0, 100))
        view_contrast_from: float = field(default=0.4, metadata=in_range(0, 1))
        image_size: Optional[int] = field(default=None, metadata=in_range(1, 4096, "pixels"))
        half_precision_weights: bool = True
        half_precision_type: str = field(default="float16", metadata=one_of(HALF_TYPES))
        half_precision_on_cpu: bool = False
        enable_channels_last_format: bool = False
        enable_torch_compile: bool = False
        enable_attention_slicing: bool = False
        enable_sequential_cpu_offload: bool = False
        enable_memory_efficient_attention: bool = False

        @staticmethod
        def check(cfg: Any) -> None:
            ScoreDistillation.Config.check(cfg)
            check_view_contrast(cfg)

    cfg: Config
    components: ClassVar[tuple[str, ...]] = ("unet", "scheduler")
    family: ClassVar[Family] = STABLE_DIFFUSION
    """The models that this guidance takes."""
    scale_width: Optional[int] = None
    """Width of the guidance scale's embedding; None if the network doesn't take the scale."""
    # guidance_interval also limits view contrast and Perp-Neg, which need no scale
    UNGUIDED_IGNORES = ("recon_std_rescale",)
    PARTICLES_IGNORE = ("momentum",)

    # Loading
    # ----------------------------------------------------------------------------------------------

    @classmethod
    def preflight(cls, cfg: Any) -> None:
        cfg = parse_structured(cls.Config, cfg)
        super().preflight(cfg)
        if not cfg.view_contrast:
            require_unset(cls, cfg, ("view_contrast_from",), "with view_contrast=0")
        cls._find(cfg, download=False)

    @classmethod
    def _find(cls, cfg: Any, **options: Any) -> Optional[Path]:
        require_extra("diffusion", "diffusers", "transformers")
        name, revision = cfg.pretrained_model_name_or_path, cfg.revision
        return find_model(name, cls.components, family=cls.family, revision=revision, **options)

    def configure(self) -> None:
        super().configure()
        self.dtype = weights_type(self.cfg, self.device)
        folder = self._find(self.cfg, half=self.half)
        info(
            f"loading {self.cfg.pretrained_model_name_or_path} in "
            f"{str(self.dtype).removeprefix('torch.')}"
        )
        self.set_schedule(folder)
        self.load(folder)
        scale = self.cfg.guidance_scale
        if self.scale_width is None and not 0 <= scale <= USUAL_SCALES:
            warn(
                f"system.guidance.guidance_scale={scale:g}: expected 1 (none) to {USUAL_SCALES}; "
                "larger scales saturate results, and those below 0 lead away from the prompt"
            )

    @property
    def half(self) -> bool:
        """Whether the networks are in half precision."""
        return self.dtype != torch.float32

    def set_schedule(self, folder: Path) -> None:
        """Read the noise schedule of the model's training, float64, and the prediction type of its
        UNet.
        """
        from diffusers import DDPMScheduler

        scheduler = load_settings(DDPMScheduler, folder, "scheduler")
        if (
            not {"beta_schedule", "trained_betas"}
            & DDPMScheduler.load_config(folder, subfolder="scheduler").keys()
        ):
            raise UserError(
                f"{self.cfg.pretrained_model_name_or_path} has no known noise schedule: "
                "its scheduler has no beta_schedule"
            )
        self.prediction_type = scheduler.config.prediction_type
        if self.prediction_type not in PREDICTIONS:
            raise unknown(
                "prediction_type of the model's scheduler", self.prediction_type, PREDICTIONS
            )
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

    def load(self, folder: Path) -> None:
        """Load the networks; subclasses extend this with their own."""
        self.load_denoiser(folder)
        if self.cfg.enable_memory_efficient_attention:
            debug("enable_memory_efficient_attention: torch's attention needs little memory")

    def load_denoiser(self, folder: Path) -> None:
        """Load the network that predicts the noise, and set ``text_width`` and ``scale_width``."""
        from diffusers import UNet2DConditionModel

        self.unet = self.network(UNet2DConditionModel, folder, "unet", self.prepare_denoiser)
        self.scale_width = scale_width(self.unet, self.cfg)
        self.text_width = self.unet.config.encoder_hid_dim or self.unet.config.cross_attention_dim

    def size_of_images(self, factor: int = 1) -> int:
        """Return height and width of the images for the model; see ``guidance/model_images.py``."""
        return size_of_images(self.cfg, self.denoiser.config.sample_size, factor)

    def require_text_to_image(
        self, channels: int, embedding_types: tuple[Optional[str], ...] = (None, "text")
    ) -> None:
        """Raise UserError unless the inputs of the UNet are an image of ``channels`` channels and
        embeddings of these types only.
        """
        config = self.unet.config
        wanted = {
            "in_channels": (channels,),
            "class_embed_type": (None,),
            "addition_embed_type": embedding_types,
        }
        if other := [
            f"{name} {config[name]}"
            for name, values in wanted.items()
            if config[name] not in values
        ]:
            raise UserError(
                f"{self.cfg.pretrained_model_name_or_path} needs other inputs than text "
                f"({', '.join(other)}), like models for inpainting, depth or upscaling: use a "
                "model that makes images from text alone"
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
        """Load one frozen network of the model, unless this process has kept it (``loaded.py``).

        Args:
            prepare: moves it to its device and applies options of this part.
            dtype: number type, in place of this part's.
            read: reads it from the folder, with the arguments of :func:`.model_files.load_network`.
            key: what ``prepare`` depends on, beside the options that begin with ``enable_``.
        """
        dtype = dtype or self.dtype

        def load() -> nn.Module:
            network = read(network_class, folder, component, half=self.half, torch_dtype=dtype)
            network.requires_grad_(False)
            if channels_last(self.cfg, dtype, self.device):
                network.to(memory_format=torch.channels_last)
            return prepare(network)

        options = tuple(name for name in sorted(self.cfg) if name.startswith("enable_"))
        chosen = tuple(bool(self.cfg[name]) for name in options)
        return loaded((component, str(folder), dtype, self.device, options, chosen, *key), load)

    def prepare_denoiser(self, network: nn.Module) -> nn.Module:
        """Move the network that predicts the noise to its device, and apply this part's options."""
        # transformers have no such method: torch's attention needs little memory without
        if self.cfg.enable_attention_slicing and hasattr(network, "set_attention_slice"):
            network.set_attention_slice(1)
        if self.cfg.enable_sequential_cpu_offload:
            keep_on_cpu(network, self.device)
        else:
            network.to(self.device)
        return torch.compile(network) if self.cfg.enable_torch_compile else network

    # Score distillation
    # ---------------------------------------------------------------------------------------

    def condition(self, prompt_utils: Any, **batch: Any) -> Condition:
        """Return the text embeddings of the batch's views.

        Args:
            prompt_utils: a :class:`.view_prompts.PromptEmbeddings`, or threestudio's
                ``PromptProcessorOutput``.
        """
        if not hasattr(prompt_utils, "get_text_embeddings"):
            raise UserError(
                "this guidance needs text embeddings: set system.prompt_processor_type to the "
                "processor of its model"
            )
        views = (
            batch["elevation"],
            batch["azimuth"],
            batch["camera_distances"],
            self.cfg.view_dependent_prompting,
        )
        other = None
        if self.cfg.view_contrast:
            other = opposite(prompt_utils, *views).to(self.device)
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
        empty = self._empty_embedding(prompt_utils)
        return Condition(embeddings.to(self.device), weights, empty, other)

    def _empty_embedding(self, prompt_utils: Any) -> Optional[Float[Tensor, "1 N F"]]:
        """Return the embedding of an empty prompt if the variant needs one and ``prompt_utils`` can
        make it, as this package's can.
        """
        make = getattr(prompt_utils, "empty", None)
        return make().to(self.device) if self.variant.NEEDS_EMPTY_PROMPT and make else None

    def select(self, condition: Condition, rows: Int[Tensor, " R"]) -> Condition:
        return condition.select(rows)

    def conditional(
        self, z: Float[Tensor, "B c h w"], t: Int[Tensor, " B"], condition: Condition
    ) -> Float[Tensor, "B c h w"]:
        return self.noise(z, t, condition.embeddings[: len(z)])

    def unconditional(
        self, z: Float[Tensor, "B c h w"], t: Int[Tensor, " B"], condition: Condition
    ) -> Float[Tensor, "B c h w"]:
        return self.noise(z, t, condition.embeddings[len(z) : 2 * len(z)])

    def empty_prompt(
        self, z: Float[Tensor, "B c h w"], t: Int[Tensor, " B"], condition: Condition
    ) -> Optional[Float[Tensor, "B c h w"]]:
        if condition.empty is None:
            return None
        return self.noise(z, t, condition.empty.expand(len(z), -1, -1))

    def particle_model(self, options: Any) -> ParticleModel:
        return LoRAParticles(self, options)

    @classmethod
    def check_particle_model(cls, cfg: Any) -> None:
        check_adaptable(cfg)

    def guided_noise(
        self,
        z: Float[Tensor, "B c h w"],
        t: Int[Tensor, " B"],
        condition: Condition,
        scale: float,
        *,
        rescale: float = 0.0,
    ) -> Float[Tensor, "B c h w"]:
        """Predict the noise with guidance, in one evaluation per view if the network takes the
        scale; Perp-Neg, ``rescale`` and scales below 1 need the unconditional prediction.
        """
        perp = condition.negative_weights is not None
        if scale == 1 and not perp:
            return contrasted(self, self.conditional(z, t, condition), z, t, condition).to(z)
        if self.scale_width is None or rescale or perp or scale < 1:
            return super().guided_noise(z, t, condition, scale, rescale=rescale)
        eps = self.noise(z, t, condition.embeddings[: len(z)], scale)
        return contrasted(self, eps, z, t, condition, scale).to(z)

    def predict(
        self, z: Float[Tensor, "B c h w"], t: Int[Tensor, " B"], condition: Condition
    ) -> tuple[Tensor, Optional[Tensor]]:
        batch, perp = len(z), condition.negative_weights
        rows = len(condition.embeddings) if self.guided or perp is not None else batch
        eps = self.noise(z, t, condition.embeddings[:rows])
        cond, uncond = eps[:batch], eps[batch : 2 * batch] if rows > batch else None
        if perp is None:
            return contrasted(self, cond, z, t, condition), uncond
        return perp_neg(cond, uncond, eps[2 * batch :].unflatten(0, (batch, 2)), perp), uncond

    def noise(
        self,
        z: Float[Tensor, "B c h w"],
        t: Int[Tensor, " B"],
        embeddings: Float[Tensor, "kB N F"],
        scale: float = 1.0,
    ) -> Float[Tensor, "kB c h w"]:
        """Predict the noise, float32, for each row of ``embeddings`` and the latent of its view, in
        one forward pass of the network.

        Args:
            scale: of guidance, for a network that takes it; 1 for none.
        """
        self.evaluations += len(embeddings)
        rows = view_of_row(len(z), len(embeddings), z.device)
        z, t = z[rows], t[rows]
        inputs = scale_input(scale, self.scale_width, len(z), device=z.device, dtype=self.dtype)
        output = self.run_network(z, t, embeddings, **inputs).float()
        # models may also predict the variance of the reverse step, in further channels
        return PREDICTIONS[self.prediction_type](output[:, : z.shape[1]], z, self._abar[t])

    def run_network(
        self, z: Latents, t: Timesteps, embeddings: Embeddings, **inputs: Tensor
    ) -> Latents:
        """Return the output of the network, of the model's prediction type, for as many rows of
        ``embeddings`` as of latents; subclasses pass the model's further inputs.
        """
        tokens = embeddings.to(self.dtype)
        return self.unet(z.to(self.dtype), t, encoder_hidden_states=tokens, **inputs).sample
