"""Damaged PLY files, and headers that announce missing data."""

import os
import struct
import time

import pytest

from tests.helpers.ply_files import cloud, gaussians, header, rng, saved
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats import ply


class TestDamage:
    @pytest.mark.parametrize(
        ("kind", "length"),
        [("char", struct.pack("<b", -1)), ("float", struct.pack("<f", float("nan")))]
        + [("double", struct.pack("<d", float("inf"))), ("uint", struct.pack("<I", 2**32 - 1))],
    )
    def test_invalid_lengths_of_lists(self, tmp_path, kind, length):
        before = f"element face 1\nproperty list {kind} int vertex_indices"
        head = header("binary_little_endian", 2, before=before)
        with pytest.raises(UserError, match="a list in 'face' is longer than the file"):
            ply.read_points(saved(tmp_path, head.encode() + length + bytes(40)))

    def test_many_lists_before_the_vertices_are_skipped_fast(self, tmp_path):
        before = "element face 1000000\nproperty list uchar int vertex_indices"
        head = header("binary_little_endian", 2, before=before)
        path = saved(tmp_path, head.encode() + bytes(1_000_000) + bytes(range(24)))
        started = time.process_time()
        assert len(ply.read_points(path).points) == 2
        assert time.process_time() - started < 1.5

    @pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
    def test_more_than_was_announced_is_reported(self, tmp_path, encoding, caplog):
        data = b"1 2 3\n4 5 6\n7 8 9\n" if encoding == "ascii" else bytes(range(36))
        assert (
            len(ply.read_points(saved(tmp_path, header(encoding, 2).encode() + data)).points) == 2
        )
        assert (
            "6 bytes follow the 2 vertices" in caplog.text
            if encoding == "ascii"
            else "12 bytes follow" in caplog.text
        )
        caplog.clear()
        ply.read_points(saved(tmp_path, header(encoding, 3).encode() + data + b"\n\n"))
        assert not [record for record in caplog.records if "follow" in record.message]

    @pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
    @pytest.mark.parametrize("count", [3, 10**12, 10**18])
    def test_a_wrong_count_allocates_nothing(self, tmp_path, encoding, count):
        import tracemalloc

        data = b"1 2 3\n4 5 6\n" if encoding == "ascii" else bytes(24)
        path = saved(tmp_path, header(encoding, count).encode() + data)
        tracemalloc.start()
        with pytest.raises(UserError, match="file.ply.*(truncated|announced)"):
            ply.read_points(path)
        assert tracemalloc.get_traced_memory()[1] < 4 << 20  # the header's limit, and change
        tracemalloc.stop()

    @pytest.mark.parametrize(
        "content, problem",
        [
            ("", "not a PLY"),
            ("solid cube", "not a PLY"),
            ("ply\n", "no end"),
            ("ply\n" + "comment x\n" * 200_000, "no end"),
            ("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\n", "no end"),
            (header("binary_middle_endian"), "binary_middle_endian"),
            (header().replace("format ascii 1.0\n", ""), "format None"),
            (header().replace("format ascii 1.0\n", "format ascii 1.0\n" * 2), "two formats"),
            (
                header(count=1, before="element vertex 1\nproperty float x"),
                "two elements of vertices",
            ),
            (
                header(count=1, properties=["float x", "float y", "uchar z"]) + "1 2 256\n",
                "range of its type",
            ),
            (
                header(count=1, before="element face 1\nproperty list uchar int i")
                + "3 0 1\n2 1 2 3\n",
                "a line of 'face'",
            ),
            (header(count=-1), "NAME COUNT"),
            (header(count="many"), "NAME COUNT"),
            (header(count="1" * 30), "NAME COUNT"),
            (header(count=0).replace("vertex", "point"), "no vertices"),
            (header(properties=["float x", "quad y"]), "number type"),
            (header(properties=["float x", "float x"]), "same name"),
            (header(properties=["list uchar int x"]), "list"),
            (header(properties=["float x", "float y"]) + "1 2\n3 4\n", "lack z"),
            (header(properties=[]), "lack x, y, z"),
            ("ply\nformat ascii 1.0\nproperty float x\nend_header\n", "property of an element"),
            (header().replace("element", "elephant"), "unknown line"),
            (header() + "1 2 3\n4.5 5\n", "not readable"),
            (header() + "1 2 3\n4 5 fox\n", "not readable"),
            (header() + "1 2 3 4\n1 2 3 4\n", "3 numbers are announced"),
            (header() + "1 2 3\n" + " " * 99, "2 vertices of 3 numbers"),
            (header("binary_little_endian") + "x" * 23, "need 24 bytes, but 23"),
            (
                header("binary_little_endian", before="element face 9\nproperty list uint int i")
                + "\xff" * 24,
                "truncated or damaged",
            ),
            (
                header(
                    "binary_little_endian",
                    before=f"element edge {10**18}\nproperty double a\nproperty double b",
                )
                + "x" * 24,
                "truncated",
            ),
            (
                header(
                    "binary_little_endian", before="element face 99999999\nproperty list uint int i"
                )
                + "\0" * 24,
                "truncated",
            ),
        ],
    )
    def test_each_kind_is_named(self, tmp_path, content, problem):
        with pytest.raises(UserError, match="file.ply") as error:
            ply.read_points(saved(tmp_path, content))
        assert problem in str(error.value)

    def test_a_missing_file_names_its_neighbours(self, tmp_path):
        saved(tmp_path, "ply", "hamburger.ply")
        with pytest.raises(UserError, match="hambuger.ply' does not exist.*hamburger.ply"):
            ply.read_gaussians(tmp_path / "hambuger.ply")
        with pytest.raises(UserError, match="no folder"):
            ply.read_points(tmp_path / "no" / "file.ply")
        with pytest.raises(UserError, match="is a folder"):
            ply.read_points(tmp_path)
        for name in ("a\0b", "a" * 5000):
            with pytest.raises(UserError, match="PLY file"):
                ply.read_points(name)

    def test_mutations_are_an_error_or_a_correct_load(self, tmp_path):
        """Five hundred damaged files: what is loaded has consistent shapes, and the only exception
        is UserError.
        """
        ply.write_gaussians(tmp_path / "gaussians.ply", gaussians(20, 1))
        ply.write_points(tmp_path / "points.ply", cloud(20))
        faces = "element face 2\nproperty list uchar int vertex_indices"
        saved(tmp_path, header(before=faces) + "3 0 1 2\n3 0 1 2\n1 2 3\n4 5 6\n", "text.ply")
        originals = [path.read_bytes() for path in sorted(tmp_path.glob("*.ply"))]
        generator, loaded = rng(1), 0
        for _ in range(500):
            path = saved(tmp_path, mutated(originals[generator.integers(3)], generator))
            for read in (ply.read_gaussians, ply.read_points):
                try:
                    arrays = read(path)
                except UserError as error:
                    assert "file.ply" in str(error)
                else:
                    loaded += 1
                    assert len({len(values) for values in arrays if values is not None}) == 1
                    assert (
                        sum(values.size for values in arrays if values is not None)
                        <= 4 * path.stat().st_size
                    )
        assert loaded > 50  # the mutations aren't all fatal, so both outcomes were tried


def mutated(content, generator):
    """Return a copy with bytes changed, removed, repeated or appended, preferably in the header."""
    content = bytearray(content)
    for _ in range(generator.integers(1, 4)):
        reach = len(content) if generator.random() < 0.5 else min(len(content), 400)
        start = int(generator.integers(0, max(reach, 1)))
        length = int(generator.integers(1, 30))
        kind = generator.integers(5)
        if kind == 0:
            content[start : start + length] = generator.bytes(length)
        elif kind == 1:
            del content[start : start + length]
        elif kind == 2:
            del content[start:]
        elif kind == 3:
            content[start:start] = content[start : start + length]
        elif content:
            content[start % len(content)] ^= 1 << int(generator.integers(8))
    return bytes(content)


class TestAtomicWriting:
    def test_a_failure_leaves_the_earlier_file_and_no_other(self, tmp_path, monkeypatch):
        ply.write_points(tmp_path / "a.ply", cloud(10))
        before = (tmp_path / "a.ply").read_bytes()

        def disk_full(descriptor):
            raise OSError(28, "No space left on device")

        monkeypatch.setattr(os, "fsync", disk_full)
        with pytest.raises(UserError, match="cannot write.*a.ply.*No space left"):
            ply.write_points(tmp_path / "a.ply", cloud(20))
        assert (tmp_path / "a.ply").read_bytes() == before
        assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]

    def test_a_missing_folder_is_named(self, tmp_path):
        with pytest.raises(UserError, match="cannot write.*no/a.ply"):
            ply.write_points(tmp_path / "no" / "a.ply", cloud())

    def test_the_mode_is_that_of_an_ordinary_file(self, tmp_path):
        (tmp_path / "ordinary").write_text("")
        ply.write_points(tmp_path / "a.ply", cloud())
        assert (tmp_path / "a.ply").stat().st_mode == (tmp_path / "ordinary").stat().st_mode
