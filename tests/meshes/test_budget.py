"""One memory budget for everything in a mesh file."""

import tracemalloc
import zlib

import numpy as np
import pytest

from tests.helpers.gltf_builder import FOUR, png, textured_quad
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.meshes import side_files as budget
from threestudio_gaussiandreamer.meshes.load import load_mesh


def refused(made, saved):
    """Return the message of a rejection, and the peak memory before it."""
    path = saved(made)
    tracemalloc.start()
    try:
        with pytest.raises(UserError) as caught:
            load_mesh(path)
        return str(caught.value), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_textures_count_together(saved, monkeypatch):
    """Two images of half a megabyte in a small file: one fits, two do not."""
    monkeypatch.setattr(budget, "FIXED_BYTES", 700_000)
    monkeypatch.setattr(budget, "BYTES_PER_FILE_BYTE", 0)
    flat = np.zeros((256, 256, 3), np.uint8)
    made = textured_quad(flat)
    assert load_mesh(saved(made)).texture.shape == (256, 256, 3)
    made.document["meshes"][0]["primitives"].append(
        made.document["meshes"][0]["primitives"][0]
        | {"material": made.material(made.texture(flat))}
    )
    message, taken = refused(made, saved)
    assert "the texture 1 of 256 x 256 texels is too large" in message and taken < 1 << 20


def test_instances_count(saved, monkeypatch):
    """2,000 nodes that show one mesh are rejected before they are created; the texture is stored
    once.
    """
    monkeypatch.setattr(budget, "FIXED_BYTES", 1 << 20)
    monkeypatch.setattr(budget, "BYTES_PER_FILE_BYTE", 0)
    made = textured_quad(np.zeros((64, 64, 3), np.uint8))
    made.document["nodes"] = [{"mesh": 0, "translation": [i, 0, 0]} for i in range(500)]
    made.document["scenes"][0]["nodes"] = list(range(500))
    assert load_mesh(saved(made)).texture.size == 64 * 64 * 3
    made.document["nodes"] *= 4
    made.document["scenes"][0]["nodes"] = list(range(2000))
    assert "too large" in refused(made, saved)[0]


def test_a_large_header_is_refused_before_anything_is_allocated(saved):
    """A PNG that announces 12,000 x 12,000 pixels in its header."""
    data = bytearray(png(FOUR))
    data[16:24] = (12000).to_bytes(4, "big") * 2
    data[29:33] = zlib.crc32(bytes(data[12:29])).to_bytes(4, "big")
    message, taken = refused(textured_quad(bytes(data)), saved)
    assert "12000 x 12000 texels is too large" in message and taken < 4 << 20
