"""Prompts with text encoders: agreement with diffusers' pipelines, the cache, the library."""

import gc
import json
import os
import shutil
import weakref
from pathlib import Path

import pytest
import torch

from tests.helpers import tiny_models
from tests.helpers.refusals import refused
from tests.prompts.conftest import processed
from threestudio_gaussiandreamer.host import NAME, find
from threestudio_gaussiandreamer.models import model_files, text_encoders
from threestudio_gaussiandreamer.prompts.prompt_processors import StableDiffusionPromptProcessor
from threestudio_gaussiandreamer.prompts.prompts import WORDS_FILE

diffusers = pytest.importorskip("diffusers")
KINDS = ("stable-diffusion", "deep-floyd")
CACHE = Path(".threestudio_cache/text_embeddings")
pytestmark = pytest.mark.usefixtures("fox")


def assert_same(mine, tokens, pooled=None):
    found = (mine,) if pooled is None else text_encoders.unpack(mine, pooled.shape[-1])
    for value, expected in zip(found, (tokens, pooled), strict=False):
        # the same network on another batch size: rounding only
        torch.testing.assert_close(value, expected, rtol=1e-5, atol=1e-5)


def changed(model, folder, part="tokenizer/tokenizer_config", **settings):
    """Return a copy of a model with other settings of its tokenizer, or of another ``part``."""
    copy = Path(shutil.copytree(model, folder))
    file = copy / f"{part}.json"
    known = json.loads(file.read_text()) | settings
    file.write_text(json.dumps({k: value for k, value in known.items() if value is not None}))
    return copy


@pytest.mark.parametrize(("kind", "pipeline"), zip(KINDS, ("StableDiffusion", "IF"), strict=True))
def test_the_embeddings_are_those_of_diffusers(models, kind, pipeline):
    out = processed(models[kind], kind, prompt=" a Fox")
    options = {"local_files_only": True} | ({"watermarker": None} if pipeline == "IF" else {})
    pipe = getattr(diffusers, f"{pipeline}Pipeline").from_pretrained(models[kind], **options)
    given = {"device": "cpu", "num_images_per_prompt": 1, "do_classifier_free_guidance": True}
    cond, uncond = pipe.encode_prompt(" a Fox", **given, negative_prompt="ugly")
    assert_same(out.text_embeddings, cond)
    assert_same(out.uncond_text_embeddings, uncond)


def test_the_embeddings_are_those_of_diffusers_stable_diffusion_xl(models, tmp_path):
    folder, kind = models["stable-diffusion-xl"], "stable-diffusion-xl"
    pipe = diffusers.StableDiffusionXLPipeline.from_pretrained(folder, local_files_only=True)
    for negative in ("ugly", ""):
        out = processed(folder, kind, negative_prompt=negative)
        # None is diffusers' way to have no negative prompt
        given = {"device": "cpu", "negative_prompt": negative or None}
        cond, uncond, pooled, pooled_uncond = pipe.encode_prompt("a fox", **given)
        assert_same(out.text_embeddings, cond, pooled)
        assert_same(out.uncond_text_embeddings, uncond, pooled_uncond)
        assert bool(out.uncond_text_embeddings.any()) == bool(negative)
    # a model that was trained with an empty prompt gets one, though the cache is the same
    other = changed(folder, tmp_path / "other", "model_index", force_zeros_for_empty_prompt=False)
    assert processed(other, kind, negative_prompt="").uncond_text_embeddings.any()
    assert not processed(folder, kind, negative_prompt="").uncond_text_embeddings.any()


@pytest.mark.parametrize("use_t5", [True, False])
def test_the_embeddings_are_those_of_diffusers_stable_diffusion_3(models, use_t5, tmp_path):
    folder, kind = models["stable-diffusion-3"], "stable-diffusion-3"
    out = processed(folder, kind, use_t5=use_t5)
    without = {} if use_t5 else {"text_encoder_3": None, "tokenizer_3": None}
    load, given = diffusers.StableDiffusion3Pipeline.from_pretrained, {"negative_prompt": "ugly"}
    encode = load(folder, local_files_only=True, **without).encode_prompt
    cond, uncond, pooled, pooled_uncond = encode("a fox", None, None, device="cpu", **given)
    assert_same(out.text_embeddings, cond, pooled)
    assert_same(out.uncond_text_embeddings, uncond, pooled_uncond)
    assert bool(out.text_embeddings[0, -text_encoders.T5_LENGTH - 1 : -1].any()) == use_t5
    # both are in one cache; without T5 its files aren't needed
    other = processed(folder, kind, use_t5=not use_t5).text_embeddings
    assert not torch.equal(out.text_embeddings, other)
    small = shutil.copytree(folder, tmp_path / "small", ignore=lambda *_: ["text_encoder_3"])
    if use_t5:
        refused("text_encoder_3/config.json is missing", processed, small, kind)
    else:
        again = processed(small, kind, use_t5=False).text_embeddings
        assert torch.equal(again, out.text_embeddings)


def test_tokens_of_stable_diffusion_2(models, fox, tmp_path, caplog):
    """Its tokenizer pads with "!" (0), which one of its two files contradicts."""
    from transformers import AutoTokenizer

    folder = models["stable-diffusion"]
    tokenizer = AutoTokenizer.from_pretrained(folder, subfolder="tokenizer")
    assert text_encoders._tokenize(tokenizer, ["a fox"], 77).input_ids[0, -1] == 0
    # one that names no length takes what CLIP was trained with
    endless = changed(folder, tmp_path / "endless", model_max_length=None)
    assert torch.equal(processed(endless).text_embeddings, fox().text_embeddings)
    assert not [record for record in caplog.records if record.levelname != "INFO"]
    one, two = (fox(prompt="a fox " * 60 + end).text_embeddings for end in ("one", "two"))
    assert "has no effect" in caplog.text and torch.equal(one, two)


def test_the_encoder_is_freed(fox, monkeypatch):
    seen, load = [], text_encoders.load_network

    def noted(*args, **options):
        network = load(*args, **options)
        seen.append(weakref.ref(network))
        return network

    monkeypatch.setattr(text_encoders, "load_network", noted)
    monkeypatch.setattr(model_files, "gc", gc)
    fox()
    assert [network() for network in seen] == [None]


def test_too_little_memory_on_the_gpu_means_the_cpu(monkeypatch, caplog):
    monkeypatch.setattr(text_encoders, "get_device", lambda: torch.device("cuda"))
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: None)

    def run(device):
        if device.type == "cuda":
            raise torch.OutOfMemoryError
        return torch.ones(1)

    assert text_encoders._freed(run) == 1
    assert "runs on the CPU" in caplog.text


def test_a_damaged_model_is_reported_and_its_code_not_run(models, tmp_path, monkeypatch):
    code = {"tokenizer_class": "Mine", "auto_map": {"AutoTokenizer": ["mine.Mine", None]}}
    folder = changed(models["stable-diffusion"], tmp_path / "custom", **code)
    (folder / "mine.py").write_text("import os\nos._exit(7)\n")
    monkeypatch.setattr("builtins.input", lambda *args: "y")
    refused("tokenizer of the model in .* can't be loaded", processed, folder)
    folder = changed(models["stable-diffusion"], tmp_path / "broken")
    (folder / "text_encoder" / "model.safetensors").write_bytes(b"not safetensors")
    refused("text_encoder of the model .* can't be loaded.*again", processed, folder)


@pytest.mark.parametrize("kind", ["stable-diffusion", "stable-diffusion-xl", "stable-diffusion-3"])
def test_the_second_time_the_encoder_is_not_loaded(models, kind, monkeypatch):
    first = processed(models[kind], kind)
    files = list(CACHE.iterdir())
    # the prompt, four directions, the negative prompt
    assert len(files) == 6 and all(path.suffix == ".safetensors" for path in files)
    assert len(first.text_embeddings_vd.unique(dim=0)) == 4
    monkeypatch.setattr(text_encoders, "load_network", lambda *_, **__: pytest.fail("loaded"))
    second = processed(models[kind], kind)
    assert torch.equal(first.text_embeddings_vd, second.text_embeddings_vd)


def test_another_model_or_text_is_another_entry(models, fox):
    mine = fox().text_embeddings
    assert not torch.equal(mine, fox(prompt="a foxy").text_embeddings)
    assert not torch.equal(mine, processed(models["other"]).text_embeddings)
    for damage in (b"", b"\x00" * 40, b"half"):  # a damaged file is made again
        for path in CACHE.iterdir():
            path.write_bytes(path.read_bytes()[:50] if damage == b"half" else damage)
        assert torch.equal(mine, fox().text_embeddings)


def test_a_cache_folder_is_checked_before_the_encoder_is_loaded(fox, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    preflight = StableDiffusionPromptProcessor.preflight
    for folder in ("file", "file/cache", "new/" + "x" * 300, "a/" * 3000, "a\0b"):
        refused("cache_dir, or set use_cache=false: the folder", preflight, {"cache_dir": folder})
        preflight({"cache_dir": folder, "use_cache": False})
    assert not (tmp_path / "a").exists()
    fox(cache_dir="other", use_cache=False)
    assert not (tmp_path / "other").exists()
    fox(cache_dir="cache")
    monkeypatch.setattr(text_encoders, "load_network", lambda *_, **__: pytest.fail("loaded"))
    refused("cache_dir.*can't be made: Not a directory", fox, cache_dir="file/cache")
    # a read-only cache that holds all embeddings is enough
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    refused("read-only", preflight, {"cache_dir": "new/cache"})
    preflight({"cache_dir": "cache"})
    fox(cache_dir="cache")
    refused("cache_dir.*read-only", fox, cache_dir="cache", prompt="another fox")


def test_prompts_of_the_user(models, fox, tmp_path, caplog):
    text = 'robot #1: "${x}" [a] \U0001f98a'
    (tmp_path / "prompt.txt").write_text(f"{text}\n", encoding="utf-8")
    assert fox(prompt="", prompt_file="prompt.txt").prompt == text
    copy = changed(models["stable-diffusion"], tmp_path / "model")
    (copy / WORDS_FILE).write_text("a\n")
    given = {"prompt_side": "a flank", "prompt_back": "a tail"}
    out = processed(copy, view_dependent_left_and_right=True, **given)
    front, overhead = (f"a fox, {name} view" for name in ("front", "overhead"))
    assert out.prompts_vd == ["a flank", "a flank", front, "a tail", overhead]
    assert "'fox'" in caplog.text and "'tail'" in caplog.text  # which this model doesn't know
    refused("no prompt", fox, prompt="  ")
    assert "bad proportions, unfocused" in StableDiffusionPromptProcessor.Config().negative_prompt


def test_the_prompt_library(fox, tmp_path):
    refused("prompt library .*does not exist", fox, prompt="lib:fox")
    texts = ["a corgi plays the ukulele", "a Corgi in the snow", "a bald eagle"]
    file = tmp_path / "load" / "prompt_library.json"
    file.parent.mkdir()
    for content in (texts, {"dreamfusion": texts[:2], "mine": texts[1:]}):
        file.write_text(json.dumps(content))
        assert fox(prompt="lib:snow_corgi").prompt == "a Corgi in the snow"
        refused("2 texts of .*corgi.*corgi plays", fox, prompt="lib:corgi")
        refused("no texts .*near: a bald eagle", fox, prompt="lib:bald_eagel")
    for content in ('{"a": 1}', '{"a": "a fox"}', "[", "[3]", "3"):
        file.write_text(content)
        refused("prompt library .*prompt_library.json.: ", fox, prompt="lib:fox")


@pytest.mark.parametrize("kind", KINDS)
def test_a_missing_model_is_reported_at_once(kind, tmp_path, monkeypatch):
    tiny_models.nothing_cached(monkeypatch, tmp_path)
    refused("hf download|no such folder", processed, tmp_path / "none", kind)
    part = find(f"gaussiandreamer-{kind}-prompt-processor")
    default = part.Config().pretrained_model_name_or_path
    refused(f"{default}.*HF_HUB_OFFLINE", processed, default, kind)
    if NAME == "builtin":  # threestudio's names are its own parts' there
        assert find(f"{kind}-prompt-processor") is part
