"""NumPy's files, NPY and NPZ, from strangers: no pickles, no size that the file can't hold, and one
message whatever is wrong.

``numpy.load`` believes the header: it allocates what that announces, ignores what is left over, and
where the header is damaged whatever parses it raises what it likes."""

import math
import os
import zipfile
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.lib import format as npy

from ..core.errors import UserError

MOST_DEFLATE_SAVES = 1032
"""Bytes that one byte of a deflate stream stands for at most (zlib's technical notes)."""
PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


class PickledArray(UserError):
    """An array of Python objects, which would be unpickled."""


def read_arrays(
    path: str | os.PathLike, kind: str, required: Sequence[str], optional: Collection[str] = ()
) -> dict[str, np.ndarray]:
    """The arrays of these names in an NPZ; the one array of an NPY counts as the first that is
    required.

    Args:
        kind: what the file is, for messages ("motion file").
        optional: names that may be missing; others that the file holds are not looked at.

    Raises:
        PickledArray: one of them holds Python objects; it is not unpickled, since that could run
            code.
        UserError: not such a file, damaged, or without a required array.
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
    return {
        name: _read_member(archive, members[name], where)
        for name in (*required, *optional)
        if name in members
    }


def _read_member(archive: zipfile.ZipFile, info: zipfile.ZipInfo, where: str) -> np.ndarray:
    if (
        info.compress_type not in PACKINGS
        or info.file_size > MOST_DEFLATE_SAVES * info.compress_size
    ):
        raise UserError(f"{where} is damaged: {info.filename!r} can't be unpacked")
    with archive.open(info) as file:
        array = _read_array(file, info.file_size, where)
        file.read()  # reaching the end makes zipfile look at the checksum
    return array


def _read_array(file: BinaryIO, size: int, where: str) -> np.ndarray:
    """The array in a stream of ``size`` bytes, which it has to fill exactly."""
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


def _read_header(file: BinaryIO, size: int) -> tuple[tuple[int, ...], np.dtype]:
    version = npy.read_magic(file)
    length_bytes = 2 if version == (1, 0) else 4
    if int.from_bytes(file.read(length_bytes), "little") > size:
        raise ValueError("the header is longer than the file")
    file.seek(-length_bytes, os.SEEK_CUR)
    # version 3 differs from 2 only in that names of fields may be Unicode, which plain arrays have
    # none of
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _, dtype = read(file)
    return shape, dtype
