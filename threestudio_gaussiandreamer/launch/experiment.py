"""The launcher: ``python launch.py --config demo.yaml --train key=value ...``, or the console
script ``gaussiandreamer`` with the same arguments.

A run is a list of stages: choose the device, load the extensions, load and check the configuration,
make the folder, build data and system, train, test. Errors that the user can correct end it with
one message and exit code 2; those that are found before training leave no files."""

import argparse
import gc
import logging
import os
import shlex
import sys
import warnings
from collections.abc import Sequence
from typing import Any, Optional

from ..core.command import run_command
from .options import LIST_PARTS, PROGRAM, announce_device, choose_gpu, find_config, parse_arguments

NOISE = (
    # warnings of Lightning that don't apply to an infinite dataset of computed cameras, or to a run
    # that is resumed
    ".*does not have many workers.*",
    ".*Checkpoint directory .* exists and is not empty.*",
    ".*checkpoint that ended before the epoch ended.*",
    ".*ModelCheckpoint with manual optimization.*",
    ".*callbacks used to create the checkpoint need to be provided.*",
    ".*predict returned None.*",
    ".*`isinstance\\(treespec, LeafSpec\\)` is deprecated.*",
)


def console() -> None:
    """Run the console script ``gaussiandreamer``."""
    sys.exit(main())


def main(argv: Optional[Sequence[str]] = None) -> int:
    """Run one command line (default: ``sys.argv``) and return the exit code: 0 on success, 2 after
    an error that the user can correct, and 129, 130, 141 or 143 if SIGHUP, Ctrl-C, a closed pipe or
    SIGTERM stopped the run.
    """
    limit_openmp_spin()
    argv = list(sys.argv[1:] if argv is None else argv)
    if LIST_PARTS in argv:
        return run_command(lambda _: None, lambda _: list_parts())
    return run_command(parse_arguments, lambda args: prepare(args, argv).run(), argv)


def list_parts() -> None:
    """Print the registered parts, with those in ``custom/``: a line for each kind and part."""
    from .. import register_parts

    register_parts()
    from .parts import load_extensions, parts_by_kind

    load_extensions()
    for kind, parts in parts_by_kind().items():
        print(kind, *(f"  {part}" for part in parts), sep="\n")


def prepare(args: argparse.Namespace, argv: Sequence[str], **options: Any) -> Any:
    """Check everything, and return the :class:`.run.Run`, which is given ``options``, too."""
    config_paths = [find_config(name) for name in args.config]
    choose_gpu(args.gpu, args.overrides)
    if args.typecheck:
        from ..core import typecheck

        typecheck.install()
    # torch and Lightning are imported only here, so that --help is answered immediately; without
    # garbage collection, which takes a fifth of the time, but in a notebook with other garbage
    is_first = gc.isenabled() and "torch" not in sys.modules
    if is_first:
        gc.disable()
    try:
        from .. import register_parts
        from .config import load_config, read_source
        from .config_check import check_config
        from .parts import load_extensions
        from .run import Run

        register_parts()
    finally:
        if is_first:
            gc.freeze()
            gc.enable()
    configure_logging(args.verbose)
    # read only once, since the file may change while the parts are built
    sources = [(path, read_source(path)) for path in config_paths]
    n_gpus = announce_device(args.gpu)
    load_extensions()
    cfg = load_config(*config_paths, cli_args=args.overrides, n_gpus=n_gpus)
    check_config(cfg)
    return Run(cfg, args, sources, shlex.join([*PROGRAM, *argv]), n_gpus, **options)


class StderrHandler(logging.Handler):
    """Writes messages as plain lines to what ``sys.stderr`` is at that moment."""

    def emit(self, record: logging.LogRecord) -> None:
        print(self.format(record), file=sys.stderr, flush=True)


def configure_logging(verbose: bool) -> None:
    """Send our messages to stderr; Lightning's from warnings up, unless ``verbose``."""
    logger = logging.getLogger(__package__.partition(".")[0])
    if not logger.handlers:
        logger.addHandler(StderrHandler())
        logger.propagate = False
    logger.setLevel(logging.DEBUG if verbose else logging.INFO)
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.INFO if verbose else logging.WARNING)
    if not verbose:
        for message in NOISE:
            warnings.filterwarnings("ignore", message=message)


def limit_openmp_spin() -> None:
    """Let idle OpenMP threads spin for about 0.1 ms before they sleep, unless the user has set it:
    a fifth of the demo's time (reports/speed.md). Call it before torch is imported.
    """
    waits = {"GOMP_SPINCOUNT": "10000", "KMP_BLOCKTIME": "0"}
    if not os.environ.keys() & {"OMP_WAIT_POLICY", *waits}:
        os.environ.update(waits)


if __name__ == "__main__":
    console()
