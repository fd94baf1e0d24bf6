"""The page's text: its size, what it may load, and prompts that look like code."""

import base64
import html
import io
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from tests.view.clouds import PROMPT, cloud, options
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.view import page as page_module
from threestudio_gaussiandreamer.view.page import Shown, decibels, page, write_page


def meta(text: str) -> dict:
    return json.loads(re.search(r'id="meta">(.*?)</script>', text)[1])


def test_5000_gaussians_and_their_prior_take_less_than_600_kB(tmp_path):
    path = tmp_path / "view.html"
    # a prior's Gaussians are isotropic and equally opaque
    prior = cloud(10_000, stretch=0.0, size=0.01)
    plain = prior.gaussians._replace(quats=np.tile(np.float32([1, 0, 0, 0]), (10_000, 1)))
    plain = plain._replace(logit_opacities=np.full(10_000, -1, np.float32))
    before = Shown(prior._replace(gaussians=plain), "prior")
    write_page(path, Shown(cloud(5000), "result"), options(), before)
    assert path.stat().st_size < 600_000


def test_a_prompt_is_text_wherever_it_stands():
    text = page(Shown(cloud(3), "result"), options())
    assert html.escape(PROMPT) in text and PROMPT not in text
    assert meta(text)["title"] == PROMPT
    assert text.count("<script") == text.count("</script>") == 8  # four shaders, meta, data x 2


class Controls(HTMLParser):
    """Collects the controls that a browser shows before any script has run."""

    VOID = ("meta", "link", "img", "input", "br")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[tuple[str, bool]] = [("", False)]
        self.shown: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        hidden = self.open[-1][1] or "hidden" in dict(attributes)
        if tag in ("button", "select", "input", "textarea") and not hidden:
            self.shown.append(tag)
        if tag not in self.VOID:
            self.open.append((tag, hidden))

    def handle_endtag(self, tag):
        assert self.open.pop()[0] == tag


def test_without_javascript_there_is_no_control():
    text = page(Shown(cloud(3), "result"), options())
    assert Controls(text).shown == []
    assert len(Controls(text.replace("<footer hidden>", "<footer>")).shown) == 6


def test_the_policy_forbids_requests_and_foreign_scripts():
    text = page(Shown(cloud(3), "result"), options())
    policy = html.unescape(re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1])
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "http" not in policy and "unsafe" not in policy
    # the only attributes that load something hold their content
    assert set(re.findall(r'(?:src|href)="(.{5})', text)) == {"data:"}


def test_the_page_knows_how_the_cloud_was_trained():
    text = page(Shown(cloud(3), "result"), options(eps2d=0.1, antialias=True, alpha_min=1 / 255))
    settings = meta(text)["settings"]
    assert settings["eps2d"] == 0.1 and settings["antialias"] and settings["alphaMin"] == 1 / 255


@pytest.mark.parametrize(
    "color, background, keep, expected",
    [
        ("white", "#ffffff", False, "#202020"),
        ("white", "#ffffff", True, "#ffffff"),
        ("black", "#000000", False, "#ffffff"),
        ("orange", "#ffffff", False, "#ffffff"),
        ("orange", "#00ff00", False, "#00ff00"),
        ("black and white", "#ffffff", False, "#808080"),
    ],
)
def test_an_object_does_not_vanish_on_the_background(color, background, keep, expected):
    """Unless the user has chosen the background."""
    colors = {"white": [1, 1, 1], "black": [0, 0, 0], "orange": [1, 0.5, 0]}
    shown = cloud(2000, size=0.05, stretch=0.0, logit=9.0)
    drawn = np.array([colors[color.split()[i % 2 and -1]] for i in range(2000)], np.float32)
    shown.gaussians.sh[:, 0] = (drawn - 0.5) / 0.28209479
    rgb = tuple(x / 255 for x in bytes.fromhex(background[1:]))
    how = options()._replace(background=rgb, keep_background=keep)
    text = page(Shown(shown, "result"), how)
    assert meta(text)["background"] == expected
    poster = re.search(r'src="data:image/webp;base64,([^"]*)"', text)[1]
    corner = Image.open(io.BytesIO(base64.b64decode(poster))).convert("RGB").getpixel((2, 2))
    assert np.allclose(corner, list(bytes.fromhex(expected[1:])), atol=3)


def test_gaussians_with_nan_are_left_out_with_a_warning(caplog):
    broken = cloud(10)
    broken.gaussians.means[3] = np.nan
    text = page(Shown(broken, "result"), options())
    assert meta(text)["clouds"][0]["count"] == 9 and "1 of 10 Gaussians" in caplog.text


def test_an_empty_cloud_is_refused():
    with pytest.raises(UserError, match="no Gaussians"):
        page(Shown(cloud(0), "result"), options())


def test_gaussians_beyond_float32_are_refused():
    large = cloud(5)
    large.gaussians.log_scales[:] = 80.0
    with pytest.raises(UserError, match="float32 can't render"):
        page(Shown(large, "result"), options())


def test_too_many_gaussians_are_refused_with_the_way_out(monkeypatch):
    monkeypatch.setattr(page_module, "MAX_GAUSSIANS", 100)
    with pytest.raises(UserError, match="prune it first.*threestudio_gaussiandreamer.prune"):
        page(Shown(cloud(101), "result"), options())


def test_unknown_dB_are_not_shown():
    assert decibels(None) == decibels(float("nan")) == ""
    assert decibels(33.213) == "33.2 dB on held-out views"
