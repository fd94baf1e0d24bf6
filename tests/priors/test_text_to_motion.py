"""Text to motion: MDM's checkpoints, sentences, HumanML3D's features, the toybox's motions and
body."""

import json
import shutil

import numpy as np
import pytest
import torch
import trimesh

from tests.helpers import tiny_3d_models as tiny
from tests.priors.cases import joints_of
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.models.bundled import FOLDER
from threestudio_gaussiandreamer.priors import motion as prior
from threestudio_gaussiandreamer.priors import text_to_motion as t2m
from threestudio_gaussiandreamer.priors.base import preflight_prior
from threestudio_gaussiandreamer.priors.body_pose import INDEX, PARENTS
from threestudio_gaussiandreamer.priors.motion_text import motion_sentence
from threestudio_gaussiandreamer.toybox import motions

KNOWN = "kicks with the left leg\nkicking with the left leg\nwalks\nwalking\nstands in a t pose"


@pytest.fixture
def export(tmp_path, clip):
    """An export of the toybox with a tiny model, whose motions are all a T pose."""
    torch.manual_seed(0)
    folder = tmp_path / "motion"
    folder.mkdir()
    network = t2m.MotionModel(16, 2, 32, tiny.FEATURES)
    state, args = t2m.mdm_files(network, 1000)  # as the published ones
    torch.save(dict(state), folder / "model.pt")
    (folder / "args.json").write_text(json.dumps(args), encoding="utf-8")
    pose = motions.features(motions.draw("t pose", np.random.default_rng(0)).positions)
    np.save(folder / "Mean.npy", pose[0])
    np.save(folder / "Std.npy", np.full(263, 1e-6))
    (folder / "actions.txt").write_text(KNOWN, encoding="utf-8")
    (tmp_path / "stable-diffusion").mkdir()
    (tmp_path / "training.json").write_text("{}")
    shutil.copytree(clip, tmp_path / "clip")
    shutil.copy(FOLDER / "body.npz", tmp_path)
    return tmp_path


# Checkpoints --------------------------------------------------------------------------------------


def test_published_checkpoints_are_read_and_sampled(export):
    """Newer ones have averaged weights and others, and CLIP's; the averaged ones are taken."""
    path = export / "motion/model.pt"
    model = t2m.load_motion_model(str(path))
    assert model.steps == 1000 and model.known == KNOWN.split("\n")
    state = torch.load(path)
    others = {name: torch.zeros_like(value) for name, value in state.items()}
    more = {"clip_model.positional_embedding": torch.zeros(3)}
    torch.save({"model": others, "model_avg": {**state, **more}}, export / "motion/new.pt")
    new = t2m.load_motion_model(str(export / "motion/new.pt")).network.state_dict()
    for name, value in model.network.state_dict().items():
        torch.testing.assert_close(new[name], value)
    text = torch.randn(1, tiny.FEATURES, generator=torch.Generator().manual_seed(1))
    model = model._replace(std=np.ones(263))

    def drawn(seed: int, text=text) -> np.ndarray:
        return t2m.sample_motions(model, text, 2, torch.Generator().manual_seed(seed), frames=6)

    first = drawn(0)
    assert first.shape == (2, 6, 22, 3) and np.isfinite(first).all()
    np.testing.assert_array_equal(first, drawn(0))
    assert not np.allclose(first, drawn(1)) and not np.allclose(first, drawn(0, -text))
    with pytest.raises(UserError, match="24 features of a text, but its CLIP gives 5"):
        drawn(0, text[:, :5])
    with pytest.raises(UserError, match="aren't finite"):
        t2m.sample_motions(
            model._replace(guidance_scale=np.inf), text, 1, torch.Generator().manual_seed(0)
        )


def sampled(predict, scale: float, monkeypatch) -> np.ndarray:
    """Return the features that the sampler draws with ``predict(x, t, text)`` as the network."""
    network = torch.nn.Module()
    network.embed_text, network.forward = torch.nn.Linear(2, 1), predict
    monkeypatch.setattr(t2m, "steady", lambda features: features)
    monkeypatch.setattr(t2m, "rigid", lambda positions: positions)
    model = t2m.TextToMotion(network, 1000, scale, np.zeros(263), np.ones(263), [])
    return t2m.sample_motions(model, torch.ones(1, 2), 8, torch.Generator().manual_seed(0))


def test_the_sampler_draws_from_known_distributions(monkeypatch):
    """Guidance towards the text's prediction, and the variance of normal features."""
    found = sampled(lambda x, t, text: (2 * text[:, :1, None] - 1).expand_as(x), 2.5, monkeypatch)
    np.testing.assert_allclose(found, -1 + 2 * 2.5, rtol=1e-5)
    abar = torch.from_numpy(t2m.cosine_alphas_cumprod(1000)).float()
    found = sampled(lambda x, t, text: abar[t, None, None].sqrt() * x, 1.0, monkeypatch)
    assert 0.93 < found.std() < 1.01 and abs(found.mean()) < 0.02  # 50 of 1000 steps lose a little


def test_features_of_a_walk_on_a_circle():
    """Turning to the right (feature 0 is half of the angle), a step ahead in each frame."""
    quarter, features = np.pi / 40, np.zeros((1, 21, 263))
    features[..., 0], features[..., 2], features[..., 3] = quarter / 2, 1.0, 0.9
    found = t2m.positions_of(features)[0, :, 0]
    np.testing.assert_allclose(found[:, 1], 0.9)
    steps = np.diff(found, axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=-1), 1, rtol=1e-9)
    angles = np.unwrap(np.arctan2(steps[:, 0], steps[:, 2]))  # from +z towards +x
    np.testing.assert_allclose(np.abs(np.diff(angles)), quarter, rtol=1e-9)
    assert angles[-1] < angles[0]  # facing +z, +x is on the left


def test_exact_velocities_mend_noisy_positions():
    """Noise of 3 cm, of which the means over some frames stay."""
    features = np.float64(
        motions.features(motions.draw("walk", np.random.default_rng(0)).positions)
    )
    noise = np.zeros_like(features)
    noise[:, 4:67] = np.random.default_rng(1).normal(0, 0.03, (len(noise), 63))
    exact, noisy = t2m.positions_of(features[None]), (features + noise)[None]
    before, after = (np.abs(of(noisy) - exact).mean() for of in (t2m.positions_of, t2m.steady))
    slide, least = (
        np.diff(of(noisy) - exact, axis=1).std() for of in (t2m.positions_of, t2m.steady)
    )
    assert after < before / 2 and least < slide / 10


@pytest.mark.parametrize(
    "file, content, message",
    [
        ("motion/model.pt", None, "MDM checkpoint"),
        ("motion/model.pt", b"PK\x03\x04 broken", "MDM checkpoint.*model.pt"),
        ("motion/model.pt", {"weight": torch.zeros(3)}, "holds another model"),
        ("motion/args.json", None, "settings of the MDM checkpoint"),
        ("motion/args.json", b"{", "damaged"),
        ("motion/args.json", b'{"dataset": "kit"}', "'humanml' is supported"),
        ("motion/args.json", b'{"diffusion_steps": 1}', "expected 2"),
        ("motion/args.json", b'{"diffusion_steps": Infinity}', "expected 2"),
        ("motion/args.json", b"[]", "settings of the MDM checkpoint.*damaged"),
        ("motion/model.pt", {"embed_text.weight": torch.zeros(3)}, "MDM checkpoint.*model.pt"),
        ("motion/actions.txt", b"\xff\xff", "MDM checkpoint.*utf-8"),
        ("motion/Std.npy", np.full(263, "a"), "need 263 numbers"),
        ("motion/Std.npy", None, "file of HumanML3D .*Std.npy' does not exist"),
        ("motion/Std.npy", np.ones(3), "need 263 numbers"),
        ("body.npz", b"PK\x03\x04", "body model"),
        ("body.npz", "parents", "another skeleton, of 24 joints"),
        ("clip/model.safetensors", None, "weights, are missing"),
    ],
)
def test_damaged_files_are_refused_before_the_run(export, file, content, message):
    path = export / file
    path.unlink()
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif isinstance(content, dict):
        torch.save(content, path)
    elif isinstance(content, np.ndarray):
        np.save(path, content)
    elif content:
        arrays = tiny.body_arrays()
        arrays["kintree_table"][0, 4] = 0  # a knee on the pelvis
        np.savez(path, **arrays)
    with pytest.raises(UserError, match=message):
        preflight_prior(prior.MotionPrior(options_of(str(export))), False)


def options_of(folder: str) -> dict:
    return {"motion": folder, "body_model": folder, "clip": folder}


# Sentences ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "prompt, sentence",
    [
        ("a person in a red shirt and blue trousers kicks his left leg", "kicks the left leg"),
        ("a woman walks wearing a green hat, a red shirt and blue trousers", "walks"),
        ("a man in a blue cap kicking the left leg in a red cape", "is kicking the left leg"),
        ("a man sits down with a red hat", "sits down"),
    ],
)
def test_clothes_are_left_out(prompt, sentence):
    assert motion_sentence(prompt) == f"Someone {sentence}"


@pytest.mark.parametrize(
    "prompt, phrase",
    [
        ("Eve Kicks with her LEFT leg", "kicks with the left leg"),
        ("Eve kicks with left leg", "kicks with the left leg"),
        ("Eve in a T-pose", "is in a t pose"),
        ("a walking, kicking fox kicks", "kicks"),
        ("a man with a walking stick jumps", "jumps"),
        ("a man walks and kicks with the left leg", "walks"),  # the first, as the judge reads it
        ("a person jump", "jumps"),
        ("a girl with a boy's hat, a sword and a wooden bow walks", "walks"),
        ("Two-Face jumps in front of two trees", "jumps"),
        ("an X-Men hero with a crown of three jewels and a couple of hats jumps", "jumps"),
    ],
)
def test_the_first_known_phrase_is_taken(prompt, phrase):
    known = ["kicks", "kicks with the left leg", "kicking with the left leg", "is in a t pose"]
    known += ["walks", "walking", "jumps"]
    assert motion_sentence(prompt, known) == f"Someone {phrase}"


@pytest.mark.parametrize(
    "prompt, message",
    [
        ("a person in a red shirt", "no action was found in.*'Someone stands in a t pose'"),
        ("a person with a walking stick dances", "doesn't know the action 'dances': near"),
        ("  ", "no prompt"),
        ("a person kicks", "'kicks': near 'kicks with the left leg'"),
        ("two persons walk", "more than one person"),
        ("a photo of three knights who walk", "more than one person"),
        ("a man in a red shirt and a tall woman walk", "more than one person"),
        ("a man with a woman walks", "more than one person"),
        ("Batman and Robin walk", "more than one person"),
        ("lib:bow", "prompt library .*does not exist"),
        ("a person kiks with the left leg", "no action.*Someone kicks with the left leg"),
    ],
)
def test_other_prompts_are_refused_before_the_run(export, prompt, message):
    made = prior.MotionPrior(options_of(str(export)))
    with pytest.raises(UserError, match=message):
        preflight_prior(made, False, prompt)


def test_a_model_without_a_list_gets_motion_text_as_it_is(export):
    (export / "motion/actions.txt").unlink()
    model = t2m.load_motion_model(str(export / "motion/model.pt"))
    made = prior.MotionPrior(options_of(str(export)) | {"motion_text": "two men dance, then bow"})
    assert made._sentence("a fox", model) == "two men dance, then bow"


def test_an_avatar_from_an_export(export, monkeypatch):
    monkeypatch.setattr(prior, "FINE", 60)
    made = prior.MotionPrior(options_of(str(export)) | {"frame": 3, "num_points": 500})
    cloud = made("a person in a red shirt and blue trousers stands in a T pose")
    size = np.ptp(cloud.points, axis=0)  # faces +x, z up
    assert size[0] < 0.6 and size.max() == pytest.approx(2, rel=0.05)
    assert 0.8 < size[1] / size[2] < 1.1
    with pytest.raises(UserError, match="there are 3 motions"):
        prior.MotionPrior(options_of(str(export)) | {"sample": 3}).preflight()
    with pytest.raises(UserError, match="no action"):
        prior.MotionPrior(options_of(str(export)) | {"motion_text": " "}).preflight_prompt("walks")


# Motions and the body -----------------------------------------------------------------------------


def test_drawn_motions_keep_their_bones_and_are_read_back_from_features():
    for index, name in enumerate(motions.names()):
        found = motions.draw(name, np.random.default_rng(index)).positions
        bones = np.linalg.norm(found[:, 1:] - found[:, PARENTS[1:]], axis=-1)
        rest = np.linalg.norm(motions.REST[1:], axis=-1)
        np.testing.assert_allclose(bones, np.tile(rest, (len(bones), 1)), atol=1e-6)
        features = np.float64(motions.features(found))[None]
        read = t2m.positions_of(features)[0]
        np.testing.assert_allclose(t2m.steady(features)[0], read, atol=1e-5)
        placed = (found - found[0, 0] * [1, 0, 1])[:-1]
        x, _, z = (placed[0, [1, 16]] - placed[0, [2, 17]]).sum(0)
        c, s = np.array([x, z]) / np.hypot(x, z)  # the first heading is along +z
        turned = placed @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])
        np.testing.assert_allclose(read, turned, atol=1e-5)


def test_the_body_of_the_package():
    """Its hips, knees and arms bend as SMPL's; its surface is closed, and looks along +z."""
    path = FOLDER / "body.npz"
    assert path.stat().st_size <= 400_000
    body = prior.load_body_model(str(path))
    surface = trimesh.Trimesh(body.template.numpy(), body.faces, process=False)
    assert surface.is_watertight and surface.volume > 0.05 and surface.body_count == 1
    assert body.weights.shape == (len(body.template), 24) and body.shape_directions.shape[2] == 10
    np.testing.assert_allclose(body.weights.sum(1), 1, atol=1e-6)
    pose = torch.zeros(2, 24, 3, dtype=torch.float64)
    pose[1, INDEX["left hip"], 0] = -np.pi / 2  # the thigh forwards
    pose[1, INDEX["left knee"], 0] = np.pi / 2  # the shin down
    pose[1, INDEX["right shoulder"], 2] = np.pi / 2  # the arm down
    rest, bent = joints_of(body, pose)
    hip, knee, ankle = (INDEX[f"left {name}"] for name in ("hip", "knee", "ankle"))
    assert bent[knee, 2] - bent[hip, 2] == pytest.approx(rest[hip, 1] - rest[knee, 1], abs=1e-6)
    np.testing.assert_allclose((bent - rest)[ankle, 1], (bent - rest)[knee, 1], atol=1e-6)
    shoulder, wrist = INDEX["right shoulder"], INDEX["right wrist"]
    assert bent[shoulder, 1] - bent[wrist, 1] == pytest.approx(0.51, abs=1e-3)
    zeros = torch.zeros(2, 10, dtype=torch.float64), torch.zeros(2, 3, dtype=torch.float64)
    surfaces = prior.posed_vertices(body, prior.BodyFit(pose, *zeros, np.zeros((2, 22))))
    np.testing.assert_allclose(surfaces[0], body.template, atol=1e-9)
    moved = (surfaces[1] - surfaces[0])[body.weights[:, knee] > 0.99]  # the shin
    np.testing.assert_allclose(moved.mean(0), (bent - rest)[knee], atol=0.01)
