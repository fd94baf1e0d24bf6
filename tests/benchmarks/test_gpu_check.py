"""The GPU check runs from end to end on the CPU, at a tiny size."""

import json
import re
import time
from pathlib import Path

import pytest
import torch

from benchmarks.splatting import (
    gpu_check,
    gpu_kernels,
    gpu_processes,
    gpu_prune,
    gpu_training,
)

ROOT = Path(__file__).parents[2]


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
    failed = report["correct"]["failed"]
    assert status == 1 and len(failed) == len(report["correct"]["relative_errors"]) + 1 == 4
    assert all("gradient by" in words for words in failed) and report["bench"]["fast"]["ms"] > 0


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


def test_without_a_gpu_it_says_why(tmp_path, capfd):
    assert gpu_check.main(["--out", str(tmp_path / "report.json")]) == 2
    assert "nothing was checked" in capfd.readouterr().err
    assert "nothing was checked" in json.loads((tmp_path / "report.json").read_text())["failed"]
