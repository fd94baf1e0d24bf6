"""Headers of the zip archives that ``torch.save`` writes, checked before anything is allocated.

An archive of torch's holds its records uncompressed, so what it unpacks to is no larger than the
file. Its pickle may call only what puts tensors and containers together: ``weights_only`` also
allows calls such as ``bytearray(10**10)``."""

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
"""What other modules hold isn't torch's to call either; its own message names it."""
MAX_OPCODES = 10_000_000


def require_plain_archive(path: Path) -> None:
    """Check that an archive of ``torch.save`` unpacks to no more than its size.

    Raises:
        UserError: compressed or overlapping records, a call that no checkpoint needs, or no
            archive.
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
    """Every name that a pickle looks up, as "module name"."""
    for count, (opcode, argument, _) in enumerate(pickletools.genops(content)):
        if opcode.name == "GLOBAL":
            yield str(argument)
        if count > MAX_OPCODES:
            raise ValueError(f"its pickle has more than {MAX_OPCODES} instructions")
