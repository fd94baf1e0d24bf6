"""Fixtures of the stability tests: `measured` and `fault`, and the report of measured values."""

import functools
import inspect
import json
import logging
import math
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.stability.backends import backends_of, cuda_on_the_host
from tests.stability.small_runs import EVERY_STEP, Ended, launch
from threestudio_gaussiandreamer import register_parts

register_parts()

REPORT: list[dict] = []


def measure(record, value, unit="", *, what="", at_most=None, at_least=None) -> None:
    """Record a number (quantity ``what``, in ``unit``) and assert its bound, or record a text.

    Of several values of the same ``what`` the report shows the worst: the smallest if ``at_least``
    is given, else the largest.
    """
    value = value if isinstance(value, str) else float(getattr(value, "item", lambda: value)())
    plain = value if isinstance(value, str) or math.isfinite(value) else str(value)
    record((plain, unit, what, "min" if at_least is not None else "max"))
    said = f"{what or 'measured'} {value} {unit}, not"
    assert at_most is None or value <= at_most, f"{said} at most {at_most}"
    assert at_least is None or value >= at_least, f"{said} at least {at_least}"


@pytest.fixture(autouse=True)
def stand_in_for_a_gpu(request, monkeypatch) -> None:
    if "backend" in request.fixturenames and request.getfixturevalue("backend") == "cuda":
        cuda_on_the_host(monkeypatch)


@pytest.fixture
def measured(record_property) -> Callable[..., None]:
    return functools.partial(measure, functools.partial(record_property, "measured"))


@pytest.fixture
def said(caplog) -> pytest.LogCaptureFixture:
    """Collect log messages, also the package's of level INFO."""
    caplog.set_level(logging.INFO, "threestudio_gaussiandreamer")
    return caplog


@pytest.fixture
def fault(measured, record_property) -> Callable[..., None]:
    """``fault(deviation, ours, theirs, at_most)``: assert that ``deviation(ours)`` holds the bar,
    and that of the emulated fault does not, or raises; with ``at_least`` if more is better.
    """

    def hold(
        deviation, ours, theirs, at_most=0.0, unit="", *, at_least=None, raises=AssertionError
    ):
        bound = {"at_most": at_most} if at_least is None else {"at_least": at_least}
        measured(deviation(ours), unit, **bound)
        found: list[tuple] = []
        with pytest.raises(raises) as caught:
            measure(found.append, deviation(theirs), unit, **bound)
        record_property("emulation", (*found, (caught.type.__name__, "", "", "max"))[0])

    return hold


def pytest_generate_tests(metafunc) -> None:
    """Run a test with the argument ``backend`` with each of them, unless it names some."""
    marks = metafunc.definition.iter_markers("parametrize")
    if "backend" in metafunc.fixturenames and all("backend" not in mark.args[0] for mark in marks):
        metafunc.parametrize("backend", backends_of())


def pytest_addoption(parser) -> None:
    parser.addoption("--stability-report", metavar="FILE", type=Path, help="measurements as JSON")


def pytest_configure(config) -> None:
    marker = "stability(group, name, bar): the row of the stability tables that a test is"
    config.addinivalue_line("markers", marker)


def pytest_collection_modifyitems(items) -> None:
    for item in items:
        if marker := item.get_closest_marker("stability"):
            *row, bar = marker.args
            reason = inspect.getdoc(item.function) or ""
            assert reason or not bar, f"{item.nodeid}: a changed bar needs a docstring"
            entry = {"reason": reason, "file": item.path.stem, "name": item.originalname}
            item.user_properties.append(("row", {"row": row, "bar": bar, **entry}))


def pytest_runtest_logreport(report) -> None:
    if report.when == "call" and (row := dict(report.user_properties).get("row")):
        kinds = ("measured", "emulation")
        values = {kind: [x for key, x in report.user_properties if key == kind] for kind in kinds}
        REPORT.append({**row, "outcome": report.outcome, **values})


def pytest_sessionfinish(session) -> None:
    if path := session.config.getoption("--stability-report", default=None):
        path.write_text(json.dumps(REPORT, indent=1) + "\n")


@pytest.fixture(scope="session")
def whole(tmp_path_factory) -> Ended:
    """Return an uninterrupted run."""
    return launch(tmp_path_factory.mktemp("whole"), *EVERY_STEP)
