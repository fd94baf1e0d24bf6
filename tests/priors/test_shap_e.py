"""Shap-E with tiny weights in the published files: the mesh and its pose, sampling, Cap3D's
checkpoint; and the files of models in folders, the hub's cache and on the hub.
"""

import gc
import sys

import numpy as np
import pytest
import torch

from tests.helpers import tiny_3d_models as tiny
from tests.helpers.prior_contract import PriorContract, assert_valid
from tests.priors.cases import seeded
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.priors import point_e
from threestudio_gaussiandreamer.priors import shap_e as module
from threestudio_gaussiandreamer.priors.point_e import PointTransformer
from threestudio_gaussiandreamer.priors.shap_e import SIGMA_MAX, ShapEPrior, load_original_prior

PARTS = ("text_encoder", "tokenizer")
QKV = "wrapped.backbone.resblocks.0.attn.c_qkv"


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Take few steps and a coarse grid."""
    monkeypatch.setattr(module, "STEPS", 2)
    monkeypatch.setattr(module, "GRID_SIZE", 24)


def make(folder, **options):
    return ShapEPrior({"model": str(folder)} | options)


def sampled(folder, prompt="a fox", seed=0, **options):
    return make(folder, **options)._sample(folder, prompt, seeded(seed))


class TestContract(PriorContract):
    @pytest.fixture
    def make_prior(self, folder):
        return lambda **options: make(folder, **options)


# The mesh in the world ----------------------------------------------------------------------------


def world(values):
    """Convert Shap-E's (x, y, z) to the prior's world: -y is the front."""
    return np.array([-values[1], values[0], values[2]])


def test_the_surface_is_where_the_shape_is_in_the_papers_scale(folder, monkeypatch):
    from diffusers import ModelMixin

    monkeypatch.setattr(module, "GRID_SIZE", 64)
    cloud = make(folder)("a fox")
    assert_valid(cloud)
    gc.collect()  # Stable Diffusion, which is loaded next, needs the memory
    assert not [thing for thing in gc.get_objects() if isinstance(thing, ModelMixin)]
    # the border that closes the surface makes it smaller: see the module
    centre, half = (1.6 * 63 / 65 * world(v) for v in (tiny.SHAPE_CENTRE, tiny.SHAPE_HALF_SIDES))
    low, high, cell = cloud.points.min(axis=0), cloud.points.max(axis=0), 1.6 * 2 / 64
    np.testing.assert_allclose((low + high) / 2, centre, atol=cell)
    np.testing.assert_allclose((high - low) / 2, np.abs(half), atol=cell)
    assert (low + high)[0] > 0  # the shape lies on the -y side of Shap-E's space
    distance = (np.abs(cloud.points - centre) / np.abs(half)).sum(axis=1)
    assert np.abs(distance - 1).mean() < 0.01
    # half a cell, 1/64, in units of the narrowest half side, 0.2
    np.testing.assert_allclose(distance, 1, atol=0.08)
    assert set(cloud.faces.ravel()) == set(range(len(cloud.points)))
    turned = make(folder, scale=0.8, front="+x")("a fox").points
    np.testing.assert_allclose(2 * turned, cloud.points[:, [1, 0, 2]] * [1, -1, 1], atol=1e-6)


def test_colors_are_display_values_and_can_be_linear(folder):
    display, linear = make(folder)("a fox"), make(folder, colors="linear")("a fox")
    # the renderer asks for colours at the shrunk surface, so here the border plays no part
    up = (display.points[:, 2] / 1.6 - tiny.SHAPE_CENTRE[2]) / tiny.SHAPE_HALF_SIDES[2]
    expected = np.stack([np.full_like(up, 2.0), up, np.zeros_like(up)], axis=1)
    logistic = 1 / (1 + np.exp(-expected))
    np.testing.assert_allclose(display.colors, logistic, atol=0.005)  # SiLU near 0
    decoded = ((display.colors + 0.055) / 1.055) ** 2.4
    wanted = np.where(display.colors < 0.04045, 0, decoded)
    np.testing.assert_allclose(linear.colors, wanted, atol=1e-5)


def test_no_surface_and_latents_that_are_not_finite_are_messages(copy):
    from diffusers.pipelines.shap_e.renderer import ShapERenderer

    renderer = ShapERenderer.from_pretrained(copy / "shap_e_renderer")
    with torch.no_grad():
        renderer.mlp.mlp[2].bias[0] = -5.0
    renderer.save_pretrained(copy / "shap_e_renderer")
    with pytest.raises(UserError, match="no surface"):
        make(copy)("a fox")
    with pytest.raises(UserError, match="not finite"):
        module.decoded(None, torch.full((1, 16, 8), torch.nan), "display")


# Sampling -----------------------------------------------------------------------------------------


def test_text_condition_equals_the_pipelines(folder):
    """Without padding, and with our loading; diffusers pads to 77 tokens."""
    from diffusers import ShapEPipeline

    prior = make(folder)
    ours = prior.condition("Shap-E", folder, "a red fox", PARTS)
    theirs = ShapEPipeline.from_pretrained(folder)._encode_prompt("a red fox", ours.device, 1, True)
    torch.testing.assert_close(ours.flip(0), theirs, atol=1e-5, rtol=1e-5)
    assert ours[0].square().mean().item() == pytest.approx(1, abs=1e-5)
    own = make(folder, prompt="a red fox").condition("Shap-E", folder, "a toy", PARTS)
    assert torch.equal(own, ours)
    cut, longer = (prior.condition("Shap-E", folder, "x" * n, PARTS) for n in (400, 500))
    torch.testing.assert_close(cut, longer)


def test_our_sampler_agrees_with_the_pipelines(copy, monkeypatch):
    """With noise levels given to its scheduler and a network that ignores time (its timesteps are
    fractional, ours are not) and stays within [-1, 1] (it clamps after guidance, the published code
    before), both are one algorithm.
    """
    from diffusers import PriorTransformer, ShapEPipeline

    prior = PriorTransformer.from_pretrained(copy / "prior")
    with torch.no_grad():
        prior.time_embedding.linear_1.weight.zero_()
        prior.proj_to_clip_embeddings.weight.mul_(0.02)
    prior.save_pretrained(copy / "prior")
    monkeypatch.setattr(module, "STEPS", 6)
    options = {"num_inference_steps": 6, "guidance_scale": 3.0}
    ours = sampled(copy, "a red fox", guidance_scale=3.0)
    pipeline = ShapEPipeline.from_pretrained(copy)
    pipeline.scheduler.register_to_config(sigma_min=1e-3, sigma_max=SIGMA_MAX)
    noise = torch.randn(1, 16, 8, generator=seeded()).flatten(1)
    theirs = pipeline("a red fox", latents=noise, output_type="latent", **options).images
    levels = [pipeline.scheduler.sigmas[place].item() for place in (0, -2)]
    assert levels == pytest.approx([160, 1e-3]) and ours.abs().max() < 1
    # 160 in float32 has a spacing of 1.5e-5
    torch.testing.assert_close(ours, theirs, atol=2e-5, rtol=0)


def test_what_latents_depend_on(folder):
    base = sampled(folder)
    assert torch.equal(sampled(folder), base) and not base.requires_grad
    changes = ({"seed": 1}, {"guidance_scale": 1.0})
    others = [sampled(folder, "a bear"), *(sampled(folder, **change) for change in changes)]
    assert all((other - base).abs().max() > 1e-4 for other in others)


# Cap3D's checkpoint -------------------------------------------------------------------------------


class OriginalShapE(PointTransformer):
    """OpenAI's text model: Point-E's transformer with positions, other channels, and the text's
    features first.
    """

    def __init__(self):
        super().__init__(width=16, layers=2)
        self.input_proj, self.output_proj = torch.nn.Linear(8, 16), torch.nn.Linear(16, 16)
        self.clip_embed = torch.nn.Linear(tiny.FEATURES, 16)
        self.pos_emb = torch.nn.Parameter(torch.randn(16, 16))

    def forward(self, z, timesteps, condition):
        points = self.input_proj(z) + self.pos_emb
        tokens = [self.clip_embed(condition)[:, None], self.time_token(timesteps), points]
        h = self.backbone.resblocks(self.ln_pre(torch.cat(tokens, dim=1)))
        return self.output_proj(self.ln_post(h)[:, 2:])


@pytest.fixture
def finetuned(tmp_path, monkeypatch):
    """Return a network, and its weights as Cap3D saves them, with the training state."""
    torch.manual_seed(5)
    monkeypatch.setattr(point_e, "HEAD_CHANNELS", 8)
    network, path = OriginalShapE(), tmp_path / "shapE_finetuned_with_330kdata.pth"
    state = {f"wrapped.{name}": value for name, value in network.state_dict().items()}
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-5).state_dict()
    torch.save({"model_state_dict": state, "optimizer_state_dict": optimizer}, path)
    return network, path


@torch.no_grad()
def test_converted_weights_are_the_original_network(finetuned, folder):
    original, path = finetuned
    loaded, generator = tiny.shap_e_prior(), seeded()
    load_original_prior(loaded, str(path))
    z = torch.randn(2, 16, 8, generator=generator)
    inputs = z, torch.tensor([3, 700]), torch.randn(2, tiny.FEATURES, generator=generator)
    ours, theirs = loaded(*inputs).predicted_image_embedding, original(*inputs)
    torch.testing.assert_close(ours, theirs, atol=1e-5, rtol=1e-5)
    assert (sampled(folder) - sampled(folder, checkpoint=str(path))).abs().max() > 1e-4


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda state: state.pop("wrapped.ln_pre.bias"), 'Missing key.*"norm_in.bias"'),
        (lambda state: state.update({f"{QKV}.bias": torch.zeros(7)}), 'ed key.*c_qkv.bias"'),
    ],
)
def test_every_key_is_accounted_for(finetuned, change, message):
    path = finetuned[1]
    state = torch.load(path)["model_state_dict"]
    change(state)
    torch.save(state, path)
    with pytest.raises(UserError, match=message):
        load_original_prior(tiny.shap_e_prior(), str(path))


# Files of models ----------------------------------------------------------------------------------


def weights_of(folder, part):
    return folder / part / "diffusion_pytorch_model.safetensors"


@pytest.mark.parametrize(
    "missing",
    ["prior/config.json", "scheduler/scheduler_config.json", "tokenizer/*", "shap_e_renderer/*.s*"],
)
def test_an_incomplete_folder_or_checkpoint_is_named(copy, missing, monkeypatch):
    assert make(copy).preflight() is None
    for option, value in {"scale": 0.0, "colors": "srgb", "front": "up"}.items():
        with pytest.raises(UserError, match=option):
            make(copy, **{option: value})
    monkeypatch.setattr(ShapEPrior, "_sample", lambda *args: pytest.fail("sampled"))
    with pytest.raises(UserError, match="Shap-E checkpoint"):
        make(copy, checkpoint="nothing.pth")("a fox")
    for path in list(copy.glob(missing)):
        path.unlink()
    with pytest.raises(UserError, match=missing.split("/")[0]):
        make(copy).preflight()


def test_a_bin_is_read_when_allowed(copy, folder):
    from safetensors.torch import load_file

    weights = weights_of(copy, "shap_e_renderer")
    torch.save(load_file(weights), weights.with_suffix(".bin"))
    weights.unlink()
    with pytest.raises(UserError, match="allow_bin"):
        make(copy).preflight()
    loaded = (make(copy, allow_bin=True), copy), (make(folder), folder)
    found, wanted = (prior._part(place, "shap_e_renderer").state_dict() for prior, place in loaded)
    assert all(torch.equal(found[name], value) for name, value in wanted.items())


def test_which_files_are_needed(folder, monkeypatch):
    """Those of the hub's repository that the pipeline of another model has are not."""
    names = [path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()]
    picked = make("some/model")._source().picks([*names, "renderer/old.bin"])
    assert weights_of(folder, "prior").relative_to(folder).as_posix() in picked
    assert "tokenizer/tokenizer_config.json" in picked and "renderer/old.bin" not in picked
    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(UserError, match=r"pip install 'threestudio-gaussiandreamer\[diffusion\]'"):
        make(folder)("a fox")
