"""The launcher: from a command line to a trained, tested and exported cloud.

``python launch.py --config demo.yaml --train key=value ...``, or the console script
``gaussiandreamer`` with the same arguments. A run is a list of stages: choose the device, load the
extensions, load and check the configuration, build data and system, make the folder, train, test.
What the user can mend ends it with one message and exit code 2, before anything is written."""

import argparse
import contextlib
import logging
import os
import shlex
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, Optional

from ..core.errors import Terminated, UserError
from .options import PROGRAM, announce_device, choose_gpu, find_config, parse_arguments

NOISE = (
    # Lightning's advice that doesn't apply to an endless stream of cameras made on the fly, or to a
    # run that is resumed
    ".*does not have many workers.*",
    ".*Checkpoint directory .* exists and is not empty.*",
    ".*checkpoint that ended before the epoch ended.*",
    ".*ModelCheckpoint with manual optimization.*",
    ".*callbacks used to create the checkpoint need to be provided.*",
    ".*predict returned None.*",
    ".*`isinstance\\(treespec, LeafSpec\\)` is deprecated.*",
)


def console() -> None:
    """Entry point of the console script ``gaussiandreamer``."""
    sys.exit(main())


def main(argv: Optional[Sequence[str]] = None) -> int:
    """Run one command line (default: this process's); returns the exit code.

    0 done; 2 something the user can mend, said in one message; 130, 141 and 143 stopped by Ctrl-C,
    a closed pipe and SIGTERM."""
    spin_briefly()
    argv = list(sys.argv[1:] if argv is None else argv)
    try:
        args = parse_arguments(argv)
    except SystemExit as stop:
        return int(stop.code or 0)
    try:
        with _signals():
            return run(args, argv)
    except UserError as error:
        if args.verbose:
            traceback.print_exc()
        print(f"error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError as error:
        # who read our output has gone, as `| head` does; what is still in its buffer would fail anew at the end
        if args.verbose:
            traceback.print_exc()
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        print(
            f"stopped: nobody reads this run's output any more ({error.strerror})", file=sys.stderr
        )
        return 128 + signal.SIGPIPE
    except (KeyboardInterrupt, Terminated) as stop:
        print("stopped", file=sys.stderr)
        return stop.code if isinstance(stop, Terminated) else 128 + signal.SIGINT
    except SystemExit as stop:
        # nothing of ours does so, and its own code may say that all went well
        *_, place = traceback.extract_tb(stop.__traceback__)
        print(
            f"error: {place.filename}:{place.lineno} ended the run with sys.exit({stop.code!r})",
            file=sys.stderr,
        )
        return 2


def run(args: argparse.Namespace, argv: Sequence[str]) -> int:
    """The stages of one run; see the module's docstring. Returns the exit code."""
    config_paths = [find_config(name) for name in args.config]
    choose_gpu(args.gpu)
    if args.typecheck:
        from ..core import typecheck

        typecheck.install()
    # torch and Lightning are imported from here on, so that --help and mistakes in the arguments
    # cost no seconds
    from .. import register_parts
    from .config import load_config
    from .config_check import check_config
    from .extensions import load_extensions

    configure_logging(args.verbose)
    n_gpus = announce_device(args.gpu)
    register_parts()
    load_extensions()
    cfg = load_config(*config_paths, cli_args=args.overrides, n_gpus=max(n_gpus, 1))
    check_config(cfg)

    from .run import Run

    return Run(cfg, args, config_paths, shlex.join([*PROGRAM, *argv]), n_gpus).run()


class StderrHandler(logging.Handler):
    """Messages as plain lines to what ``sys.stderr`` is at that moment."""

    def emit(self, record: logging.LogRecord) -> None:
        print(self.format(record), file=sys.stderr, flush=True)


def configure_logging(verbose: bool) -> None:
    """Our messages to stderr as plain lines; Lightning's only from warnings up, unless ``verbose``."""
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


def spin_briefly() -> None:
    """Let idle OpenMP threads wait for about 0.1 ms before they sleep, unless the user said how;
    before torch is imported.

    At once asleep, they are woken for each small operation (a fifth of the demo's time); for
    milliseconds awake, as is their default, they hold the cores that our own threads, or other
    programs, wait for. LLVM's and Intel's OpenMP know milliseconds only: none there."""
    waits = {"GOMP_SPINCOUNT": "10000", "KMP_BLOCKTIME": "0"}
    if not os.environ.keys() & {"OMP_WAIT_POLICY", *waits}:
        os.environ.update(waits)


@contextlib.contextmanager
def _signals() -> Iterator[None]:
    """SIGTERM ends the process through ``finally`` blocks, with code 143; afterwards all handlers
    are what they were.
    """

    def end(signum: int, frame: Any) -> None:
        raise Terminated(128 + signum)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    # Lightning leaves Ctrl-C ignored once it has seen one
    earlier = {signum: signal.getsignal(signum) for signum in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        for signum, handler in earlier.items():
            signal.signal(signum, handler)


if __name__ == "__main__":
    console()
