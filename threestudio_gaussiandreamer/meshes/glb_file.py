"""The container of GLB files: a header, the JSON and the binary content."""

import json
import os
import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..core.files import atomic_file

ALIGNMENT = 4


def write_glb_file(
    path: str | os.PathLike, document: Mapping[str, Any], blocks: Sequence[bytes]
) -> None:
    """Write a GLB atomically.

    Args:
        document: the JSON without ``buffers``; its ``bufferViews``, one for each block, lack
            buffer, offset and length.
        blocks: the binary content; padded to multiples of 4 bytes.

    Raises:
        UserError: the file can't be written.
    """
    padded = [block + b"\0" * (-len(block) % ALIGNMENT) for block in blocks]
    starts = np.cumsum([0, *map(len, padded)]).tolist()
    views = [
        {"buffer": 0, "byteOffset": start, "byteLength": len(block), **view}
        for start, block, view in zip(starts, blocks, document.get("bufferViews", ()), strict=False)
    ]
    content = {"bufferViews": views, "buffers": [{"byteLength": starts[-1]}]} if views else {}
    text = json.dumps({**document, **content}, separators=(",", ":")).encode()
    text += b" " * (-len(text) % ALIGNMENT)
    with atomic_file(path) as file:
        file.write(struct.pack("<4sII", b"glTF", 2, 28 + len(text) + starts[-1]))
        file.write(struct.pack("<I4s", len(text), b"JSON") + text)
        file.write(struct.pack("<I4s", starts[-1], b"BIN\0"))
        file.writelines(padded)
