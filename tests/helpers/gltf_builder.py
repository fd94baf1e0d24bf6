"""GLB files built by tests: one textured triangle or quad with the feature under test."""

import io
import json
import struct

import numpy as np
from PIL import Image

from threestudio_gaussiandreamer.meshes.gltf import read_gltf
from threestudio_gaussiandreamer.meshes.mesh import surface_colors

CODES = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
QUAD = np.float32([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
QUAD_UV = np.float32([[0, 1], [1, 1], [1, 0], [0, 0]])
"""glTF's v grows downwards: the quad shows the picture upright to who looks along -z."""
RED, GREEN, BLUE, WHITE = np.uint8([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255]])
FOUR = np.array([[RED, GREEN], [BLUE, WHITE]])
"""Red green / blue white, row 0 on top."""
NEAREST = {"magFilter": 9728}


class Gltf:
    """A document that is built by calls; :meth:`glb` returns the file."""

    def __init__(self, **document):
        scene = {"scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}
        lists = {"meshes": [], "accessors": [], "bufferViews": []}
        self.document = {"asset": {"version": "2.0"}, **scene, **lists, **document}
        self.binary = b""

    def add(self, kind, **entry):
        """Append an object to a list of the document; return its index."""
        self.document.setdefault(kind, []).append(entry)
        return len(self.document[kind]) - 1

    def view(self, data, **entry):
        """Append bytes; return the index of their buffer view."""
        self.binary += b"\0" * (-len(self.binary) % 4)
        place = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)}
        self.binary += data
        return self.add("bufferViews", **place, **entry)

    def accessor(self, values, stride=0, **entry):
        """Append an array (N,) or (N, W); return the index of its accessor."""
        values = np.asarray(values)
        rows = values.reshape(len(values), -1)
        data = np.ascontiguousarray(rows).view(np.uint8).reshape(len(rows), -1)
        view = {}
        if stride:
            data = np.pad(data, ((0, 0), (0, stride - data.shape[1])), constant_values=0xEE)
            view = {"byteStride": stride}
        shape = {"count": len(rows), "type": KINDS[rows.shape[1]]}
        code = CODES[values.dtype.str[1:]]
        index = self.view(data.tobytes(), **view)
        return self.add("accessors", bufferView=index, componentType=code, **shape, **entry)

    def sparse(self, count, rows, values, base=None):
        """Append a sparse accessor of VEC3: zeros, or ``base``, with some rows replaced."""
        indices = {"bufferView": self.view(np.uint16(rows).tobytes()), "componentType": 5123}
        where = {"bufferView": self.view(np.float32(values).tobytes())}
        entry = {"count": len(rows), "indices": indices, "values": where}
        shape = {"componentType": 5126, "count": count, "type": "VEC3"}
        if base is not None:
            shape["bufferView"] = self.view(np.float32(base).tobytes())
        return self.add("accessors", **shape, sparse=entry)

    def texture(self, picture, sampler=None, **entry):
        """Append a texture of a picture (an array, or the bytes of a file); return its index."""
        data = picture if isinstance(picture, bytes) else png(picture)
        image = self.add("images", bufferView=self.view(data), mimeType="image/png")
        if sampler is not None:
            entry["sampler"] = self.add("samplers", **sampler)
        return self.add("textures", source=image, **entry)

    def material(self, texture=None, factor=None, info=None):
        """Append a material; return its index."""
        model = {} if factor is None else {"baseColorFactor": factor}
        if texture is not None:
            model["baseColorTexture"] = {"index": texture} | (info or {})
        return self.add("materials", pbrMetallicRoughness=model)

    def primitive(self, attributes, **entry):
        """Append a mesh of one primitive; ``attributes`` are arrays or indices of accessors."""
        found = {}
        for name, values in attributes.items():
            found[name] = values if isinstance(values, int) else self.accessor(values)
        return self.add("meshes", primitives=[{"attributes": found, **entry}])

    def glb(self):
        """Return the bytes of the file."""
        self.document["buffers"] = [{"byteLength": len(self.binary)}]
        return glb_bytes([("JSON", json.dumps(self.document).encode()), ("BIN", self.binary)])


def glb_bytes(pieces):
    """Return a GLB of chunks, whose names are their types."""
    chunks = b""
    for name, content in pieces:
        content += (b" " if name == "JSON" else b"\0") * (-len(content) % 4)
        kind = name.encode("latin-1").ljust(4, b"\0")
        chunks += struct.pack("<I4s", len(content), kind) + content
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def png(picture):
    """Return a PNG of an array: 8 bits of (H, W, C), or 16 bits of grey (H, W)."""
    buffer = io.BytesIO()
    Image.fromarray(np.asarray(picture)).save(buffer, "PNG")
    return buffer.getvalue()


def textured_quad(
    picture, *, uv=QUAD_UV, sampler=None, info=None, factor=None, attributes=None, **document
):
    """Return a quad of two triangles that shows a picture."""
    made = Gltf(**document)
    texture = made.texture(picture, sampler)
    attributes = {"POSITION": QUAD, "TEXCOORD_0": uv} | (attributes or {})
    attributes = {name: values for name, values in attributes.items() if values is not None}
    indices = made.accessor(np.uint16([0, 1, 2, 0, 2, 3]))
    made.primitive(attributes, indices=indices, material=made.material(texture, factor, info))
    return made


def color_at(path, x, y):
    """The colour at a place of the one part of a file, seen along -z in the file's axes."""
    (part,) = read_gltf(path)
    for face, corners in enumerate(part.vertices[part.faces][:, :, :2]):
        weights = np.linalg.solve(np.vstack([corners.T, np.ones(3)]), [x, y, 1])
        if weights.min() > -1e-9:
            return surface_colors(part, np.array([face]), weights[None])[0]
