"""Convert a file of Gaussians to a textured mesh: OUT is a .glb or an .obj."""

import argparse
import os
from pathlib import Path
from typing import Any

from ..core.errors import UserError
from ..core.files import require_writable
from ..core.memory import size_text
from ..core.options import check_options
from ..formats.gaussian_files import StoredCloud, suffix_of
from ..gaussians.axes import WORLD_UP, rotation_between
from ..gaussians.views import EPS2D
from ..meshes.write import WRITERS, companions, write_textured_mesh
from ..surface.textured import METHODS, MeshOptions, mesh_from_gaussians, require_mesh_libraries

MESH_UP = "y"
OPTIONS: dict[str, dict[str, Any]] = {
    "--faces": {"type": int, "help": f"largest number of triangles (default: {MeshOptions.faces})"},
    "--texture": {
        "type": int,
        "help": f"texture width and height, texels (default: {MeshOptions.texture})",
    },
    "--views": {"type": int, "help": f"number of renders to bake (default: {MeshOptions.views})"},
    "--view-size": {
        "type": int,
        "help": f"width and height of a render, pixels (default: {MeshOptions.view_size})",
    },
    "--method": {
        "choices": METHODS,
        "help": f"how the surface is found (default: {MeshOptions.method})",
    },
    "--resolution": {
        "type": int,
        "help": f"grid cells along the longest side (default: {MeshOptions.resolution})",
    },
    "--eps2d": {
        "type": float,
        "help": f"screen-space dilation of the renders, square pixels (default: {EPS2D:g})",
    },
    "--unlit": {
        "action": "store_const",
        "const": True,
        "help": "ask viewers to show the texture without lighting",
    },
}
"""Each is None unless it is given."""


def writes_mesh(args: argparse.Namespace) -> bool:
    """Return whether OUT is a mesh."""
    return suffix_of(args.output) in WRITERS and not args.gaussians


def check_mesh_options(args: argparse.Namespace) -> None:
    """Check options, libraries and output files, before IN is read.

    Raises:
        UserError: an option is out of range or has no effect, a library is missing, or a file
            can't be written.
    """
    if not writes_mesh(args):
        given = [name for name in OPTIONS if getattr(args, _attribute(name)) is not None]
        if given:
            raise UserError(f"{given[0]}: OUT is a file of Gaussians; it is for meshes")
        return
    for path in (args.output, *companions(args.output)):
        require_writable(path, "OUT")
    if args.check:
        raise UserError("--check: OUT is a mesh; it is for files of Gaussians")
    check_options(MeshOptions, mesh_options(args, False), "--")
    require_mesh_libraries()


def mesh_options(args: argparse.Namespace, antialias: bool) -> MeshOptions:
    """Collect the mesh options; those that aren't given have their defaults."""
    names = [_attribute(name) for name in OPTIONS if name != "--unlit"]
    given = {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    return MeshOptions(**given, antialias=antialias)


def write_mesh(args: argparse.Namespace, stored: StoredCloud) -> None:
    """Convert a cloud and write the mesh; print what was written.

    Raises:
        UserError: the Gaussians form no surface, or a file can't be written.
    """
    gaussians = stored.in_axes(WORLD_UP).gaussians
    mesh = mesh_from_gaussians(gaussians, mesh_options(args, stored.antialiased), "--")
    rotation = rotation_between(WORLD_UP, MESH_UP)
    mesh = mesh._replace(vertices=mesh.vertices @ rotation.T)
    write_textured_mesh(args.output, mesh, unlit=bool(args.unlit))
    size = sum(map(os.path.getsize, (Path(args.output), *companions(args.output))))
    print(
        f"{args.output}: {len(mesh.faces):,} triangles, a texture of {mesh.texture.shape[0]} x "
        f"{mesh.texture.shape[1]}, {size_text(size)}"
    )


def _attribute(option: str) -> str:
    """Return the name that argparse gives an option's value."""
    return option.removeprefix("--").replace("-", "_")
