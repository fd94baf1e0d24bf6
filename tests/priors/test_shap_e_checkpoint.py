"""Checkpoints of the original Shap-E."""

import pickle

import pytest
import torch

from tests.helpers import tiny_3d_models as tiny
from tests.priors.shap_e_cases import CPU, make, seeded
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.priors.point_e_model import PointTransformer
from threestudio_gaussiandreamer.priors.shap_e import ShapEPrior
from threestudio_gaussiandreamer.priors.shap_e_checkpoint import load_original_prior

# -------------------------------------------------------------------------------------------------
# Cap3D's checkpoint


def to_original(state, heads=2):
    """Map diffusers' names to OpenAI's, independently of the code under test."""
    original = {}
    for name, value in state.items():
        if name in ("clip_mean", "clip_std") or any(part in name for part in ("to_k.", "to_v.")):
            continue
        if name == "positional_embedding":
            original["wrapped.pos_emb"] = value[0]
            continue
        if "to_q." in name:
            parts = [state[name.replace("to_q", part)] for part in ("to_q", "to_k", "to_v")]
            value = torch.cat(
                [torch.cat([part.chunk(heads)[head] for part in parts]) for head in range(heads)]
            )
        for diffusers_name, original_name in {
            "time_embedding.linear_1": "time_embed.c_fc",
            "time_embedding.linear_2": "time_embed.c_proj",
            "embedding_proj": "clip_embed",
            "proj_to_clip_embeddings": "output_proj",
            "proj_in": "input_proj",
            "norm_in": "ln_pre",
            "norm_out": "ln_post",
            "transformer_blocks": "backbone.resblocks",
            "attn1.to_q": "attn.c_qkv",
            "attn1.to_out.0": "attn.c_proj",
            "norm1": "ln_1",
            "norm3": "ln_2",
            "ff.net.0.proj": "mlp.c_fc",
            "ff.net.2": "mlp.c_proj",
        }.items():
            name = name.replace(diffusers_name, original_name)
        original[f"wrapped.{name}"] = value
    return original


@pytest.fixture
def finetuned(tmp_path):
    """Return a network, and its weights as Cap3D saves them, with the training state."""
    torch.manual_seed(3)
    prior = tiny.shap_e_prior()
    path = tmp_path / "shapE_finetuned_with_330kdata.pth"
    optimizer = torch.optim.AdamW(prior.parameters(), lr=1e-5)
    scheduler = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 10)
    states = {
        "optimizer_state_dict": optimizer.state_dict(),
        "scheduler_state_dict": scheduler.state_dict(),
    }
    torch.save({"model_state_dict": to_original(prior.state_dict()), **states}, path)
    return prior, path


def inputs(features=tiny.FEATURES):
    return (
        torch.randn(2, 16, 8, generator=seeded()),
        torch.tensor([3, 700]),
        torch.randn(2, features, generator=seeded(1)),
    )


@torch.no_grad()
def test_checkpoint_round_trip_is_exact(finetuned):
    prior, path = finetuned
    torch.manual_seed(4)
    loaded = tiny.shap_e_prior()
    assert not torch.equal(
        loaded(*inputs()).predicted_image_embedding, prior(*inputs()).predicted_image_embedding
    )
    load_original_prior(loaded, str(path))
    assert torch.equal(
        loaded(*inputs()).predicted_image_embedding, prior(*inputs()).predicted_image_embedding
    )


class OriginalShapE(PointTransformer):
    """OpenAI's text model: Point-E's transformer with positions, other channels, and the text's
    features first.
    """

    def __init__(self):
        super().__init__(width=16, layers=2, heads=2)
        self.input_proj, self.output_proj = torch.nn.Linear(8, 16), torch.nn.Linear(16, 16)
        self.clip_embed = torch.nn.Linear(tiny.FEATURES, 16)
        self.pos_emb = torch.nn.Parameter(torch.randn(16, 16))

    def forward(self, z, timesteps, condition):
        tokens = torch.cat(
            [
                self.clip_embed(condition)[:, None],
                self.time_token(timesteps),
                self.input_proj(z) + self.pos_emb,
            ],
            dim=1,
        )
        return self.output_proj(self.ln_post(self.backbone(self.ln_pre(tokens)))[:, 2:])


@torch.no_grad()
def test_converted_weights_are_the_same_network(tmp_path):
    """Two wrong maps of the names could be inverse to each other, so the original architecture is
    evaluated.
    """
    torch.manual_seed(5)
    original, loaded = OriginalShapE(), tiny.shap_e_prior()
    torch.save(
        {f"wrapped.{name}": value for name, value in original.state_dict().items()},
        tmp_path / "text_cond.pt",
    )
    load_original_prior(loaded, str(tmp_path / "text_cond.pt"))
    torch.testing.assert_close(
        loaded(*inputs()).predicted_image_embedding, original(*inputs()), atol=1e-5, rtol=1e-5
    )


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda state: state.pop("wrapped.ln_pre.bias"), r"1 missing \(norm_in.bias\)"),
        (
            lambda state: state.update({"wrapped.extra.weight": torch.zeros(1)}),
            "wrapped.extra.weight",
        ),
        (
            lambda state: state.update({"ln_pre.weight": torch.zeros(1)}),
            "none of Shap-E's text model",
        ),
        (lambda state: state.update({"wrapped.ln_pre.bias": torch.zeros(7)}), "another shape"),
        (
            lambda state: state.update(
                {"wrapped.backbone.resblocks.0.attn.c_qkv.bias": torch.zeros(7)}
            ),
            "heads",
        ),
        (
            lambda state: state.update({"wrapped.backbone.resblocks.7.ln_1.bias": torch.zeros(16)}),
            "unknown",
        ),
        (lambda state: [state.pop(name) for name in list(state)], "no weights by name"),
    ],
)
def test_every_key_is_accounted_for(finetuned, change, message):
    prior, path = finetuned
    state = torch.load(path)["model_state_dict"]
    change(state)
    torch.save(state, path)
    with pytest.raises(UserError, match=message):
        load_original_prior(prior, str(path))


class Evil:
    def __reduce__(self):
        return (exec, ("import os; os.environ['EVIL'] = '1'",))


def test_a_checkpoint_cannot_run_code(finetuned, monkeypatch):
    prior, path = finetuned
    monkeypatch.delenv("EVIL", raising=False)
    for write in (
        lambda: torch.save({"model_state_dict": Evil()}, path),
        lambda: path.write_bytes(pickle.dumps(Evil())),
    ):
        write()
        with pytest.raises(UserError, match="not unpickled"):
            load_original_prior(prior, str(path))
    path.write_bytes(b"not a checkpoint")
    with pytest.raises(UserError, match="checkpoint"):
        load_original_prior(prior, str(path))
    import os

    assert "EVIL" not in os.environ


def test_checkpoint_changes_what_is_sampled(folder, finetuned):
    published = make(folder)._sample(folder, "a fox", CPU, seeded())
    other = make(folder, checkpoint=str(finetuned[1]))._sample(folder, "a fox", CPU, seeded())
    assert (published - other).abs().max() > 1e-4


def test_a_missing_checkpoint_fails_before_any_work(folder, monkeypatch):
    monkeypatch.setattr(ShapEPrior, "_sample", lambda *args: pytest.fail("sampled"))
    with pytest.raises(UserError, match="Shap-E checkpoint"):
        make(folder, checkpoint="nothing.pth")("a fox")
