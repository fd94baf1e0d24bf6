"""What a user does wrong gives one message with the remedy, exit code 2, and no files."""

import shutil
from pathlib import Path

import pytest

from .commands import SMOKE, command, full_disk, launch, refused

OVERRIDES = [
    # a misspelt key, name or value: the nearest valid one
    ("system.geometry.grow.radus=1", "did you mean 'system.geometry.grow.radius'"),
    ("trainer.max_stps=3", "did you mean 'trainer.max_steps'"),
    ("checkpoint.save_lst=true", "did you mean 'checkpoint.save_last'"),
    ("sed=3", "did you mean 'seed'"),
    ("system.loss.lambda_sdss=1", "did you mean 'lambda_sds'"),
    ("system.geometry.prior_type=randm-prior", "did you mean 'random-prior'"),
    ("system.exporter.formats=[plly]", "did you mean 'ply'"),
    ("system.renderer.preset=fst", "did you mean 'fast'"),
    ("system.guidance.variant_type=sds", "unknown variant 'sds': choose from"),
    # another kind of part
    ("system.geometry.prior_type=ply-exporter", "a part of the kind exporter"),
    # a wrong type or length
    ("data.n_test_views=[1]", "data.n_test_views: expected a whole number, got [1]"),
    ("data.width=wide", "data.width: expected whole numbers from 1 to 16384, got 'wide'"),
    ("data.elevation_range=[1]", "data.elevation_range: expected a list of 2, got [1]"),
    ("system.geometry.densify.enabled=3", "system.geometry.densify.enabled: expected true or"),
    ("system.renderer.eps2d=.nan", "system.renderer.eps2d: expected a finite number"),
    # out of range
    ("system.renderer.eps2d=-1", "system.renderer.eps2d: expected 0 or more"),
    ("data.eval_fovy_deg=180", "data.eval_fovy_deg: expected a number from 0.001 to 179.999"),
    ("system.geometry.densify.stop=1", "densify.stop: expected more than start"),
    ("trainer.max_steps=-5", "trainer.max_steps: expected -1 or more"),
    ("seed=" + 400 * "9", "seed: expected a whole number of at most 64 bits"),
    # across options
    ("system.geometry.max_gaussians=1", "expected min_gaussians (64) or more"),
    ("system.optimizer.args.bets=[0.9,0.9]", "unknown argument 'bets': did you mean 'betas'?"),
    # missing
    ("system.guidance=", "system.guidance is empty"),
    ("system.prompt_processor.prompt=???", "'???' can't be a text"),
    ("resume=nothing.ckpt", "there is no checkpoint nothing.ckpt"),
    ("resume=atuo", "did you mean resume=auto"),
    ("system.geometry.prior_type=mesh-prior", "system.geometry.prior.path"),
    ("trial_dir=x", "trial_dir is computed: set exp_root_dir"),
]


@pytest.mark.parametrize(("override", "message"), OVERRIDES)
def test_a_wrong_override_is_refused_before_any_work(override, message):
    result = launch(*SMOKE, override)
    refused(result, message)
    assert not list(Path().iterdir()) and "the cloud starts" not in result.said


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [", "bad.yaml"),
        ("- 1", "bad.yaml"),
        ("system: 3", "system"),
        ("\x00", "bad.yaml"),
        ("${oc.env:nothing}: 1", "nothing"),
        ("tag: ${nothing.here}", "nothing"),
    ],
)
def test_a_broken_configuration_is_named(text, message):
    Path("bad.yaml").write_text(text)
    refused(launch(*SMOKE, "--config", "bad.yaml"), message)


def test_a_missing_file_is_named_with_its_near_names(trained):
    refused(launch("--config", "smok.yaml", "--train"), "smok.yaml", "smoke.yaml")
    mesh = ["system.geometry.prior_type=mesh-prior", "system.geometry.prior.path=fox.glb"]
    Path("fox.obj").touch()
    refused(launch(*SMOKE, *mesh), "'fox.glb' does not exist", "fox.obj")
    for module in ("convert", "prune"):
        budget = ["--count", "9"] if module == "prune" else []
        refused(command(module, "fox.ply", "out.ply", *budget), "fox.ply")
    refused(command("view", "fox.ply", "--html"), "fox.ply")
    refused(command("evaluate", ".", "--metrics", "clip", "--clip", "clip-L"), "--clip clip-L")
    refused(command("farm", "prompts.txt", "--config", "smoke.yaml"), "prompts.txt")


def test_wrong_arguments_of_commands_are_named(trained):
    cloud = trained / "save/it8-export/gaussians.ply"
    refused(command("convert", cloud, "out.xyz"), "out.xyz")
    refused(command("convert", cloud, "out.ply", "--harmonics", "9"), "--harmonics")
    refused(command("prune", cloud, "out.ply", "--bytes", "many"), "--bytes")
    refused(command("prune", cloud, "out.ply", "--within", "0.1dB"), "--quality")
    refused(command("view", cloud, "--html", "--background", "white"), "--background")
    assert not list(Path().iterdir())


@pytest.mark.parametrize("damage", ["cut", "flipped", "text", "empty"])
def test_a_damaged_checkpoint_is_named(earlier, damage):
    path = earlier / "ckpts/last.ckpt"
    data = bytearray(path.read_bytes())
    data[5000] ^= 255
    broken = {"cut": data[:-500], "flipped": data, "text": b"hello", "empty": b""}
    path.write_bytes(broken[damage])
    refused(launch(*SMOKE, f"resume={path}"), str(path))
    refused(command("convert", path, "out.ply"), "last.ckpt")
    assert not Path("out.ply").exists() and not Path("outputs").exists()


@pytest.mark.parametrize("name", ["gaussians.ply", "gaussians.spz"])
def test_a_damaged_cloud_is_named(trained, name):
    data = (trained / "save/it8-export" / name).read_bytes()
    Path(name).write_bytes(data[: len(data) // 2])
    refused(command("convert", name, "out.sog"), name)
    assert not Path("out.sog").exists()


def test_another_run_is_named_when_its_checkpoint_is_resumed(earlier):
    """With options that don't fit its tensors; the change is named, not a tensor's shape."""
    resume = f"resume={earlier}/ckpts/last.ckpt"
    refused(launch(*SMOKE, resume), "system.geometry.sh_degree was 1, now it is 0")


# -- the disk --------------------------------------------------------------------------------------


def test_an_unwritable_folder_is_found_before_any_work(trained):
    Path("a-file").touch()
    result = launch(*SMOKE, "exp_root_dir=a-file/outputs")
    refused(result, "can't be written", "choose another exp_root_dir")
    assert "the cloud starts" not in result.said
    cloud = trained / "save/it8-export/gaussians.ply"
    refused(command("convert", cloud, "a-file/out.ply"), "'a-file'")
    refused(command("prune", cloud, "a-file/out.ply", "--count", "9"), "a-file")
    refused(command("view", cloud, "--html", "a-file/out.html"), "a-file")


def test_a_full_disk_is_named_and_leaves_what_was_there(trained, earlier):
    cloud = trained / "save/it8-export/gaussians.ply"
    Path("out.ply").write_text("before")
    with full_disk(4000):
        refused(command("convert", cloud, "out.ply"), "out.ply", "File too large")
    assert Path("out.ply").read_text() == "before"
    last = earlier / "ckpts/last.ckpt"
    before = last.read_bytes()
    with full_disk(20_000):
        config = earlier / "configs/parsed.yaml"
        result = launch("--config", config, "--train", "resume=auto", "trainer.max_steps=10")
    refused(result, "File too large")
    assert last.read_bytes() == before and not list(earlier.rglob("*.tmp"))


def test_a_results_place_that_is_a_file_is_found_before_any_work():
    folder = Path("outputs/smoke/t")
    folder.mkdir(parents=True)
    (folder / "ckpts").touch()
    refused(launch(*SMOKE, "use_timestamp=false", "tag=t"), "ckpts")


def test_an_earlier_run_in_the_folder_is_set_aside(earlier):
    folder = Path("outputs/smoke/t")
    shutil.copytree(earlier, folder)
    where = ["use_timestamp=false", "tag=t", "trainer.max_steps=1", "system.pages=false"]
    assert launch(*SMOKE, *where).code == 0
    before, aside = earlier / "ckpts/last.ckpt", folder / "ckpts-2/last.ckpt"
    assert aside.read_bytes() == before.read_bytes()
