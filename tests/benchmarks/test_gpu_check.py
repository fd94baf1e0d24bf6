"""The GPU check runs from end to end on the CPU, at a tiny size."""

import json
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from benchmarks.splatting import (
    bench_scenes,
    gpu_check,
    gpu_kernels,
    gpu_processes,
    gpu_prune,
    gpu_training,
    tables,
)
from threestudio_gaussiandreamer.splatting.cuda import proof

ROOT = Path(__file__).parents[2]


def check(*arguments):
    command = [sys.executable, "-m", "benchmarks.splatting.gpu_check", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT)


OWN_PROCESSES = "errors", "speed"
"""Parts that the test of a failed section starts as processes."""


@pytest.fixture
def parts_here(request, monkeypatch):
    """Run the parts in this process, but those in the fixture's parameter: processes of their own
    take longer for their imports than the parts themselves.
    """
    elsewhere = getattr(request, "param", ())

    def here(name, args, environment=None):
        if name in elsewhere:
            return gpu_processes.in_process(name, args, environment)
        with pytest.MonkeyPatch.context() as patch:
            for key, value in (environment or {}).items():
                patch.setenv(key, value)
            return json.loads(json.dumps(gpu_check.PARTS[name](args)))

    for module in (gpu_check, gpu_kernels, gpu_prune, gpu_training):
        monkeypatch.setattr(module, "in_process", here)


@pytest.mark.slow
def test_every_section_runs_and_reports(parts_here, tmp_path, capfd):
    pytest.importorskip("diffusers")
    arguments = ["--device", "cpu", "--small", "--out", str(tmp_path / "report.json")]
    assert gpu_check.main(arguments) == 0, "".join(capfd.readouterr())
    report = json.loads((tmp_path / "report.json").read_text())
    assert all(cell["gradient"] < 2e-5 for cell in report["correct"]["relative_errors"].values())
    default, lowmem = report["train"]["default"], report["train"]["lowmem"]
    assert default["ms_per_step"] > default["unet_ms"] > 0 and lowmem["ms_per_step"] > 0
    assert default["unet_ms"] > default["empty_networks"]["unet_ms"] > 0
    assert 0 < report["correct"]["fallback"]["gradient"] < 2e-5
    assert report["demos"]["demo.yaml"]["psnr"] > 10
    assert report["demos"]["toybox.yaml"]["unet_ms"] > 0
    assert report["prune"]["gaussians"] == [800, 200] and report["prune"]["psnr"] > 20
    assert report["compile"]["first"] > 0 and report["bench"]["fast"]["ms"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("parts_here", [OWN_PROCESSES], indirect=True)
def test_a_failed_section_is_recorded_and_the_rest_continues(parts_here, monkeypatch, tmp_path):
    monkeypatch.setattr(gpu_kernels, "GRADIENT_ERROR", 0.0)
    monkeypatch.setattr(
        gpu_check, "SECTIONS", {name: gpu_check.SECTIONS[name] for name in ("correct", "bench")}
    )
    status = gpu_check.main(["--device", "cpu", "--small", "--out", str(tmp_path / "report.json")])
    report = json.loads((tmp_path / "report.json").read_text())
    assert (
        status == 1
        and len(report["correct"]["failed"]) == len(report["correct"]["relative_errors"]) + 1 == 4
    )
    assert (
        all("gradient by" in words for words in report["correct"]["failed"])
        and report["bench"]["fast"]["ms"] > 0
    )


def test_each_section_is_written_before_the_next_one_runs(monkeypatch, tmp_path):
    def crash(args):
        raise SystemExit("as if somebody had ended the process")

    monkeypatch.setattr(gpu_check, "about", lambda args: {"device": "cpu"})
    monkeypatch.setattr(
        gpu_check, "SECTIONS", {"compile": lambda args: {"first": 1.0}, "correct": crash}
    )
    with pytest.raises(SystemExit):
        gpu_check.main(["--device", "cpu", "--out", str(tmp_path / "report.json")])
    assert json.loads((tmp_path / "report.json").read_text())["compile"]["first"] == 1.0


def test_the_sections_that_are_not_asked_for_are_kept(monkeypatch, tmp_path):
    monkeypatch.setattr(gpu_check, "about", lambda args: {"device": "cpu"})
    sections = {"compile": lambda args: {"first": 2.0}, "correct": lambda args: {}}
    monkeypatch.setattr(gpu_check, "SECTIONS", sections)
    path = tmp_path / "report.json"
    earlier = {"compile": {"first": 1.0}, "correct": {"kept": True}, "old": 3}
    path.write_text(json.dumps({"machine": "another"} | earlier))
    arguments = ["--device", "cpu", "--out", str(path), "--sections", "compile"]
    assert gpu_check.main(arguments) == 0
    report = json.loads(path.read_text())
    assert report["compile"]["first"] == 2.0 and "machine" in report["compile"]
    assert report["correct"] == {"machine": "another", "kept": True} and "old" not in report


def test_a_part_that_hangs_ends_with_all_that_it_started(tmp_path):
    """Like a compiler that starts another process, or a program under compute-sanitizer: such
    children keep the pipes open, and no process waits for them.
    """
    args = gpu_check.parse_arguments([])
    late = tmp_path / "not waited for"
    command = f"(sleep 60; touch '{late}') & echo child $!; sleep 60"
    with pytest.raises(RuntimeError, match=r"more than 1 s: child \d+") as error:
        gpu_processes.run(["sh", "-c", command], args, 1, {})
    child = int(re.search(r"child (\d+)", str(error.value))[1])
    for _ in range(200):  # the signal has been sent, and takes effect soon
        if has_ended(child):
            break
        time.sleep(0.1)
    assert has_ended(child) and not late.exists()


def has_ended(process):
    try:
        return "State:\tZ" in Path(f"/proc/{process}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return True


def test_no_part_begins_when_the_minutes_are_over():
    with pytest.raises(RuntimeError, match="minutes were over"):
        gpu_processes.run(["true"], gpu_check.parse_arguments(["--minutes", "0"]), 60, {})


def test_what_is_timed_is_drawing_alone(monkeypatch):
    scene = gpu_kernels.on("cpu", bench_scenes.make_scene(50))
    draw = gpu_kernels.drawer(scene, 16, 1, "cpu")
    monkeypatch.setattr(torch, "randn", None)
    assert len(draw()) == 8


def test_a_wrong_gradient_of_the_background_is_found(monkeypatch):
    drawer = gpu_kernels.drawer

    def wrong_in_float32(scene, *arguments, **options):
        def draw():
            *others, background = drawer(scene, *arguments, **options)()
            return *others, background * (1.001 if scene.means.dtype == torch.float32 else 1)

        return draw

    args = gpu_check.parse_arguments(["--device", "cpu"])
    assert gpu_kernels.errors_of(args, 300, 33, 2, {})["gradient"] < gpu_kernels.GRADIENT_ERROR
    monkeypatch.setattr(gpu_kernels, "drawer", wrong_in_float32)
    assert gpu_kernels.errors_of(args, 300, 33, 2, {})["gradient"] == pytest.approx(1e-3, rel=0.01)


def test_without_a_gpu_it_says_why(tmp_path):
    done = check("--out", tmp_path / "report.json")
    assert done.returncode == 2 and "nothing was checked" in done.stderr
    assert "nothing was checked" in json.loads((tmp_path / "report.json").read_text())["failed"]


def test_the_fallback_is_drawn_on_the_cpu_too():
    found = gpu_kernels.fallback(gpu_check.parse_arguments(["--device", "cpu", "--small"]))
    assert 0 < found["image"] < gpu_kernels.IMAGE_ERROR
    assert 0 < found["gradient"] < gpu_kernels.GRADIENT_ERROR


@pytest.mark.parametrize(
    "slow, words",
    [
        ({"image": 1e-7, "gradient": 1e-3}, "gradient by 1.00e-03"),
        (RuntimeError("no memory"), "RuntimeError: no memory"),
    ],
)
def test_a_wrong_fallback_is_a_failure(monkeypatch, slow, words):
    right = {"image": 0.0, "gradient": 0.0, "same_bits": True}

    def in_process(name, args):
        if name == "fallback" and isinstance(slow, Exception):
            raise slow
        return slow if name == "fallback" else {"a case": right}

    monkeypatch.setattr(gpu_kernels, "in_process", in_process)
    found = gpu_kernels.correct(gpu_check.parse_arguments(["--device", "cpu", "--small"]))
    assert found["failed"] == [f"plain torch in float32: {words}"]
    assert found["relative_errors"] == {"a case": right}


@pytest.mark.parametrize("verdict", ["", "its kernels differ"])
def test_a_comparison_is_timed(monkeypatch, verdict):
    monkeypatch.setattr(torch, "zeros", lambda *_, device: None)
    monkeypatch.setattr(gpu_kernels, "synchronize", lambda args: None)
    monkeypatch.setattr(proof, "compare", lambda _: time.sleep(0.12) or verdict)
    found = gpu_kernels.comparison(gpu_check.parse_arguments([]))
    assert found["seconds"] >= 0.12 and found["beyond_aim"].endswith(" %")
    assert found["draws"] == len(proof.OPTIONS) and found.get("failed", "") == verdict


def test_a_comparison_beyond_its_aim_says_so():
    aim = gpu_kernels.COMPARISON_AIM
    assert gpu_kernels.beyond_aim(1.5 * aim) == {"beyond_aim": "50 %"}
    assert gpu_kernels.beyond_aim(aim) == {}


def table(tmp_path, monkeypatch, found) -> list[str]:
    """Return the lines of the table of one report."""
    results = tmp_path / "benchmarks/results"
    results.mkdir(parents=True)
    (results / "gpu-a.json").write_text(json.dumps(found))
    monkeypatch.setattr(tables, "ROOT", tmp_path)
    return tables.gpu().splitlines()


def test_the_table_has_aims_and_commits(tmp_path, monkeypatch):
    default = {"unet_ms": 20.0, "other_ms": 3.0, "empty_step_over_unet": 0.444}
    found = {
        "machine": "a CPU; commit 4444444",
        "device": "a GPU",
        "compile": {
            "machine": "a CPU; commit 1111111",
            "later": 0.09,
            "compared": 0.151,
            "comparison": {"seconds": 0.126, "draws": 1},
        },
        "correct": {
            "machine": "a CPU; commit 2222222",
            "fallback": {"image": 2e-7, "gradient": 3e-6},
        },
        "train": {
            "machine": "a CPU; commit 1111111",
            "default": default,
            "lowmem": default | {"other_ms": 3.5},
        },
    }
    lines = table(tmp_path, monkeypatch, found)
    for row in (
        "| comparison at the first use (aim: 0.1 s) | 0.126 s for 1 draw, 26 % beyond the aim |",
        "| what it adds to the first image with a filled cache | 0.061 s |",
        "| plain torch in float32: image, gradients | 2e-07, 3e-06 |",
        "| the rest over the U-Net (aim: 3 %): default, low memory | 15.0 %, 17.5 % |",
        "| that step over the U-Net's time | 0.44 |",
        "| commits of the sections | `1111111`: compile, train; `2222222`: correct |",
    ):
        assert row in lines
    found["compile"]["comparison"] = {"seconds": 0.09, "draws": 3}
    (tmp_path / "benchmarks/results/gpu-a.json").write_text(json.dumps(found))
    assert "(aim: 0.1 s) | 0.090 s for 3 draws |" in tables.gpu()


def test_the_table_names_what_was_not_measured(tmp_path, monkeypatch):
    found = {
        "device": "a GPU",
        "correct": {"failed": "x"},
        "bench": {"fast": {"ms": 2.0, "mb": 3.0}, "gsplat": {"unavailable": "x"}},
    }
    lines = table(tmp_path, monkeypatch, found)
    assert "| forward and backward, fast | 2.00 ms, 3 MB |" in lines
    assert "| forward and backward, gsplat | not measured |" in lines
    assert "| the same bits again | not measured |" in lines
