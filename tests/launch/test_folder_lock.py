"""The folder of a run is created by one process, locked, and removed only by its creator."""

import contextlib
import fcntl
import multiprocessing
import os
import signal
import socket
import time
from pathlib import Path

import pytest

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch import folder_lock
from threestudio_gaussiandreamer.launch.folder_lock import (
    FolderInUse,
    RunFolder,
    claim,
    claim_new,
    holder,
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


def test_a_folder_that_is_about_to_be_removed_is_in_use(folder, monkeypatch):
    with monkeypatch.context() as patch:
        stop_before(patch, folder_lock.shutil, "rmtree")
        maker = stopped_child(lambda: claim_and_discard(folder))
    with pytest.raises(FolderInUse, match="another run is training in outputs/tiny/run"):
        claim(folder)
    assert go_on(maker) == 0 and not Path("outputs").exists()
    # released and gone: the next run makes it again
    assert claim(folder).first_made == Path("outputs")


def test_a_lock_of_a_removed_folder_is_not_taken_for_one_of_the_new_folder(folder, monkeypatch):
    """Between opening and locking, the folder's creator removes it and releases the lock."""
    first, flock = claim(folder), fcntl.flock

    def remove_then_lock(*arguments):
        if first.lock is not None:
            first.discard()
            first.release()
        flock(*arguments)

    monkeypatch.setattr(fcntl, "flock", remove_then_lock)
    second = claim(folder)
    assert second.first_made == Path("outputs") and folder.is_dir()
    assert os.path.samestat(os.fstat(second.lock.descriptor), os.stat(folder))


def test_parents_of_another_run_stay(folder):
    first = claim(folder)
    other = claim(folder.with_name("other"))
    first.discard()
    assert os.listdir("outputs/tiny") == ["other"]
    other.discard()
    # its own parents were the first run's to remove
    assert other.first_made == other.path and os.listdir("outputs/tiny") == []


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
    assert holder(folder) == ""  # of a process that has ended
    claim(folder).release()
    assert list(folder.iterdir()) == []


@pytest.fixture(params=["unsupported", "Windows"])
def no_flock(request, monkeypatch):
    """Simulate a file system without locks of folders, or Windows, which also renames no file that
    a process has open.
    """

    def unsupported(*arguments):
        raise OSError(95, "Operation not supported")

    if request.param == "unsupported":
        monkeypatch.setattr(fcntl, "flock", unsupported)
        return
    monkeypatch.setattr(folder_lock, "fcntl", None)
    rename, unlink = Path.rename, Path.unlink

    def require_closed(path: Path) -> None:
        for link in Path("/proc").glob("[0-9]*/fd/*"):
            with contextlib.suppress(OSError):
                if os.readlink(link) == str(path.absolute()):
                    break
        else:
            return
        raise PermissionError(13, "The process cannot access the file", str(path))

    monkeypatch.setattr(Path, "rename", lambda p, to: require_closed(p) or rename(p, to))
    monkeypatch.setattr(Path, "unlink", lambda p, **o: require_closed(p) or unlink(p, **o))


def test_without_flock_a_file_keeps_a_second_run_away(folder, no_flock):
    first = claim(folder)
    assert (folder / ".lock").read_text().startswith(f"{socket.gethostname()} {os.getpid()} ")
    with pytest.raises(FolderInUse, match="another run is training in outputs/tiny/run.*remove"):
        claim(folder)
    assert claim_new(folder)[0].path == folder.with_name("run-2")
    first.release()
    assert list(folder.iterdir()) == []
    claim(folder).release()


def test_without_flock_the_file_of_a_killed_run_is_replaced(folder, no_flock):
    def die():
        claim(folder)
        os.kill(os.getpid(), signal.SIGSTOP)

    killed = stopped_child(die)
    with pytest.raises(FolderInUse, match=rf"process {killed} on {socket.gethostname()}: ."):
        claim(folder)
    os.kill(killed, signal.SIGKILL)
    os.waitpid(killed, 0)
    second = claim(folder)
    assert os.listdir(folder) == [".lock"]
    assert (folder / ".lock").read_text().split()[1] == str(os.getpid())
    second.release()


@pytest.mark.parametrize("no_flock", ["unsupported"], indirect=True)
@pytest.mark.parametrize("owner", ["another-machine 1", "", "x", f"{socket.gethostname()} 1"])
def test_a_lock_file_whose_process_may_run_is_kept(folder, no_flock, owner):
    folder.mkdir(parents=True)
    (folder / ".lock").write_text(owner)
    with pytest.raises(FolderInUse, match="remove outputs/tiny/run/.lock"):
        claim(folder)
    assert (folder / ".lock").read_text() == owner


def test_a_lock_file_that_cannot_be_read_or_written_is_one_message(folder, no_flock, monkeypatch):
    (folder / ".lock").mkdir(parents=True)
    with pytest.raises(FolderInUse, match="remove outputs/tiny/run/.lock"):
        claim(folder)
    (folder / ".lock").rmdir()

    def disk_full(*arguments, **options):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("os.write", disk_full)
        with pytest.raises(UserError, match="can't be written: No space left on device"):
            claim(folder)
    assert os.listdir(folder) == []


@pytest.mark.parametrize("no_flock", ["unsupported"], indirect=True)
def test_a_lock_taken_while_a_stale_one_is_removed_is_put_back(folder, no_flock, monkeypatch):
    """Another run replaces the stale file between reading and renaming it."""
    folder.mkdir(parents=True)
    (folder / ".lock").write_text(f"{socket.gethostname()} 999999999")
    rename = Path.rename

    def replace_then_rename(self, target):
        (folder / ".lock").write_text("another-machine 1")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", replace_then_rename)
    with pytest.raises(FolderInUse):
        claim(folder)
    assert os.listdir(folder) == [".lock"]
    assert (folder / ".lock").read_text() == "another-machine 1"


def test_without_flock_a_discarded_folder_is_removed_and_a_new_one_stays(folder, no_flock):
    first = claim(folder)
    (folder / "cmd.txt").touch()
    first.discard()
    assert not Path("outputs").exists()
    second = claim(folder)
    first.release()  # what is there now is the second run's
    assert (folder / ".lock").is_file()
    second.release()


def test_a_folder_that_is_not_locked_is_removed_only_if_it_is_empty(folder):
    made = make_folder(folder)
    (folder / "cmd.txt").touch()
    RunFolder(folder, made).discard()
    assert (folder / "cmd.txt").is_file()
    (folder / "cmd.txt").unlink()
    RunFolder(folder, made).discard()
    assert not Path("outputs").exists()


def test_a_folder_that_was_there_is_never_removed(folder):
    folder.mkdir(parents=True)
    claim(folder).discard()
    RunFolder(folder).discard()
    assert folder.is_dir()


def claim_numbered(path: Path, start, results) -> None:
    start.wait()
    claimed, number = claim_new(path)
    results.put((str(claimed.path), number))
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
    assert found == [(f"outputs/tiny/{name}", i) for i, name in enumerate(names, 1)]
    assert sorted(os.listdir("outputs/tiny")) == names


def test_a_deleted_working_folder_is_one_message(folder, tmp_path):
    os.makedirs("gone")
    os.chdir("gone")
    os.rmdir(tmp_path / "gone")
    with pytest.raises(UserError, match="the output folder outputs/tiny/run can't be written"):
        make_folder(folder)
    os.chdir(tmp_path)


@pytest.mark.parametrize(
    ("name", "is_folder"),
    [("ckpts", False), ("save", False), ("ckpts/last.ckpt", True), ("cmd.txt", True)],
)
def test_a_path_that_blocks_a_result_is_found_before_the_work(folder, name, is_folder):
    (folder / name).parent.mkdir(parents=True)
    (folder / name).mkdir() if is_folder else (folder / name).touch()
    with pytest.raises(UserError, match=f"{name} is "):
        require_writable(folder)


def test_paths_that_would_be_too_long_are_found_before_the_work(folder):
    # the folder's own path would do: it leaves 50 bytes
    parts = (4096 - 50 - len(os.fsencode(folder.absolute()))) // 2 * ["d"]
    deep = Path(*parts)
    with pytest.raises(UserError, match="too long"):
        require_writable(folder / deep)
    require_writable(folder)
