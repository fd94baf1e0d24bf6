"""Every registered prior satisfies one contract; then the specifics of each."""

import functools
import importlib
import logging
import pkgutil

import numpy as np
import pytest
import torch
import trimesh

from tests.helpers.prior_contract import PriorContract, assert_valid
from tests.priors.priors_cases import OPTIONS, build, rng
from threestudio_gaussiandreamer import priors
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.host import find, names
from threestudio_gaussiandreamer.priors.base import Prior, points_of, validated

for module in pkgutil.iter_modules(priors.__path__):
    importlib.import_module(f"{priors.__name__}.{module.name}")


# Their own test files build tiny weights and run the same contract.
TESTED_WITH_THEIR_WEIGHTS = {"shap-e-prior", "point-e-prior", "motion-prior", "anny-prior"}


PRIORS = sorted(name for name in names() if name.endswith("-prior"))


def test_every_registered_prior_is_tested():
    assert {p for p in PRIORS if not p.startswith(("test-", "tiny-"))} - set(
        OPTIONS
    ) <= TESTED_WITH_THEIR_WEIGHTS


@pytest.mark.parametrize("name", OPTIONS)
class TestContract(PriorContract):
    @pytest.fixture
    def make_prior(self, name, assets):
        return functools.partial(build, name, assets)


@pytest.mark.parametrize("name", [name for name in OPTIONS if "path" in OPTIONS[name]])
class TestFiles:
    def test_a_missing_file_names_its_neighbours(self, name, assets):
        source = OPTIONS[name]["path"]
        prior = build(name, assets, path=source.replace(".", "s."))
        with pytest.raises(UserError, match=f"does not exist.*{source}"):
            prior("a fox")

    def test_preflight_finds_a_missing_file_and_another_format(self, name, assets, tmp_path):
        build(name, assets).preflight()
        source = OPTIONS[name]["path"]
        with pytest.raises(UserError, match=f"does not exist.*{source}"):
            build(name, assets, path=source.replace(".", "s.")).preflight()
        (tmp_path / "a.fox").write_bytes(b"x")
        with pytest.raises(UserError, match=r"\bfox\b"):
            find(name)({"path": str(tmp_path / "a.fox")}).preflight()

    def test_no_path_is_refused_when_built(self, name, assets):
        with pytest.raises(UserError, match="path"):
            find(name)({})

    def test_damaged_files_are_refused(self, name, assets, tmp_path):
        content = (assets / OPTIONS[name]["path"]).read_bytes()
        for damaged in (b"", b"\x00\xff" * 50, content[: len(content) // 3]):
            path = tmp_path / OPTIONS[name]["path"]
            path.write_bytes(damaged)
            if name == "body-prior" and damaged.startswith(b"#"):
                continue  # a text mesh that is cut at a line is a smaller mesh
            with pytest.raises(UserError):
                find(name)({"path": str(path)})("a fox")


class Given(Prior):
    """A prior that returns given points."""

    def generate(self, prompt, generator):
        return self.cloud


class TestValidation:
    def cloud(self, bad=()):
        points = rng(0).normal(size=(200, 3))
        points[list(bad), 1] = np.nan
        faces = np.arange(198).reshape(-1, 3)
        return PointCloud(
            points=points,
            colors=rng(1).uniform(-0.5, 1.5, (200, 3)),
            normals=np.ones((200, 3)) / np.sqrt(3),
            faces=faces,
        )

    def test_few_bad_rows_are_dropped_and_counted(self, caplog):
        cloud = self.cloud(bad=[0, 10])
        cloud.colors[20, 2] = np.inf
        with caplog.at_level(logging.WARNING):
            result = validated(cloud, "some prior")
        assert "some prior: dropped 3 of 200" in caplog.text
        assert_valid(result)
        kept = np.delete(np.arange(200), [0, 10, 20])
        np.testing.assert_array_equal(result.points, cloud.points[kept].astype(np.float32))
        whole = [face for face in cloud.faces.tolist() if not set(face) & {0, 10, 20}]
        np.testing.assert_array_equal(kept[result.faces], whole)

    def test_colours_are_clipped(self):
        cloud = self.cloud()
        np.testing.assert_array_equal(
            validated(cloud, "x").colors, cloud.colors.clip(0, 1).astype(np.float32)
        )

    @pytest.mark.parametrize("factor, shift, said", [(255, 0, "0 to 2"), (2, -1, "-1 to 1")])
    def test_colours_of_another_range_are_refused(self, factor, shift, said):
        dark = self.cloud()
        dark = dark._replace(colors=0.5 * dark.colors.clip(0, 1))
        dark.colors[0], dark.colors[1] = 0, 1
        validated(dark, "x")
        other = dark._replace(colors=factor * dark.colors + shift)
        with pytest.raises(UserError, match=rf"x gave colours from {said}.*; expected \[0, 1\]"):
            validated(other, "x")

    def test_the_call_checks(self):
        prior = Given({})
        prior.cloud = self.cloud(bad=range(10))
        assert len(prior("").points) == 190  # exactly 5 %
        prior.cloud = self.cloud(bad=range(11))
        with pytest.raises(UserError, match="11 of the 200 points of Given"):
            prior("")

    @pytest.mark.parametrize(
        "returned, kind",
        [(None, "NoneType"), ((np.zeros((2, 3)),) * 2, "tuple"), (np.zeros((2, 3)), "ndarray")],
    )
    def test_anything_but_a_point_cloud_is_refused(self, returned, kind):
        prior = Given({})
        prior.cloud = returned
        with pytest.raises(UserError, match=rf"Given returned {kind}; .* a PointCloud"):
            prior("")

    def test_a_prior_without_generate_is_refused_when_built(self):
        class Unfinished(Prior):
            pass

        with pytest.raises(UserError, match=r"Unfinished has no generate\(prompt, generator\)"):
            Unfinished({})

    def test_a_generate_with_other_arguments_is_refused_when_built(self):
        class Old(Prior):
            def generate(self, prompt):
                return None

        with pytest.raises(UserError, match=r"Old has generate.*called as generate\(prompt, gen"):
            Old({})

    def test_tensors_with_gradients_are_taken(self):
        cloud = self.cloud()
        tensors = PointCloud(
            points=torch.tensor(cloud.points, requires_grad=True),
            colors=torch.tensor(cloud.colors),
            normals=torch.tensor(cloud.points, requires_grad=True),
        )
        taken = validated(tensors, "x")
        np.testing.assert_array_equal(taken.points, validated(cloud, "x").points)
        assert isinstance(taken.normals, np.ndarray)

    def test_half_precision_is_widened(self):
        cloud = self.cloud()
        half = {
            name: torch.tensor(getattr(cloud, name)).bfloat16() for name in ("points", "colors")
        }
        np.testing.assert_allclose(
            validated(PointCloud(**half), "x").points, cloud.points, rtol=0.01, atol=0.01
        )

    @pytest.mark.parametrize(
        "points", [[[0, 0, 0], [1, 1]], [["a", "b", "c"]], {}, torch.zeros(2, 3, device="meta")]
    )
    def test_what_is_no_array_is_refused(self, points):
        with pytest.raises(UserError, match="x gave something else than arrays"):
            validated(PointCloud(points=points, colors=np.zeros((2, 3))), "x")

    def test_the_result_of_another_hosts_prior_is_checked_too(self):
        cloud = self.cloud()
        taken = points_of(lambda prompt: cloud, "a toy")
        np.testing.assert_array_equal(taken.points, validated(cloud, "x").points)
        with pytest.raises(UserError, match="function returned list; expected a PointCloud"):
            points_of(lambda prompt: [], "a toy")

    @pytest.mark.parametrize(
        ("faces", "message"),
        [
            ([[0, 1, 9999]], "faces of the points 0 to 9999"),
            ([[-1, 0, 1]], "faces of the points -1 to 1"),
            ([[0, 1]], r"faces \(1, 2\) of type int64; expected integers"),
            ([[0, 1], [0, 1, 2]], "faces that are no array"),
            (np.zeros((2, 3), np.float32), r"faces \(2, 3\) of type float32"),
        ],
    )
    def test_faces_of_other_points_are_refused(self, faces, message):
        with pytest.raises(UserError, match=f"x gave {message}"):
            validated(self.cloud()._replace(faces=faces), "x")

    def test_faces_may_be_a_list(self):
        cloud = self.cloud(bad=[0])._replace(faces=[[0, 1, 2], [1, 2, 3]])
        # the face with the dropped point is dropped too, and the rows of the other are renumbered
        np.testing.assert_array_equal(validated(cloud, "x").faces, [[0, 1, 2]])

    def test_empty_and_misshapen_clouds_are_refused(self):
        with pytest.raises(UserError, match="no points"):
            validated(PointCloud(points=np.zeros((0, 3)), colors=np.zeros((0, 3))), "x")
        with pytest.raises(UserError, match=r"colours \(4, 3\)"):
            validated(PointCloud(points=np.zeros((5, 3)), colors=np.zeros((4, 3))), "x")
        with pytest.raises(UserError, match=r"x gave normals \(4, 3\); expected \(5, 3\)"):
            zeros = np.zeros((5, 3))
            validated(PointCloud(points=zeros, colors=zeros, normals=zeros[:4]), "x")


class TestMesh:
    def test_preflight_knows_bundled_meshes(self):
        find("mesh-prior")({"path": "toy.glb"}).preflight()
        with pytest.raises(UserError, match="bundled 'toy.glb'"):
            find("mesh-prior")({"path": "toi.glb"}).preflight()

    def test_vertices_as_the_paper(self, assets):
        cloud = build("mesh-prior", assets)("")
        mesh = trimesh.load(assets / "box.ply", process=False)
        np.testing.assert_allclose(
            cloud.points, mesh.vertices, atol=1e-6
        )  # the box is centred, its half side is 1
        np.testing.assert_allclose(cloud.colors, mesh.visual.vertex_colors[:, :3] / 255, atol=1e-6)
        np.testing.assert_array_equal(cloud.faces, mesh.faces)

    def test_surface_samples(self, assets):
        cloud = build("mesh-prior", assets, num_points=20_000, scale=0.5)("")
        assert len(cloud.points) == 20_000 and cloud.faces is None
        half = np.array([0.5, 0.25, 0.125])
        on_side = np.abs(np.abs(cloud.points) - half) < 1e-6
        assert on_side.any(axis=1).all() and (np.abs(cloud.points) <= half + 1e-6).all()
        areas = np.array([half[1] * half[2], half[0] * half[2], half[0] * half[1]])
        expected = areas / areas.sum()
        np.testing.assert_allclose(
            on_side.mean(axis=0), expected, atol=4 * np.sqrt(0.25 / 20_000)
        )  # four standard errors
        np.testing.assert_allclose(
            np.abs((cloud.normals * cloud.points).sum(1)), (on_side * half).max(1), atol=1e-5
        )  # outwards or inwards
        np.testing.assert_allclose(
            cloud.colors, cloud.points + 0.5, atol=0.02
        )  # the ramp, in bytes, scaled by 2 * 0.5

    def test_faces_without_area_get_no_samples(self, tmp_path):
        vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0.5, 0, 0.2], [0, 0, 1]]
        flat = [[0, 1, 4], [0, 1, 2], [3, 1, 2]]
        mesh = trimesh.Trimesh(
            vertices, flat + [[0, 0, 5]] * 30, process=False
        )  # an edge to (0, 0, 1) without area
        mesh.export(tmp_path / "mesh.ply")
        points = find("mesh-prior")({"path": str(tmp_path / "mesh.ply"), "num_points": 3000})(
            ""
        ).points
        assert points[:, 2].max() < -0.5  # the edge would reach up to +0.5

    def test_coarse_colours_and_shape(self, assets):
        sharp = build("mesh-prior", assets, num_points=1000)("")
        smooth = build("mesh-prior", assets, num_points=1000, color_smoothing=100)("")
        np.testing.assert_array_equal(smooth.points, sharp.points)
        nearest = np.linalg.norm(sharp.points[:, None] - sharp.points[None], axis=2).argsort(
            axis=1
        )[:, :100]
        np.testing.assert_allclose(smooth.colors, sharp.colors[nearest].mean(axis=1), atol=1e-5)
        everything = build("mesh-prior", assets, num_points=1000, color_smoothing=10**6)("")
        np.testing.assert_allclose(
            everything.colors, np.broadcast_to(sharp.colors.mean(0), (1000, 3)), atol=1e-4
        )
        noise = (
            build("mesh-prior", assets, num_points=1000, jitter=0.05, scale=2.0)("").points
            - 2 * sharp.points
        )
        assert noise.std() == pytest.approx(
            0.1, rel=0.05
        )  # 3000 draws: within four standard errors

    @pytest.mark.parametrize("color, expected", [("grey", 0.5), ([0.2, 0.4, 0.6], [0.2, 0.4, 0.6])])
    def test_fixed_colours(self, assets, color, expected):
        colors = build("mesh-prior", assets, color=color)("").colors
        np.testing.assert_allclose(colors, np.broadcast_to(expected, colors.shape))

    def test_up_and_front(self, assets):
        turned = build("mesh-prior", assets, up="+x", front="+y")("").points
        np.testing.assert_allclose(np.ptp(turned, axis=0), [1, 0.5, 2], atol=1e-6)

    def test_no_colours_are_reported(self, assets, caplog):
        with caplog.at_level(logging.WARNING):
            cloud = build("mesh-prior", assets, path="body.obj")("")
        assert "no colours" in caplog.text and (cloud.colors == 0.5).all()

    @pytest.mark.parametrize(
        "option",
        [
            ("color", "gray-ish"),
            ("color", [1, 2, 3]),
            ("color", [0.5]),
            ("num_points", -1),
            ("scale", 0.0),
            ("jitter", -0.1),
        ],
    )
    def test_bad_options(self, assets, option):
        with pytest.raises(UserError, match=option[0]):
            build("mesh-prior", assets, **dict([option]))


class TestBody:
    def test_points_are_upright_centred_and_random(self, assets):
        cloud = build("body-prior", assets, num_points=50_000)("")
        np.testing.assert_allclose(cloud.points.mean(axis=0), 0, atol=1e-6)
        np.testing.assert_allclose(
            np.ptp(cloud.points, axis=0), [0.75, 0.75, 2], rtol=0.01
        )  # stands along z
        assert cloud.colors.min() < 0.001 and cloud.colors.max() > 0.999
        assert cloud.colors.std() == pytest.approx(
            np.sqrt(1 / 12), rel=0.01
        )  # the released code: 0.0003
        assert (
            np.abs(np.corrcoef(cloud.colors.T) - np.eye(3)).max() < 0.02
        )  # four standard errors: coloured, not grey

    def test_vertices_and_own_colours(self, assets):
        cloud = build("body-prior", assets, path="box.ply", num_points=0, color=None)("")
        np.testing.assert_array_equal(cloud.colors, build("mesh-prior", assets)("").colors)


class TestRandom:
    def test_a_sphere_is_filled_uniformly(self, assets):
        points = build("random-prior", assets, num_points=20_000, size=0.7)("").points
        radii = np.linalg.norm(points, axis=1) / 0.7
        assert radii.max() <= 1
        # Kolmogorov-Smirnov at 0.1 %: the volume within a radius grows with its cube.
        assert np.abs(np.sort(radii**3) - np.linspace(0, 1, 20_000)).max() < 1.95 / np.sqrt(20_000)

    def test_a_box_mesh(self, assets):
        points = build("random-prior", assets, num_points=20_000, shape="box", size=0.7)("").points
        assert 0.69 < np.abs(points).max() <= 0.7 and points.std() == pytest.approx(
            0.7 / np.sqrt(3), rel=0.02
        )

    def test_colours(self, assets):
        assert build("random-prior", assets)("").colors.std() == pytest.approx(
            np.sqrt(1 / 12), rel=0.05
        )
        assert (build("random-prior", assets, color="grey")("").colors == 0.5).all()

    def test_bad_options(self, assets):
        with pytest.raises(UserError, match="did you mean 'sphere'"):
            build("random-prior", assets, shape="spere")
        with pytest.raises(UserError, match="color"):
            build("random-prior", assets, color=None)
