"""Guidance ``gaussiandreamer-mvdream-guidance``: score distillation from a camera-conditioned model
that sees several views of an object together, MVDream (Shi et al. 2023), which prevents faces on
several sides.

Takes conversions of MVDream to diffusers' format (``models/multiview_unet.py``) and the prompt
processor of Stable Diffusion. Each ``n_view`` consecutive views of a batch are one object, at one
elevation, with evenly spaced azimuths and one timestep. A single view, which validation shows, is
attended alone. MVDream's world and cameras are the host's: z up, the front towards +x.

Options in addition to those of ``guidance/stable_diffusion.py``:

======================  ============================================================================
option                  meaning
======================  ============================================================================
n_view                  views of an object that the model sees together, 4 in its training
guidance_scale          50 unless given, as MVDream's
recon_std_rescale       0.5 unless given; of each view, where MVDream takes those of an object
                        together
weighting_strategy      x0 unless given: the gradient is x minus the denoised x (section 3.3, eq. 3)
view_dependent_...      false unless given: the model knows the directions from the cameras
======================  ============================================================================
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..core.errors import UserError
from ..core.options import in_range, one_of
from ..diffusion import sds
from ..host import register
from ..models.hub import MULTI_VIEW
from ..models.multiview_unet import CAMERA, attend_across_views, load_multiview_unet
from ..models.text_encoders import pack, unpack
from .base import GUIDANCE_SCALE
from .stable_diffusion import StableDiffusionGuidance
from .types import Condition, Embeddings, Latents, Timesteps, view_of_row


@register("gaussiandreamer-mvdream-guidance")
class MVDreamGuidance(StableDiffusionGuidance):
    @dataclass
    class Config(StableDiffusionGuidance.Config):
        pretrained_model_name_or_path: str = "ashawkey/mvdream-sd2.1-diffusers"
        n_view: int = field(default=4, metadata=in_range(1, 64, "views"))
        guidance_scale: float = field(default=50.0, metadata=GUIDANCE_SCALE)
        recon_std_rescale: float = field(default=0.5, metadata=in_range(0, 1))
        weighting_strategy: str = field(default="x0", metadata=one_of(sds.WEIGHTS))
        view_dependent_prompting: bool = False

        @staticmethod
        def check(cfg: Any) -> None:
            if cfg.view_contrast:
                said = "this model has one prompt for all views: set it to 0"
                raise UserError(f"view_contrast: {said}")
            StableDiffusionGuidance.Config.check(cfg)

    cfg: Config
    family = MULTI_VIEW
    INPUTS = (("projection", None),)
    NO_LORA = "MVDream predicts several together"
    # without view contrast and Perp-Neg, which it doesn't have
    UNGUIDED_IGNORES = ("guidance_interval", "recon_std_rescale")

    def load_denoiser(self, folder: Path, **options: Any) -> None:
        super().load_denoiser(folder, read=load_multiview_unet, key=(self.cfg.n_view,))

    def prepare_denoiser(self, network: nn.Module) -> nn.Module:
        attend_across_views(network, self.cfg.n_view)
        return super().prepare_denoiser(network)

    def condition(self, prompt_utils: Any, **batch: Any) -> Condition:
        """See :meth:`.ScoreDistillation.condition`.

        Raises:
            UserError: the batch isn't groups of views, nor a single view to evaluate.
        """
        condition, views = super().condition(prompt_utils, **batch), len(batch["c2w"])
        if views != 1 and views % self.cfg.n_view:
            raise UserError(
                f"this model sees {self.cfg.n_view} views of an object together, and a batch has "
                f"{views}: set data.n_view={self.cfg.n_view} and data.batch_size to a multiple"
            )
        embeddings = condition.embeddings
        cameras = camera_matrices(batch["c2w"].to(embeddings))
        rows = view_of_row(len(cameras), len(embeddings), embeddings.device)
        empty = condition.empty
        if empty is not None:
            empty = pack(empty.expand(len(cameras), -1, -1), cameras)
        return Condition(pack(embeddings, cameras[rows]), None, empty)

    def draw_timesteps(self, latents: Latents) -> tuple[Timesteps, Float[Tensor, " B"]]:
        """Draw one timestep for each object, and repeat it for its views."""
        t, abar = super().draw_timesteps(latents[:: self.cfg.n_view])
        return tuple(
            values.repeat_interleave(self.cfg.n_view)[: len(latents)] for values in (t, abar)
        )

    def run_network(self, z: Latents, t: Timesteps, embeddings: Embeddings) -> Latents:
        tokens, cameras = unpack(embeddings.to(self.dtype), CAMERA)
        inputs = (z.to(self.dtype), t, tokens, cameras)
        # attention to copies of a view is attention to that view
        copies = self.cfg.n_view if (cameras == cameras[:1]).all() else 1
        z, t, tokens, cameras = (value.repeat_interleave(copies, dim=0) for value in inputs)
        output = self.unet(z, t, encoder_hidden_states=tokens, class_labels=cameras).sample
        return output[::copies]


def camera_matrices(c2w: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B 16"]:
    """Return the matrices by rows, with positions scaled to length 1."""
    position = torch.nn.functional.normalize(c2w[:, :3, 3:], dim=1)
    upper = torch.cat([c2w[:, :3, :3], position], dim=2)
    return torch.cat([upper, c2w[:, 3:]], dim=1).flatten(1)
