"""The paired measurement of the CPU kernel, its table, and how its costs grow."""

import pytest
import torch

from benchmarks.markdown import read, write
from benchmarks.quality.runs import ROOT
from benchmarks.splatting import growth, kernel_tables, pairs
from benchmarks.splatting.scenes import trained
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.splatting.cpu import backend as cpu

needs_kernel = pytest.mark.skipif(bool(cpu.unavailable()), reason="the kernel isn't built")


def test_the_demos_case_has_its_settings():
    demo = load_config(ROOT / "configs/demo.yaml")
    case = pairs.make_case("demo's settings 256")
    assert len(case.cloud.means) == 4 * len(trained().means) == 10_000
    assert len(case.viewmats) == demo.data.batch_size and case.size == demo.data.width
    assert (case.options.antialias, case.options.eps2d, case.options.alpha_min) == (
        demo.system.renderer.antialias,
        demo.system.renderer.eps2d,
        1 / 255,
    )
    assert (
        case.options.antialias and case.options.eps2d != pairs.make_case("demo 256").options.eps2d
    )


def test_split_gaussians_are_smaller_and_cover_the_same_place():
    whole = trained()
    parts = pairs.split_all(whole)
    torch.testing.assert_close(parts.scales[:2500], whole.scales / 1.6)
    torch.testing.assert_close(parts.colors, whole.colors.repeat(2, 1))
    torch.testing.assert_close(parts.means.std(0), whole.means.std(0), rtol=0.05, atol=0)


@needs_kernel
def test_a_case_is_measured_with_each_number_of_threads(tmp_path, monkeypatch):
    monkeypatch.setattr(pairs, "RESULTS", tmp_path / "kernel.csv")
    monkeypatch.setattr(cpu, "usable_builds", lambda: ["v3", "base"])
    library = cpu.library()
    monkeypatch.setattr(cpu, "_load", lambda build: library)
    arguments = ["--against", str(ROOT), "--rounds", "1", "--threads", "1", "2"]
    monkeypatch.setattr("sys.argv", ["", *arguments, "--cases", "demo 256"])
    pairs.main()
    rows = read(pairs.RESULTS)
    found = [(row["contender"], row["threads"], row["build"]) for row in rows]
    assert found == [(name, n, "v3") for n in "12" for name in ("before", "now")]
    assert all(row["machine"].endswith("without AVX-512") and row["commit"] for row in rows)
    assert all(float(row["both_ms"]) > float(row["forward_ms"]) > 0 for row in rows)


def rows_of(scene, build, times, machine="a", threads="1", commits=("b1", "n1", "")):
    place = {"scene": scene, "gaussians": "1000", "views": "4", "size": "64", "build": build}
    place |= {"threads": threads, "machine": machine, "forward_ms": "1"}
    names = ("before", "now", "prototype")
    return [
        place | {"contender": name, "both_ms": str(ms), "commit": commit}
        for name, ms, commit in zip(names, times, commits, strict=False)
    ]


def test_the_kernels_table_says_which_aims_are_reached(tmp_path, monkeypatch):
    monkeypatch.setattr(kernel_tables, "KERNEL", tmp_path / "kernel.csv")
    rows = [
        *rows_of("surface", "v4", (20, 9, 10)),
        *rows_of("surface", "v3", (20, 16, 10)),
        *rows_of("demo", "v3", (20, 14)),
        *rows_of("demo's settings", "v3", (20, 15)),
        *rows_of("demo's settings", "v3", (20, 13), threads="2"),
        *rows_of("surface", "v3", (20, 16), machine="b"),
    ]
    write(kernel_tables.KERNEL, pairs.COLUMNS, rows)
    first, second = kernel_tables.kernel().split("\n\nb:")
    ends = [line.split(" | ", 4)[-1] for line in first.splitlines()[4:]]
    assert ends == [
        "0.45 | 0.90 | ≤ 1.0 of the prototype: reached; ≤ 0.8 of the prototype: missed |",
        "0.80 | 1.60 | ≤ 1.5 of the prototype: missed |",
        "0.70 |  | ≤ 0.7 of before: reached |",
        "0.75 |  | ≤ 0.7 of before: missed |",
        "0.65 |  |  |",
    ]
    assert first.startswith("a:\n") and "4 × 64², 2 threads | v3 |" in first
    assert second.endswith("≤ 1.5 of the prototype: not measured |")


def test_growth_is_drawn_and_described_from_its_rows(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(growth, "CSV", tmp_path / "growth.csv")
    place = {"machine": "a processor", "commit": "abc"}
    rows = [
        {"gaussians": n, "cpu_seconds": 1e-6 * n, "memory_mb": n**0.5} | place
        for n in (10_000, 1_000_000, 4_000_000)
    ]
    write(growth.CSV, (*growth.MEASURED, *growth.PLACE), rows)
    text = growth.table()
    assert "on a processor, commit abc. From 1,000,000 to 4,000,000" in text
    assert "1.00 (seconds) and 0.50 (memory)" in text and "| 10,000 | 0.01 | 100 |" in text
    monkeypatch.setattr("sys.argv", ["", "--from-csv"])
    growth.main()
    assert (tmp_path / "growth.png").is_file() and read(growth.CSV)[0]["commit"] == "abc"


@needs_kernel
def test_growth_notes_processor_and_commit(monkeypatch):
    answer = type("Done", (), {"stdout": '{"cpu_seconds": 0.123456, "memory_mb": 70.0}\n'})
    monkeypatch.setattr(growth.subprocess, "run", lambda *_, **__: answer)
    row = growth.measure(10_000)
    assert row["cpu_seconds"] == "0.1235" and set(row) == {*growth.MEASURED, *growth.PLACE}
    assert "AVX-512" in row["machine"] and row["commit"]
