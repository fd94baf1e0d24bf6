"""Prompts with text encoders: agreement with diffusers' pipelines, the cache, directions, Perp-Neg,
the library.
"""

import gc
import json
import os
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from tests.helpers import tiny_models
from tests.prompts.prompt_processors_cases import processor
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.host import NAME, find
from threestudio_gaussiandreamer.models import model_files, text_encoders
from threestudio_gaussiandreamer.models.embedding_cache import EmbeddingCache
from threestudio_gaussiandreamer.prompts import prompt_processors

pytest.importorskip("diffusers")


KINDS = ("stable-diffusion", "deep-floyd")


@pytest.fixture(autouse=True)
def in_an_empty_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # with transformers imported a collection takes a third of a second
    monkeypatch.setattr(model_files, "gc", SimpleNamespace(collect=lambda: 0))


@pytest.fixture
def no_encoder(monkeypatch):
    """Make running a text encoder a failure from here on."""
    for name in ("CLIPTextModel", "T5EncoderModel"):
        monkeypatch.setattr(
            f"transformers.{name}.from_pretrained",
            lambda *args, **kwargs: pytest.fail("loaded the text encoder"),
        )


# What the encoders give
# --------------------------------------------------------------------------------------------------


def test_the_embeddings_are_those_of_diffusers_stable_diffusion(models):
    from diffusers import StableDiffusionPipeline

    out = processor(models)()
    pipe = StableDiffusionPipeline.from_pretrained(
        models["stable-diffusion"], local_files_only=True
    )
    cond, uncond = pipe.encode_prompt("a fox", "cpu", 1, True, negative_prompt="ugly")
    # the same network on another batch size: rounding only
    torch.testing.assert_close(out.text_embeddings, cond, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(out.uncond_text_embeddings, uncond, rtol=1e-5, atol=1e-6)


def test_the_embeddings_are_those_of_diffusers_deep_floyd(models):
    from diffusers import IFPipeline

    out = processor(models, "deep-floyd", prompt=" a Fox")()
    pipe = IFPipeline.from_pretrained(models["deep-floyd"], local_files_only=True, watermarker=None)
    cond, uncond = pipe.encode_prompt(" a Fox", device="cpu", negative_prompt="ugly")
    torch.testing.assert_close(out.text_embeddings, cond, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(out.uncond_text_embeddings, uncond, rtol=1e-5, atol=1e-6)


def test_stable_diffusion_2_is_padded_as_it_was_trained(models):
    """Its tokenizer pads with "!" (0); one of its two files contradicts this, and reading that one
    would change every embedding.
    """
    from transformers import AutoTokenizer

    tokenizer = AutoTokenizer.from_pretrained(models["stable-diffusion"], subfolder="tokenizer")
    assert text_encoders._tokenize(tokenizer, ["a fox"], 77).input_ids[0, -1] == 0


def test_a_prompt_that_is_too_long_is_cut_and_reported(models, caplog):
    long = "a fox " * 60
    out = processor(models, prompt=long + "one")()
    assert "has no effect" in caplog.text
    assert torch.equal(
        out.text_embeddings, processor(models, prompt=long + "two")().text_embeddings
    )


def test_a_tokenizer_that_names_no_length_takes_what_clip_was_trained_with(models, tmp_path):
    folder = tmp_path / "endless"
    tiny_models.stable_diffusion(folder)
    settings = json.loads((folder / "tokenizer" / "tokenizer_config.json").read_text())
    del settings["model_max_length"]
    (folder / "tokenizer" / "tokenizer_config.json").write_text(json.dumps(settings))
    assert torch.equal(
        processor({"stable-diffusion": folder})().text_embeddings,
        processor(models)().text_embeddings,
    )


def test_the_encoder_is_freed(models, monkeypatch):
    from transformers import CLIPTextModel

    monkeypatch.setattr(model_files, "gc", gc)
    gc.collect()
    others = [thing for thing in gc.get_objects() if type(thing) is CLIPTextModel]
    processor(models)
    left = [thing for thing in gc.get_objects() if type(thing) is CLIPTextModel]
    assert len(left) <= len(others)


def test_too_little_memory_on_the_gpu_means_the_cpu(monkeypatch, caplog):
    monkeypatch.setattr(text_encoders, "get_device", lambda: torch.device("cuda"))
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: None)

    def run(device):
        if device.type == "cuda":
            raise torch.OutOfMemoryError
        return torch.ones(1)

    assert text_encoders._freed(run) == 1
    assert "runs on the CPU" in caplog.text


@pytest.mark.slow
def test_spawn_gives_the_same(models):
    here, there = (
        processor(models, use_cache=False)(),
        processor(models, use_cache=False, spawn=True)(),
    )
    assert torch.equal(here.text_embeddings_vd, there.text_embeddings_vd)


def test_a_damaged_model_is_reported(tmp_path):
    folder = tmp_path / "broken"
    tiny_models.stable_diffusion(folder)
    (folder / "text_encoder" / "model.safetensors").write_bytes(b"not safetensors")
    with pytest.raises(
        UserError, match="text_encoder of the model in .* can't be loaded.*download it again"
    ):
        processor({"stable-diffusion": folder})


def test_code_in_the_models_folder_is_not_offered_to_be_run(tmp_path, monkeypatch):
    folder = tmp_path / "custom"
    tiny_models.stable_diffusion(folder)
    settings = json.loads((folder / "tokenizer" / "tokenizer_config.json").read_text())
    settings |= {"tokenizer_class": "Mine", "auto_map": {"AutoTokenizer": ["mine.Mine", None]}}
    (folder / "tokenizer" / "tokenizer_config.json").write_text(json.dumps(settings))
    (folder / "mine.py").write_text("import os\nos._exit(7)\n")
    monkeypatch.setattr("builtins.input", lambda *args: "y")
    with pytest.raises(UserError, match="tokenizer of the model in .* can't be loaded"):
        processor({"stable-diffusion": folder})


# The cache
# --------------------------------------------------------------------------------------------------


def test_the_second_time_the_encoder_is_not_loaded(models, monkeypatch, request):
    first = processor(models)()
    request.getfixturevalue("no_encoder")
    second = processor(models)()
    assert torch.equal(first.text_embeddings_vd, second.text_embeddings_vd)
    files = list(Path(".threestudio_cache/text_embeddings").iterdir())
    assert len(files) == 6  # the prompt, four directions, the negative prompt
    assert all(path.suffix == ".safetensors" for path in files)


def test_another_model_or_text_is_another_entry(models):
    mine = processor(models)().text_embeddings
    assert not torch.equal(mine, processor(models, prompt="a foxy")().text_embeddings)
    assert not torch.equal(mine, processor({"stable-diffusion": models["other"]})().text_embeddings)
    assert torch.equal(mine, processor(models)().text_embeddings)


def test_without_cache_no_file_is_written(models, tmp_path):
    processor(models, use_cache=False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "damage", [b"", b"\x00" * 40, b"half"], ids=["empty", "zeros", "truncated"]
)
def test_a_damaged_file_is_made_again(models, damage):
    first = processor(models)().text_embeddings
    for path in Path(".threestudio_cache/text_embeddings").iterdir():
        path.write_bytes(path.read_bytes()[:50] if damage == b"half" else damage)
    assert torch.equal(processor(models)().text_embeddings, first)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a process is killed in the middle")
@pytest.mark.parametrize("size", [0, 60, 150])
def test_a_crash_while_writing_leaves_no_broken_entry(tmp_path, monkeypatch, size):
    cache = EmbeddingCache(str(tmp_path / "cache"), "model")
    embedding = torch.ones(3, 4)
    if (child := os.fork()) == 0:
        monkeypatch.setattr(
            os, "fsync", lambda descriptor: (os.ftruncate(descriptor, size), os._exit(9))
        )
        cache.write("a fox", embedding)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9
    assert [path.stat().st_size for path in cache.folder.iterdir()] == [size], (
        "it died in the middle"
    )
    assert cache.read("a fox") is None
    cache.write("a fox", embedding)
    assert torch.equal(cache.read("a fox"), embedding)


def test_a_cache_folder_that_cannot_be_made(models, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cache_dir"):
        processor(models, cache_dir=str(tmp_path / "file" / "cache"))


def test_a_cache_folder_is_checked_before_the_encoder_is_loaded(models, tmp_path, no_encoder):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="'[^']*file' is no folder.*cache_dir"):
        processor(models, cache_dir=str(tmp_path / "file" / "cache"))


def test_preflight_checks_the_cache_folder_and_makes_none(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    kind = prompt_processors.StableDiffusionPromptProcessor
    for folder in ("file", "file/cache"):
        with pytest.raises(UserError, match="cache_dir"):
            kind.preflight({"cache_dir": folder})
        kind.preflight({"cache_dir": folder, "use_cache": False})
    kind.preflight({"cache_dir": "new/cache"})
    assert not (tmp_path / "new").exists()
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(UserError, match="read-only"):
        kind.preflight({"cache_dir": "new/cache"})


def test_a_read_only_cache_that_holds_all_embeddings_is_enough(models, tmp_path, monkeypatch):
    processor(models, cache_dir="cache")
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    options = {"pretrained_model_name_or_path": str(models["stable-diffusion"])}
    prompt_processors.StableDiffusionPromptProcessor.preflight(options | {"cache_dir": "cache"})
    processor(models, cache_dir="cache")
    with pytest.raises(UserError, match="read-only.*cache_dir"):
        processor(models, cache_dir="cache", prompt="another fox")


# Which prompt
# --------------------------------------------------------------------------------------------------


def test_a_prompt_from_a_file_is_verbatim(models, tmp_path):
    (tmp_path / "prompt.txt").write_text('robot #1: "${x}" [a] \U0001f98a\n', encoding="utf-8")
    assert (
        processor(models, prompt="", prompt_file="prompt.txt")().prompt
        == 'robot #1: "${x}" [a] \U0001f98a'
    )


def test_no_prompt_is_an_error(models):
    with pytest.raises(UserError, match="no prompt"):
        processor(models, prompt="  ")


@pytest.mark.parametrize("layout", ["list", "object"])
def test_the_prompt_library(models, tmp_path, layout):
    texts = ["a corgi plays the ukulele", "a Corgi in the snow", "a bald eagle"]
    (tmp_path / "load").mkdir()
    content = texts if layout == "list" else {"dreamfusion": texts[:2], "mine": texts[1:]}
    (tmp_path / "load" / "prompt_library.json").write_text(json.dumps(content))
    assert processor(models, prompt="lib:snow_corgi")().prompt == "a Corgi in the snow"
    with pytest.raises(UserError, match="matches 2 texts.*add a word"):
        processor(models, prompt="lib:corgi")
    with pytest.raises(UserError, match="near: a bald eagle"):
        processor(models, prompt="lib:bald_eagel")


def test_an_invalid_prompt_library(models, tmp_path):
    with pytest.raises(UserError, match="prompt library .*does not exist"):
        processor(models, prompt="lib:fox")
    (tmp_path / "library.json").write_text('{"a": 1}')
    with pytest.raises(UserError, match="list of texts"):
        processor(models, prompt="lib:fox", prompt_library="library.json")
    (tmp_path / "library.json").write_text("[")
    with pytest.raises(UserError, match="no JSON"):
        processor(models, prompt="lib:fox", prompt_library="library.json")


# Options
# --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_a_missing_model_is_reported_at_once(kind, tmp_path, monkeypatch):
    tiny_models.nothing_cached(monkeypatch, tmp_path)
    with pytest.raises(UserError, match="hf download|no such folder"):
        processor({kind: tmp_path / "none"}, kind)
    default = (
        find(f"gaussiandreamer-{kind}-prompt-processor").Config().pretrained_model_name_or_path
    )
    with pytest.raises(UserError, match=f"{default}.*HF_HUB_OFFLINE"):
        processor({kind: default}, kind)


@pytest.mark.parametrize(
    "name, value",
    [("front_threshold", -1.0), ("back_threshold", 200.0), ("overhead_threshold", 91.0)],
)
def test_thresholds_are_angles(models, name, value):
    with pytest.raises(UserError, match=f"prompt_processor.{name}"):
        processor(models, **{name: value})


@pytest.mark.skipif(NAME != "builtin", reason="inside threestudio its own parts have these names")
@pytest.mark.parametrize("kind", KINDS)
def test_threestudios_names_find_this_packages_parts(kind):
    assert find(f"{kind}-prompt-processor") is find(f"gaussiandreamer-{kind}-prompt-processor")


def test_the_default_negative_prompt_is_the_released_one():
    assert prompt_processors.StableDiffusionPromptProcessor.Config().negative_prompt.endswith(
        "bad proportions, unfocused"
    )
