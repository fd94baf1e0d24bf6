"""The particle model of text-to-image guidances: the model's own UNet with a low-rank addition to
the linear layers of its attention (LoRA, Hu et al. 2021), and an embedding of the camera.

The UNet itself isn't changed: hooks apply the additions while the particle model predicts. They are
zero at the start, so the particle model starts as the UNet. All of it is float32; the UNet's own
precision stays as it is."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..core.distributed import average_gradients, first_item
from ..core.errors import UserError
from ..core.host_copies import to_device
from ..core.streams import generator
from ..diffusion import sds
from ..host import run_seed
from .types import Batch, Condition, Latents, Noised, State
from .variants.vsd import Renders

ADAPTED = re.compile(r"\.(to_q|to_k|to_v|to_out\.0)$")
"""Layers of an attention block that get a low-rank addition."""
CAMERA = 16
"""Numbers in a camera-to-world matrix."""
BETAS = (0.9, 0.99)
MOMENTS = ("exp_avg", "exp_avg_sq", "step")


class LoRA(nn.Module):
    """Low-rank additions to linear layers, and an embedding of the camera.

    Args:
        network: the UNet; it isn't changed and not stored.
        rank: rank of the additions.
        seed: of the initial values.
    """

    def __init__(self, network: nn.Module, rank: int, seed: int) -> None:
        super().__init__()
        layers = dict(adapted_layers(network))
        width = network.time_embedding.linear_2.out_features
        device = next(network.parameters()).device
        rng = generator(seed, "lora")
        self.names = list(layers)
        self.down, self.up = nn.ParameterList(), nn.ParameterList()
        for layer in layers.values():
            down = torch.randn(rank, layer.in_features, generator=rng) / rank
            self.down.append(nn.Parameter(down.to(device)))
            self.up.append(nn.Parameter(torch.zeros(layer.out_features, rank, device=device)))
        down = torch.randn(width, CAMERA, generator=rng) / CAMERA**0.5
        self.camera_in = nn.Parameter(down.to(device))
        self.camera_out = nn.Parameter(torch.zeros(width, width, device=device))

    @contextmanager
    def applied(self, network: nn.Module, camera: Float[Tensor, "B 16"]) -> Iterator[None]:
        """Add the additions to the outputs of ``network``'s layers in this context.

        Args:
            camera: the camera of each item; zeros for none.
        """
        layers = dict(adapted_layers(network))
        handles = [
            layers[name].register_forward_hook(self._addition(index))
            for index, name in enumerate(self.names)
        ]
        embedding = nn.functional.silu(camera.float() @ self.camera_in.T) @ self.camera_out.T
        handles.append(
            network.time_embedding.register_forward_hook(
                lambda module, inputs, output: output + embedding.to(output)
            )
        )
        try:
            yield
        finally:
            for handle in handles:
                handle.remove()

    def _addition(self, index: int) -> Any:
        def add(module: nn.Module, inputs: tuple[Tensor, ...], output: Tensor) -> Tensor:
            added = inputs[0].float() @ self.down[index].T @ self.up[index].T
            return output + added.to(output)

        return add


def adapted_layers(network: nn.Module) -> Iterator[tuple[str, nn.Linear]]:
    """Yield name and layer of each linear layer of the attention of a UNet."""
    for name, layer in network.named_modules():
        if isinstance(layer, nn.Linear) and ADAPTED.search(name):
            yield name, layer


class LoRAParticles:
    """The renders' denoiser as a UNet with a :class:`LoRA`, trained by Adam.

    The prompts are those of the views, as for the pre-trained score.

    Args:
        guidance: has the UNet.
        options: ``rank``, ``lr``, ``samples``, ``camera_dropout``; see ``variants/vsd.py``.
    """

    def __init__(self, guidance: Any, options: Any) -> None:
        self.options = options
        self.lora = LoRA(guidance.unet, options.rank, run_seed())
        self.optimizer = torch.optim.Adam(self.lora.parameters(), lr=options.lr, betas=BETAS)

    @torch.no_grad()
    def predict(self, score: Any, noised: Noised, condition: Condition, batch: Batch) -> Latents:
        """Predict the noise; ``score`` is the guidance."""
        camera = batch["c2w"].to(noised.z.device).flatten(1)
        with self.lora.applied(score.unet, camera):
            return score.conditional(noised.z, noised.t, condition)

    @torch.enable_grad()
    def learn(self, score: Any, renders: Renders) -> dict[str, float]:
        """Take ``samples`` noisy copies of each render, and one step of Adam on the mean squared
        error of their predicted noise (ProlificDreamer, eq. 8).
        """
        self.optimizer.zero_grad(set_to_none=True)
        samples = self.options.samples if len(renders.latents) else 0
        losses = [self._backward(score, renders, sample) for sample in range(samples)]
        average_gradients(self.lora.parameters())
        if all(p.grad is not None and p.grad.isfinite().all() for p in self.lora.parameters()):
            self.optimizer.step()
        return {"lora_error": sum(losses) / len(losses)} if losses else {}

    def _backward(self, score: Any, renders: Renders, sample: int) -> float:
        """Add the gradient of one noisy copy of each render; return its mean squared error."""
        noised = particle_noise(score, renders.latents, sample)
        camera = renders.batch["c2w"].to(noised.z.device).flatten(1)
        first = first_item(len(camera))
        rng = generator(run_seed(), f"lora camera {sample}", score.step, first)
        kept = torch.rand(len(camera), 1, generator=rng) >= self.options.camera_dropout
        with self.lora.applied(score.unet, camera * kept.to(camera)):
            difference = score.conditional(noised.z, noised.t, renders.condition) - noised.noise
        # the sum's gradient at the network's output has the size of the noise, so that it neither
        # overflows nor underflows in half precision; the mean is taken in float32 afterwards
        parameters = list(self.lora.parameters())
        gradients = torch.autograd.grad(difference.square().sum(), parameters)
        count = difference.numel() * self.options.samples
        for parameter, gradient in zip(parameters, gradients, strict=True):
            mean = gradient / count
            parameter.grad = mean if parameter.grad is None else parameter.grad + mean
        return float(difference.detach().square().mean())

    # State
    # ----------------------------------------------------------------------------------------------

    def state(self) -> State:
        weights = {name: value.detach() for name, value in self.lora.named_parameters()}
        moments = {
            f"{key}.{name}": self.optimizer.state[parameter][key]
            for name, parameter in self.lora.named_parameters()
            for key in MOMENTS
            if parameter in self.optimizer.state
        }
        return weights | moments

    @torch.no_grad()
    def restore(self, state: State) -> None:
        """Restore weights and moments; an empty state is that of a run before its first step."""
        if not state:
            return
        own = dict(self.lora.named_parameters())
        shapes = {name: value.shape for name, value in own.items()}
        if len(state) > len(shapes):  # after the first step of Adam
            sizes = {"step": torch.Size([])}
            shapes |= {
                f"{key}.{name}": sizes.get(key, value.shape)
                for key in MOMENTS
                for name, value in own.items()
            }
        if {name: value.shape for name, value in state.items()} != shapes:
            raise UserError(
                f"the checkpoint's guidance had learnt {len(state)} tensors, not the LoRA of rank "
                f"{self.options.rank} of this UNet: resume with the configuration that the run was "
                "started with"
            )
        for name, parameter in own.items():
            parameter.copy_(state[name])
            if f"step.{name}" in state:
                moments = {key: state[f"{key}.{name}"].clone() for key in MOMENTS}
                # Adam expects its step count on the CPU
                self.optimizer.state[parameter] = {
                    key: value.cpu() if key == "step" else value.to(parameter)
                    for key, value in moments.items()
                }


def particle_noise(score: Any, latents: Latents, sample: int) -> Noised:
    """Add noise at timesteps from 1 to the last, uniform, drawn independently of those
    of the error.
    """
    count = len(score.alphas_cumprod)
    stream = f"lora timestep {sample}"
    options = {"seed": run_seed(), "step": score.step, "num_train": count, "stream": stream}
    t = sds.timesteps(len(latents), 0, count - 1, **options, first=first_item(len(latents)))
    abar = to_device(score.alphas_cumprod.double().cpu()[t], latents.device)
    noise = score.normal(latents, f"lora noise {sample}")
    return Noised(to_device(t, latents.device), abar, noise, sds.add_noise(latents, noise, abar))
