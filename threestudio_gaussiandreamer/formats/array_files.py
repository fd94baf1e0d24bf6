"""Read NPY and NPZ files from untrusted sources: without pickles, within a memory budget, and with
one type of error for every kind of damage.

``numpy.load`` trusts the header: it allocates the size that the header gives, ignores trailing
data, and raises many types of errors for damaged files."""

import math
import os
import zipfile
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import IO

import numpy as np
from numpy.lib import format as npy

from ..core.errors import UserError
from ..core.file_memory import require_file_memory

MOST_DEFLATE_SAVES = 1032
"""Bytes that one byte of a deflate stream stands for at most (zlib's technical notes)."""
PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
CONVERTED_BYTES = 16
"""Memory per number that is added to the budget for callers, which make two float64 copies."""


class PickledArray(UserError):
    """Raised for an array of Python objects, which would have to be unpickled."""


def read_arrays(
    path: str | os.PathLike, kind: str, required: Sequence[str], optional: Collection[str] = ()
) -> dict[str, np.ndarray]:
    """Read named arrays from an NPZ, or the single array of an NPY, which gets the first required
    name.

    Args:
        kind: what the file is, for messages ("motion file").
        required: names of arrays that must be in the file.
        optional: names of arrays that may be missing; other arrays are not read.

    Raises:
        PickledArray: an array holds Python objects; it isn't unpickled, since that could run code.
        UserError: the file is neither NPZ nor NPY, is damaged, lacks a required array, or needs
            more memory than the budget of its size.
    """
    path, where = Path(path), f"{kind} {str(path)!r}"
    try:
        with open(path, "rb") as file:
            start = file.read(len(npy.MAGIC_PREFIX))
            file.seek(0)
            if start == npy.MAGIC_PREFIX:
                return {required[0]: _read_array(file, os.fstat(file.fileno()).st_size, where)}
            if start[:1] == b"\x80":
                raise PickledArray(f"{where} is a pickle, which could run code, and isn't opened")
            with zipfile.ZipFile(file) as archive:
                return _read_archive(archive, where, required, optional)
    except UserError:
        raise
    except Exception as error:  # zipfile, zlib, ast and tokenize each raise errors of their own
        raise UserError(
            f"{where} can't be read: it is no NPZ or NPY file, or is damaged "
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
        raise PickledArray(
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
