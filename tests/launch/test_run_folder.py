"""The folder of a run: found again when it was moved, locked, removed only by its creator."""

import fcntl
import json
import multiprocessing
import os
import shutil
import signal
import socket
import time
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from tests.launch.cases import load
from threestudio_gaussiandreamer.core.checkpoint_file import save_file
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch import run_folder
from threestudio_gaussiandreamer.launch.config import dump_config, load_config
from threestudio_gaussiandreamer.launch.run_folder import FolderInUse, claim, require_writable

CHECKPOINT = {"state_dict": {}, "epoch": 0, "global_step": 3}


def test_paths_of_one_file_are_no_change(folder):
    assert run_folder._is_same("my.glb", "./my.glb") and run_folder._is_same(3, 3)
    assert run_folder._is_same("my.glb", str(Path("my.glb").absolute()))
    assert not run_folder._is_same("my.glb", "other.glb") and not run_folder._is_same(3, "3")


@pytest.fixture
def copied(folder):
    """A run's folder, copied and renamed; both have a checkpoint."""
    run = Path(load("tag=a", "use_timestamp=false").trial_dir)
    save_file(run / "ckpts/last.ckpt", CHECKPOINT)
    (run / "configs").mkdir()
    dump_config(run / "configs/parsed.yaml", load("tag=a", "use_timestamp=false"))
    return shutil.copytree(run, folder / "outputs/tiny/b")


def test_a_copy_of_a_run_continues_in_its_own_folder_or_is_left_for_others(folder, copied):
    parsed = "outputs/tiny/b/configs/parsed.yaml"
    others = {"resume=outputs/tiny/a/ckpts/last.ckpt": "a", "tag=c": "c", "seed=1": "a"}
    for option, name in others.items():
        more = ["resume=auto"] if name == "c" else []
        assert load_config(parsed, cli_args=[option, *more]).trial_dir == f"outputs/tiny/{name}"
    for resume in 2 * ["auto", "outputs/tiny/b/ckpts/last.ckpt"]:
        cfg = load_config(parsed, cli_args=[f"resume={resume}"])
        assert cfg.trial_dir == str(copied) and cfg.trial_name == "b" and not cfg.new_folder
        assert Path(cfg.resume).resolve() == copied / "ckpts/last.ckpt"
        dump_config(parsed, cfg)  # as the run does, which is resumed once more


def test_of_another_part_only_its_type_is_named(folder):
    system = {"background_type": "sky", "background": {"mode": "random"}}
    (folder / "a/configs").mkdir(parents=True)
    (folder / "a/configs/parsed.yaml").write_text(json.dumps({"system": system}))
    cfg = OmegaConf.create({"resume": str(folder / "a/ckpts/last.ckpt"), "system": {}})
    kind = "system.background_type was 'sky', now it is 'gaussiandreamer-background'"
    assert run_folder.changes_since(cfg, run_folder.SIZES) == [kind]
    cfg.system = {"background_type": "sky", "background": {"mode": "fixed"}}
    mode = "system.background.mode was 'random', now it is 'fixed'"
    assert run_folder.changes_since(cfg, run_folder.SIZES) == [mode]


def test_a_run_of_the_same_name_elsewhere_is_left_with_a_warning(folder, caplog):
    cfg = load("tag=a", "use_timestamp=false", "resume=other/outputs/tiny/a/ckpts/last.ckpt")
    here, other = folder / "outputs/tiny/a", folder / "other/outputs/tiny/a"
    said = f"the checkpoint is of the run in {other}; this one writes to {here}"
    assert Path(cfg.trial_dir).absolute() == here and said in caplog.text


def test_a_run_of_the_same_second_is_resumed_in_its_folder(folder, noon):
    first = load("tag=a")
    save_file(Path(first.trial_dir, "ckpts/last.ckpt"), CHECKPOINT)
    again = load("tag=a", "resume=auto")
    assert first.new_folder and not again.new_folder and again.trial_dir == first.trial_dir


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return Path("outputs/tiny/run")


def stop_before(monkeypatch, owner, name) -> None:
    """Stop this process with SIGSTOP before each call of ``owner.name``."""
    original = getattr(owner, name)

    def stopping(*arguments, **named):
        os.kill(os.getpid(), signal.SIGSTOP)
        return original(*arguments, **named)

    monkeypatch.setattr(owner, name, stopping)


def stopped_child(work) -> int:
    """Fork a process that does ``work`` until it stops itself; it exits with 0, 3 (in use) or 1."""
    child = os.fork()
    if child == 0:
        try:
            work()
            os._exit(0)
        except FolderInUse:
            os._exit(3)
        except BaseException:
            os._exit(1)
    assert os.WIFSTOPPED(os.waitpid(child, os.WUNTRACED)[1])
    return child


def go_on(child: int) -> int:
    """Continue a stopped child until it ends; return its exit code."""
    os.kill(child, signal.SIGCONT)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def test_the_creator_without_the_lock_does_not_remove_the_folder(place, monkeypatch):
    with monkeypatch.context() as patch:
        stop_before(patch, fcntl, "flock")
        loser = stopped_child(lambda: claim(place).discard())
    winner = claim(place)
    (place / "ckpts").mkdir()
    assert go_on(loser) == 3 and (place / "ckpts").is_dir()
    winner.release()


def test_a_folder_that_is_about_to_be_removed_is_made_again(place, monkeypatch):
    with monkeypatch.context() as patch:
        stop_before(patch, run_folder.shutil, "rmtree")
        maker = stopped_child(lambda: claim(place).discard())
    other = claim(place)
    assert other.first_made == place and go_on(maker) == 0 and place.is_dir()
    other.discard()
    # gone with the parents, but for those that the first one made
    assert os.listdir("outputs/tiny") == []


def test_a_lock_of_a_removed_folder_is_not_taken_for_one_of_the_new_folder(place, monkeypatch):
    """Between opening and locking, the folder's creator removes it and releases the lock."""
    first, flock = claim(place), fcntl.flock

    def remove_then_lock(*arguments):
        first.discard()
        flock(*arguments)

    monkeypatch.setattr(fcntl, "flock", remove_then_lock)
    second = claim(place)
    assert second.first_made == Path("outputs") and place.is_dir()
    with pytest.raises(FolderInUse):
        claim(place)
    second.release()


def test_parents_of_another_run_stay(place):
    first = claim(place)
    other = claim(place.with_name("other"))
    assert other.first_made == other.path
    first.discard()
    assert os.listdir("outputs/tiny") == ["other"]
    other.discard()
    # its own parents were the first run's to remove
    assert os.listdir("outputs/tiny") == []


def test_a_parent_that_was_just_removed_is_made_again(place, monkeypatch):
    failures = [FileNotFoundError(2, "removed by its creator")] * 3

    def mkdir(path, **options):
        if failures:
            raise failures.pop()
        os.makedirs(path)

    monkeypatch.setattr(Path, "mkdir", mkdir)
    assert run_folder.make_folder(place) == Path("outputs") and place.is_dir()


def test_the_message_names_the_process_that_holds_the_folder(place, monkeypatch):
    monkeypatch.setattr("sys.argv", ["launch.py", "--train", "tag=a b"])

    def hold():
        claim(place)
        os.kill(os.getpid(), signal.SIGSTOP)

    other = stopped_child(hold)
    command = "launch.py --train 'tag=a b'"
    held = rf"tiny/run \(process {other} on {socket.gethostname()}: {command}\): wait until"
    with pytest.raises(FolderInUse, match=held):
        claim(place)
    os.kill(other, signal.SIGKILL)
    os.waitpid(other, 0)
    claim(place).release()
    assert list(place.iterdir()) == []
    again = claim(place)
    (place / ".lock").unlink()
    (place / ".lock").mkdir()  # can't be unlinked, as on a disk that has become read-only
    again.release()
    claim(place).release()


def test_without_flock_a_file_keeps_a_second_run_away(place, monkeypatch):
    def unsupported(*arguments):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", unsupported)
    first = claim(place)
    with pytest.raises(FolderInUse, match="another run is training in outputs/tiny/run.*remove"):
        claim(place)
    other = run_folder.claim_new(place)
    assert other.path == place.with_name("run-2")
    rename = Path.rename

    def rename_before_another_run(path, target):
        rename(path, target)
        path.mkdir()
        (path / ".lock").touch()

    monkeypatch.setattr(Path, "rename", rename_before_another_run)
    other.discard()
    assert os.listdir(other.path) == [".lock"]
    first.release()
    assert list(place.iterdir()) == []
    monkeypatch.setattr(os, "open", unsupported)
    with pytest.raises(UserError, match="can't be written: Operation not supported"):
        claim(place)


def test_a_folder_that_can_not_be_renamed_is_removed_in_place(place, monkeypatch):
    monkeypatch.setattr(Path, "rename", lambda path, target: os.rename("nothing", target))
    claim(place).discard()
    assert not Path("outputs").exists()
    place.mkdir(parents=True)  # one that was there is never removed
    claim(place).discard()
    assert place.is_dir()


def claim_numbered(path: Path, start, results) -> None:
    start.wait()
    results.put(str(run_folder.claim_new(path).path))
    time.sleep(0.2)  # as a run would keep it


def test_runs_of_one_second_get_a_folder_each(place):
    fork = multiprocessing.get_context("fork")
    start, results = fork.Event(), fork.Queue()
    runs = [fork.Process(target=claim_numbered, args=(place, start, results)) for _ in range(6)]
    for run in runs:
        run.start()
    start.set()
    found = sorted(results.get(timeout=30) for _ in runs)
    for run in runs:
        run.join()
    names = ["run", *(f"run-{number}" for number in range(2, 7))]
    assert found == [f"outputs/tiny/{name}" for name in names]
    assert sorted(os.listdir("outputs/tiny")) == names


@pytest.mark.parametrize(
    ("name", "make"),
    [
        *(("ckpts", Path.touch), ("save", Path.touch), ("ckpts/last.ckpt", Path.mkdir)),
        *(("cmd.txt", Path.mkdir), ("cmd.txt", os.mkfifo)),  # writing to it would wait for a reader
    ],
)
def test_a_path_that_blocks_a_result_is_found_before_the_work(place, name, make):
    (place / name).parent.mkdir(parents=True)
    make(place / name)
    with pytest.raises(UserError, match=f"{name} is no writable"):
        require_writable(place)


def test_a_checkpoint_may_be_protected_or_a_broken_link(place, monkeypatch):
    """It is replaced by renaming."""
    monkeypatch.setattr(os, "access", lambda path, mode: os.stat(path).st_mode & 0o222)  # for root
    (place / "ckpts").mkdir(parents=True)
    (place / "ckpts/last.ckpt").symlink_to("step=2.ckpt")
    require_writable(place)
    (place / "ckpts/step=2.ckpt").touch(mode=0o444)
    require_writable(place)
    for name, make in (("cmd.txt", Path.touch), ("save", Path.mkdir), ("ckpts", Path.mkdir)):
        make(place / name, mode=0o444, exist_ok=True)
        (place / name).chmod(0o444)
        with pytest.raises(UserError, match=f"{name} is no writable f"):
            require_writable(place)
        (place / name).chmod(0o755)
