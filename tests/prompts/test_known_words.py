"""A model that lists its words gives a warning for other words, and accepts any text."""

import shutil
from pathlib import Path

import pytest

from tests.prompts.prompt_processors_cases import processor
from threestudio_gaussiandreamer.prompts.known_words import (
    WORDS_FILE,
    unknown_words,
    warn_of_unknown_words,
)

KNOWN = ["a", "3", "d", "fox", "green", "red", "scarf", "with"]


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / WORDS_FILE
    path.parent.mkdir()
    path.write_text("\n".join(KNOWN) + "\n")
    return tmp_path


def test_unknown_words_are_listed_once_in_order():
    assert unknown_words("a red zebra, a 3d ZEBRA with wings", KNOWN) == ["zebra", "wings"]
    assert unknown_words("A Red Fox!", KNOWN) == []


def test_the_warning_names_words_and_near_ones(folder, caplog):
    warn_of_unknown_words(folder, "a readd zebra with a scarfs")
    assert "'readd' (near: red)" in caplog.text
    assert "'scarfs' (near: scarf)" in caplog.text
    assert "'zebra'" in caplog.text


@pytest.mark.parametrize("prompt", ["a red fox", "  ", "...", "a 3d fox"])
def test_known_words_give_no_warning(folder, caplog, prompt):
    warn_of_unknown_words(folder, prompt)
    assert not caplog.text


def test_a_model_without_a_list_gives_no_warning(tmp_path, caplog):
    warn_of_unknown_words(tmp_path, "a zebra")
    assert not caplog.text


@pytest.mark.parametrize("prompt", ["赤い狐 " * 500, "x" * 4000, "🦊 \0 zebra"])
def test_long_and_foreign_texts_give_a_short_warning(folder, caplog, prompt):
    warn_of_unknown_words(folder, prompt)
    assert 0 < len(caplog.records[0].getMessage()) < 600


def test_the_prompt_processor_warns_and_continues(models, caplog, tmp_path, monkeypatch):
    pytest.importorskip("diffusers")
    monkeypatch.chdir(tmp_path)
    copy = Path(shutil.copytree(models["stable-diffusion"], tmp_path / "model"))
    (copy / WORDS_FILE).write_text("a\n")
    out = processor({"stable-diffusion": copy}, prompt_back="a tail")()
    assert "'fox'" in caplog.text and "'tail'" in caplog.text
    assert out.text_embeddings.isfinite().all()
