"""Extension that prints when the stages of a demo end: one line of JSON with the ``ends``, pairs of
processor seconds of the process and of the time of day, in order.

``demo_stages.py`` copies this file to ``custom/probe/__init__.py`` in the clone."""

import atexit
import functools
import json
import resource
import time
from typing import Any

from threestudio_gaussiandreamer.host import find

MARK = "MEASURED "
SYSTEM = find("gaussiandreamer-system")
ends: dict[str, tuple[float, float]] = {}


def mark_end(stage: str) -> None:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    ends.setdefault(stage, (usage.ru_utime + usage.ru_stime, time.time()))


def mark_start(method: str, stage: str) -> None:
    """Let ``stage`` end where the system's ``method`` begins."""
    body = getattr(SYSTEM, method)

    @functools.wraps(body)
    def marked(*args: Any, **options: Any) -> Any:
        mark_end(stage)
        return body(*args, **options)

    setattr(SYSTEM, method, marked)


def print_all() -> None:
    mark_end("turntable, export, pages")
    print(f"\n{MARK}{json.dumps(ends)}", flush=True)


mark_end("import")
mark_start("configure_optimizers", "configuration, parts, trainer")
mark_start("on_train_start", "prior, cloud")
mark_start("on_train_end", "training")
mark_start("on_test_start", "evaluation on held-out views")
atexit.register(print_all)
