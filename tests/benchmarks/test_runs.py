"""Measurements of benchmarks: which are missing, and where they are appended."""

from benchmarks.quality import runs


def test_only_what_a_chart_does_not_have_is_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "CHARTS", tmp_path)
    measured = []

    def measure(mesh, seed):
        measured.append((mesh, seed))
        yield {"object": runs.object_name(mesh), "seed": seed, "psnr": 30 + seed}

    columns = ["object", "seed", "psnr", "machine", "commit"]
    parser = runs.argument_parser("What is measured.\n")
    for arguments in (
        ["--seeds", "1"],
        ["--objects", "toy.glb", "b/spot.glb", "--seeds", "0", "1"],
    ):
        runs.measure_missing("chart", columns, parser.parse_args(arguments), measure)
    assert measured == [("toy.glb", 1), ("toy.glb", 0), ("b/spot.glb", 0), ("b/spot.glb", 1)]
    rows = runs.rows_of("chart")
    assert [(row["object"], row["psnr"]) for row in rows] == [
        ("toy", "31"),
        ("toy", "30"),
        ("spot", "30"),
        ("spot", "31"),
    ]
    assert all(row["machine"] and row["commit"] for row in rows)
