"""The page's text: its size, what it may load, and prompts that look like code."""

import base64
import html
import io
import re
import zlib

import numpy as np
import pytest
from PIL import Image

from tests.helpers.refusals import refused
from tests.view.clouds import PROMPT, cloud, meta, options
from threestudio_gaussiandreamer.formats import gaussian_files, ply
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.view import page as page_module
from threestudio_gaussiandreamer.view.page import COARSE_MEANS, Shown, coarse, packed, page
from threestudio_gaussiandreamer.view.render import RenderSettings, first_pose, render


def test_a_prompt_is_text_and_no_control_needs_javascript_or_a_request():
    text = page(Shown(cloud(3), "result"), options())
    title = re.search(r"<title>(.*?)</title>", text, re.S)[1]
    assert html.unescape(title) == PROMPT and "<" not in title and PROMPT not in text
    assert meta(text)["title"] == PROMPT
    assert text.count("<script") == text.count("</script>") == 8  # four shaders, meta, data x 2
    text = page(Shown(cloud(3), "result"), options())
    shown, footer = re.split("<footer hidden>|</footer>", text)[::2], text.partition("<footer")[2]
    control = re.compile("<(?:button|select|input|textarea)")
    assert not control.search("".join(shown)) and len(control.findall(footer)) == 7
    policy = html.unescape(re.search(r'Content-Security-Policy" content="([^"]*)"', text)[1])
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "http" not in policy and "unsafe" not in policy
    # the only attributes that load something hold their content
    assert set(re.findall(r'(?:src|href)="(.{5})', text)) == {"data:"}


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


def test_what_can_not_be_shown_is_left_out_or_refused(monkeypatch, caplog):
    broken = cloud(10)
    broken.gaussians.means[3] = np.nan
    text = page(Shown(broken, "result"), options())
    assert meta(text)["clouds"][0]["count"] == 9 and "1 of 10 Gaussians" in caplog.text
    large = cloud(5)
    large.gaussians.log_scales[:] = 80.0
    monkeypatch.setattr(page_module, "MAX_GAUSSIANS", 100)
    for stored, message in (
        (cloud(0), "no Gaussians"),
        (large, "float32 can't render"),
        (cloud(101), "prune it first.*threestudio_gaussiandreamer.prune"),
    ):
        refused(message, page, Shown(stored, "result"), options())


def unpacked(data: bytes, count: int) -> np.ndarray:
    """Return the columns (P, N), as the page's scripts do."""
    planes = np.frombuffer(zlib.decompress(data), np.uint8).reshape(-1, 4, count)
    return np.ascontiguousarray(planes.transpose(0, 2, 1)).view("<f4")[..., 0]


def test_packing_keeps_every_bit_and_a_coarse_cloud_is_a_fraction_of_the_size():
    gaussians = cloud(50, degree=2).gaussians
    columns = ply.gaussian_columns(gaussians)
    found = unpacked(packed(gaussians), 50)
    assert np.array_equal(found[:3].T, columns[:, :3])
    assert np.array_equal(found[3:].T, columns[:, 6:])
    assert not columns[:, 3:6].any()  # the normals, which aren't stored
    gaussians = cloud(4000, degree=1).gaussians
    rounded = coarse(gaussians)
    side = np.ptp(gaussians.means, axis=0).max()
    assert np.abs(rounded.means - gaussians.means).max() <= side / COARSE_MEANS
    assert rounded.sh.shape == (4000, 1, 3)
    assert len(packed(rounded)) < 0.4 * len(packed(gaussians._replace(sh=gaussians.sh[:, :1])))
    point = cloud(1).gaussians
    assert np.allclose(coarse(point).means, point.means)


def stored(means, scale=0.03, logit=3.0) -> gaussian_files.StoredCloud:
    """A cloud of round Gaussians with z up; ``scale`` and ``logit`` are numbers or one for each."""
    count = len(means)
    arrays = Gaussians(
        means=np.asarray(means),
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        log_scales=np.log(np.broadcast_to(scale, count))[:, None].repeat(3, 1),
        logit_opacities=np.broadcast_to(logit, count),
        sh=np.zeros((count, 1, 3)),
    )
    return gaussian_files.StoredCloud(arrays.map(lambda values: values.astype(np.float32)), "z")


def ball(count=4000) -> np.ndarray:
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


HAT = np.linspace([0, 0, 1.0], [0.3, 0, 4.0], 35)
"""A pole of less than a hundredth of the Gaussians, on top of the ball."""


def alpha(cloud: gaussian_files.StoredCloud) -> np.ndarray:
    return render(cloud, RenderSettings(), [first_pose(cloud)], 96)[0, ..., 3].numpy()


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_a_thin_hat_is_in_the_first_view(order):
    """Upright, and to the side."""
    seen = alpha(stored(np.concatenate([ball(), HAT])[:, order]))
    assert max(seen[0].max(), seen[-1].max(), seen[:, 0].max(), seen[:, -1].max()) < 0.02
    rows, columns = np.nonzero(seen > 0.1)
    assert max(np.ptp(rows), np.ptp(columns)) > 0.45 * 96  # a ball fits from every side


@pytest.mark.parametrize(
    "place, scale, logit",
    [((0, 0, 30.0), 0.03, 3.0), ((0, 0, 0), 50.0, 3.0), ((0, 0, 1.2), 0.4, -4)],
)
def test_what_does_not_belong_to_the_cloud_leaves_the_first_view(place, scale, logit):
    """A floater, one that covers everything, and one that is hardly visible."""
    more = stored([*ball(), place], [0.03] * 4000 + [scale], [3.0] * 4000 + [logit])
    ours, without = first_pose(more), first_pose(stored(ball()))
    assert ours.distance == pytest.approx(without.distance, rel=0.02)
    assert np.allclose(ours.target, without.target, atol=0.02)


@pytest.mark.parametrize("scale", [1e-12, 0.03, 1e12])
def test_a_single_gaussian_fills_the_first_view(scale):
    cloud = stored([[0, 0, 0]], scale)
    seen = render(cloud, RenderSettings(near=0.1 * scale, far=1e15), [first_pose(cloud)], 96)
    assert 0.5 < float((seen[0, 48, :, 3] > 0.1).float().mean()) <= 1
