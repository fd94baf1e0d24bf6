"""The point-cloud and Gaussians priors."""

import importlib
import logging
import pkgutil

import numpy as np
import pytest
import trimesh

from tests.helpers.ply_files import write_raw_gaussians
from tests.priors.priors_cases import build, rng
from threestudio_gaussiandreamer import priors
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats import ply
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.priors.base import preflight_prior

for module in pkgutil.iter_modules(priors.__path__):
    importlib.import_module(f"{priors.__name__}.{module.name}")


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
        prior = build("gaussians-prior", assets, ground=True)
        preflight_prior(prior, keep_attributes=False)
        for call in (prior.gaussians, lambda _: preflight_prior(prior, keep_attributes=True)):
            with pytest.raises(UserError, match="ground"):
                call("")

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
            build("gaussians-prior", assets, path="points.ply").preflight()

    @pytest.mark.parametrize(
        "name, problem",
        [
            ("tri.obj", r"tri.obj': .obj isn't one of the formats that are read: .ply.*\.splat$"),
            ("ok.npz", r"ok.npz': .npz isn't one of the formats"),
            ("cloud", "cloud': a name without extension isn't one of the formats"),
            ("last.ckpt", r".ckpt isn't.*; it is a checkpoint: export it first.*last.ckpt"),
        ],
    )
    def test_the_wrong_kind_of_file_is_named(self, tmp_path, name, problem):
        (tmp_path / name).write_bytes(b"v 0 0 0")
        with pytest.raises(UserError, match=problem):
            find("gaussians-prior")({"path": str(tmp_path / name)}).preflight()

    def test_a_ply_may_have_any_name(self, assets, tmp_path):
        (tmp_path / "cloud").write_bytes((assets / "gaussians.ply").read_bytes())
        assert len(find("gaussians-prior")({"path": str(tmp_path / "cloud")})("").points) == 200


class TestPointCloud:
    POINTS = np.array([[0, 0, 0], [1, 2, 4], [2, 0, 1]], np.float32)
    BYTES = np.array([[255, 0, 51], [0, 0, 0], [0, 102, 255]])

    def read(self, path, **options):
        return find("point-cloud-prior")({"path": str(path), **options})("")

    def written(self, folder, name):
        """Write the three points in one of the supported formats."""
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

    @pytest.mark.parametrize("name", ["a.npz", "a.xyz", "a.ply"])
    @pytest.mark.parametrize("full", [255, 65535])
    def test_integers_of_8_and_16_bits(self, tmp_path, name, full):
        colors = self.BYTES * (full // 255)
        np.testing.assert_allclose(
            self.read(self.colored(tmp_path / name, colors)).colors, self.BYTES / 255, atol=1e-6
        )

    @pytest.mark.parametrize("name", ["a.npz", "a.xyz", "a.ply"])
    @pytest.mark.parametrize(
        "low, high", [(0, 70000), (0, 300.5), (-100, 100), (-0.5, 1), (-3000, 3000)]
    )
    def test_colours_out_of_range_are_refused(self, tmp_path, name, low, high):
        colors = np.array([[low, 0, 0], [0, high, 0], [0, 0, 1]], float)
        with pytest.raises(UserError, match=rf"{name}.* from {low:g} to {high:g}; integers"):
            self.read(self.colored(tmp_path / name, colors))

    def test_colours_a_little_out_of_range_are_clipped(self, tmp_path):
        colors = np.array([[-0.005, 0.5, 1.9], [0, 0, 0], [1, 1, 1]])
        found = self.read(self.colored(tmp_path / "a.npz", colors)).colors
        np.testing.assert_allclose(found, colors.clip(0, 1), atol=1e-6)

    def colored(self, path, colors):
        """Write the three points in given colours, as float32 where the format has types."""
        rows = np.concatenate([self.POINTS, colors], axis=1)
        if path.suffix == ".npz":
            np.savez(path, points=self.POINTS, colors=colors)
        elif path.suffix == ".xyz":
            np.savetxt(path, rows)
        else:
            properties = [(name, "float") for name in (*ply.MEANS, *ply.COLORS)]
            ply.write_table(path, properties, rows.astype(np.float32))
        return path

    def test_normalize(self, tmp_path):
        cloud = self.read(self.written(tmp_path, "a.ply"), normalize=True, scale=0.5)
        np.testing.assert_allclose(cloud.points, (self.POINTS - [1, 1, 2]) / 4, atol=1e-6)

    def test_rotated_axes(self, tmp_path):
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
            ("a.glb", b"glTF broken", "can't read "),
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
