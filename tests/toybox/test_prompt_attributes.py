"""Prompts are read back into the attributes that they were written from."""

import numpy as np
import pytest

from threestudio_gaussiandreamer.toybox.words import attributes_in, describe
from threestudio_gaussiandreamer.toybox.world import Attributes, draw_attributes


def test_every_written_prompt_is_read_back():
    for index in range(500):
        attributes = draw_attributes(5, index)
        text = describe(attributes, np.random.default_rng(index))
        assert attributes_in(text) == attributes, text


@pytest.mark.parametrize(
    ("prompt", "attributes"),
    [
        (
            "A Red FOX, with a green scarf!",
            Attributes("fox", "red", accessory="scarf", accessory_color="green"),
        ),
        ("a shiny light green lorry from above", Attributes("truck", "lime")),
        ("a blue teddy bear and a horse", Attributes("bear", "blue")),
        ("a carrot coloured blue car", Attributes("car", "blue")),
    ],
)
def test_other_prompts(prompt, attributes):
    assert attributes_in(prompt) == attributes


@pytest.mark.parametrize("prompt", ["", "a fox", "something red", "狐狸", "a " * 2000])
def test_prompts_without_kind_or_colour_name_no_attributes(prompt):
    assert attributes_in(prompt) is None
