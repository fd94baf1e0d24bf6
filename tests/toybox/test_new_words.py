"""Trainings that continue from weights whose vocabulary lacks words of the toybox."""

import json

import numpy as np
import pytest
import torch
from transformers import CLIPModel, CLIPTokenizer

from tests.toybox.helpers import options
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.toybox import warm_start, words
from threestudio_gaussiandreamer.toybox.clip_stage import trained_clip
from threestudio_gaussiandreamer.toybox.tokens import open_tokenizer, token_ids
from threestudio_gaussiandreamer.toybox.train import STAGES

pytestmark = pytest.mark.usefixtures("small_world")
TEXTS = ["a red fox with a green scarf, front view", "", "a mug"]


@pytest.fixture
def grown(exported, tmp_path, monkeypatch):
    """A training that started from weights without two of the words."""
    monkeypatch.setattr(warm_start, "SEPARATION_STEPS", 5)
    monkeypatch.setitem(words.NOUNS, "fox", ("fox", "wombat", "aardvark"))
    folder = tmp_path / "training"
    warm_start.start_from(exported, options(folder), {name: STAGES[name] for name in CHANGED})
    return folder


CHANGED = ("text", "clip")


def test_new_words_are_tokens(grown):
    tokenizer = open_tokenizer(grown)
    assert [len(tokenizer(word).input_ids) for word in ("wombat", "aardvark", "fox")] == [3] * 3
    ids = token_ids(tokenizer, ["a wombat", "an aardvark"])
    wombat, aardvark = trained_clip(grown, len(tokenizer), "text").text_model(ids).pooler_output
    assert not torch.allclose(wombat, aardvark, atol=1e-3)


def test_a_tokenizer_without_the_words_is_refused(trained, monkeypatch):
    monkeypatch.setitem(words.NOUNS, "fox", ("fox", "wombat"))
    with pytest.raises(UserError, match="doesn't know wombat: export the training"):
        open_tokenizer(trained)


def test_texts_of_known_words_are_encoded_as_before(grown, exported):
    before = CLIPModel.from_pretrained(exported / "clip").float()
    known = CLIPTokenizer.from_pretrained(exported / "clip")
    expected = before.text_model(token_ids(known, TEXTS)).last_hidden_state
    tokenizer = open_tokenizer(grown)
    text_model = trained_clip(grown, len(tokenizer), "text").text_model
    found = text_model(token_ids(tokenizer, TEXTS)).last_hidden_state
    torch.testing.assert_close(found, expected)


def test_a_known_vocabulary_is_kept(exported, tmp_path):
    source = exported / "stable-diffusion" / "tokenizer"
    assert warm_start.grow_tokenizer(source, tmp_path / "tokenizer") == []
    kept, given = (
        json.loads((f / "vocab.json").read_text())
        for f in (tmp_path / "tokenizer", exported / "clip")
    )
    assert kept == given


def test_prompts_that_differ_in_a_new_word_are_moved_apart(trained, monkeypatch):
    monkeypatch.setattr(warm_start, "SEPARATION_STEPS", 20)
    tokenizer = open_tokenizer(trained)
    model = torch.nn.ModuleDict(
        {"text_model": trained_clip(trained, len(tokenizer), "text").text_model}
    )
    left, right = (token_ids(tokenizer, [f"a fox, {side} side view"]) for side in ("left", "right"))

    def distance():
        with torch.no_grad():
            states = [model["text_model"](ids).last_hidden_state for ids in (left, right)]
        return float((states[0] - states[1]).norm())

    before, weights = distance(), {k: v.clone() for k, v in model.state_dict().items()}
    warm_start.separate(model, tokenizer, ["left", "right"], seed=0)
    assert distance() > 2 * before
    rows = tokenizer.convert_tokens_to_ids(["left</w>", "right</w>"])
    weights[warm_start.EMBEDDINGS][rows] = model.state_dict()[warm_start.EMBEDDINGS][rows]
    assert all(torch.equal(value, weights[key]) for key, value in model.state_dict().items())


@pytest.mark.parametrize(
    ("new", "replaced"),
    [(["left", "right"], {"left": "right", "right": "left"}), (["left"], {"left": ""})],
)
def test_pairs_of_prompts_differ_in_a_new_word(new, replaced):
    pairs = warm_start.pairs_of_prompts(new, np.random.default_rng(0))
    assert pairs
    for text, other in pairs:
        word = next(word for word in new if word in text.split())
        assert other == text.replace(word, replaced[word])
