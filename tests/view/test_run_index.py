"""The index of a run and the gallery; no file of a run can add markup or break them."""

import json
import os
import re
from datetime import datetime
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest

from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.images import write
from threestudio_gaussiandreamer.view import run_index
from threestudio_gaussiandreamer.view.page import cloud_page

PROMPT = 'a <img src=x onerror="alert(1)"> & </title><script>alert(1)</script>'
LOG = "dB,loss,gaussians,step\n10.0,5.0,200,1\n,,,2\n20.0,0.01,150,123456\nnan,x,,4\n"


class Tags(HTMLParser):
    """Collects tags, and the files that they name."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.files: list[str] = []
        self.feed(page.read_text())

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        assert not [name for name, _ in attributes if name.startswith("on")]
        self.files += [unquote(value) for name, value in attributes if name in ("src", "href")]


@pytest.fixture
def full_run(run_folder):
    """The run with a log, pictures, a base configuration and a name that needs escaping."""
    save = run_folder / "save"
    config = (run_folder / "configs" / "parsed.yaml").read_text()
    raw = config.replace("eps2d: 0.4", "eps2d: 0.3") + "seed: 0\ntag: ${name}\n"
    (run_folder / "configs" / "raw.yaml").write_text(raw)
    extra = "seed: 0\ntag: t\nexp_dir: x\ntrainer: {max_steps: 7}\n"
    quoted = config.replace("prompt: a box", f"prompt: {PROMPT!r}")
    (run_folder / "configs" / "parsed.yaml").write_text(quoted + extra)
    log = run_folder / "csv_logs" / "version_0" / "metrics.csv"
    log.parent.mkdir(parents=True)
    log.write_text(LOG)
    for name in ("it7-0.png", "held_out/compare.png", "it7-export/poster.png", "it7-test/0.png"):
        (save / name).parent.mkdir(exist_ok=True)
        write(save / name, np.zeros((4, 4, 3), np.uint8))
    (save / "it7-test.mp4").write_bytes(b"")
    (run_folder / "cmd.txt").write_text("launch.py --train <x>\n")
    (save / "it7-export" / "view.html").write_text("")
    (save / "a 'quoted' #&?<b>.txt").write_text("")
    return run_folder


def test_the_index_shows_what_the_run_has(full_run):
    """Numbers as in the terminal."""
    for stage in ("train", "export"):
        run_index.note_time(full_run, stage, datetime(2026, 1, 2, 3, 4, 5), 61.25)
    scores = {"result": {"psnr": 31.25, "multi_face": 0.25, "gaussians": 12345678.0}}
    (full_run / "save" / "metrics.json").write_text(json.dumps(scores))
    (full_run / "save" / "it7-export" / "model.glb").write_bytes(b"glTF")
    text = run_index.write_index(full_run).read_text()
    for expected in (
        *("dB to the truth", "loss, logarithmic", "<td>31.25</td>", "61.2 s", "2026-01-02 03:04"),
        *("&lt;x&gt;", "<td>train</td>", "<td>export</td>", ">123,456<", "sides look alike"),
        *("<td>25 %</td><td>12,345,678</td>", "it7-export/view.html"),
    ):
        assert expected in text, expected
    assert "e+0" not in text
    (row,) = re.findall(r"Downloads</h2>(.*?)</section>", text, re.S)
    for name in ("gaussians.spz", "model.glb", "view.html", "it7-test.mp4"):
        assert f">{name}</a>" in row
    assert text.index("Downloads") < text.index("In 3D")
    found = Tags(full_run / "index.html")
    assert found.tags.count("svg") == 3 and "iframe" in found.tags and "video" in found.tags
    assert found.tags.count("img") == 3  # poster, comparison, validation
    assert not {"button", "select", "input", "script"} & set(found.tags)  # none that needs a script
    # a prompt, a name or a command adds no markup
    assert "b" not in found.tags and "x" not in found.files
    linked = {name for name in found.files if name != "data:,"}
    files = {str(path.relative_to(full_run)) for path in full_run.rglob("*") if path.is_file()}
    assert linked == files - {"index.html"}


def test_a_white_object_does_not_vanish_on_the_page(full_run):
    """Unless a command has set the background."""
    source = full_run / "save" / "it7-export" / "gaussians.spz"
    assert not cloud_page(source)[1].keep_background
    (full_run / "cmd.txt").write_text("--train system.background.color=[0,1,0]\n")
    assert cloud_page(source)[1].keep_background
    poster = np.zeros((8, 8, 4), np.uint8)
    poster[2:6, 2:6] = 255
    write(full_run / "save" / "it7-export" / "poster.png", poster)
    for page in (run_index.write_index(full_run), run_index.write_gallery(full_run.parent)):
        assert re.search(r'<img [^>]*poster.png"[^>]*style="background: #202020"', page.read_text())


def test_names_that_are_not_utf_8_are_linked(full_run):
    name = b"save/it7-\xff.png"
    try:
        os.close(os.open(os.fsencode(full_run) + b"/" + name, os.O_CREAT))
    except OSError:
        pytest.skip("this file system has no such names")
    assert "save/it7-%FF.png" in run_index.write_index(full_run).read_text()


def test_changes_of_the_configuration_are_listed_and_a_damaged_file_loses_its_part(full_run):
    text = run_index.write_index(full_run).read_text()
    rows = re.findall(r"<tr><td>([\w.]+)</td><td>([^<]*)</td><td>([^<]*)</td></tr>", text)
    changed = {key: (base, run) for key, base, run in rows}
    assert changed["system.renderer.eps2d"] == ("0.3", "0.4")
    assert changed["trainer.max_steps"] == ("–", "7")
    # neither what is equal, nor what is computed, nor what the base file refers to elsewhere
    assert not changed.keys() & {"seed", "exp_dir", "tag", "system.renderer.preset"}
    names = "save/metrics.json times.json configs/raw.yaml csv_logs/version_0/metrics.csv".split()
    for damage in (b"", b"{", b"[1]", b"\xff\xfe", b'{"result": {"psnr": "x"}}'):
        for name in names:
            (full_run / name).write_bytes(damage)
        assert "held_out/compare.png" in run_index.write_index(full_run).read_text()
    (full_run / "configs/parsed.yaml").write_text("trainer: &all {a: 1}\nsystem: {b: *all}\n")
    assert "system.b.a" not in run_index.write_index(full_run).read_text()


def test_the_gallery_shows_prompt_poster_and_scores_and_is_replaced(full_run):
    """Unless it is someone else's page; a run whose index can't be written stays in it."""
    page = full_run.parent / "index.html"
    page.write_text("my own page")
    refused("isn't a page of this package", run_index.write_gallery, full_run.parent)
    assert page.read_text() == "my own page"
    page.unlink()
    run_index.write_gallery(full_run.parent)
    page = run_index.write_gallery(full_run.parent)
    assert "31.2 dB" in page.read_text()
    found = Tags(page)
    assert {"run/index.html", "run/save/it7-export/poster.png"} <= set(found.files)
    assert not {"button", "select", "input", "script", "b"} & set(found.tags)
    (full_run / "index.html").unlink()
    (full_run / "index.html").mkdir()
    assert "run" in Tags(run_index.write_gallery(full_run.parent)).files


def test_a_gallery_needs_runs_and_curves_are_those_of_the_resumed_run(tmp_path):
    assert Tags(run_index.write_index(tmp_path)).tags.count("h1") == 1
    (tmp_path / "index.html").unlink()
    refused("holds no run.*configs/parsed.yaml", run_index.write_gallery, tmp_path)
    logs = {2: "loss,alone,step\n1,1,1\n2,inf,2\n3,nan,3\n", 10: "loss,step\n30,3\n40,4\n"}
    for version, text in logs.items():
        path = tmp_path / f"csv_logs/version_{version}/metrics.csv"
        path.parent.mkdir(parents=True)
        path.write_text(text)
    curves = run_index.read_curves(tmp_path, ["loss", "absent", "alone"])
    assert curves == {"loss": [(1, 1), (2, 2), (3, 30), (4, 40)]}
    assert run_index.drawn([(0, 1.0), (10, 3.0)], "loss")["points"] == "0.0000,0.0000 1.0000,1.0000"
    powers = run_index.drawn([(0, 1.0), (1, 100.0), (2, 10_000.0)], "loss")
    assert powers["points"].split()[1] == "0.5000,0.5000"
    assert powers["title"] == "loss, logarithmic" and powers["ends"] == ["1", "10,000", "0", "2"]
    assert run_index.drawn([(1, 2.0), (2, 2.0)], "loss")["points"].endswith("1.0000,0.5000")
    many = run_index.drawn([(i, float(i)) for i in range(5000)], "loss")
    assert len(many["points"].split()) <= 400
