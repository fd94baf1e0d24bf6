"""Every registered prior keeps the same contract; then what each one does of its own."""

import functools
import importlib
import logging
import pkgutil

import numpy as np
import pytest
import trimesh

from tests.helpers.prior_contract import PriorContract, assert_valid
from tests.helpers.raw_ply import write_raw_gaussians
from threestudio_gaussiandreamer import priors
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats import ply
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.host import find, names
from threestudio_gaussiandreamer.priors.base import Prior, validated

for module in pkgutil.iter_modules(priors.__path__):
    importlib.import_module(f"{priors.__name__}.{module.name}")


def rng(seed=0):
    return np.random.default_rng(seed)


@pytest.fixture(scope="session")
def assets(tmp_path_factory):
    """A folder of small sources: a body-like capsule, a coloured mesh, points and Gaussians."""
    folder = tmp_path_factory.mktemp("assets")
    body = trimesh.creation.capsule(height=1.0, radius=0.3)  # along z
    body.apply_transform(
        trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
    )  # now along y, as OBJ has it
    body.export(folder / "body.obj")
    box = trimesh.creation.box(extents=[2, 1, 0.5]).subdivide().subdivide()
    box.visual.vertex_colors = (255 * (box.vertices / 2 + 0.5).clip(0, 1)).astype(np.uint8)
    box.export(folder / "box.ply")
    ply.write_points(
        folder / "points.ply",
        PointCloud(points=rng(1).normal(size=(300, 3)), colors=rng(2).random((300, 3))),
    )
    harmonics, scales, turns = (rng(i).normal(size=(200, n)) for i, n in ((3, 12), (4, 3), (5, 4)))
    gaussians = Gaussians(
        means=rng(6).normal(size=(200, 3)),
        quats=turns,
        log_scales=scales,
        logit_opacities=np.linspace(-5, 5, 200),
        sh=harmonics.reshape(200, 4, 3),
    )
    ply.write_gaussians(folder / "gaussians.ply", gaussians, ["up: z"])
    return folder


# Needed options of each registered prior; a new prior is one row here.
OPTIONS = {
    "mesh-prior": {"path": "box.ply"},
    "body-prior": {"path": "body.obj", "num_points": 2000},
    "point-cloud-prior": {"path": "points.ply"},
    "gaussians-prior": {"path": "gaussians.ply"},
    "random-prior": {"num_points": 500},
}
# Their own test files build tiny weights and run the same contract.
TESTED_WITH_THEIR_WEIGHTS = {"shap-e-prior", "point-e-prior", "motion-prior"}
PRIORS = sorted(name for name in names() if name.endswith("-prior"))


def build(name, assets, **options):
    options = {**OPTIONS.get(name, {}), **options}
    if "path" in options:
        options["path"] = str(assets / options["path"])
    return find(name)(options)


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
    """A prior that gives what it was told."""

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

    def test_the_call_checks(self):
        prior = Given({})
        prior.cloud = self.cloud(bad=range(10))
        assert len(prior("").points) == 190  # exactly 5 %
        prior.cloud = self.cloud(bad=range(11))
        with pytest.raises(UserError, match="11 of the 200 points of Given"):
            prior("")

    def test_empty_and_misshapen_clouds_are_refused(self):
        with pytest.raises(UserError, match="no points"):
            validated(PointCloud(points=np.zeros((0, 3)), colors=np.zeros((0, 3))), "x")
        with pytest.raises(UserError, match=r"colours \(4, 3\)"):
            validated(PointCloud(points=np.zeros((5, 3)), colors=np.zeros((4, 3))), "x")


class TestMesh:
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

    def test_no_colours_are_said(self, assets, caplog):
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
    def test_upright_recentred_and_really_random(self, assets):
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
    def test_a_ball_is_filled_uniformly(self, assets):
        points = build("random-prior", assets, num_points=20_000, size=0.7)("").points
        radii = np.linalg.norm(points, axis=1) / 0.7
        assert radii.max() <= 1
        # Kolmogorov-Smirnov at 0.1 %: the volume within a radius grows with its cube.
        assert np.abs(np.sort(radii**3) - np.linspace(0, 1, 20_000)).max() < 1.95 / np.sqrt(20_000)

    def test_a_box(self, assets):
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


class TestGaussians:
    def test_centres_and_colours(self, assets):
        arrays = ply.read_gaussians(assets / "gaussians.ply")
        cloud = build("gaussians-prior", assets)("")
        np.testing.assert_array_equal(cloud.points, arrays.means)
        np.testing.assert_allclose(
            cloud.colors, (0.5 + 0.28209479 * arrays.sh[:, 0]).clip(0, 1), atol=1e-6
        )

    def test_all_attributes(self, assets):
        for a, b in zip(
            build("gaussians-prior", assets).gaussians(""),
            ply.read_gaussians(assets / "gaussians.ply"),
            strict=True,
        ):
            np.testing.assert_array_equal(a, b)
        with pytest.raises(UserError, match="ground"):
            build("gaussians-prior", assets, ground=True).gaussians("")

    def test_min_opacity(self, assets):
        arrays = ply.read_gaussians(assets / "gaussians.ply")
        kept = build("gaussians-prior", assets, min_opacity=0.5).gaussians("")
        np.testing.assert_array_equal(kept.means, arrays.means[arrays.logit_opacities >= 0])
        with pytest.raises(UserError, match="no Gaussians.*opacity of 1.0 or more, among 200"):
            build("gaussians-prior", assets, min_opacity=1.0)("")

    def test_few_bad_rows_are_dropped(self, assets, tmp_path, caplog):
        arrays = ply.read_gaussians(assets / "gaussians.ply")
        arrays.log_scales[3] = np.nan
        write_raw_gaussians(tmp_path / "a.ply", arrays)
        with caplog.at_level(logging.WARNING):
            assert len(find("gaussians-prior")({"path": str(tmp_path / "a.ply")})("").points) == 199
        assert "dropped 1 of 200" in caplog.text
        arrays.quats[:20] = np.inf
        write_raw_gaussians(tmp_path / "a.ply", arrays)
        with pytest.raises(UserError, match="20 of the 200"):
            find("gaussians-prior")({"path": str(tmp_path / "a.ply")})("")

    def test_plain_points_are_refused(self, assets):
        with pytest.raises(UserError, match="plain points"):
            build("gaussians-prior", assets, path="points.ply")("")


class TestPointCloud:
    POINTS = np.array([[0, 0, 0], [1, 2, 4], [2, 0, 1]], np.float32)
    BYTES = np.array([[255, 0, 51], [0, 0, 0], [0, 102, 255]])

    def read(self, path, **options):
        return find("point-cloud-prior")({"path": str(path), **options})("")

    def written(self, folder, name):
        """The three points in one of the supported formats."""
        path = folder / name
        rows = np.concatenate([self.POINTS, self.BYTES], axis=1)
        if path.suffix == ".npz":
            np.savez(path, points=self.POINTS, colors=self.BYTES.astype(np.uint8))
        elif path.suffix == ".npy":
            np.save(path, np.concatenate([self.POINTS, self.BYTES / 255], axis=1))
        elif path.suffix == ".csv":
            np.savetxt(path, rows, delimiter=", ", header="x,y,z,r,g,b", comments="")
        elif path.suffix == ".pts":
            np.savetxt(path, np.insert(rows, 3, 7.0, axis=1), header="3", comments="")
        elif path.suffix in (".xyz", ".txt"):
            np.savetxt(path, rows)
        else:
            trimesh.PointCloud(
                self.POINTS, colors=np.insert(self.BYTES, 3, 255, axis=1).astype(np.uint8)
            ).export(path)
        return path

    @pytest.mark.parametrize(
        "name", ["a.npz", "a.npy", "a.xyz", "a.txt", "a.csv", "a.pts", "a.ply"]
    )
    def test_formats(self, tmp_path, name):
        cloud = self.read(self.written(tmp_path, name))
        np.testing.assert_allclose(cloud.points, self.POINTS, atol=1e-6)
        np.testing.assert_allclose(cloud.colors, self.BYTES / 255, atol=1e-6)

    def test_formats_of_trimesh_have_y_up_and_z_to_the_front(self, tmp_path):
        cloud = self.read(self.written(tmp_path, "a.glb"))
        np.testing.assert_allclose(cloud.points, self.POINTS[:, [2, 0, 1]], atol=1e-6)
        np.testing.assert_allclose(cloud.colors, self.BYTES / 255, atol=1e-6)

    def test_the_vertices_of_a_mesh(self, assets):
        mesh = trimesh.load(assets / "box.ply", process=False)
        mesh.export(assets / "box.off")
        np.testing.assert_allclose(self.read(assets / "box.off").points, mesh.vertices, atol=1e-6)

    def test_normalize(self, tmp_path):
        cloud = self.read(self.written(tmp_path, "a.ply"), normalize=True, scale=0.5)
        np.testing.assert_allclose(cloud.points, (self.POINTS - [1, 1, 2]) / 4, atol=1e-6)

    def test_turned(self, tmp_path):
        cloud = self.read(self.written(tmp_path, "a.xyz"), up="+y", front="+z")
        np.testing.assert_allclose(cloud.points, self.POINTS[:, [2, 0, 1]], atol=1e-6)
        with pytest.raises(UserError, match="up axis"):
            self.read(tmp_path / "a.xyz", up="y")

    def test_gaussians_are_read_as_points(self, assets):
        np.testing.assert_array_equal(
            self.read(assets / "gaussians.ply").points,
            ply.read_gaussians(assets / "gaussians.ply").means,
        )

    def test_few_bad_rows_are_dropped_also_when_normalized(self, tmp_path):
        points = rng().uniform(-1, 1, (100, 3))
        points[7] = np.nan
        np.savez(tmp_path / "a.npz", points=points)
        cloud = self.read(tmp_path / "a.npz", normalize=True)
        assert len(cloud.points) == 99 and np.ptp(cloud.points, axis=0).max() == pytest.approx(2)
        assert (cloud.colors == 0.5).all()

    @pytest.mark.parametrize(
        "name, content, problem",
        [
            ("a.fox", b"x", "unknown point cloud format '.fox'"),
            ("a.xyz", b"1 2\n3 4\n", "rows of x y z"),
            ("a.xyz", b"1 2 3\n4 5 fox\n", "not readable"),
            ("a.npz", b"PK\3\4 broken", "can't be read"),
            ("a.npy", b"\x93NUMPY broken", "can't be read"),
            ("a.glb", b"glTF broken", "can't read the mesh"),
            ("a.ply", b"plyx", "not a PLY"),
        ],
    )
    def test_bad_files(self, tmp_path, name, content, problem):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(UserError) as error:
            self.read(tmp_path / name)
        assert problem in str(error.value)

    def test_bad_arrays(self, tmp_path):
        for arrays in (
            {"xyz": self.POINTS},
            {"points": self.POINTS[:, :2]},
            {"points": self.POINTS, "colors": self.BYTES[:2]},
        ):
            np.savez(tmp_path / "a.npz", **arrays)
            with pytest.raises(UserError, match="a.npz.*(has no array|has shape)"):
                self.read(tmp_path / "a.npz")
        np.savez(tmp_path / "a.npz", points=np.array([{}], object))  # would be unpickled
        with pytest.raises(UserError, match="could run code"):
            self.read(tmp_path / "a.npz")
