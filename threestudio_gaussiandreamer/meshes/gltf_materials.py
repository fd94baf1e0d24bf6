"""Base colours of glTF materials: factor, texture, sampler, and the transform of coordinates."""

import logging
import math
from typing import Any, NamedTuple, Optional

import numpy as np
from jaxtyping import Float, UInt8

from .colors import linear_to_srgb, unit_rgb
from .gltf_document import Document
from .mesh import CLAMP, MIRROR, REPEAT, Tile
from .textures import decode_texture

WRAPS = {10497: REPEAT, 33648: MIRROR, 33071: CLAMP}
NEAREST = 9728
UNREAD_IMAGES = ("KHR_texture_basisu", "MSFT_texture_dds")
UNSET_FACTOR = [0.4, 0.4, 0.4]
"""trimesh's default for materials without a colour; ignored, since it would darken the texture."""

log = logging.getLogger(__name__)


class Surface(NamedTuple):
    """The base colour of a material."""

    factor: Optional[Float[np.ndarray, "3"]] = None
    """Display values in [0, 1]; None where the material names none."""
    texture: Optional[UInt8[np.ndarray, "H W 3"]] = None
    tile: Optional[Tile] = None
    coordinates: int = 0
    """The texture's set of coordinates, TEXCOORD_n."""
    transform: Optional[Float[np.ndarray, "2 3"]] = None
    """Applied to them, v downwards."""


class Materials:
    """The materials of a document; each image is decoded once."""

    def __init__(self, document: Document) -> None:
        self.document = document
        self._surfaces: dict[int, Surface] = {}
        self._textures: dict[int, Optional[np.ndarray]] = {}

    def surface(self, index: Any) -> Surface:
        """Return the base colour of the material of this index; None = the default material."""
        if index is None:
            return Surface()
        if index not in self._surfaces:
            self._surfaces[index] = self._read(self.document.entry("materials", index))
        return self._surfaces[index]

    def _read(self, material: dict[str, Any]) -> Surface:
        old = _extension(material, "KHR_materials_pbrSpecularGlossiness")
        model = material.get("pbrMetallicRoughness", {}) if old is None else old
        names = ("baseColorTexture", "baseColorFactor")
        if old is not None:
            names = ("diffuseTexture", "diffuseFactor")
        surface = Surface(factor=self._factor(model.get(names[1]), textured=names[0] in model))
        info = model.get(names[0])
        texture = None if info is None else self._image(self._texture(info))
        if texture is None:
            return surface
        transform = _extension(info, "KHR_texture_transform") or {}
        return surface._replace(
            texture=texture,
            tile=self._tile(self._texture(info), texture),
            coordinates=transform.get("texCoord", info.get("texCoord", 0)),
            transform=self._transform(transform) if transform else None,
        )

    def _factor(self, factor: Any, textured: bool) -> Optional[np.ndarray]:
        if factor is None:
            return None
        rgb = self.document.numbers(factor, 4, "the colour of a material")[:3]
        by_trimesh = "trimesh" in str(self.document.json["asset"].get("generator"))
        if (by_trimesh and rgb.tolist() == UNSET_FACTOR) or (textured and (rgb == 1).all()):
            return None
        return linear_to_srgb(unit_rgb(rgb[None])[0])

    def _texture(self, info: dict[str, Any]) -> dict[str, Any]:
        return self.document.entry("textures", info.get("index"))

    def _image(self, texture: dict[str, Any]) -> Optional[np.ndarray]:
        """Return the picture of a texture; None, with a warning, where its file is missing."""
        source = (_extension(texture, "EXT_texture_webp") or texture).get("source")
        if source is None:
            source = texture.get("source")
        if source is None:
            kinds = [name for name in UNREAD_IMAGES if _extension(texture, name) is not None]
            self.document.fail(f"a texture has no PNG, JPEG or WebP image, only {kinds or 'none'}")
        if source not in self._textures:
            self._textures[source] = self._decoded(source)
        return self._textures[source]

    def _decoded(self, index: Any) -> Optional[np.ndarray]:
        image = self.document.entry("images", index)
        if "bufferView" in image:
            data = bytes(self.document.view(image["bufferView"])[0])
        else:
            data = self.document.resource(image.get("uri"), f"image {index}")
        if data is None:
            return None
        return decode_texture(data, str(image.get("name", index))[:80], self.document.budget)

    def _tile(self, texture: dict[str, Any], picture: np.ndarray) -> Tile:
        height, width = picture.shape[:2]
        sampler = {}
        if "sampler" in texture:
            sampler = self.document.entry("samplers", texture["sampler"])
        wraps = [sampler.get(key, 10497) for key in ("wrapS", "wrapT")]
        if not all(wrap in WRAPS for wrap in wraps):
            self.document.fail(f"a texture wraps by {str(wraps)[:60]}; {list(WRAPS)} are known")
        return Tile(
            0, width, height, *(WRAPS[w] for w in wraps), sampler.get("magFilter") == NEAREST
        )

    def _transform(self, transform: dict[str, Any]) -> np.ndarray:
        """Return KHR_texture_transform as a matrix: scale, then rotate, then move.

        The rotation is counter-clockwise as seen in the texture, whose v grows downwards.
        """
        numbers = self.document.numbers
        offset = numbers(transform.get("offset", [0, 0]), 2, "a texture's offset")
        scale = numbers(transform.get("scale", [1, 1]), 2, "a texture's scale")
        (angle,) = numbers([transform.get("rotation", 0)], 1, "a texture's rotation")
        c, s = math.cos(angle), math.sin(angle)
        return np.column_stack([np.array([[c, s], [-s, c]]) * scale, offset])


def _extension(entry: dict[str, Any], name: str) -> Optional[dict[str, Any]]:
    return entry.get("extensions", {}).get(name)
