"""Prune a finished cloud to a budget: ``python -m threestudio_gaussiandreamer.prune IN OUT
--psnr 40``.

IN is a file of Gaussians in any format that is read (docs/formats.md), or a checkpoint;
OUT is a PLY or SPZ file. From PLY to PLY the axes are kept; otherwise a PLY is written with -y up,
as viewers expect. The report is written to OUT.json, and views of the cloud before (top) and after
pruning to OUT.png.

OUT stores the PSNR to the original cloud that ``--psnr`` or ``--within`` has guaranteed, so that
pruning it again counts from the original: with the same budget or a stricter one nothing is
removed."""

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
from .pipeline import prune_to_budget, read
from .report import REPORTS, write_report

BUDGETS = {
    "--count": "how many Gaussians to keep",
    "--bytes": "the largest size of OUT, such as 500kB or 2MB",
    "--psnr": "smallest PSNR of the pruned cloud's views to the unpruned one's, dB, such as 40",
    "--within": "what the pruned cloud may lose against the truth, such as 0.1dB: see --quality",
}
AUTO = "as many as are needed, so that twice as many would gain less than DB (default: 0.5)"
GAIN = r"[-+]?[\d.]+(e[-+]?\d+)?\s*(dB)?"
OPTIONS: dict[str, dict[str, Any]] = {
    "--quality": {
        "type": float,
        "help": "dB of the unpruned cloud to the truth, such as 35: --within needs it, and for "
        "--auto it is 40 if it isn't given",
    },
    "--size": {
        "type": int,
        "default": PruneOptions.size,
        "help": "pixels each way of the views, for which all dB hold (default: %(default)d)",
    },
    "--steps": {
        "type": int,
        "default": PruneOptions.steps,
        "help": "recovery steps after each round (default: %(default)d)",
    },
    "--eps2d": {
        "type": float,
        "default": EPS2D,
        "help": "screen-space dilation of the viewer, square pixels (default: %(default)g)",
    },
    "--antialias": {
        "action": "store_true",
        "help": "the viewer keeps the energy of small Gaussians (default: if IN says that it was "
        "trained so)",
    },
    "--up": {
        "choices": AXES,
        "help": "which axis of IN is up (default: from the file, else its format's convention)",
    },
}


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
    budget = group.add_mutually_exclusive_group(required=True)
    for name, text in BUDGETS.items():
        budget.add_argument(name, help=text)
    budget.add_argument("--auto", metavar="DB", nargs="?", const="0.5", help=AUTO)
    for name, settings in OPTIONS.items():
        parser.add_argument(name, **settings)
    words = list(sys.argv[1:] if argv is None else argv)
    for at, word in enumerate(words):
        if word == "--auto" and not re.fullmatch(GAIN, "".join(words[at + 1 : at + 2])):
            words[at] = "--auto=0.5"  # the next word isn't its value
    return parser.parse_args(words)


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Check options and files, prune, and write the files; return the report.

    Raises:
        UserError: an option is invalid, a file can't be read or written, or the budget can't be
            met.
    """
    options = PruneOptions(
        **{option.name: getattr(args, option.name) for option in fields(PruneOptions)}
    )
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
