"""Stable Diffusion's guidance with tiny models."""

import torch
from torch import nn

from tests.helpers import tiny_models
from threestudio_gaussiandreamer.core import streams
from threestudio_gaussiandreamer.guidance import stable_diffusion  # noqa: F401
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.prompts import prompt_processors  # noqa: F401

PREDICTIONS = ("epsilon", "v_prediction")
BATCH = {
    "elevation": torch.tensor([0.0, 10.0, 70.0, -5.0]),
    "azimuth": torch.tensor([10.0, 60.0, 170.0, -120.0]),
    "camera_distances": torch.tensor([2.0, 3.0, 1.5, 4.0]),
}
TIMESTEPS = torch.tensor([40, 400, 700, 950])


def make_models(folder):
    """Make a tiny Stable Diffusion for each of ``PREDICTIONS``."""
    return {p: tiny_models.stable_diffusion(folder / p, prediction=p) for p in PREDICTIONS}


def part(kind, folder, **options):
    """Make a part of this package with a tiny model, such as "stable-diffusion-guidance"."""
    options |= {"pretrained_model_name_or_path": str(folder)}
    return find(f"gaussiandreamer-{kind}")(options)


def guidance(models, prediction="epsilon", **options):
    return part("stable-diffusion-guidance", models[prediction], **options)


def prompts_of(kind, folder, **options):
    """Make the embeddings of one prompt."""
    options = {"prompt": "a fox", "use_cache": False} | options
    return part(f"{kind}-prompt-processor", folder, **options)()


def make_prompts(models):
    """Make embeddings of one prompt, without and with Perp-Neg."""
    folder, found = models["epsilon"], {}
    for perp in (False, True):
        options = {"negative_prompt": "ugly", "use_perp_neg": perp}
        found[perp] = prompts_of("stable-diffusion", folder, **options)
    return found


def left_and_right(models):
    """Make embeddings of one prompt that tells the left side from the right one."""
    sides = {"view_dependent_left_and_right": True}
    return prompts_of("stable-diffusion", models["epsilon"], **sides)


def renders(batch=4, size=64, seed=0):
    rng = torch.Generator().manual_seed(seed)
    return torch.rand(batch, size, size, 3, generator=rng).requires_grad_()


def gradient(guide, prompt_utils, rgb, **options):
    out = guide(rgb, prompt_utils, **first(len(rgb)), **options)
    (grad,) = torch.autograd.grad(out["loss_sds"], rgb)
    return grad, out


def first(count):
    return {name: values[:count] for name, values in BATCH.items()}


def relative(a, b):
    return float((a.double() - b).norm() / b.norm())


class Recorder(nn.Module):
    """Forwards calls to a network and records their first arguments."""

    def __init__(self, network):
        super().__init__()
        self.network, self.calls = network, []

    def forward(self, *args, **kwargs):
        self.calls.append((args, kwargs))
        return self.network(*args, **kwargs)


def reference_gradient(
    rgb, network, encode, path, *, scale, clip=None, step=0, last=980, velocity=False
):
    """Compute the gradient at the render in float64: item by item, one forward pass per prompt,
    with the formulas of the papers.

    Args:
        network: returns its prediction for (z, t, row of the embeddings).
        encode: returns the latent of an image, given the generator of its noise.
        path: returns the factors of the latent and of the noise at t.
        velocity: of a rectified flow, as in RFDS; else the noise, with the weight sigma^2.
    """
    total = torch.zeros_like(rgb, dtype=torch.float64)
    for i, image in enumerate(rgb.detach().double()):
        draw = lambda stream, i=i: streams.generator(0, stream, step, i)  # noqa: E731
        t = int(torch.randint(20, last + 1, (), generator=draw("timestep")))
        a, sigma = path(t)
        image = image.permute(2, 0, 1)[None].requires_grad_()
        x = encode(image, draw("vae"))
        eps = torch.randn(x.shape[1:], generator=draw("noise")).double()
        z = a * x + sigma * eps
        with torch.no_grad():
            cond, uncond = (network(z, t, slice(row, row + 1)) for row in (i, i + len(rgb)))
        grad = uncond + scale * (cond - uncond) - (eps - x if velocity else eps)
        grad = grad if velocity else sigma**2 * grad
        grad = grad if clip is None else grad.clamp(-clip, clip)
        (back,) = torch.autograd.grad(x, image, grad.detach() / len(rgb))
        total[i] = back[0].permute(1, 2, 0)
    return total


def posterior_sample(vae, image, generator):
    """Return the latent, without scale, that the VAE's posterior gives with this noise."""
    posterior = vae.encode(image * 2 - 1).latent_dist
    noise = torch.randn(posterior.mean.shape[1:], generator=generator).double()
    return posterior.mean + posterior.std * noise


def diffusion_path(alphas):
    return lambda t: (alphas[t].sqrt(), (1 - alphas[t]).sqrt())


def in_double(kind, folder, component):
    """Load a network in float64."""
    return kind.from_pretrained(folder, subfolder=component).double().eval()
