"""SPZ files: laid out as published, close to what was stored, and safe to read when damaged."""

import functools
import gzip
import struct
import tracemalloc

import numpy as np
import pytest
import torch

from tests.helpers.ply_files import gaussians
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.spz import (
    DECODED_BYTES,
    DECODED_BYTES_PER_HARMONIC,
    read_spz,
    read_spz_comment,
    spz_arrays,
    spz_bytes,
    write_spz,
)
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.sh import sh_to_colors

packed = functools.partial(gzip.compress, mtime=0)
"""Without the time, which would end up in the names of tests."""


def cloud(count=300, degree=0, seed=0):
    values = gaussians(count, degree, seed)
    values.sh[:, 1:] *= 0.2
    return values._replace(log_scales=values.log_scales - 4)


def in_file_order(arrays, read):
    """Return the rows of ``arrays`` in the order of ``read``."""
    rows = [np.abs(arrays.means - mean).sum(1).argmin() for mean in read.means]
    assert sorted(rows) == list(range(len(arrays.means)))
    return arrays.rows(rows)


def stored(tmp_path, data, name="a.spz"):
    (tmp_path / name).write_bytes(data)
    return tmp_path / name


# Two Gaussians put together by hand from the published description, every number worked out on
# paper.
HEADER = (
    b"NGSP" + bytes([3, 0, 0, 0]) + bytes([2, 0, 0, 0]) + bytes([1, 8, 0, 0])
)  # version 3, two, degree 1, 8 fractional bits
POSITIONS = (
    bytes([0x00, 0x01, 0x00]) + bytes([0x80, 0xFF, 0xFF]) + bytes([0x01, 0x02, 0x00])
)  # 256, -128, 513 in 1/256
POSITIONS += bytes(9)
ALPHAS, COLORS = bytes([51, 204]), bytes([255, 0, 51]) + bytes([204, 102, 153])
SCALES = bytes([96, 160, 0]) + bytes([128, 112, 255])
# the first: w largest (3), x and z of magnitude 511/511/sqrt2 and 0, y = -256/511/sqrt2; the
# second: x largest (0), all others 0
ROTATIONS = struct.pack("<II", 3 << 30 | 511 << 20 | (512 | 256) << 10, 0)
HARMONICS = bytes([128, 136, 64]) + bytes([128] * 3) + bytes([192] * 3) + bytes([128] * 9)
BY_HAND = HEADER + POSITIONS + ALPHAS + COLORS + SCALES + ROTATIONS + HARMONICS


def test_a_file_put_together_by_hand_is_read(tmp_path):
    read = read_spz(stored(tmp_path, packed(BY_HAND)))
    np.testing.assert_array_equal(read.means, [[1.0, -0.5, 513 / 256], [0, 0, 0]])
    np.testing.assert_allclose(1 / (1 + np.exp(-read.logit_opacities)), [0.2, 0.8], atol=1e-6)
    np.testing.assert_allclose(
        read.sh[:, 0], np.array([[0.5, -0.5, -0.3], [0.3, -0.1, 0.1]]) / 0.15, atol=1e-5
    )
    np.testing.assert_array_equal(read.log_scales, [[-4, 0, -10], [-2, -3, 255 / 16 - 10]])
    y = -256 / 511 / np.sqrt(2)
    np.testing.assert_allclose(
        read.quats[0], [np.sqrt(1 - 0.5 - y * y), np.sqrt(0.5), y, 0], atol=1e-6
    )  # wxyz
    np.testing.assert_allclose(read.quats[1], [0, 1, 0, 0], atol=1e-6)
    np.testing.assert_array_equal(read.sh[0, 1:], [[0, 0.0625, -0.5], [0, 0, 0], [0.5, 0.5, 0.5]])


@pytest.mark.parametrize("version", [1, 2])
def test_versions_1_and_2_are_read(tmp_path, version):
    """Three components of the quaternion as bytes; version 1 has positions of float16."""
    header = BY_HAND[:4] + bytes([version]) + BY_HAND[5:16]
    halves = np.float16([[1, -0.5, 513 / 256], [0, 0.25, 65504]])
    positions = halves.tobytes() if version == 1 else POSITIONS
    rotations = bytes([255, 128, 128]) + bytes(
        [128, 0, 128]
    )  # x = 1 and y = -1, as (byte / 127.5) - 1
    data = header + positions + ALPHAS + COLORS + SCALES + rotations + HARMONICS
    read = read_spz(stored(tmp_path, packed(data)))
    np.testing.assert_array_equal(read.means[0], [1, -0.5, 513 / 256])
    np.testing.assert_array_equal(read.means[1], halves[1] if version == 1 else 0)
    np.testing.assert_allclose(read.quats, [[0, 1, 0, 0], [0, 0, -1, 0]], atol=0.005)
    np.testing.assert_array_equal(read.sh[0, 3], [0.5, 0.5, 0.5])


def test_what_is_written_is_laid_out_as_published():
    means = np.float32([[1.0, -0.5, 513 / 256]])
    sh = np.zeros((1, 4, 3), np.float32)
    sh[0, 0], sh[0, 1], sh[0, 3] = np.float32([0.5, -0.5, -0.3]) / 0.15, [0, 0.0625, -0.5], 0.5
    one = Gaussians(
        means,
        -2 * np.float32([[0.5, 0.5, -0.5, 0.5]]),
        np.float32([[-4, 0, -10]]),
        np.float32([np.log(0.25)]),
        sh,
    )
    data = gzip.decompress(spz_bytes(one))
    bits = data[13]
    assert data[:16] == b"NGSP" + bytes([3, 0, 0, 0, 1, 0, 0, 0, 1, bits, 0, 0])
    fixed = [
        int.from_bytes(data[16 + 3 * axis : 19 + 3 * axis], "little", signed=True)
        for axis in range(3)
    ]
    assert fixed == [1 << bits, -1 << bits - 1, 513 << bits - 8]
    assert data[25:26] == ALPHAS[:1] and data[26:29] == COLORS[:3] and data[29:32] == SCALES[:3]
    # all four components are alike: x, the first, counts as the largest; 1/2 is 361.33/511 of
    # 1/sqrt2; signs are relative to x's
    assert struct.unpack("<I", data[32:36])[0] == 0 << 30 | (512 | 361) << 20 | 361 << 10 | 361
    assert data[36:] == HARMONICS[:9]  # nothing of it lies between two steps of 5 bit


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_what_is_read_is_close_to_what_was_written(tmp_path, degree):
    arrays = cloud(degree=degree)
    write_spz(tmp_path / "a.spz", arrays, comment="up: y; kept")
    read = read_spz(tmp_path / "a.spz")
    arrays = in_file_order(arrays, read)
    size = np.exp(np.median(arrays.log_scales.mean(1)))
    assert np.abs(read.means - arrays.means).max() <= size / 64 * 1.001  # half a step
    assert np.abs(read.log_scales - arrays.log_scales).max() <= 1 / 32 + 1e-5
    opacities = [torch.from_numpy(values.logit_opacities).sigmoid() for values in (read, arrays)]
    assert (opacities[0] - opacities[1]).abs().max() <= 0.5 / 255 + 1e-6
    assert (
        np.abs(read.sh[:, :1] - arrays.sh[:, :1].clip(-0.5 / 0.15, 0.5 / 0.15)).max()
        <= 0.5 / 255 / 0.15 + 1e-5
    )
    if degree:
        clipped = arrays.sh[:, 1:].clip(-1, 0.93)
        assert (
            np.abs(read.sh[:, 1:] - clipped).max() <= 1.01 / 16 + 0.5 / 128
        )  # half a step of 4 bit; the last step is short
    units = [
        values.quats / np.linalg.norm(values.quats, axis=1, keepdims=True)
        for values in (read, arrays)
    ]
    turned_by = 2 * np.arccos(np.abs((units[0] * units[1]).sum(1)).clip(0, 1))
    assert np.degrees(turned_by).max() < 0.4  # steps of 0.0014 in three components
    assert read_spz_comment(tmp_path / "a.spz") == "up: y; kept"


def test_about_seventeen_bytes_are_one_gaussian():
    assert len(spz_bytes(cloud(3000))) < 18.5 * 3000  # random values pack worse than trained ones


def test_the_same_cloud_gives_the_same_bytes_in_any_order():
    arrays = cloud()
    assert spz_bytes(arrays) == spz_bytes(arrays) == spz_bytes(arrays.rows(slice(None, None, -1)))


def test_an_empty_cloud(tmp_path):
    write_spz(tmp_path / "a.spz", cloud(0))
    assert read_spz(tmp_path / "a.spz").sh.shape == (0, 1, 3)


def test_extremes_are_stored_within_the_formats_reach(tmp_path):
    arrays = cloud(4)
    arrays.log_scales[:] = [[-np.inf] * 3, [-50] * 3, [50] * 3, [0] * 3]
    arrays.logit_opacities[:] = [np.inf, -np.inf, 50, -50]
    arrays.quats[0], arrays.sh[:] = 0, 100
    arrays.means[:] = np.arange(12).reshape(4, 3) * 1000.0
    write_spz(tmp_path / "a.spz", arrays)
    read = in_file_order(read_spz(tmp_path / "a.spz"), arrays)
    np.testing.assert_array_equal(read.log_scales[:, 0], [-10, -10, 255 / 16 - 10, 0])
    assert (
        np.isfinite(read.logit_opacities).all()
        and (np.sign(read.logit_opacities) == [1, -1, 1, -1]).all()
    )
    np.testing.assert_array_equal(read.quats[0], [1, 0, 0, 0])
    assert (sh_to_colors(torch.from_numpy(read.sh), torch.ones(4, 3)) > 1.4).all()
    np.testing.assert_allclose(read.means, arrays.means, atol=0.001)


def test_opacities_stay_below_the_byte_whose_logit_is_infinite():
    """Niantic's reader takes the logit of the byte over 255."""
    arrays = cloud(4)._replace(logit_opacities=np.float32([87, 9, 5.5, -20]))
    alphas = gzip.decompress(spz_bytes(arrays))[16 + 4 * 9 :][:4]
    assert sorted(alphas) == [0, 254, 254, 254]


def test_one_gaussian_beyond_the_range_is_clipped_and_the_rest_keeps_its_precision(
    tmp_path, caplog
):
    arrays, size = cloud(300), float(np.exp(-4))
    arrays.means[7], arrays.means[9, 1], arrays.log_scales[11, 0] = 1e7, -3e38, 9
    write_spz(tmp_path / "a.spz", arrays)
    assert caplog.text.count("a.spz: 3 of 300 Gaussians are farther away or larger") == 1
    read = read_spz(tmp_path / "a.spz")
    assert len(read.means) == 300 and all(np.isfinite(values).all() for values in read)
    near = np.delete(arrays.means, [7, 9], axis=0)
    nearest = np.abs(near[:, None] - read.means[None]).max(axis=2).min(axis=1)
    assert nearest.max() <= size / 2
    caplog.clear()
    write_spz(tmp_path / "b.spz", cloud(300))
    assert not caplog.text


def test_a_cloud_that_is_far_away_as_a_whole_is_not_clipped(tmp_path, caplog):
    arrays = cloud(50)._replace(means=cloud(50).means + np.float32(1e6))
    write_spz(tmp_path / "a.spz", arrays._replace(log_scales=arrays.log_scales - 20))
    read = read_spz(tmp_path / "a.spz")
    assert not caplog.text and np.abs(read.means.mean(axis=0) - 1e6).max() < 1


def test_what_is_not_finite_is_left_out_of_the_file(tmp_path, caplog):
    arrays = cloud(20)
    arrays.means[3], arrays.sh[5] = np.nan, np.inf
    write_spz(tmp_path / "a.spz", arrays)
    assert len(read_spz(tmp_path / "a.spz").means) == 18
    assert caplog.text.count("a.spz: 2 of 20 Gaussians hold NaN or infinity: left out") == 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"means": np.float32([[np.nan, 0, 0]])}, "NaN or infinite"),
        ({"sh": np.zeros((1, 25, 3), np.float32)}, "up to degree 3, not 4"),
    ],
)
def test_what_the_format_cant_hold_is_refused(change, said):
    with pytest.raises(UserError, match=said):
        spz_bytes(cloud(1)._replace(**change))


def test_harmonics_of_degree_4_are_read(tmp_path):
    rest = np.arange(144, dtype=np.uint8)
    data = with_header(degree=4)
    body = gzip.decompress(data)[: -len(HARMONICS)] + rest.tobytes()
    read = read_spz(stored(tmp_path, packed(body)))
    np.testing.assert_array_equal(128 * read.sh[:, 1:].ravel() + 128, rest)


def with_header(version=3, count=2, degree=1, magic=b"NGSP"):
    return packed(struct.pack("<4sIIBBBB", magic, version, count, degree, 8, 0, 0) + BY_HAND[16:])


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "isn't an SPZ file, or damaged"),
        (b"ply\nformat", "isn't an SPZ file, or damaged"),
        (packed(b"short"), "isn't an SPZ file, or damaged"),
        (packed(BY_HAND)[:-20], "truncated or damaged"),
        (packed(BY_HAND)[:-1], "its checksum at the end is missing"),
        (packed(BY_HAND)[:-8] + bytes(8), "incorrect data check"),
        (b"NGSP" + bytes(40), "isn't an SPZ file of version 1 to 4"),
        (with_header(magic=b"NGSX"), "isn't an SPZ file of version 1 to 4"),
        (with_header(version=0), "isn't an SPZ file of version 1 to 4"),
        (with_header(degree=5), "degree 5 are announced"),
        (with_header(count=3), "3 Gaussians need"),
        (with_header(count=2**32 - 1), "bytes can't hold them"),
    ],
)
def test_damaged_and_foreign_files_are_refused(tmp_path, data, said):
    with pytest.raises(UserError, match=said):
        read_spz(stored(tmp_path, data))


def test_a_file_that_unpacks_to_far_more_than_it_announces_costs_no_memory(tmp_path):
    path = stored(tmp_path, packed(BY_HAND + bytes(200_000_000), 1))
    tracemalloc.start()
    assert len(read_spz(path).means) == 2
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10 * path.stat().st_size  # 900 kB packed


@pytest.mark.parametrize("degree", [0, 3])
def test_a_small_file_of_many_gaussians_is_refused_before_they_are_unpacked(tmp_path, degree):
    """Deflate packs up to 1032 bytes into one: 50 kB would take 0.5 GB."""
    count = 2_000_000 // (1 + degree)
    size = 20 + 3 * ((degree + 1) ** 2 - 1)
    head = struct.pack("<4sIIBBBB", b"NGSP", 3, count, degree, 8, 0, 0)
    path = stored(tmp_path, packed(head + bytes(count * size), 9))
    tracemalloc.start()
    with pytest.raises(UserError, match=f"{count} Gaussians would take .* of memory"):
        read_spz(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 10 * path.stat().st_size


@pytest.mark.parametrize("degree", [0, 3])
def test_the_memory_that_is_budgeted_is_what_reading_takes(degree):
    content = spz_bytes(cloud(20_000, degree))
    tracemalloc.start()
    spz_arrays(content)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    announced = 20_000 * (DECODED_BYTES + DECODED_BYTES_PER_HARMONIC * (degree + 1) ** 2)
    assert 0.7 * announced < peak < 1.05 * announced


def test_random_damage_is_an_error_or_a_cloud(tmp_path):
    rng, whole = np.random.default_rng(0), spz_bytes(cloud(40, degree=1))
    plain = gzip.decompress(whole)
    for _ in range(300):
        inside = rng.random() < 0.5  # below the checksum, or above it
        data = bytearray(plain if inside else whole)
        for place in rng.integers(0, min(len(data), 60 if rng.random() < 0.5 else len(data)), 3):
            data[place] = rng.integers(256)
        data = data[: rng.integers(len(data))] if rng.random() < 0.3 else data
        try:
            read = read_spz(stored(tmp_path, packed(bytes(data), 1) if inside else bytes(data)))
        except UserError:
            continue
        assert all(np.isfinite(values).all() and len(values) == len(read.means) for values in read)
