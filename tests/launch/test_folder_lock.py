"""The folder of a run is created by one process, locked, and removed only by its creator."""

import fcntl
import multiprocessing
import os
import signal
import socket
import time
from pathlib import Path

import pytest

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch import run_folder
from threestudio_gaussiandreamer.launch.run_folder import (
    FolderInUse,
    claim,
    claim_new,
    make_folder,
    require_writable,
)


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
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
    """Fork a process that does ``work`` until it stops itself; return its id.

    It exits with 0, with 3 for a folder in use, else with 1.
    """
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


def claim_and_discard(path: Path) -> None:
    claim(path).discard()


def test_the_creator_without_the_lock_does_not_remove_the_folder(folder, monkeypatch):
    with monkeypatch.context() as patch:
        stop_before(patch, fcntl, "flock")
        loser = stopped_child(lambda: claim_and_discard(folder))
    winner = claim(folder)
    (folder / "ckpts").mkdir()
    assert go_on(loser) == 3 and (folder / "ckpts").is_dir()
    winner.release()


def test_a_folder_that_is_about_to_be_removed_is_made_again(folder, monkeypatch):
    with monkeypatch.context() as patch:
        stop_before(patch, run_folder.shutil, "rmtree")
        maker = stopped_child(lambda: claim_and_discard(folder))
    other = claim(folder)
    assert other.first_made == folder and go_on(maker) == 0 and folder.is_dir()
    other.discard()
    # gone with the parents, but for those that the first one made
    assert os.listdir("outputs/tiny") == []


def test_a_lock_of_a_removed_folder_is_not_taken_for_one_of_the_new_folder(folder, monkeypatch):
    """Between opening and locking, the folder's creator removes it and releases the lock."""
    first, flock = claim(folder), fcntl.flock

    def remove_then_lock(*arguments):
        first.discard()
        flock(*arguments)

    monkeypatch.setattr(fcntl, "flock", remove_then_lock)
    second = claim(folder)
    assert second.first_made == Path("outputs") and folder.is_dir()
    with pytest.raises(FolderInUse):
        claim(folder)
    second.release()


def test_parents_of_another_run_stay(folder):
    first = claim(folder)
    other = claim(folder.with_name("other"))
    assert other.first_made == other.path
    first.discard()
    assert os.listdir("outputs/tiny") == ["other"]
    other.discard()
    # its own parents were the first run's to remove
    assert os.listdir("outputs/tiny") == []


def test_a_parent_that_was_just_removed_is_made_again(folder, monkeypatch):
    failures = [FileNotFoundError(2, "removed by its creator")] * 3

    def mkdir(path, **options):
        if failures:
            raise failures.pop()
        os.makedirs(path)

    monkeypatch.setattr(Path, "mkdir", mkdir)
    assert make_folder(folder) == Path("outputs") and folder.is_dir()


def test_the_message_names_the_process_that_holds_the_folder(folder, monkeypatch):
    monkeypatch.setattr("sys.argv", ["launch.py", "--train", "tag=a b"])

    def hold():
        claim(folder)
        os.kill(os.getpid(), signal.SIGSTOP)

    other = stopped_child(hold)
    command = "launch.py --train 'tag=a b'"
    held = rf"tiny/run \(process {other} on {socket.gethostname()}: {command}\): wait until"
    with pytest.raises(FolderInUse, match=held):
        claim(folder)
    os.kill(other, signal.SIGKILL)
    os.waitpid(other, 0)
    claim(folder).release()
    assert list(folder.iterdir()) == []
    again = claim(folder)
    (folder / ".lock").unlink()
    (folder / ".lock").mkdir()  # can't be unlinked, as on a disk that has become read-only
    again.release()
    claim(folder).release()


def test_without_flock_a_file_keeps_a_second_run_away(folder, monkeypatch):
    def unsupported(*arguments):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(fcntl, "flock", unsupported)
    first = claim(folder)
    with pytest.raises(FolderInUse, match="another run is training in outputs/tiny/run.*remove"):
        claim(folder)
    other = claim_new(folder)
    assert other.path == folder.with_name("run-2")
    rename = Path.rename

    def rename_before_another_run(path, target):
        rename(path, target)
        path.mkdir()
        (path / ".lock").touch()

    monkeypatch.setattr(Path, "rename", rename_before_another_run)
    other.discard()
    assert os.listdir(other.path) == [".lock"]
    first.release()
    assert list(folder.iterdir()) == []


def test_a_folder_that_can_not_be_renamed_is_removed_in_place(folder, monkeypatch):
    monkeypatch.setattr(Path, "rename", lambda path, target: os.rename("nothing", target))
    claim(folder).discard()
    assert not Path("outputs").exists()


def test_a_folder_that_was_there_is_never_removed(folder):
    folder.mkdir(parents=True)
    claim(folder).discard()
    assert folder.is_dir()


def claim_numbered(path: Path, start, results) -> None:
    start.wait()
    results.put(str(claim_new(path).path))
    time.sleep(0.2)  # as a run would keep it


def test_runs_of_one_second_get_a_folder_each(folder):
    fork = multiprocessing.get_context("fork")
    start, results = fork.Event(), fork.Queue()
    runs = [fork.Process(target=claim_numbered, args=(folder, start, results)) for _ in range(6)]
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
def test_a_path_that_blocks_a_result_is_found_before_the_work(folder, name, make):
    (folder / name).parent.mkdir(parents=True)
    make(folder / name)
    with pytest.raises(UserError, match=f"{name} is no writable"):
        require_writable(folder)


def test_a_checkpoint_may_be_protected_or_a_broken_link(folder, monkeypatch):
    """It is replaced by renaming."""
    monkeypatch.setattr(os, "access", lambda path, mode: os.stat(path).st_mode & 0o222)  # for root
    (folder / "ckpts").mkdir(parents=True)
    (folder / "ckpts/last.ckpt").symlink_to("step=2.ckpt")
    require_writable(folder)
    (folder / "ckpts/step=2.ckpt").touch(mode=0o444)
    require_writable(folder)
    (folder / "cmd.txt").touch(mode=0o444)
    with pytest.raises(UserError, match="cmd.txt is no writable file"):
        require_writable(folder)
