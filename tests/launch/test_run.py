"""What a run writes beside its results, and concurrent runs in one folder."""

import os
from pathlib import Path

from tests.helpers import tiny_parts
from tests.helpers.gallery import files, only_run
from threestudio_gaussiandreamer.core.checkpoint_file import load_checkpoint
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch import callbacks, experiment, run
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.ddp import ReplicatedStrategy
from threestudio_gaussiandreamer.launch.run_folder import claim


def test_what_is_no_source_in_custom_is_neither_loaded_nor_copied(launch):
    Path("custom/package").mkdir(parents=True)
    Path("custom/part.py").write_text("LOADED = True")
    Path("custom/package/__init__.py").write_text("from . import inner")
    Path("custom/package/inner.py").write_text("")
    for lock in ("custom/.#part.py", "custom/package/.#inner.py", "custom/gone.py"):
        os.symlink("someone@somewhere.1234", lock)  # as Emacs makes while a file is edited
    os.mkfifo("custom/pipe.py")
    os.mkfifo("custom/package/pipe.yaml")
    code, _, err = launch("--train", "trainer.limit_val_batches=0")
    assert code == 0 and "custom/pipe.py is no file" in err
    copied = {name for name in files(only_run() / "code/custom") if not name.endswith(".pyc")}
    assert copied == {"part.py", "package/__init__.py", "package/inner.py"}


def test_a_source_that_can_not_be_read_is_left_out_of_the_copy(monkeypatch, tmp_path):
    for name in ("secret.py", "part.py", ".hidden.py", "data.npy"):
        (tmp_path / name).touch()
    read, folder = Path.read_bytes, tmp_path
    secret = lambda path: read(folder if path.name == "secret.py" else path)  # noqa: E731
    monkeypatch.setattr(Path, "read_bytes", secret)
    assert callbacks.read_sources(tmp_path, Path("code")) == {Path("code/part.py"): b""}


def test_the_record_holds_what_was_read_and_said(launch, monkeypatch):
    """Of a file that is deleted meanwhile, of a name that is no UTF-8, and over a pipe."""
    name = os.fsdecode(b"caf\xe9.yaml")
    Path(name).write_text(tiny_parts.CONFIG)
    folder = Path("outputs/tiny/t")
    (folder / "configs").mkdir(parents=True)
    os.mkfifo(folder / "configs/raw.yaml")
    monkeypatch.setattr(tiny_parts.TinySystem, "post_configure", lambda self: os.unlink(name))
    assert launch("--train", "use_timestamp=false", "tag=t", config=name)[0] == 0
    assert (folder / "configs/raw.yaml").read_text() == tiny_parts.CONFIG
    assert b"--config 'caf\xe9.yaml' --train" in (folder / "cmd.txt").read_bytes()


def test_options_of_the_trainer(launch, monkeypatch):
    """DDP's wrapper would keep the parameters that densification replaces."""
    made = []

    def build(section, owner, options):
        made.append(options)
        raise UserError("of the test")

    monkeypatch.setattr(run, "build", build)
    monkeypatch.setattr(experiment, "announce_device", lambda gpu: 2)
    for option in ("trainer.profiler=simple", "trainer.strategy=auto", "trainer.strategy=ddp"):
        assert launch("--train", option)[0] == 2
        assert isinstance(made[-1]["strategy"], ReplicatedStrategy) and made[-1]["devices"] == 2
    assert made[0]["profiler"] == "simple" and len(made) == 3


ONE_FOLDER = ["use_timestamp=false", "tag=run"]


def test_a_run_from_step_0_puts_earlier_work_aside(launch, monkeypatch):
    """Else resume=auto may take a later step of the earlier run; the prior serves again."""
    folder = Path("outputs/tiny/run")
    save, aside = folder / "save", folder / "save-2"
    for name in ("it9-export", "prior"):
        (save / name).mkdir(parents=True)
        (save / name / "file").write_text(name)
    assert launch("--train", *ONE_FOLDER, "trainer.max_steps=4")[0] == 0
    assert {path.name for path in aside.iterdir()} == {"it9-export"}
    assert (save / "prior/file").read_text() == "prior" and not (save / "it9-export").exists()
    # a run may start from the weights of the checkpoints that it puts aside
    weights = f"system.weights={folder}/ckpts/last.ckpt"
    assert launch("--train", *ONE_FOLDER, "trainer.max_steps=2", weights)[0] == 0
    (earlier,) = folder.glob("ckpts-*")
    kept = [load_checkpoint(path / "last.ckpt") for path in (earlier, folder / "ckpts")]
    assert [content["global_step"] for content in kept] == [4, 2]
    results = {path.name for path in folder.glob("save*")}
    code, out, err = launch("--train", *ONE_FOLDER, "trainer.max_steps=3", "seed=5", "resume=auto")
    assert code == 0 and {path.name for path in folder.glob("save*")} == results
    assert "(step 2)" in out + err and "of another run: seed was 3, now it is 5" in out + err


def test_a_start_that_fails_leaves_the_earlier_run_in_its_place(launch, monkeypatch):
    """The prior runs in ``configure_optimizers``; ``training_step`` is before a checkpoint."""

    def fail(*_: object) -> None:
        raise UserError("none.glb does not exist")

    Path("custom").mkdir()
    Path("custom/part.py").write_text("OF = 'the first run'")
    assert launch("--train", *ONE_FOLDER)[0] == 0
    folder = Path("outputs/tiny/run")
    names = {name for name in files(folder) if name.startswith(("configs/", "code/", "ckpts/"))}
    names.add("cmd.txt")
    record = {name: (folder / name).read_bytes() for name in names}
    Path("custom/part.py").write_text("OF = 'the second'")
    resumed = ["resume=auto", "seed=5", "trainer.max_steps=9"]
    for stage in ("configure_optimizers", "training_step", None):
        for options in (["seed=5"], resumed) if stage else ([*resumed, "system.geometry.size=4"],):
            with monkeypatch.context() as patch:
                if stage:
                    patch.setattr(tiny_parts.TinySystem, stage, fail)
                code, out, err = launch("--train", *ONE_FOLDER, *options)
            message = "none.glb does not exist" if stage else "was made by another configuration"
            assert code and message in out + err
            assert "to resume" not in out or "resume=auto" in options
            assert {name: (folder / name).read_bytes() for name in names} == record
            assert not (folder / "ckpts-2").exists()
    again = ["resume=auto", "trainer.max_steps=8"]
    assert launch("--train", *again, config=str(folder / "configs/parsed.yaml"))[0] == 0
    assert load_checkpoint(folder / "ckpts/last.ckpt")["global_step"] == 8
    assert load_config(folder / "configs/parsed.yaml").seed == 3


def test_the_record_of_a_new_run_is_written_with_its_first_checkpoint(launch, monkeypatch):
    """At each write there is either no checkpoint beside the record, or one of the same run."""
    assert launch("--train", *ONE_FOLDER)[0] == 0
    folder = Path("outputs/tiny/run")
    parsed, last, seen = folder / "configs/parsed.yaml", folder / "ckpts/last.ckpt", []

    def save(path, content):
        seen.append((load_config(parsed).seed, last.is_file()))
        save_file(path, content)

    save_file = callbacks.save_file
    monkeypatch.setattr(callbacks, "save_file", save)
    assert launch("--train", *ONE_FOLDER, "seed=5")[0] == 0
    assert seen[0] == (5, False)
    seen.clear()
    go_on = ["resume=auto", "trainer.max_steps=9"]
    assert launch("--train", *ONE_FOLDER, *go_on, "seed=7")[0] == 0
    assert seen[0] == (5, True) and load_config(parsed).seed == 7


def test_a_folder_in_use_is_refused_before_the_parts_are_built(launch, monkeypatch):
    first = claim(Path("outputs/tiny/run"))
    monkeypatch.setattr(tiny_parts.TinySystem, "configure", lambda self: 1 / 0)
    code, _, err = launch("--train", *ONE_FOLDER)
    first.release()
    assert code == 2 and "another run is training in outputs/tiny/run" in err


def test_runs_of_one_second_have_a_folder_each(launch, noon):
    for _ in range(2):
        assert launch("--train", "trainer.max_steps=1", "trainer.limit_val_batches=0")[0] == 0
    folders = sorted(Path("outputs/tiny").iterdir())
    name = "a_red_ball@20260131-120000"
    assert [folder.name for folder in folders] == [name, f"{name}-2"]
    assert load_config(folders[1] / "configs/parsed.yaml").trial_dir == str(folders[1])


def test_two_stages_in_one_folder(launch, trained, monkeypatch):
    """A second --test is refused, one beside a training isn't; a file that is gone is named."""
    options = ("--test", f"resume={trained}/ckpts/last.ckpt")
    config = f"{trained}/configs/parsed.yaml"
    training, other = claim(trained), claim(trained / ".test")
    code, _, err = launch(*options, config=config)
    assert code == 2 and f"another --test is at work in {trained}/.test" in err
    other.discard()
    assert launch(*options, config=config)[0] == 0 and not (trained / ".test").exists()
    training.release()
    test_step = tiny_parts.TinySystem.test_step

    def removed_after(system, batch, batch_idx):
        test_step(system, batch, batch_idx)
        Path(system.get_save_path(f"it6-test/{int(batch['index'])}.png")).unlink()
        open(system.get_save_path("it6-test/0.png"), "rb")

    monkeypatch.setattr(tiny_parts.TinySystem, "test_step", removed_after)
    code, _, err = launch(*options, config=config)
    assert code == 2 and "another command works in" in err and "it6-test/0.png" in err
