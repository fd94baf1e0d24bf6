"""Avatars: the motion in a prompt, files of motions, CLIP's choices, bodies; SMPL's fit."""

import pickle
import shutil
import sys
import types

import numpy as np
import pytest
import scipy.sparse
import torch
import trimesh
from scipy.spatial.transform import Rotation

from tests.helpers import tiny_3d_models as tiny
from tests.helpers.prior_contract import PriorContract, assert_valid
from tests.priors.cases import UNIFORM, joints_of, walk
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.meshes.mesh import Mesh
from threestudio_gaussiandreamer.priors import motion as module
from threestudio_gaussiandreamer.priors import motion_text
from threestudio_gaussiandreamer.priors.body_pose import PARENTS, Z_UP, Body, facing, posed
from threestudio_gaussiandreamer.priors.motion import (
    BodyFit,
    MotionPrior,
    Motions,
    beyond_limits,
    body_pictures,
    fit_bodies,
    load_body_model,
    offered_frames,
    posed_vertices,
    read_motions,
)

FAST = {"num_points": 500}


@pytest.fixture
def options(motion_file, body_file, clip, monkeypatch):
    monkeypatch.setattr(module, "FINE", 60)
    return FAST | {"motion": str(motion_file), "body_model": str(body_file), "clip": clip}


class TestContract(PriorContract):
    @pytest.fixture
    def make_prior(self, options):
        return lambda **more: MotionPrior(options | {"frame": 0} | more)


@pytest.mark.parametrize(
    "prompt, motion",
    [
        ("Iron man kicks with his left leg", "Someone kicks with the left leg"),  # the paper's
        ("Spiderman stands with open arms, 4k", "Someone stands with open arms"),  # its figure's
        ("a photo of Eve raising her right hand", "Someone is raising the right hand"),
        ("A knight is running quickly", "Someone is running quickly"),
        ("a zombie lying on its back. Unreal engine", "Someone is lying on the back"),
        ("The flying dutchman PUNCHES their enemy", "Someone punches the enemy"),
        ("two soldiers march", "Someone marches"),
        ("Spiderman", None),
        ("kick", None),  # no subject
        ("", None),
    ],
)
def test_the_motion_of_a_prompt(prompt, motion, monkeypatch, capsys):
    assert motion_text.reduced_prompt(prompt) == motion
    monkeypatch.setattr(sys, "argv", ["motion_text", *prompt.split()])
    if prompt:
        motion_text.main()
        assert (motion or "no verb of motion found") in capsys.readouterr().out


# Files of motions ---------------------------------------------------------------------------------


def test_layouts_of_motions(motion_file, body, tmp_path):
    motions = read_motions(str(motion_file))
    assert motions.lengths == [6, 4]
    np.testing.assert_array_equal(motions.positions[0], walk(body))
    for joints in (22, 24):
        frames = np.random.default_rng(0).normal(size=(5, joints, 3))
        for array in (frames, frames.transpose(1, 2, 0), frames.transpose(1, 2, 0)[None]):
            np.save(tmp_path / "motion.npy", array.astype(np.float32))
            motions = read_motions(str(tmp_path / "motion.npy"))
            np.testing.assert_allclose(motions.positions, frames[None], atol=1e-6)
            assert motions.lengths == [5]
    results = {"motion": walk(body).transpose(1, 2, 0)[None], "text": ["Someone kicks"]}
    np.save(tmp_path / "results.npy", results | {"lengths": np.array([6]), "num_samples": 1})
    read = read_motions(str(tmp_path / "results.npy"))  # MDM's own
    np.testing.assert_array_equal(read.positions[0], walk(body))
    assert read.lengths == [6]
    padded = np.zeros((1, 22, 3, 5))
    padded[..., 3:] = np.nan
    np.savez(tmp_path / "motion.npz", motion=padded, lengths=np.array([3]))
    assert read_motions(str(tmp_path / "motion.npz")).lengths == [3]


ZEROS = np.zeros((1, 22, 3, 5))


def body_with(name, value, *place):
    arrays = tiny.body_arrays()
    arrays[name][place] = value
    return arrays


@pytest.mark.parametrize(
    "content, message",
    [
        (b"PK\x03\x04 broken", "motion file"),
        ({"joints": ZEROS}, "no array 'motion', only joints"),
        ({"motion": np.zeros((1, 25, 6, 5))}, "rotations"),
        ({"motion": np.zeros((1, 21, 3, 5))}, r"\(1, 21, 3, 5\).*22 or 24 joints"),
        ({"motion": ZEROS[..., :0]}, r"\(1, 22, 3, 0\)"),
        ({"motion": np.full((1, 22, 3, 5), np.nan)}, "NaN"),
        ({"motion": np.zeros((2, 22, 3, 5)), "lengths": np.array([5])}, "lengths must be 2"),
        ({"motion": ZEROS, "lengths": np.array([6])}, "from 1 to 5"),
        ({"v_template": ZEROS}, "no array 'shapedirs'"),
        (tiny.body_arrays() | {"weights": np.zeros((9, 20))}, "arrays.*fit each other"),
        (body_with("v_template", np.nan, 0), "damaged"),
        (body_with("kintree_table", 5, 0, 5), "damaged"),
        (body_with("f", 10**6, 0, 0), "damaged"),
    ],
)
def test_other_files_are_refused(tmp_path, content, message):
    if isinstance(content, bytes):
        (tmp_path / "motion.npz").write_bytes(content)
    else:
        np.savez(tmp_path / "motion.npz", **content)
    with pytest.raises(UserError, match=message):
        read = load_body_model if "v_template" in list(content) else read_motions
        read(str(tmp_path / "motion.npz"))
    with pytest.raises(UserError, match="near names.*motion.npz"):
        read_motions(str(tmp_path / "motions.npz"))


# The choice ---------------------------------------------------------------------------------------


@pytest.fixture
def asked(monkeypatch):
    """Replace CLIP: the last picture fits best. Return the texts that it is asked for."""
    texts = []

    def scores(pictures, text):
        texts.append(text)
        return np.arange(len(pictures), dtype=float)

    clip = types.SimpleNamespace(similarities=scores)
    monkeypatch.setattr(module, "PictureText", lambda source, device: clip)
    monkeypatch.setattr(module, "NUM_FRAMES", 2)
    monkeypatch.setattr(module, "ROUGH", 5)
    return texts


def test_offered_frames(monkeypatch):
    monkeypatch.setattr(module, "NUM_FRAMES", 3)
    motions = Motions(np.zeros((2, 9, 22, 3)), [9, 4])
    every = [(0, 0), (0, 4), (0, 8), (1, 0), (1, 2), (1, 3)]
    assert offered_frames(motions.lengths, None, "clip") == every
    assert offered_frames(motions.lengths, 1, "clip") == every[3:]
    assert offered_frames(motions.lengths, None, 7) == [(0, 7)]
    for sample, frame, message in ((2, "clip", "2 motions"), (1, 4, "4 frames")):
        with pytest.raises(UserError, match=message):
            offered_frames(motions.lengths, sample, frame)


def test_clip_chooses_the_frame_by_the_motions_text(options, asked, monkeypatch):
    """The cloud of a frame doesn't depend on the others; a prompt without a motion warns."""
    warned = []
    monkeypatch.setattr(module, "warn", warned.append)
    chosen = MotionPrior(options)("Iron man kicks with his left leg")
    same = MotionPrior(options | {"sample": 1, "frame": 3})("Iron man kicks with his left leg")
    np.testing.assert_array_equal(chosen.points, same.points)
    MotionPrior(options | {"sample": 1, "motion_text": "Someone bows"})("Iron man")
    assert not warned
    MotionPrior(options | {"sample": 1})("Spiderman")
    assert asked == ["Someone kicks with the left leg", "Someone bows", "Spiderman"]
    assert "motion_text" in warned[0]


def test_candidates_are_chosen_for_the_prompt(tmp_path, clip, asked):
    for name, height in (("short", 1.0), ("tall", 3.0)):
        trimesh.creation.box(extents=[1, 1, height]).export(tmp_path / f"{name}.ply")
    paths = [str(tmp_path / "short.ply"), str(tmp_path / "tall.ply")]
    options = FAST | {"candidates": paths, "clip": clip, "scale": 1.5}
    cloud = MotionPrior(options)("Iron man kicks")
    assert_valid(cloud)
    alone = MotionPrior(options | {"candidates": paths[1:], "clip": "no/where"})("Iron man kicks")
    for found in (cloud, alone):
        assert np.ptp(found.points, axis=0)[2] == pytest.approx(3.0, rel=0.02)
    assert asked == ["Iron man kicks"]  # one candidate needs no choice


def test_pictures_show_the_front_and_both_sides():
    """A plate that faces +x is widest in the middle one, one that faces +y is thin there."""
    plate = trimesh.creation.box(extents=[0.02, 1, 1])
    front, side = (
        (body_pictures(Mesh(plate.vertices[:, order], np.asarray(plate.faces))) != 0.5).all(-1)
        for order in ([0, 1, 2], [1, 0, 2])
    )
    assert front.shape == (3, 224, 224) and not front[:, 0, 0].any()  # grey
    left, middle, right = front.mean(axis=(1, 2))
    assert middle > 1.2 * max(left, right) and side[1].mean() < 0.2 * middle


# The body in the world ----------------------------------------------------------------------------


def test_a_rotated_body_is_turned_to_face_plus_x(body):
    pose = torch.zeros(4, 24, 3, dtype=torch.float64)
    pose[:, 0, 1] = torch.tensor([0.0, 1.0, 2.5, -1.5])
    for joints in joints_of(body, pose):
        turned = joints[:, Z_UP] @ facing(joints).T
        across = turned[[2, 17]] - turned[[1, 16]]  # right of left along -y
        np.testing.assert_allclose(across[:, 0], 0, atol=1e-9)
        assert across[1, 1] < -0.3 and turned[15, 2] > turned[0, 2] > turned[7, 2]  # head up
    lying = np.zeros((22, 3))  # hips and shoulders above each other: not turned
    lying[[1, 16], 1], lying[[2, 17], 1] = 0.1, -0.1
    np.testing.assert_array_equal(facing(lying), np.eye(3))


def test_the_body_of_a_frame(options, monkeypatch, tmp_path):
    """The body turns to its left while the knee rises."""
    said = []
    monkeypatch.setattr(module, "info", said.append)
    points = MotionPrior(options | {"frame": 5, "num_points": 0})("").points
    assert points[:, 0].max() > -3 * points[:, 0].min()  # the raised knee is in front
    assert np.ptp(points, axis=0).max() == pytest.approx(2.0, rel=1e-5)  # twice the scale
    np.testing.assert_allclose(points.mean(axis=0), 0, atol=1e-5)
    cloud = MotionPrior(options | {"frame": 0, "num_points": 4000})("")
    assert len(cloud.points) == 4000 and cloud.colors.std() == pytest.approx(UNIFORM, rel=0.05)
    assert any("SMPL fitted to motion 0, frame 5:" in line and "mm mean" in line for line in said)
    motion = 10 * np.load(options["motion"])["motion"]  # decimetres
    np.savez(tmp_path / "results.npz", motion=motion)
    with pytest.raises(UserError, match=r"off by \d+.* mm mean.*in metres"):
        MotionPrior(options | {"motion": str(tmp_path / "results.npz"), "frame": 0})("")


@pytest.mark.parametrize(
    "change, message",
    [
        ({"motion": ""}, "neither"),
        ({"candidates": ["a.obj"]}, "both"),
        ({"body_model": ""}, "body_model.*smpl.is.tue.mpg.de"),
        ({"frame": "best"}, "frame"),
        ({"color": "pink"}, "color"),
    ],
)
def test_options_out_of_range(options, change, message):
    with pytest.raises(UserError, match=message):
        MotionPrior(options | change)


def test_preflight_checks_all_files(options, tmp_path, clip):
    MotionPrior(options).preflight()
    spoiled = shutil.copytree(clip, tmp_path / "clip")
    (spoiled / "model.safetensors").unlink()
    for change, message in (
        ({"motion": "nothing.npz"}, "motion file"),
        ({"body_model": "nothing.npz"}, "body model"),
        ({"motion": "", "candidates": ["nothing.obj"]}, "body mesh"),
        ({"clip": str(spoiled)}, "safetensors, the weights, are missing"),
    ):
        with pytest.raises(UserError, match=message):
            MotionPrior(options | change).preflight()
    MotionPrior(options | {"clip": str(spoiled), "frame": 0}).preflight()  # not needed


# SMPL from joints ---------------------------------------------------------------------------------


def random_poses(count, seed=0, spread=0.25):
    """Return poses within the limits: rotations of about ``spread`` radians, those with limits
    uniformly between them.
    """
    rng = torch.Generator().manual_seed(seed)
    pose = spread * torch.randn(count, 24, 3, generator=rng, dtype=torch.float64)
    for joint, axes in module.LIMITS.items():
        for axis, (low, high) in axes.items():
            part = 0.15 + 0.7 * torch.rand(count, generator=rng, dtype=torch.float64)
            pose[:, joint, axis] = (low + (high - low) * part) * module.DEGREES
    pose[:, 0] = torch.randn(count, 3, generator=rng, dtype=torch.float64)
    return pose


@pytest.mark.parametrize("protocol", [0, 2, pickle.HIGHEST_PROTOCOL])
def test_the_pkl_is_read_without_chumpy(tmp_path, body_file, monkeypatch, protocol):
    """SMPL's file has arrays of chumpy and a sparse matrix, MANO's a selection of chumpy's too."""
    arrays, ch = tiny.body_arrays(), types.ModuleType("chumpy.ch")
    for name in ("Ch", "Select"):
        init = {"__init__": lambda self, **state: vars(self).update(state)}
        made = {"__module__": "chumpy.ch", **init}
        setattr(ch, name, type(name, (), made))
    shapes = arrays["shapedirs"]
    arrays["J_regressor"] = scipy.sparse.csc_matrix(arrays["J_regressor"])
    arrays["v_template"] = ch.Ch(x=arrays["v_template"])
    arrays["shapedirs"] = ch.Select(
        a=ch.Ch(x=np.asfortranarray(shapes[::-1])),
        idxs=np.arange(shapes.size).reshape(shapes.shape)[::-1].ravel(),
        preferred_shape=shapes.shape,
    )
    with monkeypatch.context() as context:
        context.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
        context.setitem(sys.modules, "chumpy.ch", ch)
        (tmp_path / "SMPL_NEUTRAL.pkl").write_bytes(pickle.dumps(arrays, protocol))
    paths = (tmp_path / "SMPL_NEUTRAL.pkl", body_file)
    read, original = (load_body_model(str(path)) for path in paths)
    for a, b in zip(read, original, strict=True):
        np.testing.assert_array_equal(a, b)


def test_bodies_with_hands_are_read(tmp_path, body):
    """SMPL-H and SMPL-X have other joints after the 22nd, and are distributed as NPZ."""
    arrays, more = tiny.body_arrays(), 28
    vertices = len(arrays["v_template"])
    arrays["posedirs"] = np.zeros((vertices, 3, 9 * 51))
    regressor, tree = arrays["J_regressor"], np.array([[20] * more, range(24, 52)], np.uint32)
    arrays["J_regressor"] = np.concatenate([regressor, np.repeat(regressor[20:21], more, axis=0)])
    arrays["weights"] = np.concatenate([arrays["weights"], np.zeros((vertices, more))], axis=1)
    arrays["kintree_table"] = np.concatenate([arrays["kintree_table"], tree], axis=1)
    np.savez(tmp_path / "SMPLH_NEUTRAL.npz", **arrays)
    model = load_body_model(str(tmp_path / "SMPLH_NEUTRAL.npz"))
    targets = joints_of(body, random_poses(1))
    fit = fit_bodies(model, targets, iterations=100)
    # joints 22 and 23 of SMPL are other ones here
    assert fit.residuals.shape == (1, 22) and fit.residuals.mean() < 10
    assert posed_vertices(model, fit).shape == (1, vertices, 3)


def test_skinning_by_another_implementation(body):
    """That of poses in ``body_pose``."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(body.pose_directions.shape, generator=generator, dtype=torch.float64)
    body = body._replace(pose_directions=0.01 * directions)
    pose, shape = random_poses(2), torch.randn(2, 10, generator=generator, dtype=torch.float64)
    pose[:, 22:] = pose[1] = 0
    fit = BodyFit(pose, shape, torch.ones(2, 3, dtype=torch.float64), np.zeros((2, 22)))
    found, joints = posed_vertices(body, fit), joints_of(body, pose, shape, fit.translation)
    weights = body.weights.numpy()[:, :22].copy()
    weights[:, 20:] += body.weights.numpy()[:, 22:]  # hands move with the wrists
    for i, vectors in enumerate(pose.numpy()):
        shaped = (body.template + body.shape_directions @ shape[i]).numpy()
        rest, turns = (body.joint_regressor.numpy() @ shaped)[:22], []
        for parent, own in zip(PARENTS, Rotation.from_rotvec(vectors[:22]), strict=False):
            turns.append(turns[parent] * own if turns else own)
        own = Rotation.from_rotvec(vectors[1:]).as_matrix() - np.eye(3)
        bent = shaped + (own.ravel() @ body.pose_directions.numpy()).reshape(-1, 3)
        pose22 = np.stack([turn.as_matrix() for turn in turns])
        oracle = posed(Body(bent, body.faces, rest, weights), pose22)
        np.testing.assert_allclose(found[i], oracle.vertices + 1, atol=1e-9)
        np.testing.assert_allclose(joints[i, :22], oracle.joints + 1, atol=1e-9)


def test_known_poses_and_surfaces_are_found(body):
    """The twist of the bones follows from the prior, and hardly moves the surface of thin tubes."""
    pose = random_poses(4)
    shape = torch.zeros(4, 10, dtype=torch.float64)
    shape[:, 0] = torch.linspace(-1, 1, 4)
    translation = torch.linspace(-2, 2, 12, dtype=torch.float64).reshape(4, 3)
    fit = fit_bodies(body, joints_of(body, pose, shape, translation)[:, :22])
    assert fit.residuals.shape == (4, 22)
    assert fit.residuals.mean() < 2 and fit.residuals.max() < 8  # mm; the pose prior pulls a little
    assert beyond_limits(fit.pose) < 1e-3  # square radians
    # wrists, head and toes have no joints after them, and keep the rest pose
    assert fit.pose[:, [10, 11, 15, 20, 21, 22, 23]].abs().max() < 1e-3
    pose = random_poses(2, seed=1, spread=0.1)
    fit = fit_bodies(body, joints_of(body, pose))
    zeros = torch.zeros(2, 10, dtype=torch.float64), torch.zeros(2, 3, dtype=torch.float64)
    truth = posed_vertices(body, BodyFit(pose, *zeros, fit.residuals))
    apart = np.linalg.norm(posed_vertices(body, fit) - truth, axis=-1)
    assert apart.mean() < 0.02  # metres; tubes are 8 cm thick
    assert fit.residuals.shape == (2, 24) and fit.residuals.mean() < 2


def test_knees_bend_forwards(body):
    """A leg that is bent backwards is not fitted."""
    pose = torch.zeros(2, 24, 3, dtype=torch.float64)
    assert beyond_limits(pose) == 0
    pose[0, 4, 0], pose[1, 4, 0] = 1.2, -1.2
    fit = fit_bodies(body, joints_of(body, pose), iterations=100)
    assert fit.pose[0, 4, 0] > 1.1 and fit.residuals[0].mean() < 2
    assert fit.pose[1, 4, 0] > -0.1 and fit.residuals[1].mean() > 5
    pose[:, 4, 0] = torch.tensor([-0.5, 0.0])  # a knee the wrong way
    pose[0, 18, 1] = -1.0  # an elbow the right way
    assert beyond_limits(pose).item() == pytest.approx(0.25)
