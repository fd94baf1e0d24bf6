"""The page in headless Chromium: it draws what our rasteriser draws, saves what the exporters
write, asks for nothing, and runs no code of a prompt.
"""

import base64
import json
import math
import time
from contextlib import contextmanager

import numpy as np
import pytest

from benchmarks.viewers.browser import chromium
from benchmarks.viewers.devtools import NO_WEBGL, difference_to_ours, open_page, orbit_poses
from tests.view.clouds import PROMPT, cloud, options
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud
from threestudio_gaussiandreamer.view.page import Shown, write_page
from threestudio_gaussiandreamer.view.render import Pose, first_pose

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(chromium() is None, reason="no Chromium is installed"),
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
    with open_page(path, flags=flags) as page:
        yield page, how


def requests_that_leave(page) -> list[str]:
    """Return the requests for anything that isn't in the page."""
    return [x for x in page.requests if not x.startswith(("data:", "blob:"))]


@pytest.mark.parametrize("name", CLOUDS)
def test_the_page_draws_what_our_rasteriser_draws(name, tmp_path):
    stored, settings = CLOUDS[name]
    with shown(tmp_path, stored, **settings) as (page, how):
        found = difference_to_ours(page, stored, how, orbit_poses(first_pose(stored), 8), SIZE)
        assert min(found) >= 40.0, found
        assert requests_that_leave(page) == [(tmp_path / "view.html").as_uri()]
        assert page.problems == []


def test_a_moving_picture_is_nearly_the_same(tmp_path):
    """It is blended into half floats, which many faint layers need most."""
    stored, settings = CLOUDS["1,500 faint layers, z up"]
    with shown(tmp_path, stored, **settings) as (page, how):
        page.evaluate("viewer.then(v => { v.renderer.targets.still = v.renderer.targets.moving; })")
        poses = orbit_poses(first_pose(stored), 2)
        assert min(difference_to_ours(page, stored, how, poses, SIZE)) >= 40.0


def test_the_views_differ_and_are_not_empty(tmp_path):
    """What the comparison above would miss if both were blank."""
    stored, settings = CLOUDS["thin, as the demo draws"]
    with shown(tmp_path, stored, **settings) as (page, how):
        poses = orbit_poses(first_pose(stored), 2)
        wrong = difference_to_ours(page, stored, how, poses[:1], SIZE, drawn=poses[1:])
        assert wrong[0] < 25.0


def test_a_prompt_is_shown_and_not_run(tmp_path):
    with shown(tmp_path, cloud(20), before=cloud(40)) as (page, _):
        page.evaluate("viewer.then(v => v.load(0))")
        assert page.evaluate("document.getElementById('prompt').textContent") == PROMPT
        assert page.evaluate("document.title") == PROMPT
        assert page.evaluate("document.getElementById('facts').textContent") == (
            "result · 20 Gaussians · 30.0 dB"
        )


def saved_file(page, button: str) -> bytes:
    """Click a button that saves a file and return the file."""
    page.evaluate(
        "window.saved = new Promise(done => { HTMLAnchorElement.prototype.click = function () {"
        " fetchedParts.then(done); }; }); const make = URL.createObjectURL; var fetchedParts;"
        " URL.createObjectURL = blob => { fetchedParts = blob.arrayBuffer().then(b =>"
        " new Uint8Array(b).toBase64()); return make(blob); }; null"
    )
    return base64.b64decode(page.evaluate(f"document.getElementById('{button}').click(), saved"))


@pytest.mark.parametrize("ending", ["ply", "spz"])
def test_the_page_saves_the_files_that_the_exporters_write(ending, tmp_path):
    stored = cloud(70, degree=1)._replace(pruned_to=40.0)
    write_cloud(str(tmp_path / f"expected.{ending}"), stored)
    with shown(tmp_path, stored) as (page, _):
        page.evaluate("viewer")
        assert saved_file(page, f"save-{ending}") == (
            (tmp_path / f"expected.{ending}").read_bytes()
        )


def test_prior_and_result_can_be_switched(tmp_path):
    result, prior = cloud(300), cloud(200)
    with shown(tmp_path, result, before=prior) as (page, how):
        page.evaluate("viewer.then(v => v.show(1))")
        facts = page.evaluate("document.getElementById('facts').textContent")
        assert facts == "prior · 200 Gaussians"
        poses = orbit_poses(first_pose(result), 2)
        assert min(difference_to_ours(page, prior, how, poses, 96)) > 30.0  # it is rounded


def test_the_pose_is_in_the_address_and_read_from_it(tmp_path):
    stored = cloud(30)
    pose = first_pose(stored)._replace(azimuth=200.0, elevation=-20.0, distance=3.5)
    with shown(tmp_path, stored) as (page, _):
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


def test_an_invalid_pose_is_ignored(tmp_path):
    with shown(tmp_path, cloud(5)) as (page, _):
        before = page.evaluate("viewer.then(v => v.pose)")
        for address in ("#", "#1,2,3", "#a,b,c,d,e,f,g", "#1,2,3,4,5,6,1e9", "#<x>"):
            page.evaluate(f"location.hash = '{address}'; new Promise(done => setTimeout(done, 50))")
            assert page.evaluate("viewer.then(v => v.pose)") == before, address
        assert page.problems == []


def test_dragging_turns_and_the_wheel_zooms(tmp_path):
    with shown(tmp_path, cloud(50)) as (page, _):
        before = Pose(**page.evaluate("viewer.then(v => v.pose)"))
        for kind, x in (("mousePressed", 400), ("mouseMoved", 300), ("mouseReleased", 300)):
            place = {"x": x, "y": 200, "button": "left", "buttons": 1, "clickCount": 1}
            page.call("Input.dispatchMouseEvent", type=kind, **place)
        page.call(
            "Input.dispatchMouseEvent", type="mouseWheel", x=400, y=200, deltaX=0, deltaY=-100
        )
        after = Pose(**page.evaluate("viewer.then(v => v.pose)"))
    assert math.isclose(after.azimuth, before.azimuth + 35, abs_tol=0.01)
    assert after.distance < 0.95 * before.distance


def test_every_control_works(tmp_path):
    """By the keyboard's focus, which is seen, and by a press."""
    with shown(tmp_path, cloud(50), before=cloud(20)) as (page, _):
        focused = {}
        for _ in range(8):
            for kind in ("keyDown", "keyUp"):
                key = {"key": "Tab", "code": "Tab", "windowsVirtualKeyCode": 9}
                page.call("Input.dispatchKeyEvent", type=kind, **key)
            place = "(x => [x.id, getComputedStyle(x.closest('footer > *') || x).outlineStyle])"
            name, style = page.evaluate(f"{place}(document.activeElement)")
            focused[name] = style
        expected = {"canvas", "cloud-choice", "turntable", "reset", "background"}
        assert expected | {"save-ply", "save-spz"} <= set(focused)
        assert {style for name, style in focused.items() if name} == {"solid"}

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
    with shown(tmp_path, cloud(50), flags=NO_WEBGL) as (page, _):
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
