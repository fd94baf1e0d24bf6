"""Convert a file of Gaussians: ``python -m threestudio_gaussiandreamer.convert IN OUT``.

The formats are those of the extensions. A .glb or .obj is a textured mesh of the cloud's surface;
``--gaussians`` writes the Gaussians themselves into a .glb, and a .spz.glb holds them always."""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Optional

from ..core.command import joined_values, run_command
from ..core.errors import UserError
from ..core.files import existing_file, require_other_file, require_writable, through_link
from ..core.options import RULE, check_options, in_range, size_text
from ..formats.gaussian_files import (
    FORMATS,
    WRITTEN,
    StoredCloud,
    read_cloud,
    require_format,
    suffix_of,
    write_cloud,
)
from ..formats.producers import GAUSSIANS, from_producer, producers_of
from ..formats.spz import SPZ_UP, SYSTEM_OF, VERSION, VERSIONS, ZSTD_VERSION, require_version
from ..gaussians.axes import AXES, VIEWER_UP, WORLD_UP, rotation_between
from ..gaussians.gaussians import finite
from ..gaussians.sh import COEFFICIENTS, MAX_DEGREE
from ..gaussians.views import EPS2D
from ..meshes.write import WRITERS, companions, write_textured_mesh
from ..surface.textured import METHODS, MeshOptions, mesh_from_gaussians, require_mesh_libraries
from ..view.run_files import read_any
from .losses import VIEWS, compare, dropped, losses, reference

SIZE = 256
"""Width and height of the views of ``--check`` unless given, pixels."""
RULES = {"harmonics": in_range(0, MAX_DEGREE), "size": in_range(16, 4096, "pixels")}
MESH_OPTIONS = ("faces", "texture", "views", "view_size", "method", "resolution", "eps2d")
"""Those of :class:`.textured.MeshOptions` that can be given; None unless they are."""


def main(argv: Optional[Sequence[str]] = None) -> int:
    """Run one command line; return the exit code of :func:`core.command.run_command`."""
    return run_command(parse, run, argv)


def parse(argv: Optional[Sequence[str]]) -> argparse.Namespace:
    """Parse a command line; exits for ``--help`` and for invalid arguments."""
    parser = argparse.ArgumentParser(
        prog="python -m threestudio_gaussiandreamer.convert",
        description="Convert a file of Gaussians to another format, or to a textured mesh, by "
        "the extensions of IN and OUT.",
    )
    add = parser.add_argument
    producer = "the program that wrote IN, which determines the axes"
    add("--from", dest="producer", choices=producers_of(GAUSSIANS), help=producer)
    up = "which axis of IN is up (default: from the file, else its format's convention)"
    add("--up", choices=AXES, help=up)
    up = f"which axis of OUT is up, for PLYs (default: {VIEWER_UP}, as viewers expect) and SPZ of "
    up += f"version 4 ({' or '.join(SYSTEM_OF)}; default: {SPZ_UP})"
    add("--up-out", choices=AXES, help=up)
    inside = "write the Gaussians themselves into a .glb (KHR_gaussian_splatting), not a mesh"
    add("--gaussians", action="store_true", help=inside)
    version = "version of an SPZ file (default: %(default)s)"
    add("--spz-version", type=int, choices=VERSIONS, default=VERSION, help=version)
    harmonics = "drop the harmonics above this degree, 0 to 3"
    add("--harmonics", type=int, metavar="DEGREE", help=harmonics)
    flag = "whether the Gaussians were trained with antialiasing (default: what IN says)"
    add("--antialiased", action=argparse.BooleanOptionalAction, help=flag)
    check = f"measure the PSNR of OUT to IN in {VIEWS} views"
    add("--check", action="store_true", help=check)
    size = f"width and height of the views of --check, pixels (default: {SIZE})"
    add("--size", type=int, help=size)
    add, default = parser.add_argument_group("for meshes, .glb and .obj").add_argument, MeshOptions
    add("--faces", type=int, help=f"largest number of triangles (default: {default.faces})")
    texture = f"texture width and height, texels (default: {default.texture})"
    add("--texture", type=int, help=texture)
    add("--views", type=int, help=f"number of renders to bake (default: {default.views})")
    view_size = f"width and height of a render, pixels (default: {default.view_size})"
    add("--view-size", type=int, help=view_size)
    method = f"how the surface is found (default: {default.method})"
    add("--method", choices=METHODS, help=method)
    resolution = f"grid cells along the longest side (default: {default.resolution})"
    add("--resolution", type=int, help=resolution)
    eps2d = f"screen-space dilation of the renders, square pixels (default: {EPS2D:g})"
    add("--eps2d", type=float, help=eps2d)
    unlit = "ask viewers to show the texture without lighting"
    add("--unlit", action="store_const", const=True, help=unlit)
    parser.add_argument("source", metavar="IN", help="a file of Gaussians, or a checkpoint")
    parser.add_argument("output", metavar="OUT", help="the file to write")
    return parser.parse_args(joined_values(argv, ["--up", "--up-out"], AXES))


def run(args: argparse.Namespace) -> None:
    """Check options and files, convert, and print what was written and what is lost."""
    args.output = str(through_link(args.output))
    mesh = suffix_of(args.output) in WRITERS and not args.gaussians
    formats = WRITTEN if args.gaussians else tuple(dict.fromkeys((*WRITTEN, *WRITERS)))
    suffix = suffix_of(args.output) if mesh else require_format(args.output, "OUT", formats)
    _check_options(args, suffix, mesh)
    source = existing_file(args.source, "file of Gaussians or checkpoint")
    require_other_file(args.output, source)
    whole = _read(source, args)
    stored = of_degree(whole, args.harmonics)
    if mesh:
        write_mesh(args, stored)
        return
    size = args.size or SIZE
    # before anything is written, since it refuses clouds that can't be rendered
    truth = reference(whole, size) if args.check else None
    spz_up = args.up_out or SPZ_UP
    write_cloud(args.output, stored, suffix, spz_version=args.spz_version, spz_up=spz_up)
    count, written = len(stored.gaussians.means), os.path.getsize(args.output)
    print(
        f"{args.output}: {count:,} Gaussians of degree {stored.gaussians.sh_degree}, "
        f"{size_text(written)}, {written / count:.1f} bytes each"
    )
    for loss in (*dropped(whole, stored), *losses(stored, suffix, args.spz_version)):
        print(f"lost: {loss}")
    if truth:
        mean, worst = compare(truth, read_cloud(args.output))
        views = f"{VIEWS} views of {size} x {size} pixels"
        print(f"check: {mean:.1f} dB in {views}, {worst:.1f} dB in the worst one")


def _check_options(args: argparse.Namespace, suffix: str, mesh: bool) -> None:
    for path in (args.output, *(companions(args.output) if mesh else ())):
        require_writable(path, "OUT")
    for name, rule in RULES.items():
        if (value := getattr(args, name)) is not None:
            rule[RULE](f"--{name}", value)
    out, version = f"OUT is a {suffix} file", args.spz_version
    turned = suffix == ".spz" and version == ZSTD_VERSION
    axes = SYSTEM_OF if turned else AXES if not mesh and FORMATS[suffix].any_up else ()
    fixed = f"--up-out: {out}, whose axes are fixed; it is for PLYs, and y or -y with --spz-version"
    of_mesh = [name for name in (*MESH_OPTIONS, "unlit") if getattr(args, name) is not None]
    no_mesh = [f"--{name.replace('_', '-')}: OUT is a file of Gaussians" for name in of_mesh]
    mistakes = {
        "--from and --up both say which axis of IN is up: give one": args.producer and args.up,
        f"--spz-version: {out}": suffix != ".spz" and version != VERSION,
        f"{fixed} 4": args.up_out and args.up_out not in axes,
        "--size: has no effect without --check": args.size is not None and not args.check,
        f"--gaussians: {out}, which always holds Gaussians": args.gaussians and suffix != ".glb",
        f"{''.join(no_mesh[:1])}; it is for meshes": no_mesh and not mesh,
        "--check: OUT is a mesh; it is for files of Gaussians": mesh and args.check,
    }
    for mistake, made in mistakes.items():
        if made:
            raise UserError(mistake)
    if suffix == ".spz":
        require_version(version)
    if mesh:
        check_options(MeshOptions, mesh_options(args, False), "--")
        require_mesh_libraries()


def _read(source: Path, args: argparse.Namespace) -> StoredCloud:
    """Read IN and apply the options but ``--harmonics``."""
    stored = read_any(source, args.up, "IN")
    if not len(stored.gaussians.means):
        raise UserError(f"{args.source} holds no Gaussians that can be drawn: nothing is written")
    if args.antialiased is not None:
        stored = stored._replace(antialiased=args.antialiased)
    if args.producer:
        stored = from_producer(stored, args.producer, suffix_of(source.name))
    stored = stored.in_axes(args.up_out or VIEWER_UP)
    return stored._replace(gaussians=finite(stored.gaussians, args.source))


def of_degree(stored: StoredCloud, degree: Optional[int]) -> StoredCloud:
    """Return the cloud without harmonics above a degree, and then without ``pruned_to``."""
    if degree is None or stored.gaussians.sh_degree <= degree:
        return stored
    sh = stored.gaussians.sh[:, : COEFFICIENTS[degree]]
    return stored._replace(gaussians=stored.gaussians._replace(sh=sh), pruned_to=None)


def mesh_options(args: argparse.Namespace, antialias: bool) -> MeshOptions:
    """Collect the mesh options; those that aren't given have their defaults."""
    given = {name: getattr(args, name) for name in MESH_OPTIONS}
    given = {name: value for name, value in given.items() if value is not None}
    return MeshOptions(**given, antialias=antialias)


def write_mesh(args: argparse.Namespace, stored: StoredCloud) -> None:
    """Convert a cloud and write the mesh; print what was written."""
    gaussians = stored.in_axes(WORLD_UP).gaussians
    mesh = mesh_from_gaussians(gaussians, mesh_options(args, stored.antialiased), "--")
    rotation = rotation_between(WORLD_UP, "y")
    mesh = mesh._replace(vertices=mesh.vertices @ rotation.T)
    write_textured_mesh(args.output, mesh, unlit=bool(args.unlit))
    size = sum(map(os.path.getsize, (Path(args.output), *companions(args.output))))
    print(
        f"{args.output}: {len(mesh.faces):,} triangles, a texture of {mesh.texture.shape[0]} x "
        f"{mesh.texture.shape[1]}, {size_text(size)}"
    )
