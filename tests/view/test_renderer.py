"""The page in headless Chromium: it draws and saves what we do, and runs no code of a prompt."""

import base64
import json
import math
import time
from contextlib import contextmanager

import numpy as np
import pytest

from benchmarks.viewers import browser, devtools
from tests.view.clouds import PROMPT, cloud, options
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud
from threestudio_gaussiandreamer.view.page import Shown, write_page
from threestudio_gaussiandreamer.view.render import Pose, first_pose

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(browser.chromium() is None, reason="no Chromium is installed"),
]
SIZE = 192
CLOUDS = {
    "thin, as the demo draws": (cloud(600), {"eps2d": 0.1, "alpha_min": 1 / 255}),
    "harmonics of degree 3, antialiased, y up": (
        cloud(500, degree=3, size=0.01, up="y"),
        {"eps2d": 0.3, "antialias": True, "bound_colors": False},
    ),
    "1,500 faint layers, z up": (
        cloud(1500, size=0.2, stretch=0.2, logit=-4.0, up="z"),
        {"eps2d": 0.3},
    ),
}


@contextmanager
def shown(folder, stored: StoredCloud, *, flags=(), before=None, **settings):
    """Open the page of a cloud; gives the page and the options."""
    path, how = folder / "view.html", options(**settings)
    write_page(path, Shown(stored, "result", "30.0 dB"), how, before and Shown(before, "prior"))
    with devtools.open_page(path, flags=flags) as page:
        yield page, how


def requests_that_leave(page) -> list[str]:
    """Return the requests for anything that isn't in the page."""
    return [x for x in page.requests if not x.startswith(("data:", "blob:"))]


@pytest.mark.parametrize("name", CLOUDS)
def test_the_page_draws_what_our_rasteriser_draws(name, tmp_path):
    stored, settings = CLOUDS[name]
    with shown(tmp_path, stored, **settings) as (page, how):
        poses = devtools.orbit_poses(first_pose(stored), 8)
        found = devtools.difference_to_ours(page, stored, how, poses, SIZE)
        assert min(found) >= 40.0, found
        # what the comparison would miss if both were blank
        wrong = devtools.difference_to_ours(page, stored, how, poses[:1], SIZE, drawn=poses[4:5])
        assert wrong[0] < 25.0 or "faint" in name
        # a moving picture is blended into half floats, which many faint layers need most
        page.evaluate("viewer.then(v => { v.renderer.targets.still = v.renderer.targets.moving; })")
        assert min(devtools.difference_to_ours(page, stored, how, poses[:2], SIZE)) >= 40.0
        assert requests_that_leave(page) == [(tmp_path / "view.html").as_uri()]
        assert page.problems == []


STORED, PRIOR = cloud(70, degree=1)._replace(pruned_to=40.0), cloud(200)


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """The page of a result and its prior, which the tests below share, and its options."""
    with shown(tmp_path_factory.mktemp("page"), STORED, before=PRIOR) as found:
        yield found


def test_a_prompt_is_shown_and_not_run_and_the_prior_can_be_chosen(opened):
    page, how = opened
    page.evaluate("viewer.then(v => v.load(0))")
    assert page.evaluate("document.getElementById('prompt').textContent") == PROMPT
    assert page.evaluate("document.title") == PROMPT
    facts = "document.getElementById('facts').textContent"
    assert page.evaluate(facts) == "result · 70 Gaussians · 30.0 dB"
    page.evaluate("viewer.then(v => v.show(1))")
    assert page.evaluate(facts) == "prior · 200 Gaussians"
    poses = devtools.orbit_poses(first_pose(STORED), 2)
    assert min(devtools.difference_to_ours(page, PRIOR, how, poses, 96)) > 30.0  # it is rounded
    page.evaluate("viewer.then(v => v.show(0))")


def saved_file(page, button: str) -> bytes:
    page.evaluate(
        "window.saved = new Promise(done => { HTMLAnchorElement.prototype.click = function () {"
        " fetchedParts.then(done); }; }); var fetchedParts; { const make = URL.createObjectURL;"
        " URL.createObjectURL = blob => { fetchedParts = blob.arrayBuffer().then(b =>"
        " new Uint8Array(b).toBase64()); return make(blob); }; } null"
    )
    return base64.b64decode(page.evaluate(f"document.getElementById('{button}').click(), saved"))


@pytest.mark.parametrize("ending", ["ply", "spz"])
def test_the_page_saves_the_files_that_the_exporters_write(ending, opened, tmp_path):
    write_cloud(str(tmp_path / f"expected.{ending}"), STORED)
    found = saved_file(opened[0], f"save-{ending}")
    assert found == (tmp_path / f"expected.{ending}").read_bytes()


def test_the_pose_is_in_the_address_and_read_from_it(opened):
    page, _ = opened
    pose = first_pose(STORED)._replace(azimuth=200.0, elevation=-20.0, distance=3.5)
    page.evaluate("viewer.then(v => v.change(() => (" + json.dumps(pose._asdict()) + ")))")
    page.evaluate("new Promise(done => setTimeout(done, 400))")
    address = page.evaluate("location.hash")
    assert address.startswith("#200,-20,3.5,")
    page.evaluate("viewer.then(v => { v.change(() => v.meta.camera); v.writeAddress(); })")
    page.evaluate(f"location.hash = '{address}'; null")
    page.evaluate("new Promise(done => setTimeout(done, 100))")
    found = Pose(**page.evaluate("viewer.then(v => v.pose)"))
    assert found.azimuth == 200.0 and found.elevation == -20.0 and found.distance == 3.5
    assert np.allclose(found.target, pose.target, atol=1e-5)
    before = page.evaluate("viewer.then(v => v.pose)")
    for wrong in ("#", "#1,2,3", "#a,b,c,d,e,f,g", "#1,2,3,4,5,6,1e9", "#<x>"):
        page.evaluate(f"location.hash = '{wrong}'; new Promise(done => setTimeout(done, 50))")
        assert page.evaluate("viewer.then(v => v.pose)") == before, wrong
    assert page.problems == []


def test_dragging_turns_the_wheel_zooms_and_every_control_works(opened):
    page, _ = opened
    before = Pose(**page.evaluate("viewer.then(v => v.pose)"))
    for kind, x in (("mousePressed", 400), ("mouseMoved", 300), ("mouseReleased", 300)):
        place = {"x": x, "y": 200, "button": "left", "buttons": 1, "clickCount": 1}
        page.call("Input.dispatchMouseEvent", type=kind, **place)
    wheel = {"x": 400, "y": 200, "deltaX": 0, "deltaY": -100}
    page.call("Input.dispatchMouseEvent", type="mouseWheel", **wheel)
    after = Pose(**page.evaluate("viewer.then(v => v.pose)"))
    assert math.isclose((after.azimuth - before.azimuth) % 360, 35, abs_tol=0.01)
    assert after.distance < 0.95 * before.distance
    page, _ = opened

    def press(name, action="click()"):
        page.evaluate(f"document.getElementById('{name}').{action}; null")
        return page.evaluate(
            "new Promise(done => setTimeout(done, 300)).then(() => viewer).then(v => "
            "[v.turning, v.pose.azimuth, v.background, v.shown])"
        )

    start = page.evaluate("viewer.then(v => v.meta.camera.azimuth)")
    assert press("turntable")[0]
    turned = f"viewer.then(v => v.pose.azimuth !== {start})"
    assert any(page.evaluate(turned) or time.sleep(0.2) for _ in range(50))
    assert not press("turntable")[0]
    before = press("reset")
    assert before[1] == start and before[3] == 0
    changed = "new Event('{}', {{bubbles: true}})"
    page.evaluate("document.getElementById('background').value = '#ff0000'; null")
    assert press("background", f"dispatchEvent({changed.format('input')})")[2] != before[2]
    page.evaluate("document.getElementById('cloud-choice').value = '1'; null")
    assert press("cloud-choice", f"dispatchEvent({changed.format('change')})")[3] == 1
    assert page.problems == []


def test_without_webgl2_the_page_gives_a_message_and_shows_the_poster(tmp_path):
    with shown(tmp_path, cloud(50), flags=devtools.NO_WEBGL) as (page, _):
        assert page.evaluate("viewer") is None
        assert "WebGL2" in page.evaluate("document.getElementById('message').textContent")
        box = "document.getElementById('poster').getBoundingClientRect().width"
        assert page.evaluate(box) > 100
        assert page.evaluate("document.getElementById('poster').naturalWidth") == 320
        shown_ids = "[...document.querySelectorAll('footer > *')].filter(x => x.offsetWidth)"
        assert page.evaluate(f"{shown_ids}.map(x => x.id)") == ["save-spz"]
        page.evaluate("window.saveFile = (name, parts) => { window.saved = parts[0].length }")
        page.evaluate("document.getElementById('save-spz').click()")
        assert page.evaluate("window.saved") > 100
        assert requests_that_leave(page) == [(tmp_path / "view.html").as_uri()]
