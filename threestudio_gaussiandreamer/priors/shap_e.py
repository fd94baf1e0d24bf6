"""``shap-e-prior``: OpenAI's Shap-E, the text-to-3D model that the paper starts from, with
diffusers' networks.

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
prompt               asked of Shap-E in place of the run's prompt
guidance_scale       1 = none; 15 in the paper's code
num_inference_steps  noise levels; 64
sigma_min, _max      the lowest and highest of them; 1e-3 and 160
grid_size            the signed distance is asked for on a grid of this many points along each axis
                     of [-1, 1]^3
query_batch_size     points asked for at a time: less is less memory
colors               ``display``: as a picture shows them; ``linear``: what the paper's code takes,
                     which is darker
scale                world units for one of Shap-E's; 1.6 in the paper's code. With ``normalize``:
                     half the longest side
normalize            centre the box and make its longest half side ``scale``
front                the axis of Shap-E's space that looks at azimuth 0
half_precision       run the text-to-latent network in float16, on a GPU only, as the paper's code
                     does
device               ``auto``: the run's GPU, or the CPU
ground, ...          see ``priors/base.py``
===================  ===============================================================================

The points are the vertices of the surface, with its faces. Shap-E's space has z up, and its objects
look along -y, the convention of the Blender scenes that it was trained on: its own preview begins
with a camera on that side. So the front becomes +x by a quarter turn, (x, y, z) -> (-y, x, z).

The latents are sampled by ``karras.py`` and not by ``ShapEPipeline``: its scheduler takes the noise
levels from the training schedule (403 to 0.108 in place of 160 to 1e-3), clamps after guidance
rather than before, and the pipeline offers no grid size. The signed distances that the published
code surrounds the grid with make its surface smaller by ``(grid_size - 1) / (grid_size + 1)``; so
does ours."""

from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Optional

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..core.errors import UserError
from ..core.extras import require_extra
from ..core.files import existing_file
from ..core.memory import count_of, require_memory
from ..core.options import in_range, one_of, positive
from ..gaussians.point_cloud import PointCloud
from ..host import info, register
from ..meshes.mesh import linear_to_srgb
from ..models.clip import load_text_encoder, load_tokenizer, text_condition
from ..models.hub import Source, locate
from ..models.loaded import loaded
from ..models.model_files import free_memory, load_network, load_settings, needed_files
from .base import FRONT, SCALE, Prior, chosen_device, placed, torch_generator
from .karras import Network, guided_denoiser, karras_sigmas, sample_heun
from .shap_e_checkpoint import load_original_prior

COMPONENTS = ("tokenizer", "text_encoder", "prior", "scheduler", "shap_e_renderer")
COLORS = ("display", "linear")
GRID_BYTES = 32
"""Memory per grid point, bytes: position, distance, and the temporaries of marching cubes."""


@register("shap-e-prior")
class ShapEPrior(Prior):
    """Sample a mesh for the prompt with Shap-E, and return its vertices and faces."""

    @dataclass
    class Config(Prior.Config):
        model: str = "openai/shap-e"
        revision: Optional[str] = None
        allow_bin: bool = False
        checkpoint: Optional[str] = None
        prompt: Optional[str] = None
        guidance_scale: float = field(default=15.0, metadata=positive())
        num_inference_steps: int = field(default=64, metadata=in_range(1, 10_000))
        sigma_min: float = field(default=1e-3, metadata=positive())
        sigma_max: float = field(default=160.0, metadata=positive())
        grid_size: int = field(default=128, metadata=in_range(2, 1024))
        query_batch_size: int = field(default=65536, metadata=count_of("points", 1, 4096))
        colors: str = field(default="display", metadata=one_of(COLORS))
        scale: float = field(default=1.6, metadata=SCALE)
        normalize: bool = False
        front: str = field(default="-y", metadata=FRONT)
        half_precision: bool = True
        device: str = "auto"

        @staticmethod
        def check(cfg: Any) -> None:
            if not cfg.sigma_min < cfg.sigma_max:
                raise UserError(
                    f"sigma_min: expected less than sigma_max, {cfg.sigma_max}, got {cfg.sigma_min}"
                )
            what = f"a grid of {cfg.grid_size} points each way"
            require_memory("grid_size", GRID_BYTES * cfg.grid_size**3, what)

    cfg: Config

    def preflight(self) -> None:
        require_extra("diffusion", "diffusers", "transformers")
        chosen_device(self.cfg.device, self.device)
        locate(self._source(), download=False)
        if self.cfg.checkpoint:
            existing_file(self.cfg.checkpoint, "Shap-E checkpoint")

    def generate(self, prompt: str, generator: np.random.Generator) -> PointCloud:
        self.preflight()
        folder = locate(self._source())
        device = chosen_device(self.cfg.device, self.device)
        info(f"Shap-E: {self.cfg.prompt or prompt!r} on {device}")
        cfg, rng = self.cfg, torch_generator(generator)
        latents = self._sample(folder, cfg.prompt or prompt, device, rng)
        renderer = self._part(folder, "shap_e_renderer", device)
        options = {"grid_size": cfg.grid_size, "query_batch_size": cfg.query_batch_size}
        cloud = decoded(renderer, latents, colors=cfg.colors, **options)
        free_memory()
        info(f"Shap-E: a mesh of {len(cloud.points)} vertices and {len(cloud.faces)} faces")
        return placed(cloud, front=cfg.front, scale=cfg.scale, normalize=cfg.normalize)

    def _source(self) -> Source:
        def picks(names: Collection[str]) -> list[str]:
            return needed_files(names, COMPONENTS, allow_bin=self.cfg.allow_bin)

        # the folder renderer is that of another pipeline
        download = "--include '*/*' --exclude 'renderer/*'"
        option = "system.geometry.prior.model"
        return Source(self.cfg.model, picks, option, self.cfg.revision, download)

    def _sample(
        self, folder: Path, prompt: str, device: torch.device, rng: torch.Generator
    ) -> Float[Tensor, "1 N D"]:
        """Return latents of the shape, from text features through the text-to-latent network; both
        are dropped on return.
        """
        cfg, condition = self.cfg, self._condition(folder, prompt, device)
        prior = self._part(folder, "prior", device)
        alphas_cumprod, prediction = read_schedule(folder)
        shape = (1, prior.config.num_embeddings, prior.config.embedding_dim)
        noise, scale = torch.randn(shape, generator=rng).to(device), cfg.guidance_scale
        half = cfg.half_precision and device.type == "cuda"
        network = prior_network(prior, condition, scale, half=half)
        denoise = guided_denoiser(network, alphas_cumprod, scale=scale, prediction=prediction)
        sigmas = karras_sigmas(cfg.num_inference_steps, cfg.sigma_min, cfg.sigma_max)
        return sample_heun(denoise, noise, sigmas, generator=rng, progress="Shap-E")

    def _condition(self, folder: Path, prompt: str, device: torch.device) -> Float[Tensor, "1 D"]:
        def load() -> Any:
            network = load_text_encoder(folder, "text_encoder", allow_bin=self.cfg.allow_bin)
            return network.to(device)

        encoder = loaded(("Shap-E text_encoder", str(folder), device, self.cfg.allow_bin), load)
        key = ("Shap-E tokenizer", str(folder))
        tokenizer = loaded(key, lambda: load_tokenizer(folder, "tokenizer"))
        return text_condition(tokenizer, encoder, prompt)

    def _part(self, folder: Path, part: str, device: torch.device) -> Any:
        """Return one network, always in float32: in half precision the renderer's encoding of
        positions loses all detail. ``checkpoint`` replaces the weights of the prior.
        """
        from diffusers import PriorTransformer
        from diffusers.pipelines.shap_e.renderer import ShapERenderer

        kind = {"prior": PriorTransformer, "shap_e_renderer": ShapERenderer}[part]
        checkpoint = self.cfg.checkpoint if part == "prior" else None

        def load() -> Any:
            network = load_network(kind, folder, part, allow_bin=self.cfg.allow_bin).float()
            if checkpoint:
                load_original_prior(network, checkpoint)
            return network.to(device)

        key = (f"Shap-E {part}", str(folder), device, self.cfg.allow_bin, checkpoint)
        return loaded(key, load)


def read_schedule(folder: Path) -> tuple[Float[np.ndarray, "T"], str]:
    """Return the abar of each timestep, and what the network predicts ("sample" or "epsilon"), from
    the model's own scheduler.
    """
    from diffusers import HeunDiscreteScheduler

    scheduler = load_settings(HeunDiscreteScheduler, folder, "scheduler")
    prediction = scheduler.config.prediction_type
    if prediction not in ("sample", "epsilon"):
        raise UserError(
            f"the scheduler in {str(folder)!r} has the prediction type {prediction!r}: "
            "Shap-E's is 'sample'"
        )
    return scheduler.alphas_cumprod.double().numpy(), prediction


def prior_network(
    prior: Any, condition: Float[Tensor, "1 D"], scale: float, *, half: bool
) -> Network:
    """Wrap diffusers' network with its condition: first the prompt's and then, with guidance, the
    empty prompt's.
    """
    conditions = condition if scale == 1 else torch.cat([condition, torch.zeros_like(condition)])

    def predict(z: Tensor, timesteps: Tensor) -> Tensor:
        with torch.autocast(z.device.type, torch.float16, enabled=half):
            output = prior(z, timesteps, conditions).predicted_image_embedding
        return output[..., : z.shape[-1]]  # the rest is the variance, which isn't used

    return predict


@torch.no_grad()
def decoded(
    renderer: Any, latents: Float[Tensor, "1 N D"], *, colors: str, grid_size: int, **options: int
) -> PointCloud:
    """Return the mesh of ``latents`` by marching cubes, with the texture field's colours at its
    vertices.

    Raises:
        UserError: the latents are not finite, or the signed distance is negative everywhere.
    """
    if not torch.isfinite(latents).all():
        raise UserError(
            "Shap-E's latents are not finite: set half_precision: false, or check its weights"
        )
    hook = renderer.mesh_decoder.register_forward_hook(_refuse_empty)
    try:
        mesh = renderer.decode_to_mesh(latents, latents.device, grid_size=grid_size, **options)
    except torch.OutOfMemoryError as error:
        raise UserError(
            f"Shap-E's grid of {grid_size}^3 does not fit the memory: set grid_size or "
            "query_batch_size lower"
        ) from error
    finally:
        hook.remove()  # the renderer may be kept for the next prompt
    channels = torch.stack([mesh.vertex_channels[name] for name in "RGB"], dim=-1)
    linear = channels.float().cpu().numpy()
    return PointCloud(
        points=mesh.verts.float().cpu().numpy(),
        colors=linear if colors == "linear" else linear_to_srgb(linear),
        faces=mesh.faces.cpu().numpy(),
    )


def _refuse_empty(decoder: Any, inputs: tuple, mesh: Any) -> None:
    """Raise UserError for a mesh without faces. This is a forward hook of the marching cubes,
    because the renderer's next steps fail on a mesh without vertices.
    """
    if not len(mesh.faces):
        raise UserError(
            "Shap-E found no surface for this prompt: try another seed, another prompt or a "
            "larger grid_size"
        )
