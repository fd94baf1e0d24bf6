"""``shap-e-prior``: OpenAI's Shap-E, with which the paper starts, by diffusers' networks.

===================  ===============================================================================
option               meaning
===================  ===============================================================================
model                a folder in the format of diffusers' ``ShapEPipeline``, or an id of the hub
revision             of the model on the hub
allow_bin            where a part has no safetensors, read its ``.bin`` (with ``weights_only``: it
                     can't run code)
checkpoint           ``.pth`` in OpenAI's format whose weights replace the text-to-latent network's:
                     Cap3D's finetuned ``shapE_finetuned_with_330kdata.pth``, as in the paper; null:
                     as published
colors               ``display``: as a picture shows them; ``linear``: what the paper's code takes,
                     which is darker
prompt, ...          see ``priors/karras.py``
ground, ...          see ``priors/base.py``
===================  ===============================================================================

The points are the vertices of the surface, with its faces. Shap-E's space has z up, and its objects
look along -y, as the Blender scenes that it was trained on; the front becomes +x by a quarter turn,
(x, y, z) -> (-y, x, z). On a GPU the text-to-latent network runs in float16, as the paper's does.

The latents are sampled by ``karras.py`` and not by ``ShapEPipeline``, whose scheduler takes the
noise levels from the training schedule (403 to 0.108 in place of 160 to 1e-3) and clamps after
guidance rather than before. The signed distance is asked for on a grid over [-1, 1]^3; as in the
published code, its border makes the surface smaller by ``(GRID_SIZE - 1) / (GRID_SIZE + 1)``."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Optional

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..core.errors import UserError
from ..core.extras import require_extra
from ..core.files import existing_file
from ..core.options import one_of, positive
from ..gaussians.point_cloud import PointCloud
from ..host import info, register
from ..meshes.mesh import linear_to_srgb
from ..models.hub import Source, locate
from ..models.model_files import (
    free_memory,
    load_exactly,
    load_network,
    load_settings,
    loaded,
    needed_files,
    read_state_dict,
)
from . import karras
from .karras import SampledPrior

COMPONENTS = ("tokenizer", "text_encoder", "prior", "scheduler", "shap_e_renderer")
STEPS, SIGMA_MAX = 64, 160.0
"""Noise levels, and the highest one."""
GRID_SIZE, QUERY_BATCH_SIZE = 128, 65536
"""Points of the grid along each axis, and points that are asked for at a time."""


@register("shap-e-prior")
class ShapEPrior(SampledPrior):
    """Sample a mesh for the prompt with Shap-E, and return its vertices and faces."""

    @dataclass
    class Config(SampledPrior.Config):
        model: str = "openai/shap-e"
        revision: Optional[str] = None
        allow_bin: bool = False
        checkpoint: Optional[str] = None
        guidance_scale: float = field(default=15.0, metadata=positive())
        colors: str = field(default="display", metadata=one_of(("display", "linear")))
        REMOVED: ClassVar[dict[str, Any]] = {
            **SampledPrior.Config.REMOVED,
            "num_inference_steps": (STEPS, f"it is {STEPS}"),
            "grid_size": (GRID_SIZE, f"it is {GRID_SIZE}"),
            "half_precision": (True, "on a GPU it is half"),
            "sigma_max": (SIGMA_MAX, f"it is {SIGMA_MAX:g}"),
            "query_batch_size": (QUERY_BATCH_SIZE, f"it is {QUERY_BATCH_SIZE}"),
        }

    cfg: Config

    def preflight(self) -> None:
        require_extra("diffusion", "diffusers", "transformers")
        locate(self._source(), download=False)
        if self.cfg.checkpoint:
            existing_file(self.cfg.checkpoint, "Shap-E checkpoint")

    def generate(self, prompt: str, generator: np.random.Generator) -> PointCloud:
        self.preflight()
        folder = locate(self._source())
        info(f"Shap-E: {self.cfg.prompt or prompt!r} on {self.device}")
        latents = self._sample(folder, prompt, karras.torch_generator(generator))
        cloud = decoded(self._part(folder, "shap_e_renderer"), latents, self.cfg.colors)
        free_memory()
        info(f"Shap-E: a mesh of {len(cloud.points)} vertices and {len(cloud.faces)} faces")
        return self.placed(cloud)

    def _source(self) -> Source:
        # the folder renderer is that of another pipeline
        download = "--include '*/*' --exclude 'renderer/*'"
        option = "system.geometry.prior.model"
        picks = partial(needed_files, components=COMPONENTS, allow_bin=self.cfg.allow_bin)
        return Source(self.cfg.model, picks, option, self.cfg.revision, download)

    def _sample(self, folder: Path, prompt: str, rng: torch.Generator) -> Float[Tensor, "1 N D"]:
        """Return latents of the shape, from text features through the text-to-latent network."""
        from diffusers import HeunDiscreteScheduler

        cfg, parts = self.cfg, ("text_encoder", "tokenizer")
        condition = self.condition("Shap-E", folder, prompt, parts, allow_bin=cfg.allow_bin)
        prior = self._part(folder, "prior")
        schedule = load_settings(HeunDiscreteScheduler, folder, "scheduler")
        shape = (1, prior.config.num_embeddings, prior.config.embedding_dim)
        noise = torch.randn(shape, generator=rng).to(self.device)
        half = noise.is_cuda

        def network(z: Tensor, timesteps: Tensor) -> Tensor:
            with torch.autocast(z.device.type, torch.float16, enabled=half):
                output = prior(z, timesteps, condition).predicted_image_embedding
            return output[..., : z.shape[-1]]  # the rest is the variance, which isn't used

        denoise = karras.guided_denoiser(
            network,
            schedule.alphas_cumprod.double().numpy(),
            scale=cfg.guidance_scale,
            prediction=schedule.config.prediction_type,
        )
        sigmas = karras.karras_sigmas(STEPS, SIGMA_MAX)
        options = {"generator": rng, "progress": "Shap-E"}
        latents = karras.sample_heun(denoise, noise, sigmas, **options)
        if half and not latents.isfinite().all():  # some weights overflow float16
            half = False
            latents = karras.sample_heun(denoise, noise, sigmas, **options)
        return latents

    def _part(self, folder: Path, part: str) -> Any:
        """Return one network in float32, since half precision loses the detail of positions."""
        from diffusers import PriorTransformer
        from diffusers.pipelines.shap_e.renderer import ShapERenderer

        kind = {"prior": PriorTransformer, "shap_e_renderer": ShapERenderer}[part]
        checkpoint = self.cfg.checkpoint if part == "prior" else None

        def load() -> Any:
            network = load_network(kind, folder, part, allow_bin=self.cfg.allow_bin).float()
            if checkpoint:
                load_original_prior(network, checkpoint)
            return network.to(self.device)

        key = (f"Shap-E {part}", str(folder), self.device, self.cfg.allow_bin, checkpoint)
        return loaded(key, load)


@torch.no_grad()
def decoded(renderer: Any, latents: Float[Tensor, "1 N D"], colors: str) -> PointCloud:
    """Return the mesh of ``latents`` by marching cubes, with the texture field's colours."""
    if not torch.isfinite(latents).all():
        raise UserError("Shap-E's latents are not finite: check its weights")

    def require_faces(decoder: Any, inputs: tuple, mesh: Any) -> None:
        if not len(mesh.faces):  # the renderer's next steps would fail
            said = "try another seed or another prompt"
            raise UserError(f"Shap-E found no surface for this prompt: {said}")

    hook = renderer.mesh_decoder.register_forward_hook(require_faces)
    try:
        options = {"grid_size": GRID_SIZE, "query_batch_size": QUERY_BATCH_SIZE}
        mesh = renderer.decode_to_mesh(latents, latents.device, **options)
    finally:
        hook.remove()  # the renderer may be kept for the next prompt
    channels = torch.stack([mesh.vertex_channels[name] for name in "RGB"], dim=-1)
    linear = channels.float().cpu().numpy()
    return PointCloud(
        points=mesh.verts.float().cpu().numpy(),
        colors=linear if colors == "linear" else linear_to_srgb(linear),
        faces=mesh.faces.cpu().numpy(),
    )


# Weights in OpenAI's own format, as Cap3D publishes its finetuned ones ----------------------------

RENAMED = {
    "time_embed.c_fc": "time_embedding.linear_1",
    "time_embed.c_proj": "time_embedding.linear_2",
    "clip_embed": "embedding_proj",
    "input_proj": "proj_in",
    "output_proj": "proj_to_clip_embeddings",
    "ln_pre": "norm_in",
    "ln_post": "norm_out",
    "ln_1": "norm1",
    "ln_2": "norm3",
    "attn.c_proj": "attn1.to_out.0",
    "mlp.c_fc": "ff.net.0.proj",
    "mlp.c_proj": "ff.net.2",
}
"""OpenAI's names of layers, and diffusers'."""


def load_original_prior(prior: nn.Module, path: str) -> None:
    """Replace the weights of diffusers' ``prior`` by those in OpenAI's format."""
    heads = prior.config.num_attention_heads
    state = to_diffusers(read_state_dict(path, "Shap-E checkpoint"), heads)
    # parameters that diffusers' class has for another model
    state.update({k: v for k, v in prior.state_dict().items() if k in ("clip_mean", "clip_std")})
    load_exactly(prior, state, f"Shap-E checkpoint {path!r}")


def to_diffusers(state: dict[str, Tensor], heads: int) -> dict[str, Tensor]:
    """Convert OpenAI's names and layouts to those of ``PriorTransformer``, the same network with
    query, key and value apart, whose rows OpenAI packs head by head; other names stay.
    """
    converted: dict[str, Tensor] = {}
    for name, value in state.items():
        name = name.removeprefix("wrapped.")
        name = name.replace("backbone.resblocks.", "transformer_blocks.")
        for original, ours in RENAMED.items():
            name = name.replace(f"{original}.", f"{ours}.")
        if name == "pos_emb":
            converted["positional_embedding"] = value[None]
        elif ".attn.c_qkv." in name and len(value) % (3 * heads) == 0:
            rows = value.reshape(heads, 3, -1, *value.shape[1:])
            for letter, part in zip("qkv", rows.unbind(dim=1), strict=True):
                converted[name.replace("attn.c_qkv", f"attn1.to_{letter}")] = part.flatten(0, 1)
        else:
            converted[name] = value
    return converted
