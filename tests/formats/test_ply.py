"""PLY files: exact round trips, files of other programs, and damaged files."""

import struct

import numpy as np
import pytest

from tests.helpers.ply_files import cloud, gaussians, header, rng, saved, write_raw_gaussians
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats import ply
from threestudio_gaussiandreamer.formats.ply import write_table
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians, usable


def assert_same(arrays, expected):
    for name in expected._fields:
        a, b = getattr(arrays, name), getattr(expected, name)
        assert a is b is None or (
            a.dtype == np.float32 and a.shape == b.shape and a.tobytes() == b.tobytes()
        ), name


class TestGaussians:
    @pytest.mark.parametrize("degree", [0, 1, 2, 3])
    @pytest.mark.parametrize("count", [0, 1, 50])
    def test_reading_back_gives_the_same_bits(self, tmp_path, degree, count):
        expected = gaussians(count, degree)
        ply.write_gaussians(tmp_path / "a.ply", expected)
        assert_same(ply.read_gaussians(tmp_path / "a.ply"), expected)

    def test_special_floats_survive(self, tmp_path):
        arrays = gaussians(4)
        arrays.means[0] = [-0.0, 1e-45, 3.4e38]
        arrays.logit_opacities[:2] = [np.inf, -np.inf]
        arrays.log_scales[0, 2] = -np.inf
        write_raw_gaussians(tmp_path / "a.ply", arrays)
        assert_same(ply.read_gaussians(tmp_path / "a.ply"), arrays)

    def test_nothing_that_is_not_finite_is_written(self, tmp_path, caplog):
        arrays = gaussians(9)
        arrays.means[0, 1], arrays.quats[1, 0], arrays.sh[2, 0, 0] = np.nan, np.inf, -np.inf
        arrays.logit_opacities[2:5] = [np.nan, np.inf, -np.inf]
        arrays.log_scales[5:8, 0] = [np.inf, -np.inf, 1e30]
        ply.write_gaussians(tmp_path / "a.ply", arrays)
        read = ply.read_gaussians(tmp_path / "a.ply")
        assert all(np.isfinite(values).all() for values in read) and len(read.means) == 5
        assert np.isfinite(np.exp(read.log_scales)).all()
        assert (np.sign(read.logit_opacities[:2]) == [1, -1]).all()
        assert caplog.text.count("a.ply: 4 of 9 Gaussians hold NaN or infinity: left out") == 1
        bad = cloud(3)._replace(points=np.full((3, 3), np.inf, np.float32))
        with pytest.raises(UserError, match="b.ply' isn't written.*NaN or infinity"):
            ply.write_points(tmp_path / "b.ply", bad)
        assert not (tmp_path / "b.ply").exists()

    def test_the_layout_is_the_one_of_the_viewers(self, tmp_path):
        arrays = gaussians(2, degree=1)
        ply.write_gaussians(tmp_path / "a.ply", arrays)
        head, data = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
        names = [
            line.split()[-1]
            for line in head.decode().splitlines()
            if line.startswith("property float ")
        ]
        rest = [f"f_rest_{i}" for i in range(9)]
        assert names == [
            *"xyz",
            "nx",
            "ny",
            "nz",
            "f_dc_0",
            "f_dc_1",
            "f_dc_2",
            *rest,
            "opacity",
            *ply.LOG_SCALES,
            *ply.QUATS,
        ]
        assert head.startswith(b"ply\nformat binary_little_endian 1.0\nelement vertex 2\n")
        row = np.array(struct.unpack(f"<{len(names)}f", data[: 4 * len(names)]), np.float32)
        np.testing.assert_array_equal(
            row[names.index("f_rest_0") :][:9], arrays.sh[0, 1:].T.ravel()
        )  # red's three, green's, blue's
        np.testing.assert_array_equal(row[-4:], arrays.quats[0])
        assert len(data) == 2 * 4 * len(names)

    def test_padding_to_degree_3_is_the_248_byte_vertex(self, tmp_path):
        arrays = gaussians(5)
        padded = arrays._replace(sh=ply.padded_sh(arrays.sh, 3))
        ply.write_gaussians(tmp_path / "a.ply", padded)
        data = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")[1]
        assert len(data) == 5 * 248  # what Unity's importer insists on
        read = ply.read_gaussians(tmp_path / "a.ply")
        np.testing.assert_array_equal(read.sh[:, :1], arrays.sh)
        assert read.sh.shape == (5, 16, 3) and not read.sh[:, 1:].any()
        assert ply.padded_sh(gaussians(2, degree=2).sh, 1).shape == (2, 9, 3)  # never cuts

    def test_shapes_that_disagree_are_refused(self, tmp_path):
        with pytest.raises((ValueError, TypeError), match="quats"):
            ply.write_gaussians(tmp_path / "a.ply", gaussians(3)._replace(quats=np.zeros((4, 4))))
        assert not list(tmp_path.iterdir())

    @pytest.mark.parametrize("order", ["<", ">"])
    def test_any_order_of_properties_and_bytes_and_extra_ones(self, tmp_path, order):
        expected = gaussians(7, degree=1)
        names = [*ply.GAUSSIAN, *(f"f_rest_{i}" for i in range(9)), "segment"]
        columns = dict(
            zip(ply.MEANS, expected.means.T, strict=True),
            opacity=expected.logit_opacities,
            segment=np.arange(7),
        )
        columns |= {f"f_dc_{i}": expected.sh[:, 0, i] for i in range(3)} | {
            f"scale_{i}": expected.log_scales[:, i] for i in range(3)
        }
        columns |= {f"rot_{i}": expected.quats[:, i] for i in range(4)}
        columns |= {f"f_rest_{i}": expected.sh[:, 1 + i % 3, i // 3] for i in range(9)}
        names = list(rng().permutation(names))
        rows = np.zeros(7, [(name, order + "f8") for name in names])
        for name in names:
            rows[name] = columns[name]
        encoding = "binary_little_endian" if order == "<" else "binary_big_endian"
        path = saved(
            tmp_path,
            header(encoding, 7, [f"double {name}" for name in names]).encode() + rows.tobytes(),
        )
        assert_same(ply.read_gaussians(path), expected)
        assert ply.is_gaussian_ply(path)

    def test_text(self, tmp_path):
        expected = gaussians(3)
        columns = [
            expected.means,
            expected.sh[:, 0],
            expected.logit_opacities[:, None],
            expected.log_scales,
            expected.quats,
        ]
        rows = np.concatenate(columns, axis=1)
        text = "\n".join(" ".join(repr(float(value)) for value in row) for row in rows)
        assert_same(
            ply.read_gaussians(
                saved(tmp_path, header("ascii", 3, [f"float {n}" for n in ply.GAUSSIAN]) + text)
            ),
            expected,
        )

    def test_what_is_not_known_is_named(self, tmp_path, caplog):
        ply.write_gaussians(tmp_path / "a.ply", gaussians())
        ply.read_gaussians(tmp_path / "a.ply")
        assert not caplog.text
        (tmp_path / "b.ply").write_bytes(
            (tmp_path / "a.ply").read_bytes().replace(b"property float nx", b"property float thing")
        )
        ply.read_gaussians(tmp_path / "b.ply")
        assert "b.ply: unknown properties are left out: thing" in caplog.text

    def test_what_is_missing_is_named(self, tmp_path):
        ply.write_points(tmp_path / "points.ply", cloud())
        with pytest.raises(UserError, match="lack f_dc_0.*plain points"):
            ply.read_gaussians(tmp_path / "points.ply")
        without = [f"float {name}" for name in ply.GAUSSIAN if name != "scale_1"]
        with pytest.raises(UserError, match="lack scale_1"):
            ply.read_gaussians(saved(tmp_path, header("ascii", 0, without)))

    @pytest.mark.parametrize("prefix", ["scalar_", "scalar_scal_"])
    def test_names_of_cloudcompare_are_known(self, tmp_path, prefix):
        """A cloud that was edited there, also one that 3dgsconverter prepared for it."""
        arrays = gaussians(5, 1)
        properties = ply.gaussian_properties(4)
        names = [(name if name[0] in "xyzn" else prefix + name, kind) for name, kind in properties]
        write_table(tmp_path / "a.ply", names, ply.gaussian_columns(arrays))
        assert ply.is_gaussian_ply(tmp_path / "a.ply")
        assert_same(ply.read_gaussians(tmp_path / "a.ply"), arrays)

    def test_2d_gaussians_are_flat(self, tmp_path, caplog):
        names = [f"float {name}" for name in ply.GAUSSIAN if name != "scale_2"]
        path = saved(tmp_path, header("ascii", 1, names) + "1 2 3 0 0 0 4 5 6 1 0 0 0")
        assert ply.is_gaussian_ply(path)
        np.testing.assert_allclose(ply.read_gaussians(path).log_scales, [[5, 6, np.log(1e-6)]])
        arrays = gaussians(5)
        arrays.log_scales[:, 2] = -np.inf
        write_raw_gaussians(tmp_path / "inf.ply", arrays)
        read = ply.read_gaussians(tmp_path / "inf.ply")
        np.testing.assert_allclose(read.log_scales[:, 2], np.log(1e-6))
        np.testing.assert_array_equal(read.log_scales[:, :2], arrays.log_scales[:, :2])
        assert "inf.ply: 2D Gaussians, without a third scale: read as flat ones" in caplog.text

    def test_the_3d_filter_is_applied(self, tmp_path):
        """Variances grow by the filter's; the integral of a Gaussian stays."""
        names = [f"float {name}" for name in (*ply.GAUSSIAN, "filter_3D")]
        row = f"0 0 0 0 0 0 0 {np.log(3)} {np.log(2)} {np.log(6)} 1 0 0 0 4"
        read = ply.read_gaussians(saved(tmp_path, header("ascii", 1, names) + row))
        sizes = np.sqrt([3**2 + 4**2, 2**2 + 4**2, 6**2 + 4**2])
        np.testing.assert_allclose(np.exp(read.log_scales), [sizes], rtol=1e-6)
        opacity = 0.5 * 3 * 2 * 6 / sizes.prod()
        np.testing.assert_allclose(1 / (1 + np.exp(-read.logit_opacities)), [opacity], rtol=1e-5)

    def test_bytes_stand_for_the_constant_harmonics(self, tmp_path):
        """As nerfstudio's exporter writes with --ply-color-mode rgb."""
        others = [f"float {name}" for name in ply.GAUSSIAN if not name.startswith("f_dc")]
        colors = [f"uchar {name}" for name in ply.COLORS]
        path = saved(
            tmp_path, header("ascii", 1, others + colors) + "0 0 0 1 2 3 4 1 0 0 0 255 0 51"
        )
        assert ply.is_gaussian_ply(path)
        read = ply.read_gaussians(path)
        np.testing.assert_allclose(0.5 + 0.28209479 * read.sh[0, 0], [1, 0, 0.2], atol=1e-6)
        np.testing.assert_array_equal(read.log_scales, [[2, 3, 4]])

    def test_rows_of_zeros_are_left_out(self, tmp_path, caplog):
        arrays = gaussians(6, degree=1)
        for values in arrays:
            values[[1, 4]] = 0
        arrays.means[2] = arrays.quats[3] = 0  # not all of the row
        write_raw_gaussians(tmp_path / "a.ply", arrays)
        assert_same(ply.read_gaussians(tmp_path / "a.ply"), arrays.rows([0, 2, 3, 5]))
        assert "a.ply: 2 of 6 rows hold nothing but zeros: left out" in caplog.text

    def test_a_compressed_ply_is_named_in_the_message(self, tmp_path):
        """PlayCanvas' layout: chunks of bounds, then four packed numbers per Gaussian."""
        bounds = "\n".join(
            f"property float {end}_{axis}" for end in ("min", "max") for axis in "xyz"
        )
        packed = [f"uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
        head = header("binary_little_endian", 1, packed, before=f"element chunk 1\n{bounds}")
        path = saved(tmp_path, head.encode() + bytes(6 * 4 + 4 * 4))
        for read in (ply.read_gaussians, ply.read_points):
            with pytest.raises(UserError, match="compressed PLY: convert it by") as said:
                read(path)
            assert "plain points" not in str(said.value)

    @pytest.mark.parametrize(
        "rest",
        [["f_rest_0"], [f"f_rest_{i}" for i in range(6)], ["f_rest_0", "f_rest_1", "f_rest_3"]],
    )
    def test_impossible_harmonics_are_refused(self, tmp_path, rest):
        path = saved(
            tmp_path, header("ascii", 0, [f"float {name}" for name in (*ply.GAUSSIAN, *rest)])
        )
        with pytest.raises(UserError, match="f_rest"):
            ply.read_gaussians(path)

    @pytest.mark.parametrize("field", Gaussians._fields)
    def test_rows_that_are_not_numbers_are_counted(self, tmp_path, field):
        arrays = gaussians(6)
        getattr(arrays, field)[[2, 4]] = np.nan
        write_raw_gaussians(tmp_path / "a.ply", arrays)
        with pytest.raises(UserError, match="a.ply.*2 of 6.*first in vertex 2"):
            ply.read_gaussians(tmp_path / "a.ply")
        read = ply.read_gaussians(tmp_path / "a.ply", allow_non_finite=True)
        np.testing.assert_array_equal(usable(read), [True, True, False, True, False, True])

    def test_is_gaussian_ply(self, tmp_path):
        ply.write_points(tmp_path / "points.ply", cloud())
        ply.write_gaussians(tmp_path / "gaussians.ply", gaussians())
        assert ply.is_gaussian_ply(tmp_path / "gaussians.ply")
        others = [tmp_path / "points.ply", tmp_path / "none.ply", tmp_path, saved(tmp_path, "x")]
        assert not any(ply.is_gaussian_ply(path) for path in others)


class TestPoints:
    @pytest.mark.parametrize("normals", [True, False])
    @pytest.mark.parametrize("count", [0, 1, 50])
    def test_reading_back_gives_the_same_bits(self, tmp_path, count, normals):
        expected = cloud(count, normals)
        ply.write_points(tmp_path / "a.ply", expected)
        assert_same(ply.read_points(tmp_path / "a.ply"), expected)

    def test_viewers_find_bytes(self, tmp_path):
        import trimesh

        expected = cloud(20)
        ply.write_points(tmp_path / "a.ply", expected)
        read = trimesh.load(tmp_path / "a.ply")
        np.testing.assert_array_equal(read.vertices, expected.points)
        np.testing.assert_array_equal(read.colors[:, :3], np.rint(expected.colors * 255))

    @pytest.mark.parametrize(
        "properties, values",
        [
            (["uchar red", "uchar green", "uchar blue"], "255 0 51"),
            (["ushort red", "ushort green", "ushort blue"], "65535 0 13107"),
            (["float red", "float green", "float blue"], "1.0 0 0.2"),
            (["float red", "float green", "float blue"], "255 0 51"),
            (["uchar diffuse_red", "uchar diffuse_green", "uchar diffuse_blue"], "255 0 51"),
        ],
    )
    def test_colours_of_other_programs(self, tmp_path, properties, values):
        text = (
            header("ascii", 1, ["float x", "float y", "float z", *properties]) + f"1 2 3 {values}\n"
        )
        read = ply.read_points(saved(tmp_path, text))
        np.testing.assert_allclose(read.colors, [[1.0, 0.0, 0.2]], atol=1e-6)
        np.testing.assert_array_equal(read.points, [[1, 2, 3]])

    def test_no_colours_are_grey(self, tmp_path):
        np.testing.assert_array_equal(
            ply.read_points(saved(tmp_path, header() + "1 2 3\n4 5 6\n")).colors,
            np.full((2, 3), 0.5),
        )

    def test_line_ends_blank_lines_and_comments(self, tmp_path):
        text = (
            header().replace("ascii 1.0", "ascii 1.0\ncomment end_header is below\nobj_info x")
            + "1 2 3\n\n4 5 6"
        )
        assert ply.read_points(saved(tmp_path, text.replace("\n", "\r\n"))).points.shape == (2, 3)
        binary = (
            header("binary_little_endian").replace("\n", "\r\n").encode()
            + np.arange(6, dtype="<f4").tobytes()
        )
        np.testing.assert_array_equal(
            ply.read_points(saved(tmp_path, binary)).points, [[0, 1, 2], [3, 4, 5]]
        )

    @pytest.mark.parametrize(
        "encoding, order",
        [("ascii", ""), ("binary_little_endian", "<"), ("binary_big_endian", ">")],
    )
    def test_elements_before_and_after_are_skipped(self, tmp_path, encoding, order):
        before = (
            "element face 2\nproperty list uchar int vertex_indices\nproperty float "
            "area\nelement edge 1\nproperty int a"
        )
        after = (
            "element empty 1000000000000\nelement face 1\nproperty list uchar int vertex_indices"
        )
        head = header(encoding, 2, before=before, after=after)
        if encoding == "ascii":
            content = head + "3 0 1 2 0.5\n4 0 1 2 3 0.5\n7\n1 2 3\n4 5 6\n3 0 1 2\n"
        else:
            faces = struct.pack(f"{order}B3if", 3, 0, 1, 2, 0.5) + struct.pack(
                f"{order}B4if", 4, 0, 1, 2, 3, 0.5
            )
            content = (
                head.encode()
                + faces
                + struct.pack(f"{order}i", 7)
                + struct.pack(f"{order}6f", 1, 2, 3, 4, 5, 6)
                + b"\3"
            )
        np.testing.assert_array_equal(
            ply.read_points(saved(tmp_path, content)).points, [[1, 2, 3], [4, 5, 6]]
        )

    def test_gaussians_are_read_as_their_coloured_centres(self, tmp_path):
        arrays = gaussians(30)
        ply.write_gaussians(tmp_path / "a.ply", arrays)
        read = ply.read_points(tmp_path / "a.ply")
        np.testing.assert_array_equal(read.points, arrays.means)
        np.testing.assert_allclose(
            read.colors, (0.5 + 0.28209479 * arrays.sh[:, 0]).clip(0, 1), atol=1e-6
        )

    def test_not_finite_is_refused_or_left_to_the_caller(self, tmp_path):
        path = saved(tmp_path, header() + "1 2 3\n4 nan 6\n")
        with pytest.raises(UserError, match="positions of 1 of 2"):
            ply.read_points(path)
        assert np.isnan(ply.read_points(path, allow_non_finite=True).points[1, 1])
