"""Prompts of models with several text encoders: agreement with diffusers' pipelines."""

import json

import pytest
import torch

from tests.helpers import tiny_large_models as tiny
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.models import model_files
from threestudio_gaussiandreamer.models.text_encoders import T5_LENGTH, pack, unpack
from threestudio_gaussiandreamer.prompts import pooled_prompt_processors  # noqa: F401

diffusers = pytest.importorskip("diffusers")


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    return {
        "stable-diffusion-xl": tiny.stable_diffusion_xl(folder / "xl"),
        "stable-diffusion-3": tiny.stable_diffusion_3(folder / "3"),
    }


def processed(folder, kind, **options):
    options = {
        "pretrained_model_name_or_path": str(folder),
        "prompt": "a fox",
        "negative_prompt": "ugly",
    } | options
    return find(f"gaussiandreamer-{kind}-prompt-processor")(options)()


def assert_same(mine, tokens, pooled):
    found = unpack(mine, pooled.shape[-1])
    for value, expected in zip(found, (tokens, pooled), strict=True):
        # the same network on another batch size: rounding only
        torch.testing.assert_close(value, expected, rtol=1e-5, atol=1e-5)


def test_packing_keeps_tokens_and_vector():
    tokens, vector = torch.randn(2, 3, 8), torch.randn(2, 5)
    packed = pack(tokens, vector)
    assert packed.shape == (2, 4, 8) and not packed[:, -1, 5:].any()
    again = unpack(packed, 5)
    assert torch.equal(again[0], tokens) and torch.equal(again[1], vector)


@pytest.mark.parametrize("negative", ["ugly", ""])
def test_the_embeddings_are_those_of_diffusers_stable_diffusion_xl(models, negative):
    folder = models["stable-diffusion-xl"]
    out = processed(folder, "stable-diffusion-xl", negative_prompt=negative)
    pipe = diffusers.StableDiffusionXLPipeline.from_pretrained(folder, local_files_only=True)
    # None is diffusers' way to have no negative prompt
    cond, uncond, pooled, pooled_uncond = pipe.encode_prompt(
        "a fox", device="cpu", negative_prompt=negative or None
    )
    assert_same(out.text_embeddings, cond, pooled)
    assert_same(out.uncond_text_embeddings, uncond, pooled_uncond)
    assert bool(out.uncond_text_embeddings.any()) == bool(negative)


def test_a_model_that_was_trained_with_an_empty_prompt_gets_one(models, tmp_path):
    import shutil

    folder = shutil.copytree(models["stable-diffusion-xl"], tmp_path / "other")
    index = json.loads((folder / "model_index.json").read_text())
    index["force_zeros_for_empty_prompt"] = False
    (folder / "model_index.json").write_text(json.dumps(index))
    out = processed(folder, "stable-diffusion-xl", negative_prompt="")
    assert out.uncond_text_embeddings.any()
    same_cache = processed(models["stable-diffusion-xl"], "stable-diffusion-xl", negative_prompt="")
    assert not same_cache.uncond_text_embeddings.any()


@pytest.mark.parametrize("use_t5", [True, False])
def test_the_embeddings_are_those_of_diffusers_stable_diffusion_3(models, use_t5):
    folder = models["stable-diffusion-3"]
    out = processed(folder, "stable-diffusion-3", use_t5=use_t5)
    without = {} if use_t5 else {"text_encoder_3": None, "tokenizer_3": None}
    pipe = diffusers.StableDiffusion3Pipeline.from_pretrained(
        folder, local_files_only=True, **without
    )
    cond, uncond, pooled, pooled_uncond = pipe.encode_prompt(
        "a fox", None, None, device="cpu", negative_prompt="ugly"
    )
    assert_same(out.text_embeddings, cond, pooled)
    assert_same(out.uncond_text_embeddings, uncond, pooled_uncond)
    assert bool(out.text_embeddings[0, -T5_LENGTH - 1 : -1].any()) == use_t5


def test_without_t5_it_is_neither_needed_nor_mixed_up_in_the_cache(models, tmp_path):
    import shutil

    folder = models["stable-diffusion-3"]
    full = processed(folder, "stable-diffusion-3").text_embeddings
    without = processed(folder, "stable-diffusion-3", use_t5=False).text_embeddings
    assert not torch.equal(full, without)
    small = shutil.copytree(folder, tmp_path / "small", ignore=lambda *_: ["text_encoder_3"])
    assert torch.equal(
        processed(small, "stable-diffusion-3", use_t5=False).text_embeddings, without
    )
    with pytest.raises(UserError, match="text_encoder_3/config.json is missing"):
        processed(small, "stable-diffusion-3")


@pytest.mark.parametrize("kind", ["stable-diffusion-xl", "stable-diffusion-3"])
def test_directions_and_cache(models, kind, monkeypatch):
    first = processed(models[kind], kind, use_perp_neg=True)
    monkeypatch.setattr(model_files, "load_network", lambda *args: pytest.fail("loaded again"))
    second = processed(models[kind], kind, use_perp_neg=True)
    assert torch.equal(first.text_embeddings_vd, second.text_embeddings_vd)
    assert len(first.text_embeddings_vd.unique(dim=0)) == 4


@pytest.mark.parametrize("kind", ["stable-diffusion-xl", "stable-diffusion-3"])
def test_a_model_of_another_family_is_refused_by_name(models, kind):
    (other,) = set(models) - {kind}
    with pytest.raises(UserError, match=f"but .*{other}-guidance.*{other}-prompt-processor"):
        processed(models[other], kind)
