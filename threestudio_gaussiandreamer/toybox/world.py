"""The toybox's objects as functions of (seed, index): their :class:`Attributes` and meshes.

An object has a kind, a colour, a pattern in a second colour, and at most one extra: a part in a
different colour, or an accessory. Meshes are in world axes (z up, front +x), centred, and inside a
sphere of radius :data:`RADIUS`; shading is baked into the vertex colours. Some combinations are
withheld from all training (:func:`withheld`), to measure generalisation."""

import hashlib
import itertools
from typing import NamedTuple, Optional

import numpy as np
from jaxtyping import Float

from ..core.streams import numpy_generator
from ..meshes.mesh import Mesh
from . import motions
from .kinds import ACCESSORIES, KINDS, Proportions
from .people import person
from .shapes import Shape, joined

VERSION = 3
"""Changes with the objects of a (seed, index), so that no training reads pictures of others."""
RADIUS = 0.8
"""Of the bounding sphere of all objects, world units: as large as Point-E's at a scale of 1.6."""
COLORS: dict[str, tuple[float, float, float]] = {
    "red": (0.86, 0.11, 0.12), "orange": (0.97, 0.52, 0.08), "yellow": (0.98, 0.86, 0.14),
    "lime": (0.60, 0.88, 0.18), "green": (0.10, 0.52, 0.17), "teal": (0.10, 0.72, 0.70),
    "blue": (0.13, 0.29, 0.85), "purple": (0.50, 0.17, 0.72), "pink": (0.98, 0.55, 0.74),
    "brown": (0.44, 0.25, 0.11), "black": (0.08, 0.08, 0.09), "white": (0.97, 0.97, 0.96),
}  # fmt: skip
DETAILS: dict[str, tuple[float, float, float]] = {
    "dark": (0.14, 0.14, 0.16), "pale": (0.93, 0.92, 0.88), "warm": (0.93, 0.47, 0.16),
    "glass": (0.63, 0.82, 0.94), "skin": (0.93, 0.72, 0.58), "tan": (0.62, 0.42, 0.29),
    "hair": (0.36, 0.21, 0.12),
}  # fmt: skip
"""Colours of details that prompts never mention."""
PATTERNS = ("plain", "striped", "dotted", "checkered", "two-tone")
PART_SHADE = 0.82
"""Factor on the body's colours for a part that has no own colour."""
LIGHT = np.array([0.25, -0.35, 0.9]) / np.linalg.norm([0.25, -0.35, 0.9])
AMBIENT = 0.70
CELL, PERIODS = 16, 16
"""Texels per period of a pattern, and periods in the texture, more than any surface has."""
PERIOD = {"striped": 0.34, "dotted": 0.34, "checkered": 0.46}
"""Length of a pattern's period before objects are scaled to RADIUS."""
WITHHELD_SHARE, PERSON_SHARE = 0.04, 0.4
"""Shares of combinations that are withheld, and of objects that are persons."""
PERSON = "person"
THINGS_WORN = [name for name in ACCESSORIES if name != "cape"]
"""Accessories of objects that are no persons."""


class Attributes(NamedTuple):
    """The attributes of an object that a prompt can mention."""

    kind: str
    color: str
    pattern: str = "plain"
    second: Optional[str] = None
    """The pattern's colour; None if there is no pattern."""
    part: Optional[str] = None
    """The colour of the kind's part (a roof, a handle, ...); None = the body's."""
    accessory: Optional[str] = None
    accessory_color: Optional[str] = None
    action: Optional[str] = None
    """What a person does: one of ``motions.names()``."""


def draw_attributes(
    seed: int, index: int, *, held_out: bool = False, person_share: float = PERSON_SHARE
) -> Attributes:
    """Draw the attributes of object ``index``, either withheld from training or not."""
    for attempt in itertools.count():  # one in 25 combinations is withheld
        rng = numpy_generator(seed, "toybox-attributes", attempt, index)
        attributes = _draw(rng, person_share)
        if withheld(attributes) == held_out:
            break
    return attributes


def _draw(rng: np.random.Generator, person_share: float) -> Attributes:
    colors = [list(COLORS)[i] for i in rng.permutation(len(COLORS))]
    pattern = "plain" if rng.random() < 0.4 else str(rng.choice(PATTERNS[1:]))
    extra = str(rng.choice(["none", "part", "accessory"], p=[0.35, 0.25, 0.4]))
    kind = str(rng.choice(list(KINDS)))
    accessory = str(rng.choice(THINGS_WORN)) if extra == "accessory" else None
    if rng.random() < person_share:
        accessory = (None, None, "hat", "cape")[int(rng.integers(4))]
        worn = accessory, colors[2] if accessory else None
        action = str(rng.choice(motions.names()))
        return Attributes(PERSON, colors[0], "plain", None, colors[1], *worn, action)
    second = colors[1] if pattern != "plain" else None
    part, worn_color = (colors[2] if extra == name else None for name in ("part", "accessory"))
    return Attributes(kind, colors[0], pattern, second, part, accessory, worn_color)


def withheld(attributes: Attributes) -> bool:
    """Return whether this combination of kind, colour, pattern and extra is withheld from training;
    of a person, of both colours, accessory and action. Other colours aren't considered. Objects
    without pattern and extra are never withheld, since the words are learnt from them."""
    extra = attributes.accessory or ("part" if attributes.part else "none")
    if attributes.action:
        extra = f"{extra}/{attributes.part}/{attributes.action}"
    if attributes.pattern == "plain" and extra == "none":
        return False
    name = f"{attributes.kind}/{attributes.color}/{attributes.pattern}/{extra}"
    digest = hashlib.blake2b(name.encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") < WITHHELD_SHARE * 2**64


def object_mesh(attributes: Attributes, rng: np.random.Generator) -> Mesh:
    """Make an object's mesh with random proportions, a texture and baked light."""
    proportions = Proportions(rng)
    if attributes.action:
        motion = motions.draw(attributes.action, rng)
        shapes, anchors = person(proportions, motion.positions[motion.best])
    else:
        shapes, anchors = KINDS[attributes.kind](proportions)
    if attributes.accessory:
        shapes += ACCESSORIES[attributes.accessory](anchors, proportions)
    shape, names = joined(shapes)
    roles = np.array(names)
    like_body = (roles == "part") & (not attributes.part)
    stretch = rng.uniform(0.85, 1.15)
    low, high = shape.vertices.min(axis=0), shape.vertices.max(axis=0)
    vertices = shape.vertices - (low + high) / 2
    # half-Lambert light from above, never below AMBIENT, and darker on parts like the body
    light = AMBIENT + (1 - AMBIENT) * (0.5 + 0.5 * shape.normals @ LIGHT)
    light = np.where(like_body, PART_SHADE, 1.0) * light
    return Mesh(
        vertices=vertices * (RADIUS / np.linalg.norm(vertices, axis=1).max()),
        faces=shape.faces,
        uv=_texture_coordinates(attributes.pattern, shape, roles, like_body, stretch),
        texture=texture(attributes),
        vertex_colors=np.repeat(light[:, None], 3, axis=1).astype(np.float32),
    )


SIZE = CELL * PERIODS


def texture(attributes: Attributes) -> Float[np.ndarray, "H W 3"]:
    """Draw the object's colours, float32, row 0 on top: the pattern's PERIODS^2 periods, and to the
    right of them a column of cells, each plain."""
    a = attributes
    names = (a.color, a.second, a.part, a.accessory_color)
    color, second, *others = (np.float32(COLORS[name or a.color]) for name in names)
    pattern = np.where(_pattern_mask(a.pattern)[..., None], second, color)
    plain = np.stack([*others, *map(np.float32, DETAILS.values())])
    column = np.zeros((SIZE, CELL, 3), np.float32)
    column[: CELL * len(plain)] = np.repeat(plain, CELL, axis=0)[:, None]
    return np.concatenate([pattern, column], axis=1)


def _pattern_mask(pattern: str) -> np.ndarray:
    """Return the mask of the second colour, (256, 256) bool; row 0 is the top."""
    y, x = (np.indices((CELL, CELL)) + 0.5) / CELL
    cells = {
        "plain": np.zeros((CELL, CELL), bool),
        "striped": y < 0.5,
        "dotted": (x - 0.5) ** 2 + (y - 0.5) ** 2 < 0.33**2,
        "checkered": (x < 0.5) ^ (y < 0.5),
    }
    if pattern == "two-tone":  # v runs over the body's height, so the upper half is on top
        return np.broadcast_to((np.arange(SIZE) < SIZE // 2)[:, None], (SIZE, SIZE))
    return np.tile(cells[pattern], (PERIODS, PERIODS))


def _texture_coordinates(
    pattern: str, shape: Shape, roles: np.ndarray, like_body: np.ndarray, stretch: float
) -> Float[np.ndarray, "V 2"]:
    """Return each vertex's uv: in the pattern (body, ``like_body``), or in its colour's cell."""
    period = PERIOD.get(pattern, 1.0) * stretch
    body = roles == "body"
    height = shape.vertices[:, 2] - shape.vertices[body, 2].min()
    whole = (height / height[body].max()).clip(0, 1) * PERIODS
    u, v = shape.uv.T / period
    v = {"two-tone": whole, "striped": height / period}.get(pattern, v)
    uv = np.stack([_inside(u), _inside(v)], 1) * [SIZE / (SIZE + CELL), 1.0]
    middle = (SIZE + CELL / 2) / (SIZE + CELL)  # of the column of cells
    for row, role in enumerate(("part", "accessory", *DETAILS)):
        uv[(roles == role) & ~like_body] = [middle, 1 - (row + 0.5) * CELL / SIZE]
    return uv


def _inside(periods: Float[np.ndarray, " V"]) -> Float[np.ndarray, " V"]:
    """Convert numbers of periods, also negative, to shares of the texture, half a texel inside."""
    periods = periods - min(0.0, np.floor(periods.min()))
    margin = 0.5 / SIZE
    return (periods / PERIODS).clip(margin, 1 - margin)
