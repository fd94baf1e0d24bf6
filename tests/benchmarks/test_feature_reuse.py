"""A U-Net of which the inner blocks' features are reused."""

import pytest
import torch

from benchmarks.quality import feature_reuse
from tests.helpers import tiny_guidance as tiny

pytest.importorskip("diffusers")


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    return tiny.make_models(tmp_path_factory.mktemp("models"))


def guidance(models, **options):
    folder = str(models["epsilon"])
    options |= {"pretrained_model_name_or_path": folder, "guidance_scale": 4.0}
    return feature_reuse.FeatureReuseGuidance(options)


@torch.no_grad()
def test_the_parts_of_a_unet_are_the_whole(models):
    unet = guidance(models).unet
    z, tokens = torch.randn(4, 4, 8, 8), torch.randn(4, 7, unet.config.cross_attention_dim)
    whole = unet(z, tiny.TIMESTEPS, encoder_hidden_states=tokens).sample
    output, features = feature_reuse.predict(unet, z, tiny.TIMESTEPS, tokens)
    assert torch.equal(output, whole)
    again, _ = feature_reuse.predict(unet, z, tiny.TIMESTEPS, tokens, features)
    other, _ = feature_reuse.predict(unet, z, tiny.TIMESTEPS, tokens, 2 * features)
    assert torch.equal(again, whole) and not torch.equal(other, whole)


def test_views_in_a_known_cell_need_a_share_of_an_evaluation(models, monkeypatch):
    monkeypatch.setattr(feature_reuse, "REUSED", 1.0)
    guide = guidance(models, timestep_cell=1000)
    prompts = tiny.make_prompts(models)[False]
    (first, _), (second, out) = (tiny.gradient(guide, prompts, tiny.renders()) for _ in range(2))
    assert torch.equal(first, second)  # features of the same inputs
    share = 1 - guide._inner_share
    assert 0 < share < 1 and out["evaluations"] == pytest.approx(8 * share)
    _, out = tiny.gradient(guide, prompts, tiny.renders(seed=1))
    assert out["evaluations"] == pytest.approx(8 * share)


def test_other_cells_are_predicted_as_a_whole(models, monkeypatch):
    monkeypatch.setattr(feature_reuse, "REUSED", 1.0)
    guide = guidance(models, timestep_cell=1000)
    prompts = tiny.make_prompts(models)[False]
    tiny.gradient(guide, prompts, tiny.renders())
    moved = tiny.BATCH | {"elevation": tiny.BATCH["elevation"] + 45}
    assert guide(tiny.renders(), prompts, **moved)["evaluations"] == 8
    guide.cfg.timestep_cell = 1
    guide.update_step(0, 1)
    _, out = tiny.gradient(guide, prompts, tiny.renders())
    assert out["evaluations"] == 8
