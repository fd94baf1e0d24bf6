"""NPY and NPZ from untrusted sources: what NumPy wrote is read to the bit; wrong headers are
rejected.
"""

import io
import tracemalloc
import zipfile

import numpy as np
import pytest

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.array_files import PickledArray, read_arrays

ARRAYS = {
    "a": np.arange(12.0).reshape(3, 4),
    "b": np.asfortranarray(np.arange(6, dtype=">i2").reshape(2, 3)),
    "text": np.array(["ein", "Wörtchen"]),
    "none": np.empty((0, 5), np.float16),
    "one": np.array(7),
}


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_what_numpy_wrote_is_read(tmp_path, save):
    save(tmp_path / "x.npz", **ARRAYS)
    read = read_arrays(tmp_path / "x.npz", "file", ["a", "b"], ["text", "none", "one", "other"])
    assert read.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert read[name].dtype == array.dtype and np.array_equal(read[name], array)


def test_the_one_array_of_an_npy_has_the_name_that_is_wanted(tmp_path):
    np.save(tmp_path / "x.npy", ARRAYS["a"])
    assert np.array_equal(
        read_arrays(tmp_path / "x.npy", "file", ["points"])["points"], ARRAYS["a"]
    )


def test_what_is_missing_is_named(tmp_path):
    np.savez(tmp_path / "x.npz", **ARRAYS)
    with pytest.raises(
        UserError,
        match="motion file .*x.npz' has no array 'points', 'c', only a, b, text, none, one",
    ):
        read_arrays(tmp_path / "x.npz", "motion file", ["a", "points", "c"])


def test_objects_are_not_unpickled_unless_nobody_asked_for_them(tmp_path):
    np.savez(tmp_path / "x.npz", good=np.ones(3), bad=np.array({"a": 1}, dtype=object))
    assert read_arrays(tmp_path / "x.npz", "file", ["good"])["good"].sum() == 3
    with pytest.raises(PickledArray, match="could run code"):
        read_arrays(tmp_path / "x.npz", "file", ["bad"])
    (tmp_path / "x.pkl").write_bytes(b"\x80\4N.")
    with pytest.raises(PickledArray):
        read_arrays(tmp_path / "x.pkl", "file", ["bad"])


def npy(header: str, body: bytes) -> bytes:
    return (
        b"\x93NUMPY\1\0" + (len(header) + 1).to_bytes(2, "little") + header.encode() + b"\n" + body
    )


def zipped(content: bytes, **changes: int) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("a.npy", content)
        for name, value in changes.items():
            setattr(archive.getinfo("a.npy"), name, value)
    return buffer.getvalue()


HEADER = "{'descr': '<f8', 'fortran_order': False, 'shape': (%s,)}"


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"PK",
        b"hello",
        b"\x93NUMPY",
        b"\x93NUMPY\2\0\xff\xff\xff\x7f{}",
        b"\x93NUMPY\7\0",
        npy(HEADER % 3, bytes(16)),
        npy(HEADER % 3, bytes(32)),
        npy(HEADER % 10**15, bytes(16)),
        npy(HEADER % -1, b""),
        npy("{", b""),
        npy("[" * 500, b""),
        npy("{'descr': 'x', 'fortran_order': 1, 'shape': ()}", b""),
        zipped(npy(HEADER % 3, bytes(32))),
        zipped(npy(HEADER % 3, bytes(24)), file_size=1 << 40),
        zipped(npy(HEADER % 3, bytes(24)), CRC=5),
        zipped(npy(HEADER % 3, bytes(24)), compress_type=99),
        zipped(npy(HEADER % 3, bytes(24)), flag_bits=1),
    ],
)
def test_damage_is_one_message_and_no_memory(tmp_path, content):
    path = tmp_path / "x.npz"
    path.write_bytes(content)
    tracemalloc.start()
    with pytest.raises(UserError, match="file .*x.npz"):
        read_arrays(path, "file", ["a"])
    assert tracemalloc.get_traced_memory()[1] < 4 << 20
    tracemalloc.stop()


def test_a_small_archive_of_large_arrays_is_refused_before_they_are_unpacked(tmp_path):
    """Each array alone is within the budget, all together are not."""
    arrays = {name: np.zeros(1_200_000, np.uint8) for name in "abc"}
    np.savez_compressed(tmp_path / "x.npz", **arrays)
    assert read_arrays(tmp_path / "x.npz", "file", ["a"])["a"].shape == (1_200_000,)
    tracemalloc.start()
    with pytest.raises(
        UserError, match="file .*x.npz': the arrays a, b, c would take .* of memory"
    ):
        read_arrays(tmp_path / "x.npz", "file", ["a"], ["b", "c"])
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()
