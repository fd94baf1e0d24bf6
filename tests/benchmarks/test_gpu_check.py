"""The GPU check runs from end to end on the CPU, at a tiny size."""

import json

import pytest

from benchmarks.splatting import gpu_check, gpu_kernels, gpu_processes, gpu_prune, gpu_training


@pytest.fixture
def parts_here(monkeypatch):
    """Run the parts in this process: processes of their own take longer for their imports."""

    def here(name, args, environment=None):
        if name == "speed":
            return gpu_processes.in_process(name, args, environment)
        with pytest.MonkeyPatch.context() as patch:
            for key, value in (environment or {}).items():
                patch.setenv(key, value)
            return json.loads(json.dumps(gpu_check.PARTS[name](args)))

    for module in (gpu_check, gpu_kernels, gpu_prune, gpu_training):
        monkeypatch.setattr(module, "in_process", here)


@pytest.mark.slow
def test_every_section_runs_and_reports(parts_here, tmp_path, monkeypatch, capfd):
    pytest.importorskip("diffusers")
    out = tmp_path / "report.json"
    arguments = ["--device", "cpu", "--small", "--out", str(out)]
    assert gpu_check.main(arguments) == 0, "".join(capfd.readouterr())
    report = json.loads(out.read_text())
    assert all(cell["gradient"] < 2e-5 for cell in report["correct"]["relative_errors"].values())
    default, lowmem = report["train"]["default"], report["train"]["lowmem"]
    assert default["ms_per_step"] > default["unet_ms"] > 0 and lowmem["ms_per_step"] > 0
    assert default["unet_ms"] > default["empty_networks"]["unet_ms"] > 0
    assert 0 < report["correct"]["fallback"]["gradient"] < 2e-5
    assert report["demos"]["demo.yaml"]["psnr"] > 10
    assert report["demos"]["toybox.yaml"]["unet_ms"] > 0
    assert report["prune"]["gaussians"] == [800, 200] and report["prune"]["psnr"] > 20
    assert report["compile"]["first"] > 0 and report["bench"]["fast"]["ms"] > 0
    # a section that fails is recorded; those that aren't asked for are kept
    monkeypatch.setattr(gpu_kernels, "GRADIENT_ERROR", 0.0)
    assert gpu_check.main([*arguments, "--sections", "correct"]) == 1
    report = json.loads(out.read_text())
    assert len(report["correct"]["failed"]) == len(report["correct"]["relative_errors"]) + 1
    assert report["bench"]["fast"]["ms"] > 0


def test_without_a_gpu_it_says_why(tmp_path, capfd):
    assert gpu_check.main(["--out", str(tmp_path / "report.json")]) == 2
    assert "nothing was checked" in capfd.readouterr().err
    assert "nothing was checked" in json.loads((tmp_path / "report.json").read_text())["failed"]
