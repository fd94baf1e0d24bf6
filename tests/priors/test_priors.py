"""Every registered prior satisfies one contract; then validation, meshes, bodies, random points."""

import functools
import logging

import numpy as np
import pytest
import torch
import trimesh

from tests.helpers.prior_contract import PriorContract, assert_valid
from tests.priors.cases import OPTIONS, UNIFORM, build, rng
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.host import find, names
from threestudio_gaussiandreamer.priors.base import Prior, points_of, validated

register_parts()
TESTED_WITH_THEIR_WEIGHTS = {"shap-e-prior", "point-e-prior", "motion-prior", "anny-prior"}
"""Their own test files build tiny weights and run the same contract."""


def test_every_registered_prior_is_tested():
    found = {name for name in names() if name.endswith("-prior")}
    found = {name for name in found if not name.startswith(("test-", "tiny-", "own-"))}
    assert found - set(OPTIONS) <= TESTED_WITH_THEIR_WEIGHTS


@pytest.mark.parametrize("name", OPTIONS)
class TestContract(PriorContract):
    @pytest.fixture
    def make_prior(self, name, assets):
        return functools.partial(build, name, assets)


@pytest.mark.parametrize("name", [name for name in OPTIONS if "path" in OPTIONS[name]])
def test_files_are_checked_before_any_work(name, assets, tmp_path):
    source = OPTIONS[name]["path"]
    build(name, assets).preflight()
    missing = build(name, assets, path=source.replace(".", "s."))
    for call in (missing.preflight, lambda: missing("a fox")):
        with pytest.raises(UserError, match=f"does not exist.*{source}"):
            call()
    (tmp_path / "a.fox").write_bytes(b"x")
    with pytest.raises(UserError, match=r"\bfox\b"):
        find(name)({"path": str(tmp_path / "a.fox")}).preflight()
    with pytest.raises(UserError, match="path"):
        find(name)({})
    content = (assets / source).read_bytes()
    for damaged in (b"", b"\x00\xff" * 50, content[: len(content) // 3]):
        (tmp_path / source).write_bytes(damaged)
        if name == "body-prior" and damaged.startswith(b"#"):
            continue  # a text mesh that is cut at a line is a smaller mesh
        with pytest.raises(UserError):
            find(name)({"path": str(tmp_path / source)})("a fox")


# Validation ---------------------------------------------------------------------------------------


class Given(Prior):
    """A prior that returns given points."""

    def generate(self, prompt, generator):
        return self.cloud


def cloud_with(bad=(), **changes):
    points = rng(0).normal(size=(200, 3))
    points[list(bad), 1] = np.nan
    colors, faces = rng(1).uniform(-0.5, 1.5, (200, 3)), np.arange(198).reshape(-1, 3)
    normals = np.ones((200, 3)) / np.sqrt(3)
    return PointCloud(points, colors, normals, faces)._replace(**changes)


def test_few_bad_rows_are_dropped_and_colours_clipped(caplog):
    cloud = cloud_with(bad=[0, 10])
    cloud.colors[20, 2] = np.inf
    with caplog.at_level(logging.WARNING):
        result = validated(cloud, "some prior")
    assert "some prior: dropped 3 of 200" in caplog.text
    assert_valid(result)
    kept = np.delete(np.arange(200), [0, 10, 20])
    np.testing.assert_array_equal(result.points, cloud.points[kept].astype(np.float32))
    np.testing.assert_array_equal(result.colors, cloud.colors[kept].clip(0, 1).astype(np.float32))
    whole = [face for face in cloud.faces.tolist() if not set(face) & {0, 10, 20}]
    np.testing.assert_array_equal(kept[result.faces], whole)
    listed = cloud_with(bad=[0], faces=[[0, 1, 2], [1, 2, 3]])
    np.testing.assert_array_equal(validated(listed, "x").faces, [[0, 1, 2]])


def test_the_call_checks_also_those_of_other_hosts():
    prior = Given({})
    prior.cloud = cloud_with(bad=range(10))
    assert len(prior("").points) == 190  # exactly 5 %
    prior.cloud = cloud_with(bad=range(11))
    with pytest.raises(UserError, match="11 of the 200 points of Given"):
        prior("")
    prior.cloud = (np.zeros((2, 3)),) * 2
    with pytest.raises(UserError, match=r"Given gave tuple; .* a PointCloud"):
        prior("")
    taken = points_of(lambda prompt: cloud_with(), "a toy")
    np.testing.assert_array_equal(taken.points, validated(cloud_with(), "x").points)
    with pytest.raises(UserError, match="function gave list; expected a PointCloud"):
        points_of(lambda prompt: [], "a toy")


def test_a_prior_without_generate_or_with_other_arguments_is_refused_when_built():
    class Unfinished(Prior):
        pass

    class Old(Prior):
        def generate(self, prompt):
            return None

    with pytest.raises(UserError, match=r"Unfinished has no generate\(prompt, generator\)"):
        Unfinished({})
    with pytest.raises(UserError, match=r"Old has generate.*called as generate\(prompt, gen"):
        Old({})


def test_tensors_are_taken():
    cloud = cloud_with()
    points, colors = torch.tensor(cloud.points, requires_grad=True), torch.tensor(cloud.colors)
    taken = validated(PointCloud(points, colors, normals=points), "x")
    np.testing.assert_array_equal(taken.points, validated(cloud, "x").points)
    assert isinstance(taken.normals, np.ndarray)
    half = validated(PointCloud(points.bfloat16(), colors.bfloat16()), "x")
    np.testing.assert_allclose(half.points, cloud.points, rtol=0.01, atol=0.01)


DARK = 0.5 * cloud_with().colors.clip(0, 1)
DARK[0], DARK[1] = 0, 1
ZEROS = np.zeros((5, 3))


@pytest.mark.parametrize(
    ("cloud", "message"),
    [
        (cloud_with(colors=255 * DARK), r"colours from 0 to 255; expected \[0, 1\]"),
        (cloud_with(colors=2 * DARK - 1), r"colours from -1 to 1; expected \[0, 1\]"),
        (PointCloud([[0, 0, 0], [1, 1]], ZEROS), "something else than arrays"),
        (PointCloud({}, ZEROS), "something else than arrays"),
        (PointCloud(torch.zeros(2, 3, device="meta"), ZEROS), "something else than arrays"),
        (PointCloud(ZEROS[:0], ZEROS[:0]), "no points"),
        (PointCloud(ZEROS, ZEROS[:4]), r"points \(5, 3\), colours \(4, 3\)"),
        (PointCloud(ZEROS, ZEROS, ZEROS[:4]), r"normals \(4, 3\); expected \(P, 3\)"),
        (cloud_with(faces=[[0, 1, 9999]]), r"faces \(1, 3\) of type int64; expected integers"),
        (cloud_with(faces=[[-1, 0, 1]]), "faces .* from 0 to 199"),
        (cloud_with(faces=[[0, 1], [0, 1, 2]]), "something else than arrays"),
        (cloud_with(faces=np.zeros((2, 3), np.float32)), r"faces \(2, 3\) of type float32"),
    ],
)
def test_other_results_are_refused(cloud, message):
    with pytest.raises(UserError, match=f"x gave .*{message}"):
        validated(cloud, "x")


# Meshes, bodies, random points --------------------------------------------------------------------


def test_the_vertices_of_a_mesh_as_the_paper(assets, caplog):
    cloud = build("mesh-prior", assets)("")
    mesh = trimesh.load(assets / "box.ply", process=False)
    np.testing.assert_allclose(cloud.points, mesh.vertices, atol=1e-6)  # centred, half side 1
    np.testing.assert_allclose(cloud.colors, mesh.visual.vertex_colors[:, :3] / 255, atol=1e-6)
    np.testing.assert_array_equal(cloud.faces, mesh.faces)
    turned = build("mesh-prior", assets, up="+x", front="+y")("").points
    np.testing.assert_allclose(np.ptp(turned, axis=0), [1, 0.5, 2], atol=1e-6)
    colors = build("mesh-prior", assets, color=[0.2, 0.4, 0.6])("").colors
    np.testing.assert_allclose(colors, np.broadcast_to([0.2, 0.4, 0.6], colors.shape))
    with caplog.at_level(logging.WARNING):
        colors = build("mesh-prior", assets, path="body.obj")("").colors
    assert "no colours" in caplog.text and (colors == 0.5).all()
    find("mesh-prior")({"path": "toy.glb"}).preflight()
    with pytest.raises(UserError, match="bundled 'toy.glb'"):
        find("mesh-prior")({"path": "toi.glb"}).preflight()


def test_surface_samples(assets):
    cloud = build("mesh-prior", assets, num_points=20_000, scale=0.5)("")
    assert len(cloud.points) == 20_000 and cloud.faces is None
    half = np.array([0.5, 0.25, 0.125])
    on_side = np.abs(np.abs(cloud.points) - half) < 1e-6
    assert on_side.any(axis=1).all() and (np.abs(cloud.points) <= half + 1e-6).all()
    areas = np.array([half[1] * half[2], half[0] * half[2], half[0] * half[1]])
    deviation = 4 * np.sqrt(0.25 / 20_000)  # four standard errors
    np.testing.assert_allclose(on_side.mean(axis=0), areas / areas.sum(), atol=deviation)
    along = np.abs((cloud.normals * cloud.points).sum(1))
    np.testing.assert_allclose(along, (on_side * half).max(1), atol=1e-5)
    np.testing.assert_allclose(cloud.colors, cloud.points + 0.5, atol=0.02)  # the ramp, in bytes


def test_smoothed_colours(assets):
    sharp = build("mesh-prior", assets, num_points=1000)("")
    smooth = build("mesh-prior", assets, num_points=1000, color_smoothing=100)("")
    np.testing.assert_array_equal(smooth.points, sharp.points)
    distances = np.linalg.norm(sharp.points[:, None] - sharp.points[None], axis=2)
    nearest = distances.argsort(axis=1)[:, :100]
    np.testing.assert_allclose(smooth.colors, sharp.colors[nearest].mean(axis=1), atol=1e-5)
    everything = build("mesh-prior", assets, num_points=1000, color_smoothing=10**6)("").colors
    mean = np.broadcast_to(sharp.colors.mean(0), (1000, 3))
    np.testing.assert_allclose(everything, mean, atol=1e-4)


def test_a_body_is_upright_centred_and_random(assets):
    cloud = build("body-prior", assets, num_points=50_000)("")
    np.testing.assert_allclose(cloud.points.mean(axis=0), 0, atol=1e-6)
    np.testing.assert_allclose(np.ptp(cloud.points, axis=0), [0.75, 0.75, 2], rtol=0.01)
    assert cloud.colors.min() < 0.001 and cloud.colors.max() > 0.999
    assert cloud.colors.std() == pytest.approx(UNIFORM, rel=0.01)  # the released code: 0.0003
    own = build("body-prior", assets, path="box.ply", num_points=0, color=None)("").colors
    np.testing.assert_array_equal(own, build("mesh-prior", assets)("").colors)


def test_random_points_are_uniform(assets):
    cloud = build("random-prior", assets, num_points=20_000, size=0.7)("")
    radii = np.linalg.norm(cloud.points, axis=1) / 0.7
    assert radii.max() <= 1 and cloud.colors.std() == pytest.approx(UNIFORM, rel=0.05)
    # Kolmogorov-Smirnov at 0.1 %: the volume within a radius grows with its cube
    assert np.abs(np.sort(radii**3) - np.linspace(0, 1, 20_000)).max() < 1.95 / np.sqrt(20_000)
    box = build("random-prior", assets, num_points=20_000, shape="box", size=0.7, color="grey")("")
    assert 0.69 < np.abs(box.points).max() <= 0.7 and (box.colors == 0.5).all()
    assert box.points.std() == pytest.approx(0.7 / np.sqrt(3), rel=0.02)


def test_bad_options(assets):
    for name, value in (("color", "gray-ish"), ("color", [1, 2, 3]), ("scale", 0.0)):
        with pytest.raises(UserError, match=name):
            build("mesh-prior", assets, **{name: value})
    with pytest.raises(UserError, match="did you mean 'sphere'"):
        build("random-prior", assets, shape="spere")
