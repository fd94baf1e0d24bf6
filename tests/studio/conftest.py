"""One studio for all of its tests."""

import pytest

from benchmarks.viewers.browser import chromium
from tests.studio.tab import opened


@pytest.fixture(scope="session")
def studio(tmp_path_factory):
    """A studio with an empty shelf, open in headless Chromium."""
    if chromium() is None:
        pytest.skip("no Chromium is installed")
    pytest.importorskip("viser")
    with opened(tmp_path_factory.mktemp("studio") / "outputs") as tab:
        yield tab
