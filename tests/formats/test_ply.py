"""PLY files: exact round trips, files of other programs, and damaged files."""

import struct
import time

import numpy as np
import pytest

from tests.helpers.memory import memory_below
from tests.helpers.ply_files import (
    cloud,
    gaussians,
    header,
    ply_bytes,
    rng,
    saved,
    write_raw_gaussians,
)
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats import compressed_ply, ply


def assert_same(arrays, expected):
    for a, b in zip(arrays, expected, strict=True):
        assert a is b is None or (a.dtype, a.shape) == (np.float32, b.shape)
        assert a is None or a.tobytes() == b.tobytes()


def text(folder, names, *rows):
    """A text of vertices with these properties, floats where they have no type."""
    properties = [name if " " in name else f"float {name}" for name in names]
    return saved(folder, header("ascii", len(rows), properties) + "\n".join(rows))


class TestGaussians:
    @pytest.mark.parametrize("degree", [0, 1, 2, 3])
    def test_reading_back_gives_the_same_bits(self, tmp_path, degree):
        for count in (0, 50):
            expected = gaussians(count, degree)
            ply.write_gaussians(tmp_path / "a.ply", expected)
            assert_same(ply.read_gaussians(tmp_path / "a.ply"), expected)
            points = ply.read_points(tmp_path / "a.ply")  # as their coloured centres
            np.testing.assert_array_equal(points.points, expected.means)
            colors = (0.5 + 0.28209479 * expected.sh[:, 0]).clip(0, 1)
            np.testing.assert_allclose(points.colors, colors, atol=1e-6)
        arrays = gaussians(4)
        arrays.means[0] = [-0.0, 1e-45, 3.4e38]
        arrays.logit_opacities[:2] = [np.inf, -np.inf]
        arrays.log_scales[0, 2], arrays.sh[3] = -np.inf, np.nan
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
        refused("b.ply' isn't written.*NaN or infinity", ply.write_points, tmp_path / "b.ply", bad)
        assert not (tmp_path / "b.ply").exists()

    def test_doubles_in_any_order_and_extra_ones(self, tmp_path):
        expected = gaussians(7, degree=1)
        names = [name for name, _ in ply.gaussian_properties(4)]
        columns = dict(zip(names, ply.gaussian_columns(expected).T, strict=True))
        columns |= {f"f_rest_{i}": expected.sh[:, 1 + i % 3, i // 3] for i in range(9)}
        columns["segment"] = np.arange(7)
        columns = {name: ("double", columns[name]) for name in rng().permutation([*columns])}
        path = saved(tmp_path, ply_bytes(columns, "binary_big_endian"))
        assert_same(ply.read_gaussians(path), expected)
        assert ply.is_gaussian_ply(path)

    def test_what_is_not_known_or_missing_is_named(self, tmp_path, caplog):
        ply.write_gaussians(tmp_path / "a.ply", gaussians())
        ply.read_gaussians(tmp_path / "a.ply")
        assert not caplog.text
        data = (tmp_path / "a.ply").read_bytes().replace(b"float nx", b"float thing")
        ply.read_gaussians(saved(tmp_path, data, "b.ply"))
        assert "b.ply: unknown properties are left out: thing" in caplog.text
        ply.write_points(tmp_path / "points.ply", cloud())
        refused("lack f_dc_0.*plain points", ply.read_gaussians, tmp_path / "points.ply")
        with pytest.raises(UserError, match="lack scale_1"):
            ply.read_gaussians(text(tmp_path, [x for x in ply.GAUSSIAN if x != "scale_1"]))

    def test_cloudcompares_names_the_3d_filter_and_colours_as_bytes_are_known(self, tmp_path):
        """A cloud that was edited there, also one that 3dgsconverter prepared for it."""
        arrays, properties = gaussians(5, 1), ply.gaussian_properties(4)
        for prefix in ("scalar_", "scalar_scal_"):
            names = [(name if name[0] in "xyzn" else prefix + name, x) for name, x in properties]
            ply.write_table(tmp_path / "a.ply", names, ply.gaussian_columns(arrays))
            assert ply.is_gaussian_ply(tmp_path / "a.ply")
            assert_same(ply.read_gaussians(tmp_path / "a.ply"), arrays)
        row = f"0 0 0 0 0 0 0 {np.log(3)} {np.log(2)} {np.log(6)} 1 0 0 0 4"
        read = ply.read_gaussians(text(tmp_path, [*ply.GAUSSIAN, "filter_3D"], row))
        sizes = np.sqrt([3**2 + 4**2, 2**2 + 4**2, 6**2 + 4**2])
        np.testing.assert_allclose(np.exp(read.log_scales), [sizes], rtol=1e-6)
        opacity = 0.5 * 3 * 2 * 6 / sizes.prod()
        np.testing.assert_allclose(1 / (1 + np.exp(-read.logit_opacities)), [opacity], rtol=1e-5)
        names = [name for name in ply.GAUSSIAN if not name.startswith("f_dc")]
        names += [f"uchar {name}" for name in ply.COLORS]
        path = text(tmp_path, names, "0 0 0 1 2 3 4 1 0 0 0 255 0 51")
        assert ply.is_gaussian_ply(path)
        read = ply.read_gaussians(path)
        np.testing.assert_allclose(0.5 + 0.28209479 * read.sh[0, 0], [1, 0, 0.2], atol=1e-6)
        np.testing.assert_array_equal(read.log_scales, [[2, 3, 4]])

    def test_2d_gaussians_are_flat_and_rows_of_zeros_are_left_out(self, tmp_path, caplog):
        names = [name for name in ply.GAUSSIAN if name != "scale_2"]
        path = text(tmp_path, names, "1 2 3 0 0 0 4 5 6 1 0 0 0")
        assert ply.is_gaussian_ply(path)
        np.testing.assert_allclose(ply.read_gaussians(path).log_scales, [[5, 6, np.log(1e-6)]])
        arrays = gaussians(5)
        arrays.log_scales[:, 2] = -np.inf
        write_raw_gaussians(tmp_path / "inf.ply", arrays)
        read = ply.read_gaussians(tmp_path / "inf.ply")
        np.testing.assert_allclose(read.log_scales[:, 2], np.log(1e-6))
        np.testing.assert_array_equal(read.log_scales[:, :2], arrays.log_scales[:, :2])
        assert "inf.ply: 2D Gaussians, without a third scale: read as flat ones" in caplog.text
        arrays = gaussians(6, degree=1)
        for values in arrays:
            values[[1, 4]] = 0
        arrays.means[2] = arrays.quats[3] = 0  # not all of the row
        write_raw_gaussians(tmp_path / "a.ply", arrays)
        assert_same(ply.read_gaussians(tmp_path / "a.ply"), arrays.rows([0, 2, 3, 5]))
        assert "a.ply: 2 of 6 rows hold nothing but zeros: left out" in caplog.text

    def test_a_compressed_ply_is_named_in_the_message(self, tmp_path):
        compressed_ply.write_compressed_ply(tmp_path / "a.ply", gaussians(3))
        for read in (ply.read_gaussians, ply.read_points):
            with pytest.raises(UserError, match="compressed PLY: convert it by") as said:
                read(tmp_path / "a.ply")
            assert "plain points" not in str(said.value)

    @pytest.mark.parametrize("rest", [[0], range(6), [0, 1, 3]])
    def test_impossible_harmonics_are_refused(self, tmp_path, rest):
        with pytest.raises(UserError, match="f_rest"):
            ply.read_gaussians(text(tmp_path, [*ply.GAUSSIAN, *(f"f_rest_{i}" for i in rest)]))


class TestPoints:
    @pytest.mark.parametrize("normals", [True, False])
    def test_reading_back_gives_the_same_bits(self, tmp_path, normals):
        for count in (0, 1, 50):
            expected = cloud(count, normals)
            ply.write_points(tmp_path / "a.ply", expected)
            assert_same(ply.read_points(tmp_path / "a.ply"), expected)
        assert not ply.is_gaussian_ply(tmp_path / "a.ply")
        import trimesh

        read = trimesh.load(tmp_path / "a.ply")  # which finds the bytes
        np.testing.assert_array_equal(read.vertices, expected.points)
        np.testing.assert_array_equal(read.colors[:, :3], np.rint(expected.colors * 255))

    @pytest.mark.parametrize(
        "properties, values",
        [
            (["uchar red", "uchar green", "uchar blue"], "255 0 51"),
            (["ushort red", "ushort green", "ushort blue"], "65535 0 13107"),
            (ply.COLORS, "1.0 0 0.2"),
            (ply.COLORS, "255 0 51"),
            (["uchar diffuse_red", "uchar diffuse_green", "uchar diffuse_blue"], "255 0 51"),
        ],
    )
    def test_colours_of_other_programs(self, tmp_path, properties, values):
        read = ply.read_points(text(tmp_path, [*ply.MEANS, *properties], f"1 2 3 {values}\n"))
        np.testing.assert_allclose(read.colors, [[1.0, 0.0, 0.2]], atol=1e-6)
        np.testing.assert_array_equal(read.points, [[1, 2, 3]])

    def test_line_ends_blank_lines_and_comments(self, tmp_path):
        more = "ascii 1.0\ncomment end_header is below\nobj_info x"
        content = header().replace("ascii 1.0", more) + "1 2 3\n\n4 5 6"
        read = ply.read_points(saved(tmp_path, content.replace("\n", "\r\n")))
        assert read.points.shape == (2, 3)
        np.testing.assert_array_equal(read.colors, np.full((2, 3), 0.5))  # no colours are grey
        binary = header("binary_little_endian").replace("\n", "\r\n").encode()
        path = saved(tmp_path, binary + np.arange(6, dtype="<f4").tobytes())
        np.testing.assert_array_equal(ply.read_points(path).points, [[0, 1, 2], [3, 4, 5]])

    @pytest.mark.parametrize("encoding, order", ply.BYTE_ORDERS.items())
    def test_elements_before_and_after_are_skipped(self, tmp_path, encoding, order):
        faces = "property list uchar int vertex_indices"
        before = f"element face 2\n{faces}\nproperty float area\nelement edge 1\nproperty int a"
        after = f"element empty 1000000000000\nelement face 1\n{faces}"
        head = header(encoding, 2, before=before, after=after).encode()
        if encoding == "ascii":
            content = b"3 0 1 2 0.5\n4 0 1 2 3 0.5\n7\n1 2 3\n4 5 6\n3 0 1 2\n"
        else:
            rows = [("B3if", 3, 0, 1, 2, 0.5), ("B4if", 4, 0, 1, 2, 3, 0.5), ("i", 7)]
            rows += [("6f", 1, 2, 3, 4, 5, 6)]
            content = b"".join(struct.pack(order + kind, *row) for kind, *row in rows) + b"\3"
        found = ply.read_points(saved(tmp_path, head + content)).points
        np.testing.assert_array_equal(found, [[1, 2, 3], [4, 5, 6]])


BINARY, FACE = "binary_little_endian", "element face 1\nproperty list uchar int i"


class TestDamage:
    @pytest.mark.parametrize(
        ("kind", "length"),
        [("char", -1), ("float", np.nan), ("double", np.inf), ("uint", 2**32 - 1)],
    )
    def test_invalid_lengths_of_lists(self, tmp_path, kind, length):
        head = header(BINARY, before=f"element face 1\nproperty list {kind} int vertex_indices")
        content = np.array(length, "<" + ply.NUMBER_TYPES[kind]).tobytes() + bytes(40)
        with pytest.raises(UserError, match="file.ply.*(list|integer)"):
            ply.read_points(saved(tmp_path, head.encode() + content))

    def test_many_lists_before_the_vertices_are_skipped_fast(self, tmp_path):
        before = "element face 1000000\nproperty list uchar int vertex_indices"
        head = header("binary_little_endian", 2, before=before)
        path = saved(tmp_path, head.encode() + bytes(1_000_000) + bytes(range(24)))
        started = time.process_time()
        assert len(ply.read_points(path).points) == 2
        assert time.process_time() - started < 1.5
        head = header(before=before.replace("1000000", "20000")).encode()
        path = saved(tmp_path, head + b"3 10000 10001 10002\n" * 20_000 + b"1 2 3\n4 5 6\n")
        with memory_below(6 * path.stat().st_size):
            assert len(ply.read_points(path).points) == 2

    @pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
    def test_more_than_was_announced_is_reported(self, tmp_path, encoding, caplog):
        data = b"1 2 3\n4 5 6\n7 8 9\n" if encoding == "ascii" else bytes(range(36))
        path = saved(tmp_path, header(encoding, 2).encode() + data)
        assert len(ply.read_points(path).points) == 2
        assert "more data follows than the 2 rows of 'vertex'" in caplog.text
        caplog.clear()
        ply.read_points(saved(tmp_path, header(encoding, 3).encode() + data + b"\n\n"))
        assert not [record for record in caplog.records if "follows" in record.message]

    @pytest.mark.parametrize(
        "content, problem",
        [
            ("", "not a PLY"),
            ("ply\n", "no end"),
            ("ply\n" + "comment x\n" * 200_000, "no end"),
            ("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\n", "no end"),
            (header("binary_middle_endian"), "binary_middle_endian"),
            (header().replace("format ascii 1.0\n", ""), "format None"),
            (header().replace("format ascii 1.0\n", "format ascii 1.0\n" * 2), "unknown line"),
            (header(count=1, before="element vertex 1\nproperty float x"), "are vertex, vertex"),
            (header(count=1, before=FACE) + "3 0 1\n1 2 3\n", "it is truncated"),
            (header(count=-1), "unknown line"),
            (header(count=0).replace("vertex", "point"), "its elements are point"),
            (header(properties=["float x", "quad y"]), "number type"),
            (header(properties=["float x", "float x"]), "same name"),
            (header(properties=["list uchar int x"]), "list"),
            (header(properties=["float x", "float y"]) + "1 2\n3 4\n", "lack z"),
            (header(properties=[]), "lack x, y, z"),
            ("ply\nformat ascii 1.0\nproperty float x\nend_header\n", "unknown line"),
            (header() + "1 2 3\n4.5 5\n", "other than the 3 numbers"),
            (header() + "1 2 3\n4 5 fox\n", "truncated, damaged"),
            (header() + "1 2 3 4\n1 2 3 4\n", "other than the 3 numbers that are announced"),
            (header() + "1 2 3\n1 2 3 4\n", "other than the 3 numbers"),
            (header(count=1) + "1 2 1_0\n", "other words than numbers"),
            (header(count=1, properties=["float x", "uchar z"]) + "2 256\n", "range of its type"),
            (header() + "1 2 3\n" + " " * 99, "ends before the 2 rows of 'vertex'"),
            (header(BINARY) + "x" * 23, "ends before the 2 rows"),
            (header(BINARY, before=f"element a {10**18}\nproperty int a") + "x" * 24, "truncated"),
            (header(BINARY, before=FACE.replace("1", "99999999")) + "\0" * 24, "truncated"),
        ],
    )
    def test_each_kind_is_named(self, tmp_path, content, problem):
        with pytest.raises(UserError, match="file.ply") as error:
            ply.read_points(saved(tmp_path, content))
        assert problem in str(error.value)

    def test_what_is_no_file_is_named(self, tmp_path):
        for name in (tmp_path, tmp_path / "no" / "file.ply", "a\0b", "a" * 5000):
            refused("PLY file", ply.read_points, name)
