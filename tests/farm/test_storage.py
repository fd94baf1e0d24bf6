"""The farm's folder below a URL: in memory, and on an S3 server that runs on this machine."""

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.request

import pytest

from threestudio_gaussiandreamer.core.checkpoint_file import newest_readable, save_file
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.farm import assets, remote_ledger, storage, worker
from threestudio_gaussiandreamer.farm.assets import Job, Recipe
from threestudio_gaussiandreamer.farm.ledger import FINISHED, RUNNING
from threestudio_gaussiandreamer.farm.remote_ledger import open_ledger
from threestudio_gaussiandreamer.farm.report import write_report
from threestudio_gaussiandreamer.farm.rows import Row
from threestudio_gaussiandreamer.farm.storage import RemotePlace, Unreachable, place_of
from threestudio_gaussiandreamer.farm.worker import Setting, Worker

FOX = Row("fox", "a fox")


@pytest.fixture(autouse=True)
def scratch(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(storage, "FIRST_WAIT", 0.0)


@pytest.fixture
def memory():
    fsspec = pytest.importorskip("fsspec")
    fsspec.filesystem("memory").store.clear()
    return "memory://farm"


@pytest.fixture(scope="module")
def s3():
    """The URL of a bucket on a moto server."""
    for package in ("s3fs", "moto.server"):
        pytest.importorskip(package)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "moto.server", "-p", str(port)]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    server = subprocess.Popen(command, **quiet)
    endpoint = f"http://127.0.0.1:{port}"
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {
            "AWS_ENDPOINT_URL": endpoint,
            "AWS_ACCESS_KEY_ID": "testing",
            "AWS_SECRET_ACCESS_KEY": "testing",
            "AWS_DEFAULT_REGION": "us-east-1",
        }.items():
            patch.setenv(name, value)
        wait_for(endpoint)
        import s3fs

        s3fs.S3FileSystem().mkdir("farms")
        yield "s3://farms/one"
    server.kill()
    server.wait()


def wait_for(endpoint):
    for _ in range(300):
        try:
            return urllib.request.urlopen(endpoint, timeout=1)
        except OSError:
            time.sleep(0.1)
    raise RuntimeError("the S3 server doesn't start")


def made(place, row=FOX):
    """Write what a run leaves in an asset's work folder."""
    folder = place.work_folder(row)
    for name in (
        "save/it5-export/a.ply",
        "ckpts/last.ckpt",
        "ckpts/epoch=0-step=5.ckpt",
        "cmd.txt",
    ):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)
    assets.write_result(folder, {"key": row.key, "hash": "ab"})
    return folder


def live_of_an_asset(url):
    """Train, lose the machine, go on elsewhere, publish."""
    first, second = RemotePlace(url), RemotePlace(url, scratch=place_of(url).folder / "elsewhere")
    folder = made(first)
    assert first.finished(FOX) is None  # the local result doesn't count
    first.keep_checkpoint(FOX)
    second.fetch_checkpoint(FOX)
    assert (second.work_folder(FOX) / "ckpts/fetched.ckpt").read_text() == "ckpts/last.ckpt"
    first.publish(FOX)
    assert second.finished(FOX)["hash"] == "ab" and not folder.exists()
    assert first.read("assets/fox/save/it5-export/a.ply") == b"save/it5-export/a.ply"
    assert first.read("assets/fox/ckpts/epoch=0-step=5.ckpt") is None
    assert first.read("parts/fox/last.ckpt") is None


def life_of_a_ledger(url, tmp_path):
    """Write it with one driver, and read it with the next one on another machine."""
    place = RemotePlace(url)
    ledger = open_ledger(place)
    for state in (RUNNING, FINISHED):
        ledger.append([{"name": "fox", "key": FOX.key, "state": state}])
    ledger.close()
    again = open_ledger(RemotePlace(url, scratch=tmp_path / "elsewhere"))
    assert again.state(FOX) == FINISHED and again.damaged == 0
    write_report(place, [FOX], again)
    assert b"fox" in place.read("report/table.csv")


def test_an_asset_in_memory(memory):
    live_of_an_asset(memory)


def test_a_ledger_in_memory(memory, tmp_path):
    life_of_a_ledger(memory, tmp_path)


def test_an_asset_and_a_ledger_on_s3(s3, tmp_path):
    live_of_an_asset(s3)
    life_of_a_ledger(s3, tmp_path)


def test_checkpoints_of_earlier_attempts_are_not_uploaded(tmp_path):
    made = ("ckpts/last.ckpt", "ckpts/fetched.ckpt", "ckpts-2/last.ckpt", "ckpts-2/.part")
    for name in (*made, assets.RESULT):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    names = [str(path.relative_to(tmp_path)) for path in storage.uploaded_files(tmp_path)]
    assert names == ["ckpts/last.ckpt", assets.RESULT]


def test_the_result_is_uploaded_last_and_a_reader_sees_no_half_asset(memory, monkeypatch):
    place, seen = RemotePlace(memory), []
    made(place)
    put = place._put

    def watched(path, name):
        seen.append(name)
        assert RemotePlace(memory).finished(FOX) is None
        put(path, name)

    monkeypatch.setattr(place, "_put", watched)
    place.publish(FOX)
    assert seen[-1] == "assets/fox/result.json" and len(seen) == 4
    assert RemotePlace(memory).finished(FOX)


def test_an_upload_that_fails_once_is_tried_again(memory, monkeypatch):
    place = RemotePlace(memory)
    made(place)
    put, failures = place.system().put_file, [OSError("reset"), OSError("reset")]

    def flaky(*args):
        if failures:
            raise failures.pop()
        put(*args)

    monkeypatch.setattr(place.system(), "put_file", flaky)
    place.publish(FOX)
    assert not failures and RemotePlace(memory).finished(FOX)


def test_a_store_that_is_gone_is_named(memory, monkeypatch):
    place = RemotePlace(memory)

    def gone(*args):
        raise ConnectionError("no route to host")

    monkeypatch.setattr(place.system(), "cat_file", gone)
    with pytest.raises(Unreachable, match="memory://farm can't be reached: .*no route to host"):
        place.finished(FOX)


def checkpoint(place, step):
    """Write the last checkpoint of an asset's run."""
    content = {"global_step": step, "epoch": 0, "state_dict": {}}
    save_file(place.work_folder(FOX) / storage.LAST, content)


def test_the_newer_checkpoint_wins_on_every_machine(memory, tmp_path):
    first, second = (RemotePlace(memory, scratch=tmp_path / name) for name in "ab")
    for place, step in ((first, 3), (second, 7)):
        place.fetch_checkpoint(FOX)
        checkpoint(place, step)
        place.keep_checkpoint(FOX)
    first.fetch_checkpoint(FOX)
    assert newest_readable(first.work_folder(FOX) / "ckpts")[1] == 7
    first.keep_checkpoint(FOX)  # its own file is older than the one that it goes on from
    third = RemotePlace(memory, scratch=tmp_path / "c")
    third.fetch_checkpoint(FOX)
    assert newest_readable(third.work_folder(FOX) / "ckpts")[1] == 7


def test_what_a_stopped_worker_has_saved_is_there_for_others(memory, tmp_path, monkeypatch):
    def stopped(self, job, folder, attempt):
        checkpoint(place, 4278)
        return None, 128 + signal.SIGTERM

    monkeypatch.setattr(worker.Worker, "_run", stopped)
    monkeypatch.setattr(worker, "keep_loaded", lambda: None)
    monkeypatch.chdir(tmp_path)
    place = RemotePlace(memory)
    setting = Setting(0, Recipe((), (), True, 1), place, None, ".", "now", 1)
    assert Worker().make(Job(FOX), setting)["state"] == worker.STOPPED
    other = RemotePlace(memory, scratch=tmp_path / "other")
    other.fetch_checkpoint(FOX)
    assert newest_readable(other.work_folder(FOX) / "ckpts")[1] == 4278


def test_many_parts_of_a_ledger_are_joined(memory, monkeypatch, tmp_path):
    monkeypatch.setattr(remote_ledger, "SECONDS_BETWEEN", 0.0)
    monkeypatch.setattr(remote_ledger, "MOST_PARTS", 4)
    place = RemotePlace(memory)
    ledger = open_ledger(place)
    for _ in range(6):
        ledger.append([{"name": "fox", "key": FOX.key, "state": RUNNING, "worker_seconds": 2.0}])
    ledger.append([{"name": "fox", "key": FOX.key, "state": FINISHED}])
    assert len(place.names("ledger")) == 7
    read = open_ledger(RemotePlace(memory, scratch=tmp_path / "a"), only_read=True)
    assert read.state(FOX) == FINISHED and len(place.names("ledger")) == 7
    parts = {name: place.read(name) for name in place.names("ledger")}
    joined = open_ledger(RemotePlace(memory, scratch=tmp_path / "b"))
    assert joined.state(FOX) == FINISHED and len(place.names("ledger")) == 1
    for again in ({}, parts):  # also where a kill has left the parts beside it
        for name, content in again.items():
            place.write(name, content)
        read = open_ledger(RemotePlace(memory, scratch=tmp_path / "c"), only_read=True)
        assert read.state(FOX) == FINISHED and read.worker_seconds(FOX) == 12.0


def test_an_unknown_protocol_is_refused():
    with pytest.raises(UserError, match="nothing://farm can't be used"):
        place_of("nothing://farm").read("farm.json")


def test_a_folder_is_a_place_too(tmp_path):
    place = place_of(str(tmp_path))
    place.write("a/b.txt", b"1")
    made(place)
    assert place.read("a/b.txt") == b"1" and place.read("none") is None
    assert place.finished(FOX)["hash"] == "ab" and str(place) == os.fspath(tmp_path)
    place.discard(FOX)
    assert place.finished(FOX) is None
