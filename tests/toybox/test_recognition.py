"""The judge's probabilities become recognised attributes and a share of views with a wrong side."""

import math

import pytest
import torch

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.toybox import export, models, recognition
from threestudio_gaussiandreamer.toybox.views import LABELS, label_row
from threestudio_gaussiandreamer.toybox.world import Attributes

FOX = Attributes("fox", "red", "striped", "white", None, "hat", "blue")


def sure(attributes, sides=None):
    """Probabilities of a judge that is sure of these attributes in all eight views."""
    azimuths = recognition.views().azimuth.tolist()
    rows = torch.tensor([label_row(attributes, azimuth).tolist() for azimuth in azimuths])
    if sides is not None:
        rows[:, list(LABELS).index("quadrant")] = torch.tensor(sides)
    return {
        name: torch.nn.functional.one_hot(rows[:, column], len(classes)).float()
        for column, (name, classes) in enumerate(LABELS.items())
    }


def test_all_attributes_are_recognised_from_the_right_sides():
    assert all(recognition.recognized(sure(FOX), FOX).values())
    assert recognition.multi_face(sure(FOX), FOX) == 0.0


@pytest.mark.parametrize(
    ("change", "missed"),
    [
        ({"kind": "bear"}, "kind"),
        ({"color": "black"}, "colors"),
        ({"second": "black"}, "colors"),
        ({"pattern": "dotted"}, "pattern"),
        ({"accessory": None, "accessory_color": None}, "accessory"),
        ({"accessory_color": "green"}, "accessory"),
        ({"part": "green"}, "accessory"),
    ],
)
def test_one_wrong_attribute_is_missed_alone(change, missed):
    found = recognition.recognized(sure(FOX._replace(**change)), FOX)
    assert [name for name, right in found.items() if not right] == [missed]


@pytest.mark.parametrize(
    ("pattern", "right"), [("striped", True), ("checkered", True), ("dotted", False)]
)
def test_colours_may_be_exchanged_where_nobody_can_tell(pattern, right):
    wanted = FOX._replace(pattern=pattern)
    exchanged = wanted._replace(color=wanted.second, second=wanted.color)
    assert recognition.recognized(sure(exchanged), wanted)["colors"] is right
    plain = wanted._replace(pattern="plain", second=None)
    assert not recognition.recognized(sure(plain), wanted)["colors"]


def test_the_two_colours_of_a_pattern_differ():
    """Where each colour alone is most probably red, the second is the next most probable one."""
    found = sure(FOX)
    red, white = (LABELS["second"].index(name) for name in ("red", "white"))
    found["second"][:, red], found["second"][:, white] = 0.6, 0.4
    assert recognition.most_probable_pattern(found) == ("striped", "red", "white")


def test_a_pattern_has_a_second_colour_and_plain_objects_have_none():
    found = sure(FOX)
    none, white = (LABELS["second"].index(name) for name in ("none", "white"))
    found["second"][:, none], found["second"][:, white] = 0.5, 0.3
    assert recognition.most_probable_pattern(found) == ("striped", "red", "white")
    striped, plain = (LABELS["pattern"].index(name) for name in ("striped", "plain"))
    found["pattern"][:, striped], found["pattern"][:, plain] = 0.2, 0.8
    assert recognition.most_probable_pattern(found) == ("plain", "red", "none")


def test_an_uncertain_second_colour_does_not_make_an_object_plain():
    """Half of the probability says "none", the other half is spread over two colours."""
    found = sure(FOX)
    for name, values in {
        "pattern": {"striped": 0.6, "plain": 0.4},
        "second": {"none": 0.5, "white": 0.3, "pink": 0.2},
    }.items():
        found[name] = torch.tensor([[values.get(one, 0.0) for one in LABELS[name]]] * 8)
    assert recognition.most_probable_pattern(found) == ("striped", "red", "white")


def test_faces_on_all_sides():
    assert recognition.multi_face(sure(FOX, sides=[0] * 8), FOX) == 0.75
    mug = Attributes("mug", "red")
    assert math.isnan(recognition.multi_face(sure(mug), mug))


def test_an_exported_judge_is_loaded(tmp_path):
    torch.manual_seed(0)
    judge = models.Judge()
    export.write_weights(tmp_path / "judge.safetensors", judge.state_dict())
    loaded = recognition.load_judge(tmp_path / "judge.safetensors")
    pictures = torch.rand(2, 3, 128, 128)
    for name, values in recognition.probabilities(judge, pictures).items():
        torch.testing.assert_close(
            recognition.probabilities(loaded, pictures)[name], values, atol=1e-2, rtol=0
        )


def test_the_message_about_a_judge_of_another_size_is_one_line(tmp_path, monkeypatch):
    path = tmp_path / "judge.safetensors"
    export.write_weights(path, models.Judge().state_dict())
    monkeypatch.setattr(models.Judge, "CHANNELS", (8, 8, 8, 8))
    with pytest.raises(UserError, match="judge") as caught:
        recognition.load_judge(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [None, b"", b"\x08\0\0\0\0\0\0\0{}      "])
def test_a_missing_or_foreign_judge_is_named(tmp_path, content):
    path = tmp_path / "judge.safetensors"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError, match="judge"):
        recognition.load_judge(path)
