"""Convert a file of Gaussians: ``python -m threestudio_gaussiandreamer.convert IN OUT``.

The formats are those of the extensions: .ply, .compressed.ply, .spz, .sog, .glb, .usda and .usdz
are read and written, .splat, .ksplat, meta.json (SOG), .gltf, .usd and .usdc are read; IN may also
be a checkpoint. The command says what OUT can't hold of IN, and ``--check`` measures the PSNR
between them.

A .glb or .obj is a textured mesh of the cloud's surface; ``--gaussians`` writes the Gaussians
themselves into a .glb, and a .spz.glb holds them always, as SPZ, which CesiumJS needs."""

import argparse
import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Optional

from ..core.command import joined_values, run_command
from ..core.errors import UserError
from ..core.files import existing_file, require_other_file, require_writable, through_link
from ..core.memory import size_text
from ..core.options import check_options, in_range
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
from ..gaussians.axes import AXES, VIEWER_UP
from ..gaussians.gaussians import finite
from ..gaussians.sh import COEFFICIENTS, MAX_DEGREE
from ..meshes.write import WRITERS
from ..view.run_files import read_any
from . import to_mesh
from .check import VIEWS, compare, reference
from .losses import dropped, losses

SIZE = 256
"""Width and height of the views of ``--check`` unless given, pixels."""


@dataclass
class ConvertOptions:
    """The numeric options, with their ranges."""

    harmonics: Optional[int] = field(default=None, metadata=in_range(0, MAX_DEGREE))
    size: Optional[int] = field(default=None, metadata=in_range(16, 4096, "pixels"))


OPTIONS: dict[str, dict[str, Any]] = {
    "--from": {
        "dest": "producer",
        "choices": producers_of(GAUSSIANS),
        "help": "the program that wrote IN, which determines the axes",
    },
    "--up": {
        "choices": AXES,
        "help": "which axis of IN is up (default: from the file, else its format's convention)",
    },
    "--up-out": {
        "choices": AXES,
        "help": f"which axis of OUT is up, for PLYs (default: {VIEWER_UP}, as viewers expect) and "
        f"SPZ of version 4 ({' or '.join(SYSTEM_OF)}; default: {SPZ_UP})",
    },
    "--gaussians": {
        "action": "store_true",
        "help": "write the Gaussians themselves into a .glb (KHR_gaussian_splatting), not a mesh",
    },
    "--spz-version": {
        "type": int,
        "choices": VERSIONS,
        "default": VERSION,
        "help": "version of an SPZ file (default: %(default)s)",
    },
    "--harmonics": {
        "type": int,
        "metavar": "DEGREE",
        "help": "drop the harmonics above this degree, 0 to 3",
    },
    "--antialiased": {
        "action": argparse.BooleanOptionalAction,
        "help": "whether the Gaussians were trained with antialiasing (default: what IN says)",
    },
    "--check": {"action": "store_true", "help": f"measure the PSNR of OUT to IN in {VIEWS} views"},
    "--size": {
        "type": int,
        "help": f"width and height of the views of --check, pixels (default: {SIZE})",
    },
}


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
    for name, settings in OPTIONS.items():
        parser.add_argument(name, **settings)
    meshes = parser.add_argument_group("for meshes, .glb and .obj")
    for name, settings in to_mesh.OPTIONS.items():
        meshes.add_argument(name, **settings)
    parser.add_argument("source", metavar="IN", help="a file of Gaussians, or a checkpoint")
    parser.add_argument("output", metavar="OUT", help="the file to write")
    return parser.parse_args(joined_values(argv, ["--up", "--up-out"], AXES))


def run(args: argparse.Namespace) -> None:
    """Check options and files, convert, and print what was written and what is lost.

    Raises:
        UserError: an option is invalid, a file can't be read or written, or it holds no Gaussians.
    """
    args.output = str(through_link(args.output))
    mesh = to_mesh.writes_mesh(args)
    formats = WRITTEN if args.gaussians else tuple(dict.fromkeys((*WRITTEN, *WRITERS)))
    suffix = suffix_of(args.output) if mesh else require_format(args.output, "OUT", formats)
    _check_options(args, suffix, mesh)
    source = existing_file(args.source, "file of Gaussians or checkpoint")
    require_other_file(args.output, source)
    whole = _read(source, args)
    stored = of_degree(whole, args.harmonics)
    if mesh:
        to_mesh.write_mesh(args, stored)
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
        found = compare(truth, read_cloud(args.output))
        print(
            f"check: {found.mean:.1f} dB in {VIEWS} views of {size} x {size} pixels, "
            f"{found.worst:.1f} dB in the worst one"
        )


def _check_options(args: argparse.Namespace, suffix: str, mesh: bool) -> None:
    require_writable(args.output, "OUT")
    if args.producer and args.up:
        raise UserError("--from and --up both say which axis of IN is up: give one")
    if suffix == ".spz":
        require_version(args.spz_version)
    elif args.spz_version != VERSION:
        raise UserError(f"--spz-version: OUT is a {suffix} file")
    if args.up_out and args.up_out not in _axes_of(suffix, args.spz_version, mesh):
        raise UserError(
            f"--up-out: OUT is a {suffix} file, whose axes are fixed; it is for PLYs, and y or -y "
            "with --spz-version 4"
        )
    check_options(ConvertOptions, ConvertOptions(args.harmonics, args.size), "--")
    if args.size is not None and not args.check:
        raise UserError("--size: has no effect without --check")
    if args.gaussians and suffix != ".glb":
        raise UserError(f"--gaussians: OUT is a {suffix} file, which always holds Gaussians")
    to_mesh.check_mesh_options(args)


def _axes_of(suffix: str, spz_version: int, mesh: bool) -> Collection[str]:
    """Return the up axes that OUT can have."""
    if suffix == ".spz" and spz_version == ZSTD_VERSION:
        return SYSTEM_OF
    return AXES if not mesh and FORMATS[suffix].any_up else ()


def _read(source: Path, args: argparse.Namespace) -> StoredCloud:
    """Read IN and apply the options but ``--harmonics``.

    Raises:
        UserError: it can't be read, or holds no Gaussians that can be drawn.
    """
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
    """Return the cloud without harmonics above a degree; as it is if there are none. What it has
    been pruned to isn't known then.
    """
    if degree is None or stored.gaussians.sh_degree <= degree:
        return stored
    sh = stored.gaussians.sh[:, : COEFFICIENTS[degree]]
    return stored._replace(gaussians=stored.gaussians._replace(sh=sh), pruned_to=None)
