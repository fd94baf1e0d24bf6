"""threestudio's own SDI and VSD beside ours: prints the relative errors as JSON."""

import itertools
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import threestudio
import torch
from diffusers import DDPMScheduler
from torch.autograd import grad
from torch.nn.utils import parameters_to_vector

from tests.helpers import tiny_guidance as tiny
from threestudio_gaussiandreamer.diffusion import sds
from threestudio_gaussiandreamer.diffusion.inversion import NoiseTable
from threestudio_gaussiandreamer.guidance.variants import vsd

VSD = threestudio.find("stable-diffusion-vsd-guidance")


class Prompts:
    """Random text embeddings, with and without words for the view."""

    def __init__(self, views, perp_neg=False):
        self.use_perp_neg = perp_neg
        self.rows = torch.randn((4 if perp_neg else 2) * views, 77, tiny.tiny_models.TEXT_WIDTH)

    def get_text_embeddings(
        self, elevation, azimuth, camera_distances, view_dependent_prompting=True
    ):
        return self.rows if view_dependent_prompting else -self.rows

    def get_text_embeddings_perp_neg(self, *views, **options):
        return self.rows, -torch.rand(len(self.rows) // 4, 2, generator=torch.Generator())


def their_sdi(models, prediction, eta, steps_offset=1):
    """Return threestudio's SDI; by default with the steps_offset of Stable Diffusion's files."""
    options = {"pretrained_model_name_or_path": str(models[prediction]), "inversion_eta": eta}
    options |= {"half_precision_weights": False, "guidance_scale": 7.5}
    theirs = threestudio.find("stable-diffusion-sdi-guidance")(options)
    for scheduler in (theirs.scheduler, theirs.inverse_scheduler):
        scheduler.register_to_config(clip_sample=False, steps_offset=steps_offset)
    return theirs


def compare_sdi(models, prediction, eta, perp_neg):
    """Compare the gradients; both inversions take the steps from 0 to 100, ..., 600 and 650."""
    plain = 0 if perp_neg else 1  # their scale of guidance is one less, except with Perp-Neg
    theirs = their_sdi(models, prediction, eta, steps_offset=0)
    variant = {"eta": eta, "inversion_scale": plain - 7.5}
    options = {"guidance_scale": 7.5 + plain, "weighting_strategy": "x0", "variant": variant}
    ours = tiny.guidance(models, prediction, variant_type="sdi-variant", **options)
    for guide in (theirs, ours):
        guide.min_step = guide.max_step = 650
    x, noise = torch.randn(1, 4, 8, 8, requires_grad=True), torch.randn(1, 4, 8, 8)
    arguments = {"prompt_utils": Prompts(1, perp_neg), **tiny.first(1), "rgb_as_latents": True}
    with mock.patch.object(NoiseTable, "draw", return_value=noise):
        (own,) = grad(ours(x.movedim(1, -1), **arguments)["loss_sds"], x)
    with (
        mock.patch("random.random", return_value=0.0),  # no overshoot
        mock.patch("torch.randn_like", return_value=noise),
    ):
        (other,) = grad(theirs(x, **arguments)["loss_sdi"], x)
    return {"gradient": tiny.relative(own, other * x.numel())}


def compare_steps(models):
    """Compare single steps between the timesteps that threestudio takes by default."""
    theirs, errors = their_sdi(models, "epsilon", 0.0), []
    with mock.patch("random.random", return_value=0.5):
        times = theirs.get_inversion_timesteps(torch.tensor([650]), 1)
    assert times.tolist() == [-99, 1, 101, 201, 301, 401, 501, 601, 700]
    z, eps = torch.randn(2, 1, 4, 8, 8)
    abar = sds.sd_alphas_cumprod()
    for now, later in zip(times[:-1], times[1:], strict=True):
        own = sds.ddim_step(z, eps, abar[now.clamp_min(0)][None], abar[later][None])
        errors.append(tiny.relative(own, theirs.ddim_inversion_step(eps, now, later, z)))
    return {"step": max(errors)}


class GivenNetworks(VSD):
    """threestudio's VSD with the UNet, of noise, and the LoRA of one of our guidances."""

    def configure(self, ours, folder):
        self.weights_dtype, self.single_model, self.grad_clip_val = torch.float32, False, None
        self.scheduler, self.scheduler_lora = (
            DDPMScheduler.from_pretrained(folder / "scheduler") for _ in range(2)
        )
        self.scheduler.register_to_config(prediction_type="epsilon")
        self.alphas, self.num_train_timesteps = self.scheduler.alphas_cumprod, 1000
        self.set_min_max_steps()
        lora = ours.variant.particles(ours)

        def network(z, t, encoder_hidden_states, class_labels=None, cross_attention_kwargs=None):
            if class_labels is None:
                return SimpleNamespace(sample=ours.predict_rows(z, t.long(), encoder_hidden_states))
            with lora.applied(ours.unet, class_labels):
                return ours.unet(z, t, encoder_hidden_states=encoder_hidden_states)

        pipe = SimpleNamespace(unet=network)
        network.class_embedding, self.submodules = None, SimpleNamespace(pipe=pipe, pipe_lora=pipe)

    def get_latents(self, rgb_BCHW, rgb_as_latents=False):
        return rgb_BCHW, None


def compare_vsd(models, prediction, dropped):
    """Compare the gradient of two views, without words for the view, since threestudio's LoRA gets
    none; and if the LoRA predicts the noise, its loss and its gradient, since threestudio's loss is
    the error of v where it predicts v.

    Args:
        dropped: train the LoRA without the camera.
    """
    options = {"guidance_scale": 7.5, "view_dependent_prompting": False}
    ours = tiny.guidance(models, prediction, **options, variant_type="vsd-variant")
    particles = ours.variant.particles(ours)
    weights = list(particles.parameters())
    for weight in weights:
        weight.data += 0.2 * torch.randn(weight.shape)
    particles.optimizer.step = lambda: None
    x = torch.randn(2, 4, 8, 8, requires_grad=True)
    arguments = {"prompt_utils": Prompts(2), **tiny.first(2), "rgb_as_latents": True}
    arguments |= {"rgb": x.movedim(1, -1), "c2w": torch.randn(2, 4, 4)}
    with mock.patch.object(vsd, "CAMERA_DROPOUT", float(dropped)):
        out = ours(**arguments)
    (own,) = grad(out["loss_sds"], x)
    theirs = GivenNetworks(options, ours, models[prediction])
    draws = ours.add_noise(x), vsd.particle_noise(ours, x.detach())
    with (
        mock.patch("random.random", return_value=0.0 if dropped else 1.0),
        mock.patch("torch.randint", side_effect=[draw.t for draw in draws]),
        mock.patch("torch.randn_like", side_effect=[draw.noise for draw in draws]),
    ):
        their = theirs(mvp_mtx=None, **arguments)
    errors = {"gradient": tiny.relative(own, *grad(their["loss_vsd"], x))}
    if prediction == "epsilon":
        loss = their["loss_lora"]
        pair = [weight.grad for weight in weights], grad(loss, weights)
        errors["gradient of the LoRA"] = tiny.relative(*map(parameters_to_vector, pair))
        errors["loss of the LoRA"] = abs(out["lora_error"] / float(loss.detach()) - 1)
    return errors


def main(folder):
    torch.manual_seed(0)
    models = tiny.make_models(folder)
    errors = {"SDI, single steps": compare_steps(models)}
    for prediction, eta, perp_neg in itertools.product(tiny.PREDICTIONS, (0.0, 0.3), (False, True)):
        name = f"SDI, {prediction}, eta {eta}{', Perp-Neg' * perp_neg}"
        errors[name] = compare_sdi(models, prediction, eta, perp_neg)
    for prediction, dropped in itertools.product(tiny.PREDICTIONS, (False, True)):
        name = f"VSD, {prediction}{', without the camera' * dropped}"
        errors[name] = compare_vsd(models, prediction, dropped)
    print(json.dumps(errors))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
