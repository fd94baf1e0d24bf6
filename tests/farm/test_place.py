"""The farm's folder, also in memory and on an S3 server, and the records of its assets."""

import json
import os
import pickle
import signal
from unittest.mock import Mock

import pytest

from threestudio_gaussiandreamer.core.checkpoint_file import newest_readable, save_file
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.farm import place as module
from threestudio_gaussiandreamer.farm import worker
from threestudio_gaussiandreamer.farm.place import CHANGED, FINISHED, STOPPED, WAITING, Place
from threestudio_gaussiandreamer.farm.recipe import Job, Recipe, Source, job_of, unfinished
from threestudio_gaussiandreamer.farm.report import write_report
from threestudio_gaussiandreamer.farm.rows import Row, read_rows
from threestudio_gaussiandreamer.farm.worker import Setting

FOX, CAT, DOG = Row("fox", "a fox"), Row("cat", "a cat", line=2), Row("dog", "a dog")


@pytest.fixture(autouse=True)
def machine(tmp_path, monkeypatch):
    """``machine(name, url)`` returns a farm as it is on another machine."""

    def on(name, url):
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / name))
        return Place(url)

    on("cache", tmp_path)
    return on


@pytest.fixture
def memory():
    fsspec = pytest.importorskip("fsspec")
    fsspec.filesystem("memory").store.clear()
    return "memory://farm"


@pytest.fixture(scope="module")
def s3():
    """The URL of a bucket on a moto server."""
    s3fs = pytest.importorskip("s3fs")
    server = pytest.importorskip("moto.server").ThreadedMotoServer("127.0.0.1", 0)
    server.start()
    keys = dict.fromkeys(("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"), "testing")
    keys["AWS_ENDPOINT_URL"] = "http://{}:{}".format(*server.get_host_and_port())
    with pytest.MonkeyPatch.context() as patch:
        for name, value in {**keys, "AWS_DEFAULT_REGION": "us-east-1"}.items():
            patch.setenv(name, value)
        s3fs.S3FileSystem().mkdir("farms")
        yield "s3://farms/one"
    server.stop()


LEFT_OUT = ("ckpts/epoch=0-step=5.ckpt", "ckpts/fetched.ckpt", "ckpts-2/last.ckpt", "ckpts-2/.a")


def made(place, row=FOX):
    """Write what a run leaves in an asset's work folder."""
    folder = place.work_folder(row)
    for name in ("save/it5-export/a.ply", "ckpts/last.ckpt", "cmd.txt", *LEFT_OUT):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)
    return folder


RESULT = {"key": FOX.key, "hash": "ab", "files": ["save/it5-export/a.ply"]}


def test_a_folder_is_a_place_too(tmp_path):
    place = Place(str(tmp_path))
    place.write("a/b", {})
    made(place)
    assert place.read(["a/b", "none", "a/b/c", "."]) == [b"{}", *[None] * 3]
    assert str(place) == os.fspath(tmp_path)
    place.publish(FOX, RESULT)
    assert place.finished(FOX)["hash"] == "ab" and place.finished(FOX._replace(seed=1)) is None
    assert (tmp_path / "assets/fox/ckpts/last.ckpt").exists()


@pytest.mark.parametrize("url", ["memory://farm", "s3"])
def test_the_life_of_a_farm_below_a_url(url, memory, request, machine):
    """Train, lose the machine, go on elsewhere, fail, publish, and read the records."""
    url = request.getfixturevalue("s3") if url == "s3" else url
    first, second = machine("one", url), pickle.loads(pickle.dumps(machine("other", url)))
    folder = made(first)
    first.keep_checkpoint(FOX, False)
    found = list(second.records([FOX, CAT]))
    assert found == [(FOX, {"state": module.RUNNING}), (CAT, {"state": WAITING})]
    second.fetch_checkpoint(FOX, False)
    assert (second.work_folder(FOX) / "ckpts/fetched.ckpt").read_text() == "ckpts/last.ckpt"
    other = FOX._replace(prompt="another")
    second.fetch_checkpoint(other, False)
    note(first, FOX, "failed.json", state=STOPPED, worker_seconds=3.0)
    assert next(second.records([FOX]))[1]["state"] == STOPPED
    first.publish(FOX, RESULT)
    assert second.finished(FOX)["hash"] == "ab" and not folder.exists()
    assert dict(second.records([CAT, FOX]))[FOX] == {"state": FINISHED, **RESULT}
    files = ("save/it5-export/a.ply", "failed.json", *LEFT_OUT)
    found = first.read([f"assets/fox/{name}" for name in files])
    assert found == [b"save/it5-export/a.ply", None, *[None] * len(LEFT_OUT)]
    assert first.read([module.part_of(FOX, False)]) == [None]
    write_report(first, [FOX], 1)
    assert b"fox" in first.read(["report/table.csv"])[0]


def test_the_result_is_uploaded_last_and_a_reader_sees_no_half_asset(memory, monkeypatch):
    place, seen = Place(memory), []
    made(place)
    upload = place.upload

    def watched(name, path):
        seen.append(Place(memory).finished(FOX))
        upload(name, path)

    monkeypatch.setattr(place, "upload", watched)
    place.publish(FOX, RESULT)
    assert seen == [None] * 3 and Place(memory).finished(FOX)


@pytest.mark.parametrize("error", [ConnectionError("no route"), FileNotFoundError("no bucket")])
def test_a_store_that_is_gone_is_named_and_no_bucket_is_an_empty_one(memory, monkeypatch, error):
    place, lacks = Place(memory), isinstance(error, FileNotFoundError)
    for name in ("cat_file", "pipe_file", "put_file", "ls", "rm_file"):
        monkeypatch.setattr(place.system, name, Mock(side_effect=error))
    for write, act in (
        (False, lambda: place.finished(FOX)),
        (False, lambda: place.names("a")),
        (False, lambda: place.remove(["a"])),
        (True, lambda: place.write("a", {})),
        (True, lambda: place.upload("a")),
    ):
        if lacks and not write:
            assert not act()
            continue
        with pytest.raises(module.Unreachable, match=f"memory://farm can't be reached: .*{error}"):
            act()


def checkpoint(place, step):
    content = {"global_step": step, "epoch": 0, "state_dict": {}}
    save_file(place.work_folder(FOX) / module.LAST, content)


def test_the_newer_checkpoint_wins_on_every_machine(memory, machine):
    first, second = (machine(name, memory) for name in "ab")
    for place, step in ((first, 3), (second, 7)):
        place.fetch_checkpoint(FOX, False)
        checkpoint(place, step)
        place.keep_checkpoint(FOX, False)
    first.fetch_checkpoint(FOX, False)
    assert newest_readable(first.work_folder(FOX) / "ckpts")[1] == 7
    first.keep_checkpoint(FOX, False)  # its own file is older than the one that it goes on from
    third = machine("c", memory)
    third.fetch_checkpoint(FOX, False)
    assert newest_readable(third.work_folder(FOX) / "ckpts")[1] == 7


def test_each_configuration_has_its_own_checkpoint(memory, machine, tmp_path, monkeypatch):
    """What the low-memory configuration made is only for those that use it."""
    seen = []

    def stopped(self, job, folder, attempt):
        place = self.setting.place
        seen.append((job.saves_memory, (newest_readable(folder / "ckpts") or [0, None])[1]))
        checkpoint(place, 90 - 80 * job.saves_memory + len(seen))
        return None, 128 + signal.SIGTERM

    monkeypatch.setattr(worker.Worker, "_run", stopped)
    monkeypatch.setattr(worker, "keep_loaded", lambda: None)
    monkeypatch.chdir(tmp_path)
    recipe = Recipe((), (), True, 1, Source("low.yaml", b""))
    normal, low = Job(FOX), Job(FOX, saves_memory=True)
    for name, job in (("a", normal), ("b", normal), ("b", low), ("a", low), ("c", low)):
        setting = Setting(recipe, machine(name, memory), None, ".", "now", 9)
        outcome = worker.Worker().make(job, 0, setting)
        assert outcome["state"] == worker.STOPPED
    assert seen == [(False, None), (False, 91), (True, None), (True, 13), (True, 14)]


def note(place, row, file, **record):
    place.write(f"assets/{row.name}/{file}", {"key": row.key, **record})


@pytest.mark.parametrize("file", ["result.json", "failed.json"])
def test_a_row_that_has_changed_has_a_state_of_its_own(tmp_path, file):
    note(Place(tmp_path), CAT, file, seconds=5.0)
    other = CAT._replace(seed=1)
    assert dict(Place(tmp_path).records([FOX, other]))[other] == {"state": CHANGED}
    _, states = write_report(Place(tmp_path), [FOX, other], 2)
    assert states == {WAITING: 1, CHANGED: 1}


def test_a_record_that_something_else_has_written_is_one_message(tmp_path):
    note(Place(tmp_path), FOX, "result.json")
    wrong = ['{"seconds": "5"}', '{"worker_seconds": null}', '{"scores": [1]}']
    for content in ("", "{", "[1]", "[" * 99_999, *wrong, '{"scores": {"psnr": [1]}}'):
        (tmp_path / "assets/fox/result.json").write_text(content)
        with pytest.raises(UserError, match="assets/fox/result.json is damaged .*: delete it, or"):
            list(Place(tmp_path).records([FOX]))


def test_many_records_are_read_in_the_order_of_the_rows(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "BATCH", 2)
    rows, place = [Row(f"toy{i}", "a toy", i) for i in range(7)], Place(tmp_path)
    for row in rows[::2]:
        note(place, row, "result.json", steps=row.seed)
    found = [(row.seed, record.get("steps")) for row, record in place.records(iter(rows))]
    assert found == [(i, None if i % 2 else i) for i in range(7)]


def test_a_url_that_can_not_be_used_is_one_message(monkeypatch):
    with pytest.raises(UserError, match="nothing://farm can't be used"):
        Place("nothing://farm")
    refuses = Mock(side_effect=ConnectionRefusedError("Connection refused"))
    monkeypatch.setattr("fsspec.core.url_to_fs", refuses)
    with pytest.raises(UserError, match="ftp://host/farm can't be used: Connection refused"):
        Place("ftp://host/farm")


def test_unfinished_assets_are_handed_out_with_what_their_records_say(tmp_path):
    place, path = Place(tmp_path), tmp_path / "prompts.jsonl"
    (tmp_path / "row.yaml").write_text("x: 1")
    rows = [{"prompt": row.prompt, "name": row.name} for row in (FOX, CAT, DOG)]
    rows[2]["config"] = str(tmp_path / "row.yaml")
    path.write_text("\n".join(map(json.dumps, rows)))
    note(place, FOX, "result.json")
    note(place, CAT, "failed.json", state=STOPPED, saves_memory=True, worker_seconds=3.0)
    list(map(job_of, read_rows(path)))  # as the check before any work does
    (tmp_path / "row.yaml").write_text("x: 2")
    finished, jobs = unfinished(place, path, 3)
    assert finished == 1
    cat, dog = jobs
    assert (cat.row.name, cat.saves_memory, cat.spent) == ("cat", True, 3.0)
    assert [source.content for source in dog.sources] == [b"x: 1"]
