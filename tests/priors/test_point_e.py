"""Point-E with tiny weights under the published names, and the Karras sampler on a case with a
known answer.
"""

import math
import os
import pickle

import numpy as np
import pytest
import safetensors.torch
import torch

from tests.helpers import tiny_3d_models as tiny
from tests.helpers.prior_contract import PriorContract, assert_valid
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.priors.point_e import BASE, UPSAMPLER, PointEPrior, load_network
from threestudio_gaussiandreamer.priors.point_e_model import (
    BaseModel,
    PointTransformer,
    Upsampler,
    timestep_embedding,
)

FAST = {"num_steps": 3, "num_points": 64, "num_upsampled": 96}


@pytest.fixture(scope="session")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    base, upsampler = tiny.point_e(folder / "point-e")
    return {
        "checkpoint": str(base),
        "upsampler": str(upsampler),
        "clip": str(tiny.clip(folder / "clip")),
    }


def make(files, **options):
    return PointEPrior(FAST | files | options)


class TestContract(PriorContract):
    @pytest.fixture
    def make_prior(self, files):
        return lambda **options: make(files, **options)


# --------------------------------------------------------------------------------------------------
# the networks


def block_names(block):
    linear = ("attn.c_qkv", "attn.c_proj", "ln_1", "mlp.c_fc", "mlp.c_proj", "ln_2")
    return {
        f"backbone.resblocks.{block}.{name}.{kind}"
        for name in linear
        for kind in ("weight", "bias")
    }


def both(*names):
    return {f"{name}.{kind}" for name in names for kind in ("weight", "bias")}


SHARED = both(
    "time_embed.c_fc", "time_embed.c_proj", "ln_pre", "ln_post", "input_proj", "output_proj"
).union(*map(block_names, range(12)))


def test_names_and_shapes_are_the_published_ones():
    """Those of the configurations ``base40M-textvec`` and ``upsample`` that openai/point-e
    publishes.
    """
    with torch.device("meta"):
        base, upsampler = BaseModel().state_dict(), Upsampler().state_dict()
    assert set(base) == SHARED | both("clip_embed")
    assert set(upsampler) == SHARED | both("cond_point_proj", "clip_embed.0", "clip_embed.1") | {
        "channel_scales",
        "channel_biases",
    }
    shapes = {
        "input_proj.weight": (512, 6),
        "output_proj.weight": (12, 512),
        "time_embed.c_fc.weight": (2048, 512),
    }
    shapes |= {
        "backbone.resblocks.11.attn.c_qkv.weight": (1536, 512),
        "backbone.resblocks.0.mlp.c_proj.weight": (512, 2048),
    }
    for name, shape in shapes.items():
        assert base[name].shape == upsampler[name].shape == shape
    assert base["clip_embed.weight"].shape == (512, 768) and upsampler[
        "clip_embed.1.weight"
    ].shape == (512, 1024)
    assert 40e6 < sum(value.numel() for value in base.values()) < 41e6  # "40M"


def test_normalisation_of_the_upsampler_is_the_published_one():
    upsampler = Upsampler(width=64, layers=1)
    assert upsampler.channel_scales.tolist() == pytest.approx([2.0] * 3 + [0.007843137255] * 3)
    assert upsampler.channel_biases.tolist() == [0.0] * 3 + [-1.0] * 3


@torch.no_grad()
def test_the_transformer_is_its_formula():
    """One block of two heads, written in numpy."""
    torch.manual_seed(0)
    model = PointTransformer(width=16, layers=1, heads=2).double()
    x = torch.randn(1, 5, 16, dtype=torch.float64)
    state = {
        name: value.numpy() for name, value in model.backbone.resblocks[0].state_dict().items()
    }

    def norm(h, name):
        return (h - h.mean(-1, keepdims=True)) / np.sqrt(h.var(-1, keepdims=True) + 1e-5) * state[
            f"{name}.weight"
        ] + state[f"{name}.bias"]

    def linear(h, name):
        return h @ state[f"{name}.weight"].T + state[f"{name}.bias"]

    h = x[0].numpy()
    packed, heads = linear(norm(h, "ln_1"), "attn.c_qkv"), []
    for head in range(2):
        q, k, v = (packed[:, head * 24 + part * 8 : head * 24 + part * 8 + 8] for part in range(3))
        scores = np.exp(q @ k.T / math.sqrt(8))
        heads.append(scores / scores.sum(-1, keepdims=True) @ v)
    h = h + linear(np.concatenate(heads, axis=-1), "attn.c_proj")
    inner = linear(norm(h, "ln_2"), "mlp.c_fc")
    h = h + linear(inner * 0.5 * (1 + np.vectorize(math.erf)(inner / math.sqrt(2))), "mlp.c_proj")
    np.testing.assert_allclose(model.backbone(x)[0].numpy(), h, atol=1e-12)


@torch.no_grad()
def test_points_have_no_order_and_conditions_matter():
    torch.manual_seed(0)
    base, upsampler = BaseModel(64, 1, tiny.FEATURES), Upsampler(64, 1, 40)
    points, timesteps, order = torch.randn(2, 6, 9), torch.tensor([5, 900]), torch.randperm(9)
    condition, coarse = torch.randn(2, tiny.FEATURES), torch.rand(2, 6, 7) * 100
    for model, given in ((base, condition), (upsampler, coarse)):
        output = model(points, timesteps, given)
        assert output.shape == (2, 12, 9)
        torch.testing.assert_close(
            model(points[:, :, order], timesteps, given), output[:, :, order], atol=1e-5, rtol=1e-5
        )
        assert (model(points, timesteps, 0 * given) - output).abs().max() > 1e-3
        assert (model(points, timesteps + 50, given) - output).abs().max() > 1e-3
        torch.testing.assert_close(
            model(points[:1], timesteps[:1], given[:1]), output[:1], atol=1e-5, rtol=1e-5
        )


@torch.no_grad()
def test_the_upsampler_sees_an_empty_image():
    """256 equal tokens; softmax attention would depend on their number."""
    torch.manual_seed(0)
    upsampler, seen = Upsampler(64, 1, 40), []
    upsampler.ln_pre.register_forward_hook(lambda module, inputs, output: seen.append(inputs[0]))
    upsampler(torch.randn(1, 6, 9), torch.tensor([5]), torch.rand(1, 6, 7))
    assert seen[0].shape == (1, 1 + 256 + 7 + 9, 64)
    expected = upsampler.clip_embed(torch.zeros(40))
    torch.testing.assert_close(seen[0][0, 1:257], expected.expand(256, 64))


def test_timestep_embedding():
    embedding = timestep_embedding(torch.tensor([0.0, 7.0]), 8)
    assert embedding[0].tolist() == [1, 1, 1, 1, 0, 0, 0, 0]
    expected = [math.cos(7 * f) for f in (1, 0.1, 0.01, 0.001)] + [
        math.sin(7 * f) for f in (1, 0.1, 0.01, 0.001)
    ]
    torch.testing.assert_close(embedding[1], torch.tensor(expected), atol=1e-5, rtol=0)


# --------------------------------------------------------------------------------------------------
# the prior


def test_registered_and_valid(files):
    assert find("point-e-prior") is PointEPrior
    cloud = make(files)("a fox")
    assert_valid(cloud)
    assert len(cloud.points) == 64 + 96 and cloud.faces is None
    # x0 is clamped, and guidance is 3, so coarse points lie within 1 + 2 * 2 = 5 times, further
    # ones within the box
    assert np.abs(cloud.points[64:]).max() <= 0.5 * 1.6 + 1e-5
    np.testing.assert_allclose(cloud.colors * 255, (cloud.colors * 255).round(), atol=1e-4)


def test_the_default_is_4096_points():
    cfg = PointEPrior({"checkpoint": "x.pt"}).cfg
    assert (cfg.num_points + cfg.num_upsampled, cfg.num_steps, cfg.guidance_scale) == (4096, 64, 3)
    assert (cfg.sigma_min, *cfg.sigma_max, *cfg.churn) == (1e-3, 120, 160, 3, 0)


def test_coarse_points_come_first_and_alone_without_an_upsampler(files):
    whole, coarse = make(files)("a fox"), make(files, upsampler=None)("a fox")
    np.testing.assert_array_equal(whole.points[:64], coarse.points)
    assert len(coarse.points) == 64


def test_prompt_seed_and_guidance_matter(files, monkeypatch):
    first = make(files)("a fox")
    assert not np.allclose(make(files)("a bear").points, first.points)
    assert not np.allclose(make(files, guidance_scale=1.0)("a fox").points, first.points)
    np.testing.assert_array_equal(make(files, prompt="a fox")("a bear").points, first.points)
    monkeypatch.setenv("PL_GLOBAL_SEED", "7")
    assert not np.allclose(make(files)("a fox").points, first.points)


def known_sample(files, monkeypatch, **options):
    """Return the prior with networks that always give one point each: x, y, z and a colour, in the
    networks' units.
    """

    def fixed(point):
        return lambda self, points, timesteps, given: torch.cat(
            [torch.tensor(point)[None, :, None].expand_as(points)] * 2, dim=1
        )

    monkeypatch.setattr(BaseModel, "forward", fixed([0.2, 0.4, 0.6, 1.0, 0.2, -1.0]))
    monkeypatch.setattr(
        "threestudio_gaussiandreamer.priors.point_e.guided_denoiser",
        lambda network, levels, **_: lambda x, sigma: network(x, torch.zeros(1)),
    )
    return make(files, upsampler=None, **options)("a fox")


def test_units_and_axes(files, monkeypatch):
    cloud = known_sample(files, monkeypatch)
    np.testing.assert_allclose(
        cloud.points, np.tile(1.6 * np.array([-0.2, 0.1, 0.3]), (64, 1)), atol=1e-5
    )  # (-y, x, z) of half the units
    np.testing.assert_allclose(
        cloud.colors, np.tile([1.0, 153 / 255, 0.0], (64, 1)), atol=1e-6
    )  # 1.2 * 127.5 = 153


def test_sizes_are_read_off_the_weights(tmp_path, files):
    torch.manual_seed(0)
    torch.save(BaseModel(width=128, layers=3, features=10).state_dict(), tmp_path / "other.pt")
    model = load_network(BASE, str(tmp_path / "other.pt"))
    assert (
        model.width == 128
        and len(model.backbone.resblocks) == 3
        and model.backbone.resblocks[0].attn.heads == 2
    )
    assert not model.training and not any(
        parameter.requires_grad for parameter in model.parameters()
    )


def test_cap3ds_wrapped_checkpoint_is_the_same_network(tmp_path, files):
    torch.save(
        {"model_state_dict": torch.load(files["checkpoint"]), "epoch": 3},
        tmp_path / "pointE_finetuned_with_330kdata.pth",
    )
    wrapped = make(files, checkpoint=str(tmp_path / "pointE_finetuned_with_330kdata.pth"))("a fox")
    np.testing.assert_array_equal(wrapped.points, make(files)("a fox").points)


def test_files_of_the_old_format_are_read(tmp_path, files):
    torch.save(
        torch.load(files["checkpoint"]), tmp_path / "old.pt", _use_new_zipfile_serialization=False
    )
    np.testing.assert_array_equal(
        make(files, checkpoint=str(tmp_path / "old.pt"))("a fox").points,
        make(files)("a fox").points,
    )


def test_safetensors_are_read(tmp_path, files):
    path = tmp_path / "points.safetensors"
    safetensors.torch.save_file(torch.load(files["checkpoint"]), path)
    np.testing.assert_array_equal(
        make(files, checkpoint=str(path))("a fox").points, make(files)("a fox").points
    )
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(UserError, match=r"points\.safetensors' can't be read"):
        make(files, checkpoint=str(path))("a fox")


def test_swapped_files_are_named(files):
    with pytest.raises(UserError, match=r"upsampler checkpoint .* give upsample_40m.pt"):
        load_network(UPSAMPLER, files["checkpoint"])
    with pytest.raises(UserError, match=r"base checkpoint .* give base_40m_textvec.pt"):
        load_network(BASE, files["upsampler"])


def spoiled(state, change):
    change(state)
    return state


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda state: state.pop("ln_post.bias"), r"1 missing \(ln_post.bias\)"),
        (lambda state: state.update({"extra": torch.zeros(1)}), r"1 unknown \(extra\)"),
        (lambda state: state.update({"output_proj.bias": torch.zeros(6)}), "another shape"),
        (lambda state: state.pop("ln_pre.weight"), "another model"),
        (lambda state: state.update({"ln_pre.weight": torch.zeros(65)}), "another model"),
        (lambda state: state.update({"step": 3}), "no weights by name"),
    ],
)
def test_another_models_weights_are_refused(tmp_path, files, change, message):
    torch.save(spoiled(torch.load(files["checkpoint"]), change), tmp_path / "spoiled.pt")
    with pytest.raises(UserError, match=message):
        load_network(BASE, str(tmp_path / "spoiled.pt"))


class Evil:
    def __reduce__(self):
        return (exec, ("import os; os.environ['EVIL'] = '1'",))


def test_a_checkpoint_cannot_run_code(tmp_path, files, monkeypatch):
    monkeypatch.delenv("EVIL", raising=False)
    path = tmp_path / "evil.pt"
    for write in (lambda: torch.save(Evil(), path), lambda: path.write_bytes(pickle.dumps(Evil()))):
        write()
        with pytest.raises(UserError, match="not unpickled"):
            make(files, checkpoint=str(path))("a fox")
    assert "EVIL" not in os.environ


def test_a_clip_of_another_size_is_named(tmp_path, files):
    torch.save(
        BaseModel(width=64, layers=1, features=tiny.FEATURES + 8).state_dict(),
        tmp_path / "other.pt",
    )
    with pytest.raises(UserError, match="clip: .* 24 features, .* 32: use ViT-L/14"):
        make(files, checkpoint=str(tmp_path / "other.pt"))("a fox")


@pytest.mark.parametrize("option", ["checkpoint", "upsampler"])
def test_missing_files_fail_before_any_work(files, option, monkeypatch):
    monkeypatch.setattr(PointEPrior, "_condition", lambda *args: pytest.fail("worked"))
    with pytest.raises(UserError, match="nothing.pt"):
        make(files, **{option: "nothing.pt"})("a fox")


def test_a_missing_clip_fails_before_any_work(files, tmp_path):
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(UserError, match="are missing"):
        make(files, clip=str(tmp_path)).preflight()


@pytest.mark.parametrize(
    "option",
    [
        {"checkpoint": ""},
        {"sigma_max": [120.0]},
        {"sigma_max": [120.0, 1e-4]},
        {"churn": "much"},
        {"churn": [-1.0, 0.0]},
        {"num_points": 0},
        {"guidance_scale": 0.0},
        {"front": "z"},
    ],
)
def test_options_out_of_range(files, option):
    with pytest.raises(UserError, match=next(iter(option)).split("_")[0]):
        make(files, **option)
