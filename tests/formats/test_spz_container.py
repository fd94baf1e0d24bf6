"""SPZ of version 4: laid out as published, and no damage does harm."""

import gzip
import struct
import sys
import tracemalloc

import numpy as np
import pytest

from tests.formats.test_spz import (
    ALPHAS,
    COLORS,
    HARMONICS,
    POSITIONS,
    ROTATIONS,
    SCALES,
    cloud,
    stored,
)
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats import spz as spz_container
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud
from threestudio_gaussiandreamer.formats.spz import load_spz, read_spz, spz_bytes, write_spz

zstandard = pytest.importorskip("zstandard", reason="zstandard isn't installed")
BLOCKS = [POSITIONS, ALPHAS, COLORS, SCALES, ROTATIONS, HARMONICS]


def by_hand(blocks=BLOCKS, *, count=2, flags=0, degree=1, extension=b"", streams=6, sizes=None):
    """A file put together from the published description."""
    packed = [zstandard.compress(block) for block in blocks]
    sizes = sizes or [len(block) for block in blocks]
    table = b"".join(struct.pack("<QQ", len(a), b) for a, b in zip(packed, sizes, strict=True))
    head = b"NGSP" + struct.pack("<IIBBBB", 4, count, degree, 8, flags, streams)
    return b"".join([head, struct.pack("<I12x", 32 + len(extension)), extension, table, *packed])


def test_a_file_put_together_by_hand_is_read(tmp_path):
    read, antialiased = load_spz(stored(tmp_path, by_hand()))
    np.testing.assert_array_equal(read.means, [[1.0, -0.5, 513 / 256], [0, 0, 0]])
    np.testing.assert_array_equal(read.log_scales, [[-4, 0, -10], [-2, -3, 255 / 16 - 10]])
    np.testing.assert_array_equal(read.sh[0, 1:], [[0, 0.0625, -0.5], [0, 0, 0], [0.5, 0.5, 0.5]])
    assert not antialiased


@pytest.mark.parametrize("version", [3, 4])
def test_the_antialiased_flag_is_kept(tmp_path, version):
    write_spz(tmp_path / "a.spz", cloud(), version=version, antialiased=True)
    assert load_spz(tmp_path / "a.spz")[1]


@pytest.mark.parametrize("degree", [0, 3])
def test_both_versions_hold_the_same_and_4_is_no_larger(tmp_path, degree):
    arrays = cloud(2000, degree)
    write_spz(tmp_path / "3.spz", arrays)
    write_spz(tmp_path / "4.spz", arrays, version=4)
    old, new = (read_spz(tmp_path / name) for name in ("3.spz", "4.spz"))
    assert all(np.array_equal(a, b) for a, b in zip(old, new, strict=True))
    assert (tmp_path / "4.spz").stat().st_size < 1.01 * (tmp_path / "3.spz").stat().st_size


def test_an_empty_cloud(tmp_path):
    write_spz(tmp_path / "a.spz", cloud(0), version=4)
    assert len(read_spz(tmp_path / "a.spz").means) == 0


def test_other_extensions_are_skipped_with_a_warning(tmp_path, caplog):
    data = by_hand(flags=2, extension=struct.pack("<II4s", 0xADBE0002, 4, b"abcd"))
    assert len(read_spz(stored(tmp_path, data)).means) == 2
    assert "vendor extension 0xadbe0002, which is ignored" in caplog.text


def axes(number):
    """SPZ_ADOBE_coordinate_system after another record."""
    return struct.pack("<IIBIII", 0xADBE0002, 1, 0, 0xADBE0003, 4, number)


@pytest.mark.parametrize(
    ("number", "matrix"),
    [
        (4, np.eye(3)),
        (6, np.diag([1, -1, -1])),  # RDF, the axes of a PLY
        (8, np.diag([1, 1, -1])),  # RUF, Unity's, mirrored
        (12, [[1, 0, 0], [0, 0, 1], [0, -1, 0]]),  # RFU, z up
    ],
)
def test_the_record_of_the_axes_is_honoured(tmp_path, number, matrix):
    """Positions, covariances and colours turn alike."""
    plain = read_spz(stored(tmp_path, by_hand()))
    turned = read_spz(stored(tmp_path, by_hand(flags=2, extension=axes(number))))
    matrix = np.array(matrix, float)
    np.testing.assert_allclose(turned.means, plain.means @ matrix.T, atol=1e-6)
    for ours, old in zip(covariances(turned), covariances(plain), strict=True):
        np.testing.assert_allclose(ours, matrix @ old @ matrix.T, atol=1e-5)
    # degree 1 is (-y, z, -x): a vector
    ours, old = (cloud.sh[:, [3, 1, 2]] * [[-1], [-1], [1]] for cloud in (turned, plain))
    np.testing.assert_allclose(ours, matrix @ old, atol=1e-5)


def covariances(cloud):
    from scipy.spatial.transform import Rotation

    frames = Rotation.from_quat(cloud.quats[:, [1, 2, 3, 0]]).as_matrix()
    return frames * np.exp(2 * cloud.log_scales)[:, None] @ frames.transpose(0, 2, 1)


def test_the_record_in_the_gzip_versions_is_honoured(tmp_path):
    raw = bytearray(gzip.decompress(spz_bytes(cloud(5))))
    raw[14] |= 2
    read = read_spz(stored(tmp_path, gzip.compress(bytes(raw) + axes(6))))
    raw[14] = 0
    plain = read_spz(stored(tmp_path, gzip.compress(bytes(raw))))
    np.testing.assert_array_equal(read.means, plain.means * np.float32([1, -1, -1]))


@pytest.mark.parametrize(("up", "number"), [("y", 4), ("-y", 6)])
def test_the_record_of_the_axes_is_written(tmp_path, up, number):
    """By version 4: the same cloud is read whichever axes it is stored in."""
    write_cloud(str(tmp_path / "a.spz"), StoredCloud(cloud(), "z"), spz_version=4, spz_up=up)
    write_cloud(str(tmp_path / "b.spz"), StoredCloud(cloud(), "z"))
    data = (tmp_path / "a.spz").read_bytes()
    assert data[14] & 2 and struct.unpack_from("<I12xIII", data, 16) == (44, 0xADBE0003, 4, number)
    ours, plain = (read_spz(tmp_path / name) for name in ("a.spz", "b.spz"))
    order, other = (np.lexsort(np.rint(300 * found.means.T)) for found in (ours, plain))
    np.testing.assert_allclose(ours.means[order], plain.means[other], atol=2e-3)
    np.testing.assert_allclose(ours.sh[order], plain.sh[other], atol=0.07)


def test_an_unknown_number_of_the_axes_is_refused(tmp_path):
    with pytest.raises(UserError, match="record of the axes has the number 17: 1 to 16"):
        read_spz(stored(tmp_path, by_hand(flags=2, extension=axes(17))))


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (by_hand()[:-1], "truncated or damaged"),
        (by_hand()[:20], "isn't an SPZ file, or damaged"),
        (by_hand()[:40], "its table of 6 blocks is damaged"),
        (by_hand() + b"\0", "1 bytes follow its last block"),
        (by_hand(streams=5), "its table of 5 blocks is damaged"),
        (by_hand(count=2**32 - 1), "of memory"),
        (by_hand(degree=5), "degree 5 are announced"),
        (by_hand(sizes=[18, 2, 6, 6, 8, 17]), "truncated or damaged"),
        (by_hand([*BLOCKS[:-1], HARMONICS + b"\0"], sizes=[18, 2, 6, 6, 8, 18]), "another size"),
        (by_hand([*BLOCKS[:-1], HARMONICS[1:]], sizes=[18, 2, 6, 6, 8, 18]), "another size"),
        (by_hand().replace(b"\x28\xb5\x2f\xfd", b"abcd"), "a block of it is damaged"),
    ],
    ids=range(11),
)
def test_damaged_files_are_refused(tmp_path, data, said):
    with pytest.raises(UserError, match=said):
        read_spz(stored(tmp_path, data))


def test_a_block_that_unpacks_to_more_than_announced_costs_no_memory(tmp_path):
    bomb = [POSITIONS + bytes(200_000_000), *BLOCKS[1:]]
    path = stored(tmp_path, by_hand(bomb, sizes=[18, 2, 6, 6, 8, 18]))
    tracemalloc.start()
    with pytest.raises(UserError, match="another size"):
        read_spz(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 20


def test_without_zstandard_version_4_is_refused_by_name(tmp_path, monkeypatch):
    path = stored(tmp_path, by_hand())
    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(UserError, match="pip install zstandard"):
        spz_bytes(cloud(), version=4)
    with pytest.raises(UserError, match="pip install zstandard"):
        read_spz(path)


def test_what_is_written_has_the_published_header():
    data = spz_bytes(cloud(5, 1), version=4)
    head = spz_container.SpzHeader._make(spz_container.HEADER.unpack_from(data))
    assert head.magic == b"NGSP" and head[1:4] == (4, 5, 1) and head.streams == 6
    assert struct.unpack_from("<I12x", data, 16)[0] == 44 and data[20:32] == bytes(12)
    first = struct.unpack_from("<QQ", data, 44)
    assert first[1] == 45  # positions: 9 bytes for each of 5
    means = zstandard.ZstdDecompressor().decompress(data[140 : 140 + first[0]])
    assert len(means) == 45
