"""Errors of a stage become one line."""

import pytest
import torch

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch.stage_errors import lightning_errors


class Background(torch.nn.Module):
    def __init__(self, *names: str):
        super().__init__()
        for name in names:
            self.register_parameter(name, torch.nn.Parameter(torch.zeros(3)))


def test_renamed_parameters_of_a_part_are_named_in_one_line():
    """As those of a custom background, which was edited between a run and its resumption."""
    system, earlier = (
        torch.nn.ModuleDict({"background": Background(*names)})
        for names in (("tint", "glow"), ("color", "glow"))
    )
    with pytest.raises(UserError) as error, lightning_errors("last.ckpt"):
        system.load_state_dict(earlier.state_dict())
    assert str(error.value) == (
        "the checkpoint last.ckpt was made by another configuration: it has no background.tint, "
        "its background.color is in no part of this run"
    )


def test_other_words_of_torch_are_one_line_too():
    with pytest.raises(UserError) as error, lightning_errors("last.ckpt"):
        torch.nn.Linear(2, 3).load_state_dict(torch.nn.Linear(3, 3).state_dict())
    assert "size mismatch for weight" in str(error.value) and "\n" not in str(error.value)
