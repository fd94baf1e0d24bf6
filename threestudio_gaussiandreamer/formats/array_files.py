"""Read NPY and NPZ files, and pickled dicts of arrays, from untrusted sources: without running any
code of theirs, within a memory budget, and with one type of error for every kind of damage.

``numpy.load`` trusts the header: it allocates the size that the header gives, ignores trailing
data, and raises many types of errors for damaged files.

In a pickle every class and function is replaced by one that only keeps what it was called with.
What that stands for is worked out afterwards, for the few kinds that hold arrays: NumPy's, SciPy's
sparse matrices, and chumpy's in the files of SMPL and MANO, which need no chumpy so."""

import io
import math
import os
import pickle
import pickletools
import zipfile
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from ..core.errors import UserError
from ..core.memory import require_file_memory

MOST_DEFLATE_SAVES = 1032
"""Bytes that one byte of a deflate stream stands for at most (zlib's technical notes)."""
PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
CONVERTED_BYTES = 16
"""Memory per number that is added to the budget for callers, which make two float64 copies."""


PICKLES = (".pkl", ".pickle")
"""Extensions of pickles, whose oldest kind has no mark at its start."""


def read_arrays(
    path: str | os.PathLike, kind: str, required: Sequence[str], optional: Collection[str] = ()
) -> dict[str, np.ndarray]:
    """Read named arrays from an NPZ or a pickled dict, or the single array of an NPY, which gets
    the first required name.

    Args:
        kind: what the file is, for messages ("motion file").
        required: names of arrays that must be in the file.
        optional: names of arrays that may be missing; other arrays are not read.

    Raises:
        UserError: the file is neither NPZ nor NPY nor a pickle, is damaged, lacks a required array,
            holds other Python objects in its place, or needs more memory than the budget of its
            size.
    """
    path, where = Path(path), f"{kind} {str(path)!r}"
    try:
        with open(path, "rb") as file:
            start = file.read(len(npy.MAGIC_PREFIX))
            file.seek(0)
            size = os.fstat(file.fileno()).st_size
            if start == npy.MAGIC_PREFIX:
                if not _read_header(file, size)[1].hasobject:
                    file.seek(0)
                    return {required[0]: _read_array(file, size, where)}
                return _read_pickle(file.read(), where, required, optional)
            if start[:1] == pickle.PROTO or path.suffix.lower() in PICKLES:
                return _read_pickle(file.read(), where, required, optional)
            with zipfile.ZipFile(file) as archive:
                return _read_archive(archive, where, required, optional)
    except UserError:
        raise
    except Exception as error:  # zipfile, zlib, ast and tokenize each raise errors of their own
        raise UserError(
            f"{where} can't be read: it is no NPZ or NPY file or pickled dict, or is damaged "
            f"({type(error).__name__}: {error})"
        ) from error


def _read_archive(
    archive: zipfile.ZipFile, where: str, required: Sequence[str], optional: Collection[str]
) -> dict[str, np.ndarray]:
    members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
    if missing := [name for name in required if name not in members]:
        raise UserError(
            f"{where} has no array {', '.join(map(repr, missing))}, only "
            f"{', '.join(members) or 'none'}"
        )
    wanted = {name: members[name] for name in (*required, *optional) if name in members}
    _require_memory(archive, wanted, where)
    return {name: _read_member(archive, info, where) for name, info in wanted.items()}


def _require_memory(
    archive: zipfile.ZipFile, wanted: dict[str, zipfile.ZipInfo], where: str
) -> None:
    """Check the total size in the headers before any array is unpacked."""
    needed = 0
    for info in wanted.values():
        with _open_member(archive, info, where) as file:
            shape, dtype = _read_header(file, info.file_size)
        needed += math.prod(shape) * (dtype.itemsize + CONVERTED_BYTES)
    file_size = os.fstat(archive.fp.fileno()).st_size
    require_file_memory(needed, file_size, where, f"the arrays {', '.join(wanted)}")


def _open_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, where: str) -> IO[bytes]:
    too_large = info.file_size > MOST_DEFLATE_SAVES * info.compress_size
    if info.compress_type not in PACKINGS or too_large:
        raise UserError(f"{where} is damaged: {info.filename!r} can't be unpacked")
    return archive.open(info)


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, where: str) -> np.ndarray:
    with _open_member(archive, info, where) as file:
        array = _read_array(file, info.file_size, where)
        file.read()  # at the end, zipfile compares the checksum
    return array


def _read_array(file: IO[bytes], size: int, where: str) -> np.ndarray:
    """Read the array in a stream; header and data must have ``size`` bytes together."""
    shape, dtype = _read_header(file, size)
    if dtype.hasobject:
        raise UserError(
            f"{where} holds Python objects as a pickle, which could run code, and isn't opened"
        )
    if min(shape, default=0) < 0 or file.tell() + math.prod(shape) * dtype.itemsize != size:
        raise UserError(
            f"{where} is damaged: an array {shape} of {dtype} is announced, but the file is of "
            "another size"
        )
    file.seek(0)
    return npy.read_array(file, allow_pickle=False)


def _read_header(file: IO[bytes], size: int) -> tuple[tuple[int, ...], np.dtype]:
    version = npy.read_magic(file)
    length_bytes = 2 if version == (1, 0) else 4
    if int.from_bytes(file.read(length_bytes), "little") > size:
        raise ValueError("the header is longer than the file")
    file.seek(-length_bytes, os.SEEK_CUR)
    # version 3 differs from 2 only in Unicode names of fields, which plain arrays don't have
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, dtype = read(file)
    return shape, dtype


# ---- pickles -------------------------------------------------------------------------------------


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
"""Functions of ours that make bytes, and objects of protocols 0 and 1, by the names of those that
pickles call for it.
"""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        return OURS.get(name) or type(_Object.__name__, (_Object,), {"kind": name})


def _read_pickle(
    data: bytes, where: str, required: Sequence[str], optional: Collection[str]
) -> dict[str, np.ndarray]:
    for opcode, argument, _ in pickletools.genops(data):  # checks the sizes that it announces
        if opcode.name in ("PUT", "LONG_BINPUT") and int(argument) > len(data):
            raise UserError(f"{where} is damaged: it would fill the memory")
    content = _plain(_Unpickler(io.BytesIO(data), encoding="latin1").load(), where, len(data))
    if isinstance(content, list) and len(content) == 1:  # numpy.save's array of one dict
        content = content[0]
    if not isinstance(content, dict):
        raise UserError(f"{where} is a pickle of something else than a dict of arrays")
    if missing := [name for name in required if name not in content]:
        raise UserError(
            f"{where} has no array {', '.join(map(repr, missing))}, only "
            f"{', '.join(map(str, content)) or 'none'}"
        )
    names = [name for name in (*required, *optional) if name in content]
    arrays = {name: np.array(_plain(content[name], where, len(data))) for name in names}
    for name, values in arrays.items():
        if values.dtype.hasobject:
            raise UserError(f"{where} holds Python objects as {name!r}; an array was expected")
    return arrays


def _plain(value: Any, where: str, size: int) -> Any:
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
        return _plain(state["x"], where, size)
    if value.kind == "Select":
        source, rows = (_plain(state[name], where, size) for name in ("a", "idxs"))
        return np.ravel(source)[rows].reshape(state["preferred_shape"])
    if value.kind in ("csc_matrix", "csr_matrix"):
        from scipy import sparse

        shape = state.get("_shape", state.get("shape"))
        require_file_memory(3 * 8 * math.prod(shape), size, where, f"a sparse matrix {shape}")
        parts = [_plain(state[name], where, size) for name in ("data", "indices", "indptr")]
        return getattr(sparse, value.kind)(tuple(parts), shape).toarray()
    raise UserError(f"{where} holds an object {value.kind[:60]!r}; an array was expected")


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
