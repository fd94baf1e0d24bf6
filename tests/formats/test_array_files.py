"""NPY, NPZ and pickled dicts from untrusted sources: exact, and no code is run."""

import io
import os
import pickle
import zipfile

import numpy as np
import pytest
import scipy.sparse

from tests.helpers.memory import memory_below
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.array_files import read_arrays

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
    said = "motion file .*x.npz': it has no array 'points', 'c', only a, b, text, none, one"
    refused(said, read_arrays, tmp_path / "x.npz", "motion file", ["a", "points", "c"])
    np.save(tmp_path / "x.npy", ARRAYS["a"])
    found = read_arrays(tmp_path / "x.npy", "file", ["points"])
    assert np.array_equal(found["points"], ARRAYS["a"])
    np.savez(tmp_path / "y.npz", good=np.ones(3), bad=np.array({"a": 1}, dtype=object))
    assert read_arrays(tmp_path / "y.npz", "file", ["good"])["good"].sum() == 3
    refused("could run code", read_arrays, tmp_path / "y.npz", "file", ["bad"])


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_pickled_dicts_of_arrays_are_read(tmp_path, protocol):
    given = ARRAYS | {"columns": np.asfortranarray(np.eye(3)[:, :2]), "big": np.ones(2, ">i4")}
    (tmp_path / "x.pkl").write_bytes(pickle.dumps(given, protocol))
    read = read_arrays(tmp_path / "x.pkl", "file", list(given))
    for name, values in given.items():
        np.testing.assert_array_equal(read[name], values)
        assert read[name].dtype == values.dtype


class Runs:
    def __reduce__(self):
        return (exec, ("import os; os.environ['RAN'] = '1'",))


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"\x80\4N.", "something else than a dict"),
        (pickle.dumps(Runs()), "holds an object 'exec'"),
        (pickle.dumps({"a": Runs()}), "holds an object 'exec'"),
        (pickle.dumps({"a": [Runs()]}), "Python objects as 'a'"),
        (pickle.dumps({"a": np.array([Runs()], object)}), "Python objects as 'a'"),
        (pickle.dumps({"b": 1}), "no array 'a', only b"),
        (pickle.dumps({"a": np.ones(9)})[:-40], "is truncated, damaged"),
        (b"\x80\2Nr\xff\xff\xff\x7f.", "fill the memory"),
        (b"\x80\2cposix\nsystem\nX\4\0\0\0trueb.", "is truncated, damaged"),
        (pickle.dumps({"a": scipy.sparse.csc_matrix((10**6, 10**6))}), "sparse matrix .* memory"),
    ],
)
def test_pickles_run_no_code(tmp_path, monkeypatch, data, said):
    monkeypatch.delenv("RAN", raising=False)
    (tmp_path / "x.pkl").write_bytes(data)
    refused(said, read_arrays, tmp_path / "x.pkl", "file", ["a"])
    assert "RAN" not in os.environ


def npy(header: str, body: bytes) -> bytes:
    size = (len(header) + 1).to_bytes(2, "little")
    return b"\x93NUMPY\1\0" + size + header.encode() + b"\n" + body


def zipped(content: bytes, **changes: int) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(zipfile.ZipInfo("a.npy"), content)  # no time: it would stand in test ids
        for name, value in changes.items():
            setattr(archive.getinfo("a.npy"), name, value)
    return buffer.getvalue()


HEADER = "{'descr': '<f8', 'fortran_order': False, 'shape': (%s,)}"


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"PK",
        b"\x93NUMPY\2\0\xff\xff\xff\x7f{}",
        b"\x93NUMPY\7\0",
        npy(HEADER % 3, bytes(16)),
        npy(HEADER % 3, bytes(32)),
        npy(HEADER % 10**15, bytes(16)),
        npy(HEADER % -1, b""),
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
    with memory_below(4 << 20), pytest.raises(UserError, match="file .*x.npz"):
        read_arrays(path, "file", ["a"])


def test_a_small_archive_of_large_arrays_is_refused_before_they_are_unpacked(tmp_path):
    """Each array alone is within the budget, all together are not."""
    arrays = {name: np.zeros(1_200_000, np.uint8) for name in "abc"}
    np.savez_compressed(tmp_path / "x.npz", **arrays)
    assert read_arrays(tmp_path / "x.npz", "file", ["a"])["a"].shape == (1_200_000,)
    said = "file .*x.npz': the arrays a, b, c would take .* of memory"
    with memory_below(1 << 20), pytest.raises(UserError, match=said):
        read_arrays(tmp_path / "x.npz", "file", ["a"], ["b", "c"])
