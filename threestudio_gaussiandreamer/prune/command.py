"""Prune a finished cloud: ``python -m threestudio_gaussiandreamer.prune IN OUT --psnr 40``

From PLY to PLY the axes are kept; otherwise a PLY is written with -y up, as viewers expect. OUT
stores the PSNR to the original cloud, so that pruning it again counts from the original."""

import argparse
import functools
import re
import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, Optional

from ..core.command import run_command
from ..core.files import require_other_file, require_writable, through_link
from ..core.options import check_options
from ..formats.gaussian_files import PRUNED_FORMATS, require_format, write_cloud
from ..gaussians.axes import AXES, VIEWER_UP
from ..gaussians.views import EPS2D
from .options import PruneOptions
from .pipeline import REPORTS, prune_to_budget, read, write_report

GAIN = r"[-+]?[\d.]+(e[-+]?\d+)?\s*(dB)?"


def parse(argv: Optional[Sequence[str]]) -> argparse.Namespace:
    """Parse a command line; exits for ``--help`` and for invalid arguments."""
    parser = argparse.ArgumentParser(
        prog="python -m threestudio_gaussiandreamer.prune",
        description="Prune a finished cloud of Gaussians to a budget; beside OUT: OUT.json, "
        "the report, and OUT.png, before and after.",
    )
    parser.add_argument("source", metavar="IN", help="a file of Gaussians, or a checkpoint")
    parser.add_argument("output", metavar="OUT", help="the PLY or SPZ file to write")
    group = parser.add_argument_group("the budget, one of")
    add = group.add_mutually_exclusive_group(required=True).add_argument
    add("--count", help="how many Gaussians to keep")
    add("--bytes", help="the largest size of OUT, such as 500kB or 2MB")
    psnr = "smallest PSNR of the pruned cloud's views to the unpruned one's, dB, such as 40"
    add("--psnr", help=psnr)
    within = "what the pruned cloud may lose against the truth, such as 0.1dB: see --quality"
    add("--within", help=within)
    auto = "as many as are needed, so that twice as many would gain less than DB (default: 0.5)"
    add("--auto", metavar="DB", nargs="?", const="0.5", help=auto)
    add = parser.add_argument
    quality = (
        "dB of the unpruned cloud to the truth, such as 35: --within needs it, and for --auto "
    )
    add("--quality", type=float, help=f"{quality}it is 40 if it isn't given")
    size = "pixels each way of the views, for which all dB hold (default: %(default)d)"
    add("--size", type=int, default=PruneOptions.size, help=size)
    steps = "recovery steps after each round (default: %(default)d)"
    add("--steps", type=int, default=PruneOptions.steps, help=steps)
    eps2d = "screen-space dilation of the viewer, square pixels (default: %(default)g)"
    add("--eps2d", type=float, default=EPS2D, help=eps2d)
    flag = (
        "the viewer keeps the energy of small Gaussians (default: if IN says that it was trained "
    )
    add("--antialias", action="store_true", help=f"{flag}so)")
    up = "which axis of IN is up (default: from the file, else its format's convention)"
    add("--up", choices=AXES, help=up)
    words = list(sys.argv[1:] if argv is None else argv)
    for at, word in enumerate(words):
        if word == "--auto" and not re.fullmatch(GAIN, "".join(words[at + 1 : at + 2])):
            words[at] = "--auto=0.5"  # the next word isn't its value
    return parser.parse_args(words)


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Check options and files, prune, and write the files; return the report."""
    options = PruneOptions(**{x.name: getattr(args, x.name) for x in fields(PruneOptions)})
    check_options(PruneOptions, options, "--")
    args.output = str(through_link(args.output))
    suffix = require_format(args.output, "OUT", PRUNED_FORMATS)
    for ending in ("", *REPORTS):
        require_writable(args.output + ending, f"OUT{ending}")
    require_other_file(args.output, args.source)
    stored = read(args.source, args.up)
    options.antialias = options.antialias or stored.antialiased
    if suffix == ".ply" and Path(args.source).suffix.lower() != ".ply":
        stored = stored.in_axes(VIEWER_UP)  # from a PLY, the axes stay as they are
    result = prune_to_budget(stored, options, suffix, "--")
    write_cloud(args.output, result.after)
    return write_report(args.output, result, suffix, options)


main = functools.partial(run_command, parse, run)
