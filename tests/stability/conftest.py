"""Fixtures of the stability tests: `measured` and `fault`, and the report of measured values."""

import inspect
import json
import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Callable, Optional

import pytest

from tests.stability.backends import backends_of, cuda_on_the_host
from tests.stability.rows import ROWS
from tests.stability.small_runs import EVERY_STEP, Ended, launch
from threestudio_gaussiandreamer import register_parts

register_parts()

REPORT = pytest.StashKey[list]()


class Measured:
    """Record what a test measured, and assert the row's bar."""

    def __init__(self, properties: list):
        self.properties = properties

    def __call__(
        self,
        value: Any,
        unit: str = "",
        *,
        what: str = "",
        at_most: Optional[float] = None,
        at_least: Optional[float] = None,
    ) -> None:
        """Record a number (quantity ``what``, in ``unit``) and assert its bound, or record a text
        result that was asserted before.

        Of several values of the same ``what`` the report shows the worst: the smallest if
        ``at_least`` is given, else the largest.
        """
        worst = "min" if at_least is not None else "max"
        value = value if isinstance(value, str) else float(getattr(value, "item", lambda: value)())
        self.properties.append(
            ("measured", {"value": value, "unit": unit, "what": what, "worst": worst})
        )
        assert at_most is None or value <= at_most, (
            f"{what or 'measured'} {value} {unit} > {at_most}"
        )
        assert at_least is None or value >= at_least, (
            f"{what or 'measured'} {value} {unit} < {at_least}"
        )


@pytest.fixture(autouse=True)
def stand_in_for_a_gpu(request, monkeypatch) -> None:
    if "backend" in request.fixturenames and request.getfixturevalue("backend") == "cuda":
        cuda_on_the_host(monkeypatch)


@pytest.fixture
def measured(request) -> Measured:
    return Measured(request.node.user_properties)


@pytest.fixture
def said() -> Iterator[list[str]]:
    """Collect the package's log messages, also if the launcher has its own handler."""
    messages: list[str] = []
    listener, logger = logging.Handler(), logging.getLogger("threestudio_gaussiandreamer")
    listener.emit = lambda record: messages.append(record.getMessage())
    level = logger.level
    logger.addHandler(listener)
    logger.setLevel(logging.INFO)
    yield messages
    logger.removeHandler(listener)
    logger.setLevel(level)


@pytest.fixture
def fault(request):
    """``fault(deviation, ours, emulation, at_most)``: assert that our implementation holds the bar
    and that the emulated fault does not.

    ``deviation`` is a function of an implementation; use ``at_least`` instead of ``at_most`` if
    more is better; ``raises`` names the exception of an emulation that crashes instead of returning
    a wrong number.
    """

    def hold(
        deviation: Callable[[Any], float],
        ours: Any,
        emulation: Any,
        at_most: float = 0.0,
        unit: str = "",
        *,
        at_least: Optional[float] = None,
        raises: type[Exception] = AssertionError,
    ) -> None:
        bound = {"at_most": at_most} if at_least is None else {"at_least": at_least}
        Measured(request.node.user_properties)(deviation(ours), unit, **bound)
        emulated = Measured([])
        with pytest.raises(raises) as caught:
            emulated(deviation(emulation), unit, **bound)
        crashed = {"value": caught.type.__name__, "unit": "", "what": "", "worst": "max"}
        measured = emulated.properties[0][1] if emulated.properties else crashed
        request.node.user_properties.append(("emulation", measured))

    return hold


def pytest_generate_tests(metafunc) -> None:
    """Run a test with the argument ``backend`` with each of them, unless it names some."""
    marks = metafunc.definition.iter_markers("parametrize")
    if "backend" in metafunc.fixturenames and all("backend" not in mark.args[0] for mark in marks):
        metafunc.parametrize("backend", backends_of())


def pytest_addoption(parser) -> None:
    parser.addoption(
        "--stability-report", metavar="FILE", type=Path, help="write what the rows measured as JSON"
    )


def pytest_configure(config) -> None:
    config.addinivalue_line(
        "markers", "stability(group, name, bar): the row of the stability tables that a test is"
    )
    config.stash[REPORT] = []


def pytest_collection_modifyitems(items) -> None:
    for item in items:
        marker = item.get_closest_marker("stability")
        if marker:
            item.user_properties.append(("row", _describe(item, *marker.args)))


def _describe(item: pytest.Item, group: str, name: str, bar: Optional[str]) -> dict:
    reason = inspect.getdoc(item.function) or ""
    if bar and not reason:
        raise pytest.UsageError(f"{item.nodeid}: a changed bar needs a docstring that proves it")
    return {
        **ROWS[group, name]._asdict(),
        "changed_bar": bar,
        "reason": reason,
        "file": item.path.name,
        "test": item.originalname,
    }


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item):
    report = (yield).get_result()
    properties = dict(item.user_properties)
    if report.when == "call" and "row" in properties:
        values = {
            kind: [_plain(x) for key, x in item.user_properties if key == kind]
            for kind in ("measured", "emulation")
        }
        item.config.stash[REPORT].append({**properties["row"], "outcome": report.outcome, **values})


def _plain(entry: dict) -> dict:
    """Replace infinity and NaN, which JSON does not support, by text."""
    value = entry["value"]
    return {
        **entry,
        "value": value if isinstance(value, str) or math.isfinite(value) else str(value),
    }


def pytest_sessionfinish(session) -> None:
    path = session.config.getoption("--stability-report", default=None)
    if path:
        path.write_text(json.dumps(session.config.stash[REPORT], indent=1) + "\n")


@pytest.fixture(scope="session")
def whole(tmp_path_factory) -> Ended:
    """Return an uninterrupted run."""
    ended = launch(tmp_path_factory.mktemp("whole"), *EVERY_STEP)
    assert ended.code == 0, ended.err
    return ended
