"""Axes in which programs write Gaussians: the argument ``--from`` of the converter."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..core.errors import unknown
from ..formats.gaussian_files import StoredCloud
from ..gaussians.axes import rotate

Y_UP = "y"
VECTORS = {f"{sign}{axis}": s * np.eye(3)[i]
           for i, axis in enumerate("xyz") for sign, s in (("+", 1.0), ("-", -1.0))}  # fmt: skip


class Producer(NamedTuple):
    """Where up and the front of an object are in a program's files."""

    up: str
    """A key of ``VECTORS``."""
    front: str
    """The side of the object that a viewer sees first; a key of ``VECTORS``."""
    note: str
    """The reason, for the table of ``docs/formats.md``."""


PRODUCERS = {
    "3dgs": Producer("-y", "-z", "the first camera of COLMAP: y down, it looks along z"),
    "nerfstudio": Producer("+z", "+x", "cameras are levelled to z up; the front is arbitrary"),
    "trellis": Producer("-y", "-z", "saves its z-up objects as (x, -z, y)"),
    "triposplat": Producer("-y", "+x", "its viewer turns the file by 90 degrees about y, then "
                           "180 about x"),
    "lgm": Producer("+y", "+z", "OpenGL world, the first camera on +z"),
    "diffsplat": Producer("+y", "+z", "OpenGL world, the first camera on +z"),
    "supersplat": Producer("-y", "-z", "it undoes its half turn about z when it saves"),
}  # fmt: skip


def from_producer(cloud: StoredCloud, name: str) -> StoredCloud:
    """Return the cloud of a producer's file with y up and its front towards +z.

    Raises:
        UserError: the producer is unknown.
    """
    if name not in PRODUCERS:
        raise unknown("producer", name, PRODUCERS)
    return cloud._replace(gaussians=rotate(cloud.gaussians, to_y_up(PRODUCERS[name])), up=Y_UP)


def to_y_up(producer: Producer) -> Float[np.ndarray, "3 3"]:
    """Return the rotation from a producer's axes to right, up, front."""
    up, front = VECTORS[producer.up], VECTORS[producer.front]
    return np.stack([np.cross(up, front), up, front])
