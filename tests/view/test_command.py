"""The command ``view``: any cloud becomes a page, rendered like its run."""

import html
import re
from pathlib import Path

import pytest
import torch

from benchmarks.viewers import browser, devtools
from tests.helpers.pruning import ball
from tests.helpers.refusals import refused
from tests.view.clouds import cloud, meta
from threestudio_gaussiandreamer.convert import command as convert
from threestudio_gaussiandreamer.formats.gaussian_files import write_cloud
from threestudio_gaussiandreamer.view import notebook, page, run_files
from threestudio_gaussiandreamer.view.command import main, parse
from threestudio_gaussiandreamer.view.notebook import show


@pytest.fixture
def source(tmp_path) -> Path:
    path = tmp_path / "box.ply"
    write_cloud(str(path), cloud(30))
    return path


def test_options_say_how_a_cloud_is_drawn(source, tmp_path):
    out = tmp_path / "out.html"
    given = "--eps2d 0.1 --preset accurate --antialias --no-bound-colors --background 0080ff"
    assert main([str(source), "--html", str(out), "--title", "a box \udcff", *given.split()]) == 0
    found = meta(out.read_text())
    settings = found["settings"]
    assert settings["eps2d"] == 0.1 and settings["alphaMin"] == 1 / 65536
    assert settings["antialias"] and not settings["boundColors"]
    assert found["background"] == "#0080ff" and found["title"] == "a box \udcff"
    assert "<title>a box ?</title>" in out.read_text(encoding="utf-8")


def test_a_cloud_of_a_run_is_drawn_as_the_run_has_drawn_it(run_folder):
    export = run_folder / "save" / "it7-export" / "gaussians.spz"
    assert main([str(export), "--html"]) == 0
    found = meta(export.with_suffix(".html").read_text())
    settings = found["settings"]
    assert settings["eps2d"] == pytest.approx(0.1) and settings["alphaMin"] == 1 / 255
    assert settings["antialias"] and not settings["boundColors"]
    assert found["title"] == "a box" and found["background"] == "#00ff00"
    assert found["clouds"][0]["quality"] == "31.2 dB on held-out views"
    other = run_folder / "save" / "it3-export"
    export.parent.rename(other)  # a step of which the scores aren't
    assert main([str(other / "gaussians.spz"), "--html"]) == 0
    assert meta((other / "gaussians.html").read_text())["clouds"][0]["quality"] == ""


def message(capsys, *argv: object) -> str:
    """Run a command line that must fail; return what it says."""
    assert main([str(argument) for argument in argv]) == 2
    return capsys.readouterr().err


def test_what_is_wrong_is_named(source, tmp_path, run_folder, capsys, monkeypatch):
    (tmp_path / "notes.txt").write_text("hello")
    (tmp_path / "notes.ply").write_text("hello")
    (tmp_path / "empty").mkdir()
    alias, other, before = tmp_path / "alias.html", tmp_path / "other.ply", source.read_bytes()
    alias.symlink_to(source)
    other.write_bytes(before)
    write_cloud(str(tmp_path / "empty.ply"), cloud(0))
    for said, *arguments in (
        (".ply", tmp_path / "notes.txt", "--html"),
        ("no Gaussians", tmp_path / "empty.ply", "--html"),
        ("PLY", tmp_path / "notes.ply", "--html"),
        ("near names", tmp_path / "boxx.ply", "--html"),
        ("no folder", source, "--html", source.parent / "a" / "out.html"),
        ("--eps2d", source, "--html", "--eps2d", "nan"),
        ("not a usable file name", "a" * 5000, "--html"),
        ("OUT is PATH", source, "--html", source),
        ("OUT is PATH", source, "--html", alias),
        ("expected a name that ends in .html", source, "--html", other),
        ("holds no run", tmp_path / "empty", "--html"),
        ("is a folder", run_folder, "--html", "out.html"),
        ("--eps2d", run_folder, "--html", "--eps2d", "1"),
    ):
        assert said in message(capsys, *arguments), arguments
    assert source.read_bytes() == other.read_bytes() == before and alias.is_symlink()
    monkeypatch.setattr(page, "MAX_GAUSSIANS", 29)
    said = message(capsys, source, "--html")
    assert "has 30 Gaussians" in said and "prune" in said and "--count" in said


def test_a_cloud_of_any_unit_has_no_far_plane_and_an_axis_may_begin_with_a_hyphen(tmp_path):
    large = cloud(30)
    large.gaussians.means[:] *= 1e13
    large.gaussians.log_scales[:] += 30
    write_cloud(str(tmp_path / "large.ply"), large)
    _, options = page.cloud_page(tmp_path / "large.ply")
    assert options.settings.far > 1e30 and options.settings.near > 1e10
    assert parse(["a.ply", "--up", "-y", "--html"]).up == "-y"
    converted = convert.parse(["a.ply", "b.ply", "--up=-y", "--up-out", "-y"])
    assert (converted.up, converted.up_out) == ("-y", "-y")


def test_a_run_gets_the_page_of_any_export_but_of_a_ply_first(run_folder):
    export = run_folder / "save" / "it7-export"
    (export / "gaussians.spz").unlink()
    for name in ("gaussians.sog", "gaussians.compressed.ply"):
        write_cloud(str(export / name), cloud(30))
        assert run_files.RunFiles(run_folder).cloud == export / name
    write_cloud(str(export / "gaussians.ply"), cloud(30))
    (export / "mesh.ply").write_bytes(b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    assert run_files.RunFiles(run_folder).cloud == export / "gaussians.ply"


def test_a_run_gets_an_index_and_a_page_and_a_folder_of_runs_a_gallery(run_folder, capsys):
    assert main([str(run_folder), "--html"]) == 0
    assert meta((run_folder / "save" / "it7-export" / "view.html").read_text())["title"] == "a box"
    assert capsys.readouterr().out.strip().endswith(str(run_folder / "index.html"))
    assert "it7-export/view.html" in (run_folder / "index.html").read_text()
    assert main([str(run_folder.parent), "--html"]) == 0
    assert "run/index.html" in (run_folder.parent / "index.html").read_text()


@pytest.fixture
def ply(tmp_path):
    path = tmp_path / "a “box”.ply"
    write_cloud(str(path), cloud(50))
    return path


def embedded(shown) -> str:
    """Return the page in the frame, as a browser reads it."""
    return html.unescape(re.search(r'srcdoc="([^"]*)"', shown._repr_html_())[1])


def test_the_output_is_the_page_in_a_frame_and_of_a_run_its_own(ply, run_folder):
    shown = show(ply, height=300, title="a <b> & “c”", background="ff0000")
    assert embedded(shown) == shown.content and "a &lt;b&gt; &amp; “c”" in shown.content
    text = shown._repr_html_()
    assert text.isascii() and 'height="300"' in text and "allow-same-origin" not in text
    assert '"background": "#ff0000"' in shown.content
    assert len(repr(shown)) < 100
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
        refused(message, show, ply, **options)
    refused("is no run with an exported cloud", show, tmp_path)
    monkeypatch.setattr(notebook, "MAX_BYTES", 1000)
    refused("prune the cloud first, or write the page to a file", show, ply)


@pytest.mark.slow
@pytest.mark.skipif(browser.chromium() is None, reason="no Chromium is installed")
def test_the_frame_draws_and_can_be_turned(tmp_path, ply):
    path = tmp_path / "notebook.html"  # without an encoding, as in some notebooks
    path.write_text(f"<body>{show(ply)._repr_html_()}</body>")
    # in the process of the notebook, so that its exceptions are seen here
    with devtools.open_page(path, flags=("--disable-features=IsolateSandboxedIframes",)) as page:
        wait = "new Promise(done => setTimeout(done, 5000))"
        page.evaluate(wait)
        before, turn = page.screenshot(), {"x": 400, "y": 250, "button": "left", "clickCount": 1}
        for kind, x in (("mousePressed", 400), ("mouseMoved", 500), ("mouseReleased", 500)):
            page.call("Input.dispatchMouseEvent", **turn | {"type": kind, "x": x})
        page.evaluate(wait)  # the pose is written into the address when the view has been still
        assert page.screenshot() != before
        assert page.problems == []


def checkpoint(folder):
    cloud = ball(20)
    names = {"sh0": cloud.sh, "sh_rest": torch.zeros(20, 0, 3)}
    names |= {name: value for name, value in cloud._asdict().items() if name != "sh"}
    folder.mkdir(parents=True)
    state = {f"geometry.{name}": value for name, value in names.items()}
    torch.save({"state_dict": state}, folder / "last.ckpt")
    return folder / "last.ckpt"


@pytest.mark.parametrize("option", ["true", "false", "1", "{}"])
def test_a_checkpoint_has_the_antialiasing_of_its_run(tmp_path, option):
    path = checkpoint(tmp_path / "run/ckpts")
    (tmp_path / "run/configs").mkdir()
    parsed = tmp_path / "run/configs/parsed.yaml"
    parsed.write_text(f"system: {{renderer: {{antialias: {option}}}}}")
    assert run_files.read_any(path).antialiased == (option == "true")
    assert not run_files.read_any(checkpoint(tmp_path / "alone")).antialiased
