"""Read NPY and NPZ files, and pickled dicts of arrays, from untrusted sources: without running any
code of theirs, within a memory budget (``numpy.load`` allocates what the header says), and with one
type of error for every kind of damage.

In a pickle every class and function is replaced by one that only keeps what it was called with. Of
those, NumPy's arrays, SciPy's sparse matrices, and chumpy's (in SMPL's files) are read."""

import io
import math
import os
import pickle
import pickletools
import zipfile
from collections.abc import Collection, Sequence
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from .reading import Unreadable, reading, require, require_file_memory

MOST_HEADER_BYTES = 1 << 16
PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def read_arrays(
    path: str | os.PathLike, kind: str, required: Sequence[str], optional: Collection[str] = ()
) -> dict[str, np.ndarray]:
    """Read named arrays from an NPZ or a pickled dict, or the single array of an NPY, which gets
    the first required name.

    Args:
        kind: what the file is, for messages ("motion file").
        required, optional: names of arrays that must or may be in it; others are not read.

    Raises:
        UserError: the file is neither NPZ nor NPY nor a pickle, is damaged, lacks a required array
            or has other objects in its place, or needs more memory than the budget of its size.
    """
    with reading(path, kind) as path, open(path, "rb") as file:
        start = file.read(len(npy.MAGIC_PREFIX))
        file.seek(0)
        size = os.fstat(file.fileno()).st_size
        if start == npy.MAGIC_PREFIX:
            _, dtype, end = _header_of(file.read(MOST_HEADER_BYTES))
            file.seek(end if dtype.hasobject else 0)
            if dtype.hasobject:
                return _read_pickle(file.read(), required, optional)
            return {required[0]: _read_array(file, size)}
        # the oldest kind of pickles has no mark at its start
        if start[:1] == pickle.PROTO or path.suffix.lower() in (".pkl", ".pickle"):
            return _read_pickle(file.read(), required, optional)
        archive, needed, arrays = zipfile.ZipFile(file), 0, {}
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        names = _wanted(members, required, optional)
        for name in names:  # the sizes of all, before any is unpacked
            usual = members[name].compress_type in PACKINGS
            require(usual, f"{name!r} is packed in a way that NumPy doesn't")
            with archive.open(members[name]) as member:
                shape, dtype, _ = _header_of(member.read(MOST_HEADER_BYTES))
            needed += math.prod(shape) * (dtype.itemsize + 16)  # callers make two float64 copies
        require_file_memory(needed, size, f"the arrays {', '.join(names)}")
        for name in names:
            with archive.open(members[name]) as member:
                arrays[name] = _read_array(member, members[name].file_size)
                member.read()  # at the end, zipfile compares the checksum
        return arrays


def _wanted(found: Collection[Any], required: Sequence[str], optional: Collection[str]) -> list:
    """Return the names to read, after checking that all required ones are there."""
    missing = ", ".join(repr(name) for name in required if name not in found)
    require(not missing, f"it has no array {missing}, only {', '.join(map(str, found)) or 'none'}")
    return [name for name in (*required, *optional) if name in found]


def _read_array(file: IO[bytes], size: int) -> np.ndarray:
    """Read the array in a stream; header and data must have ``size`` bytes together."""
    shape, dtype, start = _header_of(file.read(MOST_HEADER_BYTES))
    said = "it holds Python objects as a pickle, which could run code, and isn't opened"
    require(not dtype.hasobject, said)
    whole = min(shape, default=0) >= 0 and start + math.prod(shape) * dtype.itemsize == size
    require(whole, f"it is damaged: an array {shape} of {dtype} doesn't fill it")
    file.seek(0)
    return npy.read_array(file, allow_pickle=False)


def _header_of(start: bytes) -> tuple[tuple[int, ...], np.dtype, int]:
    """Return shape, type and the place of the numbers from the start of an NPY."""
    file = io.BytesIO(start)
    # version 3 differs from 2 only in Unicode names of fields, which plain arrays don't have
    first = npy.read_magic(file) == (1, 0)
    shape, _, dtype = (npy.read_array_header_1_0 if first else npy.read_array_header_2_0)(file)
    return shape, dtype, file.tell()


class _Object:
    """Stands for an object of any class, or for the result of any function, in a pickle."""

    kind = ""
    made_from: tuple[Any, ...]

    def __new__(cls, *made_from: Any, **_: Any) -> "_Object":
        self = super().__new__(cls)
        self.made_from, self.state = made_from, {}
        return self

    def __setstate__(self, state: Any) -> None:
        self.state = state


OURS = {
    "encode": lambda text, _: text.encode("latin1"),
    "bytes": lambda: b"",
    "_reconstructor": lambda cls, *_: cls(),
}
"""Functions of ours in place of those that make bytes, and objects of protocols 0 and 1."""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        return OURS.get(name) or type(_Object.__name__, (_Object,), {"kind": name})


def _read_pickle(
    data: bytes, required: Sequence[str], optional: Collection[str]
) -> dict[str, np.ndarray]:
    for opcode, argument, _ in pickletools.genops(data):  # checks the sizes that it announces
        too_large = opcode.name in ("PUT", "LONG_BINPUT") and int(argument) > len(data)
        require(not too_large, "it is damaged: it would fill the memory")
    content = _plain(_Unpickler(io.BytesIO(data), encoding="latin1").load(), len(data))
    if isinstance(content, list) and len(content) == 1:  # numpy.save's array of one dict
        content = content[0]
    require(isinstance(content, dict), "it is a pickle of something else than a dict of arrays")
    names = _wanted(content, required, optional)
    arrays = {name: np.array(_plain(content[name], len(data))) for name in names}
    for name, values in arrays.items():
        usual = not values.dtype.hasobject
        require(usual, f"it holds Python objects as {name!r}; an array was expected")
    return arrays


def _plain(value: Any, size: int) -> Any:
    """Return what an object of a pickle of ``size`` bytes stands for; other values as they are."""
    if not isinstance(value, _Object):
        return value
    state = value.state
    if value.kind == "_reconstruct":
        _, shape, kind, columns_first, data = state
        return _array(data, kind, shape, "F" if columns_first else "C")
    if value.kind == "_frombuffer":
        return _array(*value.made_from)
    if value.kind == "Ch":
        return _plain(state["x"], size)
    if value.kind == "Select":
        source, rows = (_plain(state[name], size) for name in ("a", "idxs"))
        return np.ravel(source)[rows].reshape(state["preferred_shape"])
    if value.kind in ("csc_matrix", "csr_matrix"):
        from scipy import sparse

        shape = state.get("_shape", state.get("shape"))
        require_file_memory(3 * 8 * math.prod(shape), size, f"a sparse matrix {shape}")
        parts = [_plain(state[name], size) for name in ("data", "indices", "indptr")]
        return getattr(sparse, value.kind)(tuple(parts), shape).toarray()
    raise Unreadable(f"it holds an object {value.kind[:60]!r}; an array was expected")


def _array(data: Any, kind: _Object, shape: tuple[int, ...], order: str) -> Any:
    """Make an array from what NumPy pickles of it; one of Python objects is a list."""
    (name, *_), mark = kind.made_from, kind.state[1] if kind.state else "="
    if name == "O8":
        return data
    dtype = np.dtype(f"{mark if mark in '<>' else ''}{name}")
    if dtype.hasobject:
        raise ValueError(f"an array of {name}")
    raw = data.encode("latin1") if isinstance(data, str) else data
    return np.frombuffer(raw, dtype).reshape(shape, order=order)
