"""Look at clouds and runs: ``python -m threestudio_gaussiandreamer.view cloud.ply [--html]``."""

import argparse
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Optional

from ..core.command import joined_values, run_command
from ..core.errors import UserError
from ..core.files import (
    existing_file,
    is_folder,
    require_other_file,
    require_writable,
    through_link,
)
from ..gaussians.axes import AXES
from ..gaussians.views import EPS2D
from ..splatting import PRESETS
from .live import require_server, serve, serve_until_stopped
from .page import cloud_page, write_page
from .run_files import RunFiles, cloud_file, is_run, read_any
from .run_index import write_gallery, write_index

OPTIONS = ("title", "up", "eps2d", "preset", "antialias", "bound_colors", "background")
"""Arguments of :func:`.page.cloud_page`; all but the first two are of pages only."""


def parse(argv: Optional[Sequence[str]]) -> argparse.Namespace:
    """Parse the arguments of the command; exits as :mod:`argparse` does."""
    parser = argparse.ArgumentParser(
        prog="python -m threestudio_gaussiandreamer.view",
        description="Serve a cloud of Gaussians to browsers, or write it as one HTML file, or the "
        "index of a run or of a folder of runs.",
    )
    add, flag = parser.add_argument, argparse.BooleanOptionalAction
    add("path", metavar="PATH", help="a file of Gaussians, a checkpoint, a run or runs")
    html = "write a file instead of serving (default: PATH with the ending .html, or index.html in "
    add("--html", metavar="OUT", nargs="?", const="", help=f"{html}a folder)")
    add("--host", default="127.0.0.1", help="address to serve on (this machine)")
    add("--port", type=int, default=8080, help="port to serve on (8080)")
    add("--title", help="what the page is called (default: the run's prompt, or the file's name)")
    add("--eps2d", type=float, help=f"dilation, square pixels (default: the run's, or {EPS2D:g})")
    add("--preset", choices=PRESETS, help="smallest alpha (default: the run's, or balanced)")
    add("--antialias", action=flag, help="keep the energy of small Gaussians (default: the run's)")
    add("--bound-colors", action=flag, help="clamp colours to [0, 1] (default: the run's, or yes)")
    add("--background", metavar="RRGGBB", help="behind the cloud (default: the run's, or ffffff)")
    add("--up", choices=AXES, help="the axis of PATH that is up (default: the file's, or format's)")
    return parser.parse_args(joined_values(argv, ["--up"], AXES))


def run(args: argparse.Namespace) -> None:
    """Serve a cloud, or write its page, the index of a run, or the gallery of a folder of runs."""
    if args.html is None:
        if given := _given(args, OPTIONS[2:]):
            raise UserError(f"{' '.join(given)}: is for the page that --html writes")
        require_server(args.host, args.port)
        source = cloud_file(args.path, ", or give --html for the gallery of a folder of runs")
        address, title = (args.host, args.port), args.title or source.name
        serve_until_stopped(serve(read_any(source, args.up), *address, title))
    elif is_folder(args.path):
        run_folder(Path(args.path).expanduser(), args)
    else:
        source = existing_file(args.path, "file of Gaussians or checkpoint")
        out = through_link(args.html) if args.html else source.with_suffix(".html")
        require_writable(out, "--html")
        require_other_file(out, source, "--html OUT is PATH")
        if out.suffix.lower() not in (".html", ".htm"):
            raise UserError(f"--html {args.html}: expected a name that ends in .html")
        write_cloud_page(source, out, args)


def write_cloud_page(source: Path, out: Path, args: argparse.Namespace) -> None:
    """Write the page of a file or checkpoint, as its run has drawn it or as the options say."""
    shown, options = cloud_page(source, **{name: getattr(args, name) for name in OPTIONS})
    write_page(out, shown, options)
    count = len(shown.cloud.gaussians.means)
    print(f"{out}: {count:,} Gaussians, {out.stat().st_size / 1e6:.2f} MB")


main = functools.partial(run_command, parse, run)


def run_folder(folder: Path, args: argparse.Namespace) -> None:
    """Write the index of a run, with the page of its cloud if there is none, or a gallery."""
    given = _given(args, OPTIONS)
    if args.html or given:
        raise UserError(
            f"{' '.join(given) or '--html OUT'}: is for a cloud, and {args.path!r} is a folder, "
            "whose index.html is written into it"
        )
    if not is_run(folder):
        print(write_gallery(folder))
        return
    found = RunFiles(folder)
    page = found.export and found.export / "view.html"
    if found.cloud and not page.exists():
        write_cloud_page(found.cloud, page, args)
    print(write_index(folder))


def _given(args: argparse.Namespace, names: Sequence[str]) -> list[str]:
    """Return the options of these names that are given, as they are written."""
    return [f"--{name.replace('_', '-')}" for name in names if getattr(args, name) is not None]
