"""Avatars: the motion in a prompt, files of motions and bodies, the fit of SMPL to joints, and
CLIP's choices.
"""

import shutil
import subprocess
import sys

import numpy as np
import pytest
import torch
import trimesh

from tests.helpers import tiny_3d_models as tiny
from tests.helpers.prior_contract import PriorContract, assert_valid
from tests.priors.motion_cases import joints_of
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.meshes.mesh import Mesh
from threestudio_gaussiandreamer.models.clip import PictureText, clip_source
from threestudio_gaussiandreamer.priors import motion as module
from threestudio_gaussiandreamer.priors.motion import (
    MotionPrior,
    Motions,
    body_pictures,
    offered_frames,
)
from threestudio_gaussiandreamer.priors.motion_text import reduced_prompt
from threestudio_gaussiandreamer.priors.skeleton import facing, z_up

FAST = {"num_points": 500}


@pytest.fixture(scope="session")
def clip(bodies):
    return str(tiny.clip(bodies / "clip"))


@pytest.fixture
def options(motion_file, body_file, clip):
    return FAST | {"motion": str(motion_file), "body_model": str(body_file), "clip": clip}


class TestContract(PriorContract):
    @pytest.fixture
    def make_prior(self, options):
        return lambda **more: MotionPrior(options | {"frame": 0} | more)


# --------------------------------------------------------------------------------------------------
# the text


@pytest.mark.parametrize(
    "prompt, motion",
    [
        ("Iron man kicks with his left leg", "Someone kicks with the left leg"),  # the paper's
        ("Spiderman stands with open arms", "Someone stands with open arms"),  # its figure's
        (
            "Stormtrooper stands with open arms, highly detailed, 4k",
            "Someone stands with open arms",
        ),
        (
            "a DSLR photo of Wonder Woman raising her right hand",
            "Someone is raising the right hand",
        ),
        ("A knight is running quickly", "Someone is running quickly"),
        ("a zombie lying on its back. Unreal engine", "Someone is lying on the back"),
        ("The flying dutchman punches their enemy", "Someone punches the enemy"),
        ("two soldiers march", "Someone marches"),
        ("An astronaut DANCES", "Someone dances"),
        ("a wizard sitting cross-legged", "Someone is sitting cross-legged"),
        ("Spiderman", None),
        ("kick", None),  # no subject
        ("", None),
    ],
)
def test_the_motion_of_a_prompt(prompt, motion):
    assert reduced_prompt(prompt) == motion


def test_the_motion_can_be_asked_for_on_the_command_line():
    command = [
        sys.executable,
        "-m",
        "threestudio_gaussiandreamer.priors.motion_text",
        "Iron man kicks with his left leg",
    ]
    printed = subprocess.run(
        command, capture_output=True, text=True, check=True, cwd=module.__file__.rsplit("/", 3)[0]
    )
    assert printed.stdout.strip() == "Someone kicks with the left leg"


# --------------------------------------------------------------------------------------------------
# the choice


def test_offered_frames():
    motions = Motions(np.zeros((2, 9, 22, 3)), None, [9, 4])
    assert offered_frames(motions, None, "clip", 3) == [
        (0, 0),
        (0, 4),
        (0, 8),
        (1, 0),
        (1, 2),
        (1, 3),
    ]
    assert offered_frames(motions, 1, "clip", 100) == [(1, 0), (1, 1), (1, 2), (1, 3)]
    assert offered_frames(motions, None, 7, 3) == [(0, 7)]
    for sample, frame, message in (
        (2, "clip", "2 motions"),
        (1, 4, "4 frames"),
        (-1, "clip", "no -1"),
    ):
        with pytest.raises(UserError, match=message):
            offered_frames(motions, sample, frame, 3)


@pytest.mark.slow
def test_clip_chooses_the_frame_and_the_text_is_the_motion(options, monkeypatch):
    """With given scores instead of CLIP's, the fifth of the bodies wins, the second frame of the
    second motion.
    """
    asked = []

    def scores(files, pictures, text, *, device):
        asked.append((len(pictures), text))
        return np.repeat([0.1, 0.2, 0.3, 0.2, 0.9, 0.1], len(module.VIEW_AZIMUTHS))

    monkeypatch.setattr(module, "picture_similarities", scores)
    chosen = MotionPrior(options | {"num_frames": 3})("Iron man kicks with his left leg")
    same = MotionPrior(options | {"sample": 1, "frame": 2})("Iron man kicks with his left leg")
    np.testing.assert_array_equal(chosen.points, same.points)
    assert asked == [(6 * len(module.VIEW_AZIMUTHS), "Someone kicks with the left leg")]
    MotionPrior(options | {"num_frames": 3, "motion_text": "Someone bows"})("Iron man")
    MotionPrior(options | {"num_frames": 3, "motion_text": "Someone bows", "clip_text": "a bow"})(
        "Iron man"
    )
    assert [text for _, text in asked[1:]] == ["Someone bows", "a bow"]


@pytest.mark.slow
def test_clip_itself_chooses(options, clip):
    """The tiny CLIP's choice is arbitrary, but follows its scores and is repeatable."""
    prior = MotionPrior(options | {"num_frames": 3, "sample": 0})
    cloud = prior("Iron man kicks")
    assert_valid(cloud)
    frames = [
        MotionPrior(options | {"sample": 0, "frame": frame})("").points for frame in (0, 2, 5)
    ]
    assert sum(np.array_equal(cloud.points, points) for points in frames) == 1


def test_similarities_are_those_of_transformers(clip):
    from transformers import CLIPModel, CLIPTokenizer

    pictures = np.random.default_rng(0).random((3, tiny.IMAGE_SIZE, tiny.IMAGE_SIZE, 3), np.float32)
    model, tokenizer = CLIPModel.from_pretrained(clip), CLIPTokenizer.from_pretrained(clip)
    pixels = (pictures - [0.48145466, 0.4578275, 0.40821073]) / [0.26862954, 0.26130258, 0.27577711]
    with torch.no_grad():
        output = model(
            **tokenizer("a fox", return_tensors="pt"),
            pixel_values=torch.from_numpy(pixels).float().permute(0, 3, 1, 2),
        )
    compared = PictureText(clip_source(clip), torch.device("cpu"))
    scores = compared.similarities(pictures, "a fox", batch=2)
    np.testing.assert_allclose(
        scores, (output.logits_per_text[0] / model.logit_scale.exp()).detach().numpy(), atol=1e-5
    )


def test_candidates_are_chosen_for_the_prompt(tmp_path, clip, monkeypatch):
    for name, height in (("short", 1.0), ("tall", 3.0)):
        trimesh.creation.box(extents=[1, 1, height]).export(tmp_path / f"{name}.ply")
    asked = []
    monkeypatch.setattr(
        module,
        "picture_similarities",
        lambda files, pictures, text, **_: asked.append(text) or np.array([0.1] * 3 + [0.2] * 3),
    )
    options = FAST | {
        "candidates": [str(tmp_path / "short.ply"), str(tmp_path / "tall.ply")],
        "clip": clip,
        "scale": 1.5,
    }
    cloud = MotionPrior(options)("Iron man kicks")
    assert_valid(cloud)
    assert np.ptp(cloud.points, axis=0)[2] == pytest.approx(3.0, rel=0.02) and asked == [
        "Iron man kicks"
    ]
    monkeypatch.setattr(
        module,
        "picture_similarities",
        lambda *_, **__: pytest.fail("one candidate needs no choice"),
    )
    alone = MotionPrior(options | {"candidates": options["candidates"][:1], "clip": "no/where"})(
        "Iron man kicks"
    )
    assert np.ptp(alone.points, axis=0)[2] == pytest.approx(3.0, rel=0.02)


def test_pictures_show_the_front_and_both_sides():
    """A plate facing +x fills the middle image and is narrower in the others; the background is
    white.
    """
    plate = trimesh.creation.box(extents=[0.02, 1, 1])
    front, side = (
        body_pictures(Mesh(np.asarray(plate.vertices)[:, order], np.asarray(plate.faces)))
        for order in ([0, 1, 2], [1, 0, 2])
    )
    assert front.shape == (3, 224, 224, 3) and front[:, 0, 0].min() == 1
    covered = [(picture < 0.99).all(-1).mean() for picture in front]
    assert covered[1] > 1.2 * covered[0] and covered[1] > 1.2 * covered[2]
    assert (side[1] < 0.99).all(-1).mean() < 0.2 * covered[1]


# ---------------------------------------------------------------------------------------------- the
# body in the world


def test_a_rotated_body_is_turned_to_face_plus_x(body):
    pose = torch.zeros(4, 24, 3, dtype=torch.float64)
    pose[:, 0, 1] = torch.tensor([0.0, 1.0, 2.5, -1.5])
    for joints in joints_of(body, pose):
        turned = z_up(joints) @ facing(joints).T
        np.testing.assert_allclose(
            (turned[[2, 17]] - turned[[1, 16]])[:, 0], 0, atol=1e-9
        )  # right of left along -y
        assert (turned[17] - turned[16])[1] < -0.3
        assert turned[15, 2] > turned[0, 2] > turned[7, 2]  # head up


def test_a_body_on_its_side_is_not_rotated():
    joints = np.zeros((22, 3))
    joints[[1, 16], 1], joints[[2, 17], 1] = 0.1, -0.1  # hips and shoulders above each other
    np.testing.assert_array_equal(facing(joints), np.eye(3))


def test_face_front_and_the_released_axes(options):
    """The body turns to its left while the knee rises; without facing the front it ends
    facing +y.
    """
    front = MotionPrior(options | {"sample": 0, "frame": 5, "num_points": 0})("")
    free = MotionPrior(options | {"sample": 0, "frame": 5, "num_points": 0, "face_front": False})(
        ""
    )
    np.testing.assert_allclose(
        np.ptp(front.points, axis=0), np.ptp(free.points, axis=0)[[1, 0, 2]], rtol=0.02
    )
    assert (
        front.points[:, 0].max() > -3 * front.points[:, 0].min()
    )  # the raised knee is on the front's side
    assert free.points[:, 1].max() > -3 * free.points[:, 1].min()
    assert np.ptp(front.points, axis=0).max() == pytest.approx(
        2.0, rel=1e-5
    )  # half the longest side is the scale
    np.testing.assert_allclose(front.points.mean(axis=0), 0, atol=1e-5)


def test_points_and_colors(options):
    cloud = MotionPrior(options | {"frame": 0, "num_points": 4000})("")
    assert len(cloud.points) == 4000 and cloud.colors.std() == pytest.approx(
        np.sqrt(1 / 12), rel=0.05
    )  # uniform
    grey = MotionPrior(options | {"frame": 0, "color": "grey"})("")
    assert (grey.colors == 0.5).all()


def test_residuals_are_reported_and_limited(options, caplog, tmp_path, monkeypatch):
    said = []
    monkeypatch.setattr(module, "info", said.append)
    MotionPrior(options | {"frame": 3})("")
    assert any("SMPL fitted to motion 0, frame 3:" in line and "mm mean" in line for line in said)
    motion = 10 * np.load(options["motion"])["motion"]  # decimetres
    np.savez(tmp_path / "results.npz", motion=motion)
    with pytest.raises(UserError, match=r"off by \d+.* mm mean.*in metres"):
        MotionPrior(options | {"motion": str(tmp_path / "results.npz"), "frame": 0})("")


def test_the_clouds_of_a_frame_dont_depend_on_the_others(options, monkeypatch):
    monkeypatch.setattr(
        module,
        "picture_similarities",
        lambda files, pictures, text, **_: (np.arange(len(pictures)) < 3).astype(float),
    )
    alone = MotionPrior(options | {"sample": 0, "frame": 0})("a fox kicks")
    for frames in (2, 5):
        np.testing.assert_array_equal(
            MotionPrior(options | {"num_frames": frames})("a fox kicks").points, alone.points
        )


# --------------------------------------------------------------------------------------------------
# options and errors


def test_registered():
    assert find("motion-prior") is MotionPrior


@pytest.mark.parametrize(
    "change, message",
    [
        ({"motion": ""}, "neither"),
        ({"candidates": ["a.obj"]}, "both"),
        ({"body_model": ""}, "body_model.*smpl.is.tue.mpg.de"),
        ({"frame": "best"}, "frame"),
        ({"frame": -1}, "frame"),
        ({"num_frames": 0}, "num_frames"),
        ({"max_residual_mm": 0.0}, "max_residual_mm"),
        ({"color": "pink"}, "color"),
    ],
)
def test_options_out_of_range(options, change, message):
    with pytest.raises(UserError, match=message):
        MotionPrior(options | change)


def test_preflight_checks_all_files(options, tmp_path, clip):
    MotionPrior(options).preflight()
    with pytest.raises(UserError, match="motion file"):
        MotionPrior(options | {"motion": "nothing.npz"}).preflight()
    with pytest.raises(UserError, match="body model"):
        MotionPrior(options | {"body_model": "nothing.npz"}).preflight()
    with pytest.raises(UserError, match="body mesh"):
        MotionPrior(FAST | {"candidates": ["nothing.obj"]}).preflight()
    spoiled = shutil.copytree(clip, tmp_path / "clip")
    (spoiled / "model.safetensors").unlink()
    with pytest.raises(UserError, match="safetensors, the weights, are missing"):
        MotionPrior(options | {"clip": str(spoiled)}).preflight()
    MotionPrior(options | {"clip": str(spoiled), "frame": 0}).preflight()  # not needed


def test_without_smplx_the_extra_is_named(options, monkeypatch):
    monkeypatch.setitem(sys.modules, "smplx", None)
    with pytest.raises(UserError, match=r"pip install 'threestudio-gaussiandreamer\[smpl\]'"):
        MotionPrior(options | {"frame": 0})("a fox kicks")


def test_a_prompt_without_motion_warns_and_uses_itself(options, monkeypatch):
    asked, warned = [], []
    monkeypatch.setattr(module, "warn", warned.append)
    monkeypatch.setattr(
        module,
        "picture_similarities",
        lambda files, pictures, text, **_: asked.append(text) or np.zeros(len(pictures)),
    )
    MotionPrior(options | {"num_frames": 2})("Spiderman")
    assert asked == ["Spiderman"] and "motion_text" in warned[0]
