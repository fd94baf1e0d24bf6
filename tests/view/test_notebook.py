"""A cloud in the output of a notebook's cell."""

import html
import re

import pytest

from benchmarks.viewers.browser import chromium
from benchmarks.viewers.devtools import open_page
from tests.view.clouds import cloud
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.gaussian_files import write_cloud
from threestudio_gaussiandreamer.view import notebook
from threestudio_gaussiandreamer.view.notebook import show


@pytest.fixture
def ply(tmp_path):
    path = tmp_path / "a “box”.ply"
    write_cloud(str(path), cloud(50))
    return path


def embedded(shown) -> str:
    """Return the page in the frame, as a browser reads it."""
    return html.unescape(re.search(r'srcdoc="([^"]*)"', shown._repr_html_())[1])


def test_the_output_is_the_page_in_a_frame(ply):
    shown = show(ply, height=300, title="a <b> & “c”", background="ff0000")
    assert embedded(shown) == shown.content and "a &lt;b&gt; &amp; “c”" in shown.content
    text = shown._repr_html_()
    assert text.isascii() and 'height="300"' in text and "allow-same-origin" not in text
    assert '"background": "#ff0000"' in shown.content
    assert len(repr(shown)) < 100


def test_of_a_run_its_own_page_is_shown(run_folder):
    (export,) = run_folder.glob("save/it*-export")
    assert ">a box<" in show(run_folder).content
    (export / "view.html").write_text("with the prior")
    assert show(str(run_folder)).content == "with the prior"
    assert '"eps2d": 0.7' in show(run_folder, eps2d=0.7).content


def test_what_can_not_be_shown_is_named(tmp_path, ply, monkeypatch):
    for options, message in (
        ({"background": "red"}, "--background: expected RRGGBB"),
        ({"eps2d": -1.0}, "--eps2d: expected a number of square pixels"),
    ):
        with pytest.raises(UserError, match=message):
            show(ply, **options)
    with pytest.raises(UserError, match="is no run with an exported cloud"):
        show(tmp_path)
    monkeypatch.setattr(notebook, "MAX_BYTES", 1000)
    with pytest.raises(UserError, match="prune the cloud first, or write the page to a file"):
        show(ply)


@pytest.mark.slow
@pytest.mark.skipif(chromium() is None, reason="no Chromium is installed")
def test_the_frame_draws_and_can_be_turned(tmp_path, ply):
    path = tmp_path / "notebook.html"  # without an encoding, as in some notebooks
    path.write_text(f"<body>{show(ply)._repr_html_()}</body>")
    # in the process of the notebook, so that its exceptions are seen here
    with open_page(path, flags=("--disable-features=IsolateSandboxedIframes",)) as page:
        wait = "new Promise(done => setTimeout(done, 5000))"
        page.evaluate(wait)
        before, turn = page.screenshot(), {"x": 400, "y": 250, "button": "left", "clickCount": 1}
        for kind, x in (("mousePressed", 400), ("mouseMoved", 500), ("mouseReleased", 500)):
            page.call("Input.dispatchMouseEvent", **turn | {"type": kind, "x": x})
        page.evaluate(wait)  # the pose is written into the address when the view has been still
        assert page.screenshot() != before
        assert page.problems == []
