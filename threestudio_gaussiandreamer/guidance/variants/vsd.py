"""``vsd-variant``: variational score distillation (Wang et al. 2023, ProlificDreamer, eq. 9).

    e = eps_hat(z_t, t) - eps_particles(z_t, t, camera)

eps_particles predicts the noise in the renders' own distribution; it is trained beside the cloud to
minimise E |eps_particles(z_t, t, camera) - eps|^2 on the renders (eq. 8). For text-to-image models
it is the UNet with a LoRA in its attention (:class:`LoRAParticles`). For a score in closed form it
is the optimal denoiser of a Gaussian with the renders' mean and variance
(:class:`GaussianParticles`): a perfect model of a single cloud's renders would give SDS.

==============  ====================================================================================
option          meaning
==============  ====================================================================================
rank            rank of the LoRA
lr              learning rate of the LoRA
==============  ====================================================================================

ProlificDreamer's ``guidance_scale`` is 7.5."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ...core.distributed import all_sum, average_gradients, first_item
from ...core.errors import UserError
from ...core.options import in_range, positive
from ...core.streams import generator
from ...diffusion import sds
from ...host import register, run_seed
from ..types import Batch, Good, Latents, Noised, Residual, State, items_of, require_resumable
from .base import Variant

ADAPTED = re.compile(r"\.(to_q|to_k|to_v|to_out\.0)$")
"""Layers of an attention block that get a low-rank addition."""
REPLACES_UNET = ("enable_torch_compile", "enable_sequential_cpu_offload")
"""Options that replace the UNet's forward pass."""
CAMERA = 16
"""Numbers in a camera-to-world matrix."""
BETAS = (0.9, 0.99)
CAMERA_DROPOUT = 0.1
"""Share of the training without the camera, as in ProlificDreamer."""
MOMENTS = ("exp_avg", "exp_avg_sq", "step")
MOMENTUM = 0.95
"""Share of the moving averages of :class:`GaussianParticles` that a step keeps."""


class GaussianParticles:
    """The renders as one Gaussian per element, N(m, s^2), of all cameras together.

    m and s^2 are moving averages over the renders of recent steps. With z = a x + sigma eps as in
    ``diffusion/sds.py``, the optimal denoiser of this Gaussian is

        eps(z) = sigma (z - a m) / (a^2 s^2 + sigma^2),

    the minimum of VSD's training objective among denoisers that are affine in each element. Before
    the first step there are no renders, and the noise itself is returned, as in SDS.
    """

    def __init__(self) -> None:
        self._state: State = {}

    def predict(self, guidance: Any, noised: Noised, condition: Any, batch: Batch) -> Latents:
        """Predict the noise; called without gradients."""
        if self._state.get("mean", noised.z[:0]).shape != noised.z.shape[1:]:
            return noised.noise
        mean, square = (self._state[name] / self._state["weight"] for name in ("mean", "square"))
        variance = (square - mean**2).clamp_min(0).to(noised.z)
        mean = mean.to(noised.z)
        abar = sds.per_item(noised.abar, noised.z)
        sigma = sds.per_item((1 - noised.abar).sqrt(), noised.z)
        residual = noised.z - sds.per_item(noised.abar.sqrt(), noised.z) * mean
        return sigma * residual / (abar * variance + sigma**2)

    @torch.no_grad()
    def learn(
        self, guidance: Any, latents: Latents, condition: Any, batch: Batch
    ) -> dict[str, float]:
        """Learn from the renders of a step, of which there may be none; return numbers to log."""
        count = all_sum(latents.new_tensor(float(len(latents))))
        total, square = all_sum(latents.sum(0)), all_sum(latents.square().sum(0))
        if not count:
            return {}
        new = {"weight": torch.ones_like(count), "mean": total / count, "square": square / count}
        old = self._state
        if old.get("mean", latents[:0]).shape != latents.shape[1:]:
            old = {name: torch.zeros_like(value) for name, value in new.items()}
        self._state = {
            name: MOMENTUM * old[name].to(value) + (1 - MOMENTUM) * value
            for name, value in new.items()
        }
        return {}

    def state(self) -> State:
        """Return all that a resumed run needs."""
        return dict(self._state)

    def restore(self, state: State) -> None:
        """Restore what :meth:`state` returned; raise UserError for that of another model."""
        require_resumable(state, {"weight", "mean", "square"})
        self._state = dict(state)


class LoRAParticles(nn.Module):
    """The renders' denoiser as a UNet with low-rank additions (Hu et al. 2021) to the linear layers
    of its attention and an embedding of the camera, float32, which Adam trains with the prompts of
    the views. The UNet isn't changed: hooks apply the additions, which are zero at the start.

    Args:
        network: the UNet; it isn't stored.
        rank: of the additions.
        lr: learning rate.
    """

    def __init__(self, network: nn.Module, rank: int, lr: float) -> None:
        super().__init__()
        layers = adapted_layers(network)
        width = network.time_embedding.linear_2.out_features
        device, rng = next(network.parameters()).device, generator(run_seed(), "lora")

        def drawn(rows: int, columns: int, scale: float) -> nn.Parameter:
            values = torch.randn(rows, columns, generator=rng) / scale
            return nn.Parameter(values.to(device))

        def zeros(rows: int, columns: int) -> nn.Parameter:
            return nn.Parameter(torch.zeros(rows, columns, device=device))

        self.down = nn.ParameterList(drawn(rank, layer.in_features, rank) for layer in layers)
        self.up = nn.ParameterList(zeros(layer.out_features, rank) for layer in layers)
        self.camera_in = drawn(width, CAMERA, CAMERA**0.5)
        self.camera_out = zeros(width, width)
        self.optimizer = torch.optim.Adam(self.parameters(), lr=lr, betas=BETAS)

    @contextmanager
    def applied(self, network: nn.Module, camera: Float[Tensor, "B 16"]) -> Iterator[None]:
        """Add the additions to the outputs of ``network``'s layers in this context.

        Args:
            camera: the camera of each item; zeros for none.
        """
        embedding = nn.functional.silu(camera.float() @ self.camera_in.T) @ self.camera_out.T

        def add(down: Tensor, up: Tensor, layer: Any, inputs: Any, output: Tensor) -> Tensor:
            return output + (inputs[0].float() @ down.T @ up.T).to(output)

        layers = zip(adapted_layers(network), self.down, self.up, strict=True)
        handles = [layer.register_forward_hook(partial(add, *pair)) for layer, *pair in layers]
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

    @torch.no_grad()
    def predict(self, guidance: Any, noised: Noised, condition: Any, batch: Batch) -> Latents:
        camera = batch["c2w"].to(noised.z.device).flatten(1)
        with self.applied(guidance.unet, camera):
            return guidance.conditional(noised.z, noised.t, condition)

    @torch.enable_grad()
    def learn(
        self, guidance: Any, latents: Latents, condition: Any, batch: Batch
    ) -> dict[str, float]:
        """Take a noisy copy of each render, and one step of Adam on the mean squared error of their
        predicted noise (ProlificDreamer, eq. 8).
        """
        self.optimizer.zero_grad(set_to_none=True)
        parameters, report = list(self.parameters()), {}
        if len(latents):
            noised = particle_noise(guidance, latents)
            camera = batch["c2w"].to(noised.z.device).flatten(1)
            place = run_seed(), "lora camera 0", guidance.step, first_item(len(camera))
            kept = torch.rand(len(camera), 1, generator=generator(*place)) >= CAMERA_DROPOUT
            with self.applied(guidance.unet, camera * kept.to(camera)):
                difference = guidance.conditional(noised.z, noised.t, condition) - noised.noise
            # the sum's gradient at the network's output has the size of the noise, so that it
            # neither overflows nor underflows in half precision; the mean is taken in float32
            gradients = torch.autograd.grad(difference.square().sum(), parameters)
            for parameter, gradient in zip(parameters, gradients, strict=True):
                parameter.grad = gradient / difference.numel()
            report["lora_error"] = float(difference.detach().square().mean())
        average_gradients(parameters)
        if all(p.grad is not None and p.grad.isfinite().all() for p in parameters):
            self.optimizer.step()
        return report

    def state(self) -> State:
        """Return weights and, after the first step of Adam, its moments, by name."""
        own, moments = dict(self.named_parameters()), self.optimizer.state
        return {name: value.detach() for name, value in own.items()} | {
            f"{key}.{name}": moments[value][key]
            for name, value in own.items()
            for key in MOMENTS
            if value in moments
        }

    @torch.no_grad()
    def restore(self, state: State) -> None:
        """Restore weights and moments; an empty state is that of a run before its first step."""
        own = dict(self.named_parameters())
        names = {
            name for name, value in own.items() if state.get(name, value[:0]).shape == value.shape
        }
        if len(state) > len(own):
            names |= {f"{key}.{name}" for key in MOMENTS for name in own}
        require_resumable(state, names)
        for name, parameter in own.items() if state else ():
            parameter.copy_(state[name])
            if f"step.{name}" in state:
                moments = {key: state[f"{key}.{name}"].clone() for key in MOMENTS}
                # Adam expects its step count on the CPU
                moved = {key: moments[key].to(parameter) for key in MOMENTS[:2]}
                self.optimizer.state[parameter] = moved | {"step": moments["step"].cpu()}


def adapted_layers(network: nn.Module) -> list[nn.Linear]:
    """Return the linear layers of the attention of a UNet."""
    return [
        layer
        for name, layer in network.named_modules()
        if isinstance(layer, nn.Linear) and ADAPTED.search(name)
    ]


def particle_noise(guidance: Any, latents: Latents) -> Noised:
    """Add noise at timesteps from 1 to the last, drawn independently of those of the residual."""
    last = len(guidance.alphas_cumprod) - 1
    t, abar = guidance.timesteps_between(latents, 0, last, "lora timestep 0")
    noise = guidance.normal(latents, "lora noise 0")
    return Noised(t, abar, noise, sds.diffuse(latents, noise, abar))


@register("vsd-variant")
class VSD(Variant):
    @dataclass
    class Config(Variant.Config):
        rank: int = field(default=4, metadata=in_range(1, 1024))
        lr: float = field(default=1e-4, metadata=positive())

        REMOVED = {
            "samples": (1, "the LoRA is trained on one noisy copy of each render"),
            "camera_dropout": (0.1, "it is 0.1"),
            "momentum": (MOMENTUM, f"it is {MOMENTUM}"),
        }

    cfg: Config

    def configure(self) -> None:
        super().configure()
        self._particles: Any = None
        self._numbers: dict[str, float] = {}

    @classmethod
    def preflight(cls, guidance: Any, cfg: Any) -> None:
        super().preflight(guidance, cfg)
        if guidance.NO_LORA:
            said = f"trains a LoRA in a UNet of single views, and {guidance.NO_LORA}"
            raise UserError(f"vsd-variant {said}: use another system.guidance.variant_type")
        if found := [name for name in REPLACES_UNET if getattr(cfg, name, False)]:
            said = f"vsd-variant trains a LoRA in the plain UNet: set {found[0]}=false"
            raise UserError(f"system.guidance.{found[0]}: {said}")

    def particles(self, guidance: Any) -> Any:
        """Return the particle model, which is built on first use, when the networks are loaded."""
        if self._particles is None:
            self._particles = guidance.particle_model(self.cfg)
        return self._particles

    def residual(self, guidance: Any, latents: Latents, condition: Any, batch: Batch) -> Residual:
        noised = guidance.add_noise(latents)
        eps = guidance.predict_noise(noised.z, noised.t, condition)
        own = self.particles(guidance).predict(guidance, noised, condition, batch)
        return eps - own, noised.abar

    def learn(
        self, guidance: Any, latents: Latents, condition: Any, batch: Batch, good: Good
    ) -> None:
        if not good.all():
            rows = good.nonzero()[:, 0]
            batch = items_of(batch, len(latents), rows.cpu())
            latents, condition = latents[rows], guidance.select(condition, rows)
        self._numbers = self.particles(guidance).learn(guidance, latents, condition, batch)

    def report(self) -> dict[str, float]:
        return self._numbers

    def state(self) -> State:
        return self._particles.state() if self._particles else {}

    def restore(self, guidance: Any, state: State) -> None:
        self.particles(guidance).restore(state)
