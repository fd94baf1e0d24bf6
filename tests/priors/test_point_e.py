"""Point-E with tiny weights under the published names; its blocks: ``test_shap_e.py``."""

import numpy as np
import pytest
import safetensors.torch
import torch

from tests.helpers import tiny_3d_models as tiny
from tests.helpers.prior_contract import PriorContract, assert_valid
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.priors import point_e as module
from threestudio_gaussiandreamer.priors.point_e import (
    BaseModel,
    PointEPrior,
    Upsampler,
    load_network,
)

FAST = {"num_steps": 3, "num_points": 64}


@pytest.fixture(autouse=True)
def few_points(monkeypatch):
    monkeypatch.setattr(module, "UPSAMPLED", 96)


def make(files, **options):
    return PointEPrior(FAST | files | options)


class TestContract(PriorContract):
    @pytest.fixture
    def make_prior(self, point_e):
        return lambda **options: make(point_e, **options)


# The networks -------------------------------------------------------------------------------------


def both(*names):
    return {f"{name}.{kind}" for name in names for kind in ("weight", "bias")}


LINEAR = ("attn.c_qkv", "attn.c_proj", "ln_1", "mlp.c_fc", "mlp.c_proj", "ln_2")
SHARED = both(
    "time_embed.c_fc", "time_embed.c_proj", "ln_pre", "ln_post", "input_proj", "output_proj",
    *(f"backbone.resblocks.{block}.{name}" for block in range(12) for name in LINEAR),
)  # fmt: skip


def test_names_and_shapes_are_the_published_ones():
    """Those of the configurations ``base40M-textvec`` and ``upsample`` that openai/point-e
    publishes.
    """
    with torch.device("meta"):
        base, upsampler = BaseModel().state_dict(), Upsampler().state_dict()
    buffers = {"channel_scales", "channel_biases"}
    assert set(base) == SHARED | both("clip_embed")
    names = both("cond_point_proj", "clip_embed.0", "clip_embed.1")
    assert set(upsampler) == SHARED | names | buffers
    shapes = {
        "input_proj.weight": (512, 6),
        "output_proj.weight": (12, 512),
        "time_embed.c_fc.weight": (2048, 512),
        "backbone.resblocks.11.attn.c_qkv.weight": (1536, 512),
        "backbone.resblocks.0.mlp.c_proj.weight": (512, 2048),
    }
    for name, shape in shapes.items():
        assert base[name].shape == upsampler[name].shape == shape
    assert base["clip_embed.weight"].shape == (512, 768)
    assert upsampler["clip_embed.1.weight"].shape == (512, 1024)
    assert 40e6 < sum(value.numel() for value in base.values()) < 41e6  # "40M"
    assert module.SCALES[:, 0].tolist() == pytest.approx([2.0] * 3 + [0.007843137255] * 3)
    assert module.BIASES[:, 0].tolist() == [0.0] * 3 + [-1.0] * 3


@torch.no_grad()
def test_points_have_no_order_and_conditions_matter():
    torch.manual_seed(0)
    base, upsampler = BaseModel(64, 1, tiny.FEATURES), Upsampler(64, 1, 40)
    points, timesteps, order = torch.randn(2, 6, 9), torch.tensor([5, 900]), torch.randperm(9)
    condition, coarse = torch.randn(2, tiny.FEATURES), torch.rand(2, 6, 7) * 100
    close = {"atol": 1e-5, "rtol": 1e-5}
    for model, given in ((base, condition), (upsampler, coarse)):
        output = model(points, timesteps, given)
        assert output.shape == (2, 12, 9)
        other = model(points[:, :, order], timesteps, given)
        torch.testing.assert_close(other, output[:, :, order], **close)
        assert (model(points, timesteps, 0 * given) - output).abs().max() > 1e-3
        assert (model(points, timesteps + 50, given) - output).abs().max() > 1e-3
    # of the upsampler's empty image 256 equal tokens; attention would depend on their number
    seen = []
    upsampler.ln_pre.register_forward_hook(lambda module, inputs, output: seen.append(inputs[0]))
    upsampler(torch.randn(1, 6, 9), torch.tensor([5]), torch.rand(1, 6, 7))
    assert seen[0].shape == (1, 1 + 256 + 7 + 9, 64)
    expected = upsampler.clip_embed(torch.zeros(40))
    torch.testing.assert_close(seen[0][0, 1:257], expected.expand(256, 64))


# The prior ----------------------------------------------------------------------------------------


def test_what_points_depend_on(point_e, monkeypatch):
    cloud = make(point_e)("a fox")
    assert_valid(cloud)
    assert len(cloud.points) == 64 + 96 and cloud.faces is None
    # x0 is clamped, and guidance is 3, so coarse points lie within 1 + 2 * 2 = 5 times, further
    # ones within the box
    assert np.abs(cloud.points[64:]).max() <= 0.5 * 1.6 + 1e-5
    np.testing.assert_allclose(cloud.colors * 255, (cloud.colors * 255).round(), atol=1e-4)
    coarse = make(point_e, upsampler=None)("a fox")
    np.testing.assert_array_equal(cloud.points[:64], coarse.points)
    assert len(coarse.points) == 64
    same = make(point_e, prompt="a fox")("a bear").points
    np.testing.assert_array_equal(same, cloud.points)
    others = [make(point_e)("a bear"), make(point_e, guidance_scale=1.0)("a fox")]
    monkeypatch.setenv("PL_GLOBAL_SEED", "7")
    others.append(make(point_e)("a fox"))
    assert not any(np.allclose(other.points, cloud.points) for other in others)


def test_the_default_is_4096_points(monkeypatch):
    monkeypatch.undo()
    cfg = PointEPrior({"checkpoint": "x.pt"}).cfg
    assert (cfg.num_points + module.UPSAMPLED, cfg.num_steps, cfg.guidance_scale) == (4096, 64, 3)
    numbers = [(kind.sigma_max, kind.churn) for kind in (BaseModel, Upsampler)]
    assert numbers == [(120, 3), (160, 0)]


def test_units_and_axes(point_e, monkeypatch):
    """With networks that always give one point: x, y, z and a colour, in the networks' units."""

    def fixed(self, points, timesteps, given):
        point = torch.tensor([0.2, 0.4, 0.6, 1.0, 0.2, -1.0])
        return torch.cat([point[None, :, None].expand_as(points)] * 2, dim=1)

    def denoiser(network, levels, **_):
        return lambda x, sigma: network(x, torch.zeros(1))

    monkeypatch.setattr(BaseModel, "forward", fixed)
    monkeypatch.setattr(module.karras, "guided_denoiser", denoiser)
    cloud = make(point_e, upsampler=None)("a fox")
    wanted = 1.6 * np.array([-0.2, 0.1, 0.3])  # (-y, x, z) of half the units
    np.testing.assert_allclose(cloud.points, np.tile(wanted, (64, 1)), atol=1e-5)
    wanted = [1.0, 153 / 255, 0.0]  # 1.2 * 127.5 = 153
    np.testing.assert_allclose(cloud.colors, np.tile(wanted, (64, 1)), atol=1e-6)


def test_sizes_are_read_off_the_weights(tmp_path, point_e):
    torch.save(BaseModel(width=128, layers=3, features=10).state_dict(), tmp_path / "other.pt")
    model = load_network(BaseModel, str(tmp_path / "other.pt"))
    blocks = model.backbone.resblocks
    assert (model.width, len(blocks), blocks[0].attn.heads) == (128, 3, 2)
    assert not model.training and not any(value.requires_grad for value in model.parameters())
    with pytest.raises(UserError, match="clip: .* 24 features, .* 10: use ViT-L/14"):
        make(point_e, checkpoint=str(tmp_path / "other.pt"))("a fox")


def test_other_files_of_the_same_weights(tmp_path, point_e):
    """Cap3D's wrapped checkpoint, torch's old format, and safetensors."""
    state = torch.load(point_e["checkpoint"])
    torch.save({"model_state_dict": state, "epoch": 3}, tmp_path / "finetuned.pth")
    torch.save(state, tmp_path / "old.pt", _use_new_zipfile_serialization=False)
    safetensors.torch.save_file(state, tmp_path / "points.safetensors")
    for name in ("finetuned.pth", "old.pt", "points.safetensors"):
        found = load_network(BaseModel, str(tmp_path / name)).state_dict()
        assert all(torch.equal(found[key], value) for key, value in state.items())
    path = tmp_path / "points.safetensors"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(UserError, match=r"points\.safetensors' can't be read"):
        load_network(BaseModel, str(path))


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda state: state.pop("ln_post.bias"), 'Missing key.*"ln_post.bias"'),
        (lambda state: state.update({"extra": torch.zeros(1)}), 'Unexpected key.*"extra"'),
        (lambda state: state.update({"output_proj.bias": torch.zeros(6)}), "size mismatch"),
        (lambda state: state.update({"ln_pre.weight": torch.zeros(65)}), "another model"),
        (lambda state: state.update({"step": 3}), "no weights by name"),
    ],
)
def test_another_models_weights_are_refused(tmp_path, point_e, change, message):
    state = torch.load(point_e["checkpoint"])
    change(state)
    torch.save(state, tmp_path / "spoiled.pt")
    with pytest.raises(UserError, match=message):
        load_network(BaseModel, str(tmp_path / "spoiled.pt"))
    with pytest.raises(UserError, match=r"upsampler checkpoint .* give upsample_40m.pt"):
        load_network(Upsampler, point_e["checkpoint"])


def test_wrong_options_and_missing_files_fail_before_any_work(point_e, tmp_path, monkeypatch):
    for option in ({"checkpoint": ""}, {"num_points": 0}, {"guidance_scale": 0.0}, {"front": "z"}):
        with pytest.raises(UserError, match=next(iter(option)).split("_")[0]):
            make(point_e, **option)
    monkeypatch.setattr(PointEPrior, "condition", lambda *args: pytest.fail("worked"))
    for option in ("checkpoint", "upsampler"):
        with pytest.raises(UserError, match="nothing.pt"):
            make(point_e, **{option: "nothing.pt"})("a fox")
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(UserError, match="are missing"):
        make(point_e, clip=str(tmp_path)).preflight()
