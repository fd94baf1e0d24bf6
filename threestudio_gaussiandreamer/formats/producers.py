"""Axes in which programs write objects: the argument ``--from`` of the converter, and the option
``producer`` of the priors that read files."""

from typing import NamedTuple, Optional

import numpy as np
from jaxtyping import Float

from ..core.errors import UserError, unknown
from ..gaussians.axes import VIEWER_UP, rotate
from .gaussian_files import FORMATS, StoredCloud

VECTORS = {f"{sign}{axis}": s * np.eye(3)[i]
           for i, axis in enumerate("xyz") for sign, s in (("+", 1.0), ("-", -1.0))}  # fmt: skip
GAUSSIANS, MESH = "gaussians", "mesh"


class Axes(NamedTuple):
    """Where up and the front of an object are in a file."""

    up: str
    """A key of ``VECTORS``."""
    front: str
    """The side of the object that a viewer sees first; a key of ``VECTORS``."""


class Producer(NamedTuple):
    """The axes of a program's files; None for files that it doesn't write."""

    gaussians: Optional[Axes]
    mesh: Optional[Axes]
    note: str
    """The reason, for the table of ``docs/formats.md``."""


CAMERA, GLTF, WORLD = Axes("-y", "-z"), Axes("+y", "+z"), Axes("+z", "+x")
PRODUCERS = {
    "3dgs": Producer(CAMERA, None, "the first camera of COLMAP: y down, it looks along z"),
    "nerfstudio": Producer(WORLD, None, "cameras are levelled to z up; the front is arbitrary"),
    "trellis": Producer(CAMERA, GLTF, "`save_ply` writes (x, -z, y) and `to_glb` (x, z, -y) of "
                        "z-up objects; their front is -y, Blender's axes of glTF files"),
    "trellis2": Producer(None, GLTF, "`o_voxel.postprocess.to_glb` writes (x, z, -y), as TRELLIS"),
    "triposplat": Producer(Axes("-y", "+x"), None, "its viewer turns the file by 90 degrees about "
                           "y, then 180 about x"),
    "triposg": Producer(None, GLTF, "nothing is turned; its demo's texture stage sees the front "
                        "from where MV-Adapter's loader puts +z"),
    "hunyuan3d": Producer(None, GLTF, "the first view of its texture stage, (0, 0), is from +z, "
                          "elevation 90 from +y"),
    "lgm": Producer(GLTF, GLTF, "OpenGL world, the first camera on +z; `convert.py` keeps it"),
    "diffsplat": Producer(GLTF, None, "its README: OpenGL world, the camera on +z"),
    "triposr": Producer(None, WORLD, "`run.py` turns nothing; x is towards its first camera, z up"),
    "triposr-app": Producer(None, Axes("+y", "-z"), "its Gradio demo turns the mesh by -90 degrees "
                            "about x, then 90 about y"),
    "sam3d": Producer(Axes("+z", "-y"), GLTF, "`save_ply` keeps z up, `to_glb` writes (x, z, -y); "
                      "the front is that of TRELLIS, whose decoders it continues"),
    "supersplat": Producer(CAMERA, None, "it undoes its half turn about z when it saves"),
}  # fmt: skip
"""By name. The sources are in docs/formats.md."""
UNTURNED = {("supersplat", ".spz")}
"""Formats that a producer writes in the axes of its PLY, against their definition."""


def producers_of(kind: str) -> list[str]:
    """Return the names of the producers of files of a kind, ``GAUSSIANS`` or ``MESH``."""
    return [name for name, known in PRODUCERS.items() if getattr(known, kind) is not None]


def producer_axes(name: str, kind: str) -> Axes:
    """Return the axes of a producer's files of a kind, ``GAUSSIANS`` or ``MESH``.

    Raises:
        UserError: the producer is unknown, or doesn't write such files.
    """
    if name not in PRODUCERS:
        raise unknown("producer", name, PRODUCERS)
    axes = getattr(PRODUCERS[name], kind)
    if axes is None:
        here, other = ("Gaussians", "meshes") if kind == GAUSSIANS else ("meshes", "Gaussians")
        raise UserError(
            f"producer: {name!r} stands for files of {other}, and this one is of {here}; "
            f"producers of {here} are {', '.join(producers_of(kind))}"
        )
    return axes


def from_producer(cloud: StoredCloud, name: str, suffix: str = ".ply") -> StoredCloud:
    """Return the cloud of a producer's file, with this extension, with y up and its front at +z.

    The producer's axes are those of its PLYs. Formats with axes of their own were turned on the
    way from a PLY by their definition, except those that the producer writes in a PLY's axes.

    Raises:
        UserError: the producer is unknown, or doesn't write Gaussians.
    """
    rotation = to_y_up(producer_axes(name, GAUSSIANS))
    known = FORMATS.get(suffix, FORMATS[".ply"])
    if known.up != VIEWER_UP and (name, suffix) not in UNTURNED:
        cloud = cloud.in_axes(VIEWER_UP)
    return cloud._replace(gaussians=rotate(cloud.gaussians, rotation), up="y")


def to_y_up(axes: Axes) -> Float[np.ndarray, "3 3"]:
    """Return the rotation from a file's axes to right, up, front."""
    up, front = VECTORS[axes.up], VECTORS[axes.front]
    return np.stack([np.cross(up, front), up, front])
