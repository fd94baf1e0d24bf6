"""The runs of ``tests/helpers/gallery.py``: what each leaves."""

from tests.helpers.gallery import assert_same_training, files

TESTED = {
    *(f"ckpts/{name}.ckpt" for name in ("epoch=0-step=8", "last")),
    *(f"configs/{name}.yaml" for name in ("raw", "parsed")),
    *(f"save/it8-export/{name}" for name in ("gaussians.ply", "gaussians.spz", "view.html")),
    *(f"save/it8-test{name}" for name in (".mp4", ".webp", "/0.png", "/1.png")),
    "cmd.txt", "csv_logs/version_0/metrics.csv", "index.html", "save/it8-0.png", "times.json",
}  # fmt: skip


def test_what_finished_runs_leave(gallery):
    prior = {f"save/prior/{name}" for name in ("points.npz", "points.ply")}
    step_4 = {"ckpts/epoch=0-step=4.ckpt", "save/it4-0.png"}
    assert TESTED | prior | step_4 <= files(gallery("trained"))
    assert TESTED <= (resumed := files(gallery("resumed"))) and not resumed & (prior | step_4)
    assert gallery.code("trained") == gallery.code("resumed") == gallery.code("exported") == 0
    exported = {path.suffix for path in (gallery("exported") / "save/it8-export").iterdir()}
    assert exported >= {".ply", ".spz", ".sog", ".glb", ".usda"}


def test_a_resumed_run_ends_as_the_uninterrupted_one(gallery):
    ends = (gallery(name) / "ckpts/last.ckpt" for name in ("trained", "resumed"))
    assert_same_training(*ends)


def test_a_failed_run_keeps_its_checkpoint(gallery, copied):
    assert gallery.code("failed") == 2
    assert "error: the guidance has failed" in gallery.said("failed")
    assert {"ckpts/last.ckpt", "csv_logs/version_0/metrics.csv"} <= files(copied("failed"))
