"""Curves of logs: what a resumed run has overwritten, and axes."""

import re

from threestudio_gaussiandreamer.view.curves import LEFT, WIDTH, read_curves, svg


def log(folder, version: int, text: str) -> None:
    path = folder / "csv_logs" / f"version_{version}" / "metrics.csv"
    path.parent.mkdir(parents=True)
    path.write_text(text)


def test_a_resumed_run_replaces_the_steps_that_it_repeats(tmp_path):
    log(tmp_path, 2, "loss,step\n1,1\n2,2\n3,3\n")
    log(tmp_path, 10, "loss,step\n30,3\n40,4\n")
    curves = read_curves(tmp_path, ["loss", "absent"])
    assert curves == {"loss": [(1, 1), (2, 2), (3, 30), (4, 40)]}


def test_a_value_alone_is_no_curve(tmp_path):
    log(tmp_path, 0, "loss,step\n1,1\ninf,2\nnan,3\n")
    assert read_curves(tmp_path, ["loss"]) == {}


def points(text: str) -> list[tuple[float, float]]:
    pairs = re.search(r'points="([^"]*)"', text)[1].split()
    return [tuple(map(float, pair.split(","))) for pair in pairs]


def test_a_curve_fills_its_axes():
    (x0, y0), (x1, y1) = points(svg([(0, 1.0), (10, 3.0)], "loss"))
    assert x0 == LEFT and x1 == WIDTH - 8 and y0 > y1


def test_powers_of_ten_are_spaced_evenly():
    text = svg([(0, 1.0), (1, 100.0), (2, 10_000.0)], "loss <x>")
    heights = [y for _, y in points(text)]
    assert abs(heights[0] - 2 * heights[1] + heights[2]) < 0.2
    assert "loss &lt;x&gt;, logarithmic" in text


def test_a_long_curve_and_a_constant_one():
    assert len(points(svg([(i, float(i)) for i in range(5000)], "dB"))) <= 400
    assert len({y for _, y in points(svg([(0, 2.0), (1, 2.0)], "dB"))}) == 1
