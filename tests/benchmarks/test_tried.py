"""The table of what was tried."""

from benchmarks.markdown import read
from benchmarks.quality import tried


def test_every_recorded_idea_is_in_the_table_with_its_page():
    lines = tried.table().splitlines()[2:]
    ideas = [line.split(" | ")[0] for line in lines]
    assert len(set(ideas)) == len(ideas)
    for row in read(tried.RECORDED):
        assert row["area"] in tried.AREAS and row["idea"] and row["finding"]
        (line,) = (line for line in lines if line.startswith(f"| {row['idea']} | "))
        assert f"[{row['area']}]({tried.AREAS[row['area']]})" in line
        assert row["evidence"] or "not tried" in row["finding"] or "not measured" in row["finding"]


def test_changes_of_the_demo_are_compared_with_what_it_has(monkeypatch):
    def row(change, base, name, psnr, floaters, gain=""):
        found = {"change": change, "base": base, "object": name, "psnr": psnr}
        return found | {"floaters": floaters, "gain": gain}

    rows = [
        row("B: two changes", "", "toy", "38.11", "1.9"),
        row("B: two changes", "", "spot", "39.03", "2.3"),
        row("C: 20,000 to 5,000 Gaussians", "B", "toy", "38.42", "1.4", "+0.31"),
        row("40,000 to 5,000 Gaussians", "B", "toy", "38.19", "1.3", "+0.08"),
        row("flat", "B", "toy", "38.00", "1.7", "-0.12"),
        row("flat", "B", "spot", "39.23", "2.0", "+0.20"),
    ]
    monkeypatch.setattr(tried, "rows_of", lambda chart: rows)
    first, second = tried.changes_of_the_demo()
    assert first["idea"] == "40,000 to 5,000 Gaussians (compared with C)"
    assert first["finding"] == "−0.23 dB (toy; floaters 1.4 → 1.3 %)"
    assert second["finding"] == (
        "−0.12 dB (toy; floaters 1.9 → 1.7 %); +0.20 dB (spot; floaters 2.3 → 2.0 %)"
    )
