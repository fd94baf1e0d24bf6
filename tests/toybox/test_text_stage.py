"""What the text encoder's prompts tell about the object's view."""

import pytest
import torch

from threestudio_gaussiandreamer.toybox import views
from threestudio_gaussiandreamer.toybox.classifiers import IGNORED
from threestudio_gaussiandreamer.toybox.text_stage import NAMED_QUADRANT, told_labels


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("a fox, left side view", True),
        ("right side view of a fox", True),
        ("backside view of a fox", True),
        ("a fox, front view", True),
        ("a fox, side view", False),
        ("a fox, overhead view", False),
        ("a fox", False),
    ],
)
def test_prompts_that_name_a_quadrant(text, named):
    assert bool(NAMED_QUADRANT.search(text)) == named


def test_only_directions_that_prompts_tell_are_labels():
    quadrants = torch.arange(8) % 4  # front, left, back, right
    labels = quadrants[:, None].repeat(1, len(views.LABELS))
    told = torch.arange(8) < 4
    found = told_labels(labels, told)
    quadrant = list(views.LABELS).index("quadrant")
    assert found[:, quadrant].tolist() == [0, 1, 2, 3, *[IGNORED] * 4]
    assert torch.equal(found[:, :quadrant], labels[:, :quadrant])
