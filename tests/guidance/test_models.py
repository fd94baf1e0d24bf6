"""The guidances of all models with tiny ones, against float64 by the papers' formulas."""

import json
import math
import shutil
from pathlib import Path
from pkgutil import iter_modules

import pytest
import torch
import torch.nn.functional as F

from tests.guidance import test_mvdream
from tests.helpers import tiny_guidance as tiny
from tests.helpers import tiny_large_guidance as large_tiny
from tests.helpers import tiny_models
from tests.helpers.refusals import refused
from tests.helpers.tiny_large_guidance import gradient, guidance
from threestudio_gaussiandreamer.guidance import base, stable_diffusion, text_to_image, variants
from threestudio_gaussiandreamer.guidance.text_to_image import weights_type
from threestudio_gaussiandreamer.models.text_encoders import unpack

pytest.importorskip("diffusers")
SD, XL, SD3, IF = "stable-diffusion", "stable-diffusion-xl", "stable-diffusion-3", "deep-floyd"
LATENTS = {SD: (0.18215, 0.0), XL: (0.13025, 0.0), SD3: (1.5305, 0.0609)}
"""Scale and shift of each model's latents."""
POOLED = tiny_models.POOLED


def sigma_of(t, shift=3.0):
    u = t / 1000
    return shift * u / (1 + (shift - 1) * u)


def reference_gradient(kind, model, prompt_utils, rgb, *, prediction="epsilon", **options):
    """Compute the gradient in float64, of Stable Diffusion 3 that of RFDS: v_hat - (eps - x)."""
    from diffusers import AutoencoderKL, DDPMScheduler, SD3Transformer2DModel, UNet2DConditionModel

    text = prompt_utils.get_text_embeddings(**tiny.BATCH).double()
    if kind == SD3:
        transformer = tiny.in_double(SD3Transformer2DModel, model, "transformer")
        options |= {"last": 700, "velocity": True}
    else:
        unet = tiny.in_double(UNet2DConditionModel, model, "unet")
        betas = DDPMScheduler.from_pretrained(model, subfolder="scheduler").betas.double()
        diffusion = tiny.diffusion_path(torch.cumprod(1 - betas, 0))
    vae = None if kind == IF else tiny.in_double(AutoencoderKL, model, "vae")

    def path(t):
        return (1 - sigma_of(t), sigma_of(t)) if kind == SD3 else diffusion(t)

    def network(z, t, row):
        if kind == SD3:
            tokens, pooled = unpack(text[row], 2 * POOLED)
            time = torch.tensor([1000 * sigma_of(t)]).double()
            return transformer(z, tokens, pooled, time).sample
        tokens, more = text[row], {}
        if kind == XL:
            tokens, pooled = unpack(tokens, POOLED)
            sizes = torch.tensor([[64, 64, 0, 0, 64, 64]]).double()
            more["added_cond_kwargs"] = {"text_embeds": pooled, "time_ids": sizes}
        output, (a, sigma) = unet(z, t, encoder_hidden_states=tokens, **more).sample, path(t)
        return a * output + sigma * z if prediction == "v_prediction" else output[:, : z.shape[1]]

    def encode(image, generator):
        if vae is None:
            return image * 2 - 1
        scale, shift = LATENTS[kind]
        image = F.interpolate(image, (64, 64), mode="bilinear", align_corners=False)
        return scale * (tiny.posterior_sample(vae, image, generator) - shift)

    return tiny.reference_gradient(rgb, network, encode, path, **options)


@pytest.mark.parametrize(
    "kind, size, options, step",
    [
        (SD, 64, {"guidance_scale": 7.5, "grad_clip": 0.5}, 3),
        ("v_prediction", 128, {"guidance_scale": 100.0}, 0),
        (XL, 64, {"guidance_scale": 100.0}, 0),
        (SD3, 64, {"guidance_scale": 100.0, "max_step_percent": 0.7}, 0),
        (IF, 16, {"guidance_scale": 20.0}, 0),
    ],
)
def test_the_gradient_is_that_of_a_float64_reference(large, models, kind, size, options, step):
    (model, prompts), prediction, rgb = large(SD), "epsilon", tiny.renders(size=size)
    if kind == "v_prediction":
        model, kind, prediction = models[kind], SD, kind
    elif kind != SD:
        model, prompts = large(kind)
    guide = guidance(kind, model, **options)
    guide.update_step(0, step)
    mine, _ = gradient(guide, prompts, rgb)
    more = {"prediction": prediction, "clip": options.get("grad_clip"), "step": step}
    scale = options["guidance_scale"]
    expected = reference_gradient(kind, model, prompts, rgb, scale=scale, **more)
    # guidance 100 magnifies the rounding of float32 (6e-8) a hundredfold; measured 1e-6 to 3e-6
    assert tiny.relative(mine, expected) < 1e-5


@pytest.fixture
def half(monkeypatch):
    """Use float16 on the CPU too, where a run would use float32."""
    monkeypatch.setattr(text_to_image, "weights_type", lambda *options: torch.float16)


@pytest.mark.parametrize("native", [False, True])
def test_half_precision_on_a_cpu_is_bfloat16_where_it_is_native(monkeypatch, native):
    monkeypatch.setattr(text_to_image, "cpu_multiplies_bfloat16", lambda: native)
    cpu, gpu = torch.device("cpu"), torch.device("cuda")
    cfg = stable_diffusion.StableDiffusionGuidance.Config()
    assert (weights_type(cfg, gpu), weights_type(cfg, cpu)) == (torch.float16, torch.float32)
    cfg.half_precision_on_cpu = True
    assert weights_type(cfg, cpu) == (torch.bfloat16 if native else torch.float32)
    cfg.half_precision_weights = False
    assert weights_type(cfg, gpu) == weights_type(cfg, cpu) == torch.float32


def test_the_gradient_in_bfloat16_on_a_cpu(large, monkeypatch):
    monkeypatch.setattr(text_to_image, "cpu_multiplies_bfloat16", lambda: True)
    options, (model, prompts) = {"half_precision_on_cpu": True}, large(SD)
    guide = guidance(SD, model, guidance_scale=4.0, enable_channels_last_format=True, **options)
    assert guide.unet.dtype == guide.vae.dtype == torch.bfloat16
    assert guide.vae.encoder.conv_in.weight.is_contiguous()
    mine, _ = gradient(guide, prompts, rgb := tiny.renders())
    expected = reference_gradient(SD, model, prompts, rgb, scale=4.0)
    assert mine.dtype == torch.float32
    assert 0 < tiny.relative(mine, expected) < 0.1  # bfloat16 rounds to 4e-3


def test_half_precision_stays_inside_the_networks(large, half):
    model, prompts = large(SD)
    guide, rgb = guidance(SD, model), tiny.renders()
    guide.unet = recorder = tiny.Recorder(guide.unet)
    networks = (guide.unet, guide.vae)
    assert {p.dtype for network in networks for p in network.parameters()} == {torch.float16}
    latents = guide.encode(rgb.movedim(-1, 1))
    mine, out = gradient(guide, prompts, rgb)
    assert recorder.calls[0][0][0].dtype == torch.float16
    assert latents.dtype == mine.dtype == out["loss_sds"].dtype == torch.float32
    assert guide.decode(latents).dtype == torch.float32
    with torch.autocast("cpu", torch.bfloat16):
        loss = guide(rgb, prompts, **large_tiny.views())["loss_sds"]
    assert torch.equal(mine, torch.autograd.grad(loss, rgb)[0])
    expected = reference_gradient(SD, model, prompts, rgb, scale=100.0)
    # float16 rounds to 5e-4, which guidance 100 magnifies: the right gradient, not an exact one
    assert tiny.relative(mine, expected) < 0.1
    assert (mine != 0).float().mean() > 0.99
    for loss_scale in (2.0**-30, 2.0**40):
        loss = guide(rgb, prompts, **tiny.BATCH)["loss_sds"] * loss_scale
        assert torch.equal(torch.autograd.grad(loss, rgb)[0] / loss_scale, mine)


def test_the_loss_scale_of_each_item_is_undone():
    x = torch.randn(3, 5, generator=torch.Generator().manual_seed(0)).requires_grad_()
    seen, results = [], []

    def network(x):
        inner = x * 1.0
        inner.register_hook(seen.append)
        return inner * 1.0

    weights = torch.tensor([[1e-12], [0.0], [3e12]])
    (stable_diffusion.with_loss_scales(network, x, results.append) * weights).sum().backward()
    torch.testing.assert_close(x.grad, weights.expand(3, 5), rtol=0, atol=0)
    peaks = seen[0].abs().amax(1)
    assert (peaks[[0, 2]] >= 64).all() and (peaks[[0, 2]] < 128).all() and peaks[1] == 0
    assert [result.tolist() for result in results] == [[False] * 3]


def test_a_gradient_that_overflows_in_the_encoder_is_left_out_and_counted(large, half, monkeypatch):
    monkeypatch.setattr(base, "MAX_BAD_STEPS", 3)
    model, prompts = large(SD)
    guide, rgb = guidance(SD, model), tiny.renders()
    clean, _ = gradient(guide, prompts, rgb)
    encode = guide.vae.encode

    def overflowing(images):
        images.register_hook(lambda grad: torch.cat([grad[:1], grad[1:2] * math.inf, grad[2:]]))
        return encode(images)

    guide.vae.encode = overflowing
    corrupted, _ = gradient(guide, prompts, rgb)
    assert not corrupted[1].any() and guide.bad_items == 1
    assert torch.equal(corrupted[[0, 2, 3]], clean[[0, 2, 3]])
    with pytest.raises(base.NonFiniteScore, match="VAE.*half_precision_weights=false"):
        for _ in range(2):
            gradient(guide, prompts, rgb)


@pytest.mark.parametrize(
    "half_type, force_upcast", [("float16", True), ("float16", False), ("bfloat16", True)]
)
def test_a_vae_that_overflows_is_float32(large, tmp_path, monkeypatch, half_type, force_upcast):
    folder = tiny_models.stable_diffusion_xl(tmp_path / "xl", force_upcast=force_upcast)
    dtype, prompts = getattr(torch, half_type), large(XL)[1]
    monkeypatch.setattr(text_to_image, "weights_type", lambda *options: dtype)
    guide, rgb = guidance(XL, folder, half_precision_type=half_type), tiny.renders()
    stays = force_upcast and dtype == torch.float16
    assert (guide.unet.dtype, guide.vae.dtype) == (dtype, torch.float32 if stays else dtype)
    mine, _ = gradient(guide, prompts, rgb)
    # bfloat16 rounds to 4e-3, which guidance 100 magnifies
    assert tiny.relative(mine, reference_gradient(XL, folder, prompts, rgb, scale=100.0)) < 0.5


def test_what_the_unets_of_xl_and_if_get_and_give(large):
    model, prompts = large(XL)
    guide = guidance(XL, model, image_size=128)
    guide.unet = recorder = tiny.Recorder(guide.unet)
    gradient(guide, prompts, tiny.renders())
    ((_, options),) = recorder.calls
    added = options["added_cond_kwargs"]
    assert added["time_ids"].tolist() == [[128, 128, 0, 0, 128, 128]] * 8
    assert torch.equal(added["text_embeds"][4:], prompts.uncond_text_embeddings_vd[:4, -1, :POOLED])
    model, _ = large(IF)
    guide, rgb = guidance(IF, model), tiny.renders(size=16)
    prompts = large_tiny.prompts(IF, model, use_perp_neg=True)
    before, _ = gradient(guide, prompts, rgb)
    with torch.no_grad():
        guide.unet.conv_out.weight[3:] += 1.0
    assert torch.equal(before, gradient(guide, prompts, rgb)[0])
    # its cosine schedule ends at 2.4e-9, below the value that replaces a signal of exactly 0
    from diffusers import DDPMScheduler

    expected = DDPMScheduler.from_pretrained(model, subfolder="scheduler").alphas_cumprod.double()
    torch.testing.assert_close(guide.alphas_cumprod, expected, rtol=1e-3, atol=0)
    assert guide.alphas_cumprod[-1] < 1e-8 and guide.text_width == tiny_models.TEXT_WIDTH  # of T5


@pytest.mark.parametrize("shift", [None, 1.0])
def test_the_gradient_of_a_flow_towards_one_known_latent_is_the_closed_form(large, shift):
    """With one mode of zero width the noise cancels: v_hat - v = (x - x1) / sigma."""
    target = torch.randn(1, 16, 8, 8, generator=torch.Generator().manual_seed(1))
    model, prompts = large(SD3)
    guide = guidance(SD3, model, guidance_scale=1.0, flow_shift=shift, min_step_percent=0.1)

    def exact(hidden_states, timestep, **conditions):
        return (hidden_states - target) / (timestep / 1000)[:, None, None, None]

    guide.transformer = large_tiny.StandIn(guide.transformer, exact)
    latents = torch.randn(4, 8, 8, 16, generator=torch.Generator().manual_seed(2)).requires_grad_()
    mine, _ = gradient(guide, prompts, latents, rgb_as_latents=True)
    sigma = sigma_of(guide.draw_timesteps(latents)[0].double(), shift or 3.0)
    expected = (latents.detach().double() - target.movedim(1, -1)) / sigma[:, None, None, None] / 4
    assert tiny.relative(mine, expected) < 1e-5


@pytest.mark.parametrize(
    "kind, trained, other, wrong, said",
    [
        (SD, 64, 128, 100, "expected a multiple of 8"),
        (SD3, 64, 192, 72, "expected a multiple of 16"),
        (SD3, 64, 96, 208, ".* positions up to 192 pixels, got 208"),
        (IF, 16, 32, 5000, "expected a number from 1 to 4096"),
    ],
)
def test_the_size_is_the_models_unless_given(large, caplog, kind, trained, other, wrong, said):
    model, prompts = large(kind)
    assert guidance(kind, model).image_size == trained
    assert "was trained on images of" not in caplog.text
    guide = guidance(kind, model, image_size=other)
    assert guide.image_size == other
    assert f"was trained on images of {trained} x {trained}" in caplog.text
    mine, _ = gradient(guide, prompts, tiny.renders(size=32))
    assert (mine != 0).all(), "a pixel that the model doesn't see is never trained"
    refused(f"image_size: {said}", guidance, kind, model, image_size=wrong)


def test_other_models_and_shifts_that_depend_on_the_picture_are_refused(tmp_path, large):
    folder = tiny_models.stable_diffusion_3(tmp_path / "dynamic")
    file = folder / "scheduler" / "scheduler_config.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"use_dynamic_shifting": True}))
    refused("set system.guidance.flow_shift", guidance, SD3, folder)
    assert guidance(SD3, folder, flow_shift=3.0).image_size == 64
    (model, prompts), (other, _) = large(XL), large(SD)
    said = "isn't Stable Diffusion XL, but Stable Diffusion 1.x.*--config gaussiandreamer.yaml"
    for build in (guidance, large_tiny.prompts):
        refused(said, build, XL, other)
    refused("isn't Stable Diffusion 1.x.*gaussiandreamer-sdxl.yaml", guidance, SD, model)
    refused("64 channels.*takes 32", gradient, guidance(SD, other), prompts, tiny.renders())


DTYPES = {"fp16": torch.float16, "bf16": torch.bfloat16}
NO_LORA = {SD3: "is a transformer", "mvdream": "predicts several together"}
VARIANTS = [module.name for module in iter_modules(variants.__path__) if module.name != "base"]


def ring():
    """Return four views around the object, and what the renderer gives of them."""
    depth, opacity = torch.full((4, 16, 16, 1), 2.0), torch.ones(4, 16, 16, 1)
    return test_mvdream.ring() | {"depth": depth, "opacity": opacity, "fovy": torch.ones(4)}


@pytest.mark.parametrize(
    "kind, variant",
    [*((SD, variant) for variant in VARIANTS), (XL, "sdi"), (SD3, "cfd"), ("mvdream", "nfsd")],
)
def test_variants_give_a_gradient(large, prompts, kind, variant):
    folder, prompt_utils = large(kind)
    prompt_utils = prompts[True] if kind == SD else prompt_utils
    guide = guidance(kind, folder, guidance_scale=7.5, variant_type=f"{variant}-variant")
    plain = guidance(kind, folder, guidance_scale=7.5)
    plain, _ = gradient(plain, prompt_utils, tiny.renders(), **ring())
    grad, out = gradient(guide, prompt_utils, tiny.renders(), **ring())
    assert grad.isfinite().all() and (grad != 0).float().mean() > 0.9 and out["bad_items"] == 0
    assert torch.allclose(grad, plain) == (variant == "sds") and out["evaluations"] >= 8


def test_several_views_together_have_an_empty_prompt_with_their_cameras(large):
    folder, prompt_utils = large("mvdream")
    guide = guidance("mvdream", folder, variant_type="nfsd-variant")
    condition = guide.condition(prompt_utils, **ring())
    negative = condition.embeddings[4:]
    assert condition.empty.shape == negative.shape and not torch.equal(condition.empty, negative)
    z, t = torch.randn(4, 4, 8, 8), torch.full((4,), 600)
    empty = guide.empty_prompt(z, t, condition)
    assert not torch.allclose(empty, guide.unconditional(z, t, condition))
    rows = torch.tensor([2, 0])
    assert torch.equal(condition.select(rows).empty, condition.empty[rows])


@pytest.mark.parametrize("kind", [XL, *NO_LORA])
def test_a_lora_is_trained_in_unets_of_single_views(large, kind):
    folder, prompt_utils = large(kind)
    options = {"pretrained_model_name_or_path": str(folder), "variant_type": "vsd-variant"}
    if kind in NO_LORA:
        part = type(guidance(kind, folder))
        refused(f"vsd-variant trains a LoRA .*{NO_LORA[kind]}", part.preflight, options)
    else:
        guide = guidance(kind, folder, variant_type="vsd-variant")
        for option in ("enable_torch_compile", "enable_sequential_cpu_offload"):
            said = f"system.guidance.{option}: vsd-variant trains"
            refused(said, guide.preflight, options | {option: True})
        grad, out = gradient(guide, prompt_utils, tiny.renders(), **ring())
        assert grad.isfinite().all() and grad.any() and out["bad_items"] == 0


@pytest.mark.parametrize(
    "kind, variant, named", [(XL, "fp16", True), (SD3, "bf16", True), ("mvdream", "fp16", False)]
)
def test_models_published_in_half_precision_only(large, kind, variant, named, tmp_path):
    """With the precision in the files' names, or without."""
    from safetensors.torch import load_file, save_file

    folder, prompts = large(kind)
    copy = Path(shutil.copytree(folder, tmp_path / "model"))
    for path in copy.rglob("*.safetensors"):
        tensors = load_file(path)
        for name, value in tensors.items():
            tensors[name] = value.to(DTYPES[variant]) if value.is_floating_point() else value
        path.unlink()
        new = path.with_name(f"{path.stem}.{variant}.safetensors") if named else path
        save_file(tensors, new, metadata={"format": "pt"})
    guides = (guidance(kind, model) for model in (folder, copy))
    full, half = (gradient(guide, prompts, tiny.renders(), **ring())[0] for guide in guides)
    # bfloat16 rounds to 4e-3, which guidance 100 magnifies
    assert 0 < tiny.relative(half, full.double()) < (0.1 if variant == "fp16" else 0.5)
