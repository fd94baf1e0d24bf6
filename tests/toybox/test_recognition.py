"""The judge's probabilities become recognised attributes and a share of views with a wrong side."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.toybox import export, models, recognition
from threestudio_gaussiandreamer.toybox.judge_stage import judge_labels, mirrored
from threestudio_gaussiandreamer.toybox.views import LABELS, label_row
from threestudio_gaussiandreamer.toybox.world import Attributes

FOX = Attributes("fox", "red", "striped", "white", None, "hat", "blue")
KICK = Attributes("person", "red", "plain", None, "blue", "cape", "lime", "kick left")


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


@pytest.mark.parametrize(
    ("change", "missed"),
    [
        ({"action": "kick right"}, ["sides"]),
        ({"action": "punch right"}, ["action"]),
        ({"action": None}, ["action"]),
        ({"part": "red"}, ["colors"]),
        ({"color": "blue"}, ["colors"]),
        ({"accessory": "hat"}, ["accessory"]),
        ({"accessory_color": "red"}, ["accessory"]),
    ],
)
def test_one_wrong_attribute_of_a_person_is_missed_alone(change, missed):
    found = recognition.recognized(sure(KICK._replace(**change)), KICK)
    assert [name for name, right in found.items() if right == 0] == missed
    assert math.isnan(found["sides"]) == (missed == ["action"])  # nothing to be swapped
    wanted = KICK._replace(action="sit")  # has no side
    found = recognition.recognized(sure(wanted._replace(**change)), wanted)
    assert math.isnan(found["sides"]) and found["action"] == ("action" not in change)


def test_sides_in_pictures_from_behind_are_read_back():
    azimuth = recognition.views().azimuth.numpy()
    rows = np.stack([label_row(KICK, angle) for angle in azimuth])
    seen = judge_labels(SimpleNamespace(labels=rows, azimuth=azimuth), np.arange(8))
    names = [LABELS["action"][i] for i in seen[:, list(LABELS).index("action")]]
    assert names == [f"kick {'right' if 90 < abs(angle) else 'left'}" for angle in azimuth]

    def judge(pictures, persons):
        return {n: torch.eye(len(c))[seen[:, i]] for i, (n, c) in enumerate(LABELS.items())}

    found = recognition.probabilities(judge, torch.zeros(8, 3, 4, 4), KICK)["action"].argmax(-1)
    assert {LABELS["action"][i] for i in found} == {"kick left"}


def test_a_mirrored_person_has_the_other_sides():
    seen = torch.from_numpy(label_row(KICK, 90.0))
    other = torch.from_numpy(label_row(KICK._replace(action="kick right"), -90.0))
    assert mirrored(torch.stack([seen, other])).tolist() == [other.tolist(), seen.tolist()]


@pytest.mark.parametrize(
    ("change", "missed"),
    [
        ({}, []),
        ({"kind": "bear"}, ["kind"]),
        ({"color": "black"}, ["colors"]),
        ({"second": "black"}, ["colors"]),
        ({"pattern": "dotted"}, ["pattern"]),
        ({"accessory": None, "accessory_color": None}, ["accessory"]),
        ({"part": "green"}, ["accessory"]),
    ],
)
def test_one_wrong_attribute_is_missed_alone(change, missed):
    found = recognition.recognized(sure(FOX._replace(**change)), FOX)
    assert [name for name, right in found.items() if not right] == missed


def test_colours_may_be_exchanged_where_nobody_can_tell():
    for pattern, right in (("striped", True), ("checkered", True), ("dotted", False)):
        wanted = FOX._replace(pattern=pattern)
        exchanged = wanted._replace(color=wanted.second, second=wanted.color)
        assert recognition.recognized(sure(exchanged), wanted)["colors"] == right
        plain = wanted._replace(pattern="plain", second=None)
        assert not recognition.recognized(sure(plain), wanted)["colors"]


def test_colours_and_pattern_are_a_combination_that_objects_have():
    """Where each alone is most probably red or "none", the second is the next most probable."""
    red, white, none = (LABELS["second"].index(name) for name in ("red", "white", "none"))
    for other in (red, none):
        found = sure(FOX)
        found["second"][:, other], found["second"][:, white] = 0.6, 0.4
        assert recognition.most_probable_pattern(found) == ("striped", "red", "white")
    striped, plain = (LABELS["pattern"].index(name) for name in ("striped", "plain"))
    found["pattern"][:, striped], found["pattern"][:, plain] = 0.2, 0.8
    assert recognition.most_probable_pattern(found) == ("plain", "red", "none")
    # half of the probability says "none", the other half is spread over two colours
    for name, values in {
        "pattern": {"striped": 0.6, "plain": 0.4},
        "second": {"none": 0.5, "white": 0.3, "pink": 0.2},
    }.items():
        found[name] = torch.tensor([[values.get(one, 0.0) for one in LABELS[name]]] * 8)
    assert recognition.most_probable_pattern(found) == ("striped", "red", "white")


def test_faces_on_all_sides():
    assert recognition.multi_face(sure(FOX), FOX) == 0.0
    assert recognition.multi_face(sure(FOX, sides=[0] * 8), FOX) == 0.75
    mug = Attributes("mug", "red")
    assert math.isnan(recognition.multi_face(sure(mug), mug))


def test_an_exported_judge_is_loaded_and_other_files_are_named(tmp_path, monkeypatch):
    torch.manual_seed(0)
    judge, path = models.Judge(), tmp_path / "judge.safetensors"
    with pytest.raises(UserError, match="judge .*make train-toybox.*does not exist"):
        recognition.load_judge(path)
    export.write_weights(path, judge.state_dict())
    loaded, pictures = recognition.load_judge(path), torch.rand(8, 3, 128, 128)
    for asked in (FOX, KICK):
        found, right = (recognition.probabilities(j, pictures, asked) for j in (loaded, judge))
        for name, values in right.items():
            torch.testing.assert_close(found[name], values, atol=1e-2, rtol=0)
    # each of two networks reads its own pictures, in one batch too
    logits = judge(pictures[:2], torch.tensor([True, False]))["kind"]
    torch.testing.assert_close(logits[:1], judge.persons(pictures[:1])["kind"])
    torch.testing.assert_close(logits[1:], judge.objects(pictures[1:2])["kind"])
    monkeypatch.setattr(models.Classifier, "CHANNELS", (8, 8, 8, 8))
    for content in (None, b"", b"\x08\0\0\0\0\0\0\0{}      "):
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(UserError, match="judge") as caught:
            recognition.load_judge(path)
        assert "\n" not in str(caught.value)
