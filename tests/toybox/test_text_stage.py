"""What the text encoder's prompts tell about the object's view."""

import pytest

from threestudio_gaussiandreamer.toybox.clip_stage import NAMED_QUADRANT


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
