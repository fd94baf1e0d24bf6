"""Headers of the zip archives that ``torch.save`` writes, checked before anything is allocated.

``torch.save`` stores its records uncompressed, so the unpacked archive is no larger than the file.
The pickle in it may only call the functions that rebuild tensors and containers; torch's own
``weights_only`` also allows calls that allocate memory, such as ``bytearray(10**10)``."""

import os
import pickletools
import re
import zipfile
from collections.abc import Iterator
from pathlib import Path

from .errors import UserError

ALLOWED_CALLS = re.compile(
    r"collections (OrderedDict|Counter)|builtins (set|complex)"
    r"|torch (Size|device|\w+Storage|u?int\d+|b?float\d+\w*|bool|complex\d+)"
    r"|torch\.storage UntypedStorage|torch\.serialization _get_layout"
    r"|torch\._utils (_rebuild_tensor|_rebuild_tensor_v2|_rebuild_parameter\w*)"
)
WATCHED_MODULES = re.compile(r"torch\b|builtins\b|_codecs\b|collections\b")
"""Modules whose names are checked here; ``weights_only`` refuses names of all other modules."""
MAX_OPCODES = 10_000_000


def require_plain_archive(path: Path) -> None:
    """Check that reading an archive of ``torch.save`` allocates no more than the file's size.

    Raises:
        UserError: the file is no zip archive, its records are compressed or overlap, or its pickle
            calls a function that isn't in ``ALLOWED_CALLS``.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            _require_stored_records(archive, path)
            for record in archive.infolist():
                if record.filename.endswith("data.pkl"):
                    _require_plain_pickle(archive.read(record), path)
    except (zipfile.BadZipFile, NotImplementedError, OSError, ValueError, RuntimeError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{path} isn't a checkpoint, or is damaged: {error}") from error


def _require_stored_records(archive: zipfile.ZipFile, path: Path) -> None:
    records, size = archive.infolist(), os.path.getsize(path)
    if any(record.compress_type != zipfile.ZIP_STORED for record in records):
        raise UserError(f"{path} is no checkpoint of torch.save: its records are compressed")
    if sum(record.file_size for record in records) > size:
        raise UserError(f"{path} is damaged: its records are larger than the file")


def _require_plain_pickle(content: bytes, path: Path) -> None:
    for name in _called(content):
        if WATCHED_MODULES.match(name) and not ALLOWED_CALLS.fullmatch(name):
            raise UserError(
                f"{path} calls {name.replace(' ', '.')} when it is read, which no checkpoint "
                "needs, so it isn't read"
            )


def _called(content: bytes) -> Iterator[str]:
    """Yield every global that a pickle looks up, as "module name"."""
    for count, (opcode, argument, _) in enumerate(pickletools.genops(content)):
        if opcode.name == "GLOBAL":
            yield str(argument)
        if count > MAX_OPCODES:
            raise ValueError(f"its pickle has more than {MAX_OPCODES} instructions")
