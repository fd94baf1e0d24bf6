"""A5: what happens to runs. Kills, full disks, damaged checkpoints, wrong keys, odd prompts,
signals.
"""

import contextlib
import ctypes
import io
import os
import random
import resource
import signal
import struct
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf, open_dict

from tests.launch import test_shipped_configs as test_configs
from tests.stability.rows import row
from tests.stability.small_runs import DEMO, Ended, differences, launch
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core import images as pictures
from threestudio_gaussiandreamer.core.checkpoint_file import (
    load_checkpoint,
    load_file,
    previous_of,
    save_file,
)
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch.config import dump_config, load_config
from threestudio_gaussiandreamer.launch.config_check import check_config, check_part
from threestudio_gaussiandreamer.training.system import GaussianDreamerSystem

register_parts()
EVERY_STEP = ["checkpoint.every_n_train_steps=1", "trainer.max_steps=5"]


def at_step(monkeypatch, step, act) -> None:
    """Lets ``act(system)`` happen after that many steps, before the checkpoint of that step is
    written.
    """
    training_step = GaussianDreamerSystem.training_step

    def wrapped(self, batch, batch_idx):
        training_step(self, batch, batch_idx)
        if self.global_step == step:
            act(self)

    monkeypatch.setattr(GaussianDreamerSystem, "training_step", wrapped)


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Ended:
    """A run that nothing happens to."""
    ended = launch(tmp_path_factory.mktemp("whole"), *EVERY_STEP)
    assert ended.code == 0, ended.err
    return ended


# ---- writing checkpoints -------------------------------------------------------------------------


def content(step: int, size: int = 20_000) -> dict:
    return {
        "state_dict": {"means": torch.arange(float(size)) + step},
        "epoch": 0,
        "global_step": step,
    }


@pytest.mark.slow
@row("A5", "Crash mid checkpoint")
def test_killed_at_random_moments_of_200_saves(tmp_path, measured):
    """After each kill the file is whole and no older than the last save that the child has told
    of.
    """
    path, rng = tmp_path / "last.ckpt", random.Random(0)
    save_file(path, content(0))
    saved, kills, read_end_lost = 0, 0, 0
    while saved < 200 or kills < 20:
        read_end, write_end = os.pipe()
        child = os.fork()
        if child == 0:
            # only torch.save and files, which need no thread that the fork has lost
            for step in range(saved + 1, 10_000):
                save_file(path, content(step))
                os.write(write_end, struct.pack("i", step))
        os.close(write_end)
        time.sleep(rng.uniform(0.01, 0.08))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        told = os.read(read_end, 1 << 16)
        os.close(read_end)
        kills, told = kills + 1, struct.unpack("i", told[-4:])[0] if told else saved
        found = load_checkpoint(path)
        assert found["state_dict"]["means"].equal(
            content(found["global_step"])["state_dict"]["means"]
        )
        read_end_lost += max(0, told - found["global_step"])
        if previous_of(path).exists():
            assert load_checkpoint(previous_of(path))["global_step"] <= found["global_step"]
        saved = found["global_step"]
    save_file(path, content(saved + 1))
    assert {entry.name for entry in tmp_path.iterdir()} <= {
        "last.ckpt",
        "last-prev.ckpt",
    }  # what was half-written is gone
    measured(kills, "kills", what="in 200 saves or more", at_least=20)
    measured(read_end_lost, "saves", what="lost", at_most=0)


@row("A5", "Crash mid checkpoint")
def test_a_file_written_in_place_is_lost_by_such_kills(tmp_path, measured):
    """The test above can fail: the same kills of a child that saves as ``torch.save(content,
    path)`` does leave damaged files.
    """
    path, rng, lost = tmp_path / "last.ckpt", random.Random(0), 0
    for _ in range(20):
        save_file(path, content(0))
        child = os.fork()
        if child == 0:
            while True:
                buffer = io.BytesIO()
                torch.save(content(1), buffer)
                with open(path, "wb") as file:
                    file.write(buffer.getvalue())
                    os.fsync(file.fileno())
        time.sleep(rng.uniform(0.01, 0.08))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        try:
            load_checkpoint(path)
        except UserError:
            lost += 1
    assert lost
    measured("such kills damage a file that is written in place")


@contextlib.contextmanager
def file_size_limit(limit: int):
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@contextlib.contextmanager
def permissions_count_for_root():
    """Root may write where permissions forbid it, by two capabilities that a thread can put down
    and take up again.
    """
    if os.geteuid():
        yield
        return
    libc = ctypes.CDLL(None, use_errno=True)
    header, before, without = (
        (ctypes.c_uint32 * 2)(0x20080522, 0),
        (ctypes.c_uint32 * 6)(),
        (ctypes.c_uint32 * 6)(),
    )
    if libc.capget(header, before):
        pytest.skip("this system doesn't tell its capabilities")
    without[:] = before[:]
    without[
        0
    ] &= (
        ~0b110
    )  # DAC_OVERRIDE and DAC_READ_SEARCH are 1 and 2; the first number holds what is in effect
    libc.capset(header, without)
    try:
        yield
    finally:
        libc.capset(header, before)


def assert_stopped_cleanly(ended: Ended, message: str) -> None:
    """One named error; the checkpoint of step 2 is whole and the newest, and nothing temporary is
    left.
    """
    assert ended.code == 2 and "Traceback" not in ended.err, ended.err
    assert (
        sum(line.startswith("error: ") for line in ended.err.splitlines()) == 1
        and message in ended.err
    ), ended.err
    assert load_checkpoint(ended.last)["global_step"] == 2
    assert not [
        path for path in ended.folder.rglob("*") if path.suffix == ".tmp" or "step=3" in path.name
    ]


@row("A5", "Disk full, read-only")
def test_a_full_disk_in_the_middle_of_a_run(tmp_path, monkeypatch, measured):
    with contextlib.ExitStack() as full:
        at_step(monkeypatch, 3, lambda _: full.enter_context(file_size_limit(2000)))
        ended = launch(tmp_path, *EVERY_STEP)
    assert_stopped_cleanly(ended, "File too large")
    measured("named error, exit code 2, earlier file whole, no temporary")


@row("A5", "Disk full, read-only")
@pytest.mark.parametrize(
    "hook", ["ensure_cloud", "score", "on_test_start", "on_test_epoch_end", "export"]
)
def test_a_disk_that_is_full_by_then(hook, tmp_path, monkeypatch, measured):
    """When the prior is kept, the cloud scored, views and the video written, the cloud exported:
    never a success with half a file.
    """
    original = getattr(GaussianDreamerSystem, hook)
    with contextlib.ExitStack() as full:

        def wrapped(self, *args):
            full.enter_context(file_size_limit(100))
            return original(self, *args)

        monkeypatch.setattr(GaussianDreamerSystem, hook, wrapped)
        ended = launch(tmp_path, "trainer.max_steps=1", "data.eval_width=64", "data.eval_height=64")
    assert (
        ended.code == 2 and sum(line.startswith("error: ") for line in ended.err.splitlines()) == 1
    ), ended.err
    assert "Traceback" not in ended.err and (
        "cannot write" in ended.err or "could not be written" in ended.err
    )
    assert not [
        path
        for path in ended.folder.rglob("*")
        if path.suffix == ".tmp" or path.name.startswith(".part")
    ]
    measured("named error at every place that writes")


@row("A5", "Disk full, read-only")
@pytest.mark.parametrize("kind", ["mp4", "gif", "png"])
@pytest.mark.parametrize("limit", [0, 100, 3000])
def test_half_a_video_is_none(kind, limit, tmp_path, measured):
    """The encoder is a process of its own, which ends in silence: an mp4 counts as written when its
    index is in it.
    """
    noise = np.random.default_rng(0).integers(0, 255, (4, 64, 64, 3), dtype=np.uint8)
    for i, frame in enumerate(noise):
        pictures.write(tmp_path / f"{i}.png", frame)
    frames = [tmp_path / f"{i}.png" for i in range(4)]
    path = tmp_path / f"out.{kind}"

    def write() -> None:
        pictures.write(path, noise[0]) if kind == "png" else pictures.write_video(
            str(path), frames, fps=5
        )

    with file_size_limit(limit), pytest.raises(UserError, match=f"out.{kind}"):
        write()
    assert not path.exists()
    write()
    whole = path.read_bytes()
    with file_size_limit(limit), pytest.raises(UserError):
        write()
    assert path.read_bytes() == whole and len(list(tmp_path.iterdir())) == 5
    measured("named error, earlier file whole")


@row("A5", "Disk full, read-only")
def test_a_folder_that_becomes_read_only(tmp_path, monkeypatch, measured):
    with contextlib.ExitStack() as locked:

        def lock(system):
            folder = Path(system._save_dir).parent / "ckpts"
            locked.enter_context(permissions_count_for_root())
            folder.chmod(0o555)
            locked.callback(folder.chmod, 0o755)

        at_step(monkeypatch, 3, lock)
        ended = launch(tmp_path, *EVERY_STEP)
    assert_stopped_cleanly(ended, "Permission denied")
    measured("named error, exit code 2, earlier file whole, no temporary")


@row("A5", "Disk full, read-only")
def test_a_read_only_output_root_is_named_before_any_work(tmp_path, measured):
    tmp_path.chmod(0o555)
    with permissions_count_for_root():
        ended = launch(tmp_path, *EVERY_STEP)
    tmp_path.chmod(0o755)
    assert (
        ended.code == 2
        and "can't be written: Permission denied" in ended.err
        and "the cloud starts" not in ended.err
    )
    assert not list(tmp_path.iterdir())
    measured("named before any work")


# ---- damaged checkpoints -------------------------------------------------------------------------


def damaged(path: Path, how: str, rng: random.Random) -> None:
    data = bytearray(path.read_bytes())
    if how == "truncated":
        path.write_bytes(data[: rng.randrange(len(data))])
    else:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(data)


@row("A5", "Corrupted checkpoint")
@pytest.mark.parametrize("how, times", [("truncated", 50), ("flipped", 200)])
def test_no_damaged_byte_is_ever_loaded(how, times, tmp_path, measured):
    path, rng, refused = tmp_path / "a.ckpt", random.Random(0), 0
    save_file(path, content(7))
    good = path.read_bytes()
    for _ in range(times):
        path.write_bytes(good)
        damaged(path, how, rng)
        with pytest.raises(UserError, match=str(path)):
            load_file(path)
        refused += 1
    measured(refused - times, f"of {times}", what=f"{how} and loaded", at_most=0)


@pytest.fixture
def stopped(tmp_path) -> Ended:
    """A run of three steps whose last checkpoint, and the file that it is a copy of, are damaged;
    that before it is whole.
    """
    ended = launch(tmp_path, "checkpoint.every_n_train_steps=1", "trainer.max_steps=3")
    assert ended.code == 0, ended.err
    for name in ("last.ckpt", "epoch=0-step=3.ckpt"):
        damaged(ended.last.with_name(name), "flipped", random.Random(1))
    return ended


@row("A5", "Corrupted checkpoint")
def test_a_damaged_checkpoint_that_was_asked_for_is_refused(stopped, tmp_path, measured):
    ended = launch(tmp_path, *EVERY_STEP, f"resume={stopped.last}")
    assert (
        ended.code == 2
        and str(stopped.last) in ended.err
        and "checksum" in ended.err
        and "Traceback" not in ended.err
    )
    assert "last-prev.ckpt" in ended.err  # what could be taken instead, though only the user may
    measured("refused, its path named")


@row("A5", "Corrupted checkpoint")
def test_resume_auto_takes_the_one_before_and_says_so(stopped, whole, tmp_path, measured):
    ended = launch(tmp_path, *EVERY_STEP, "resume=auto")
    assert ended.code == 0, ended.err
    assert (
        "going on from" in ended.err
        and "step=2.ckpt" in ended.err.split("going on from")[1]
        or "last-prev.ckpt" in ended.err
    )
    assert ended.err.count("is damaged") == 2  # what was passed over is named
    measured(
        differences(whole.checkpoint(), ended.checkpoint()),
        "tensors",
        what="that differ after resume=auto",
        at_most=0,
    )


@row("A5", "Corrupted checkpoint")
def test_resume_auto_without_a_checkpoint_starts_anew_and_says_so(tmp_path, measured):
    ended = launch(tmp_path, "trainer.max_steps=1", "resume=auto")
    assert ended.code == 0
    assert "no checkpoint of" in ended.err and "starting from the prior" in ended.err
    measured("says what it chose")


HANDMADE = {
    "without loops": (lambda c: c.pop("loops"), "it has no loops"),
    "without optimizer_states": (lambda c: c.pop("optimizer_states"), "it has no optimizer_states"),
    "0-d means": (
        lambda c: c["state_dict"].update({"geometry.means": torch.tensor(1.0)}),
        "geometry.means",
    ),
    "means (N, 2)": (
        lambda c: c["state_dict"].update({"geometry.means": torch.zeros(120, 2)}),
        "geometry.means",
    ),
    "a mean more": (
        lambda c: c["state_dict"].update({"geometry.means": torch.zeros(121, 3)}),
        "geometry.quats",
    ),
    "means as a list": (
        lambda c: c["state_dict"].update({"geometry.means": [1.0, 2.0]}),
        "geometry.means",
    ),
    "no means": (lambda c: c["state_dict"].pop("geometry.means"), "geometry.means"),
    "moments of another size": (
        lambda c: c["optimizer_states"][0]["param_groups"].pop(),
        "another configuration",
    ),
    "a step that is a word": (
        lambda c: c.update(global_step="three"),
        "global_step is of type str",
    ),
}


@row("A5", "Corrupted checkpoint")
@pytest.mark.parametrize("what", HANDMADE)
def test_a_handmade_checkpoint_that_does_not_fit_is_named(what, whole, tmp_path, measured):
    """Whole by its checksum, but not what a run can go on from: never trained from step 0, or with
    half of it.
    """
    change, message = HANDMADE[what]
    checkpoint = whole.checkpoint()
    change(checkpoint)
    save_file(tmp_path / "made.ckpt", checkpoint)
    ended = launch(
        tmp_path / "run", *EVERY_STEP, "trainer.max_steps=9", f"resume={tmp_path}/made.ckpt"
    )
    assert ended.code == 2 and "Traceback" not in ended.err, ended.err
    assert "made.ckpt" in ended.err and message in ended.err, ended.err
    assert not (tmp_path / "run").exists()
    measured("named error, nothing written")


# ---- configuration -------------------------------------------------------------------------------


def keys_of(cfg, path=""):
    """Every dotted key of a configuration but the names of sections' own parts, whose keys are
    checked with them.
    """
    for key in cfg:
        yield f"{path}{key}"
        if hasattr(cfg._get_node(key), "keys"):
            yield from keys_of(cfg[key], f"{path}{key}.")


def misspelt(word: str) -> list[str]:
    """One letter dropped, and two exchanged, in the middle of the word."""
    at = len(word) // 2
    return [word[:at] + word[at + 1 :], word[: at - 1] + word[at] + word[at - 1] + word[at + 1 :]]


def refusal(cfg, section: str, wrong: str, name: str) -> str:
    """The message about one more key in a configuration that is fine without it; empty if it is
    accepted.
    """
    part = OmegaConf.select(cfg, section) if section else cfg
    try:
        if section:
            with open_dict(part):
                part[wrong] = 1
            check_config(cfg)
        else:
            load_config(DEMO.with_name(name), cli_args=[*FOX, f"{wrong}=1"])
    except UserError as error:
        return str(error)
    finally:
        part._content.pop(wrong, None)
    return ""


COMPUTED = (
    "exp_dir",
    "trial_name",
    "trial_dir",
    "n_gpus",
    "timestamp",
    "resume",
    "description",
    "use_timestamp",
)
FOX = ["system.prompt_processor.prompt=a fox"]


@pytest.mark.slow
@row("A5", "Wrong config keys")
def test_every_key_misspelt_by_one_letter_is_refused_with_the_right_one(measured):
    """Every key that the shipped files use, at every depth: the right word is in the message."""
    tried, failed = set(), []
    for name in ("demo.yaml", "gaussiandreamer.yaml", "gaussiandreamer-official.yaml"):
        cfg = load_config(DEMO.with_name(name), cli_args=FOX)
        check_config(cfg)
        for key in set(keys_of(cfg)) - set(COMPUTED) - tried:
            section, _, word = key.rpartition(".")
            wrongs = [wrong for wrong in misspelt(word) if len(word) > 1 and wrong != word]
            failed += [
                (section, wrong)
                for wrong in wrongs
                if word not in refusal(cfg, section, wrong, name)
            ]
            tried.add(key)
    assert not failed, failed
    assert len(tried) > 100
    measured(
        len(failed),
        f"of {len(tried)} keys",
        what="misspelt and accepted, or without the right word",
        at_most=0,
    )


@row("A5", "Wrong config keys")
def test_every_option_of_every_part_misspelt_is_refused_with_the_right_one(measured):
    """Also those that no shipped file uses, groups within groups included."""
    tried, failed = 0, []
    for place, config in test_configs.config_classes().items():
        name, _, group = place.partition(".")
        for word in config.__dataclass_fields__:
            for wrong in set(misspelt(word)) - set(config.__dataclass_fields__):
                tried += 1
                try:
                    check_part("part", name, {group: {wrong: 1}} if group else {wrong: 1})
                    failed.append((place, wrong))
                except UserError as error:
                    failed += [] if word in str(error) else [(place, wrong)]
    assert not failed, failed
    assert tried > 400
    measured(
        len(failed),
        f"of {tried} misspelt options",
        what="accepted, or without the right word",
        at_most=0,
    )


@row("A5", "Wrong config keys")
def test_every_accepted_key_is_read(measured):
    read, classes = test_configs.names_that_are_read(), test_configs.config_classes()
    keys = [(name, field) for name, cls in classes.items() for field in cls.__dataclass_fields__]
    measured(
        sum(field not in read for _, field in keys),
        f"of {len(keys)} keys",
        what="read by nobody",
        at_most=0,
    )


@row("A5", "Wrong config keys")
@pytest.mark.parametrize(
    "monitor, message",
    [("los", "did you mean 'loss'"), ("train/loss_sdss", "train/loss_sds"), ("val/psnr", "choose")],
)
def test_a_quantity_that_nobody_logs_is_named_before_any_work(monitor, message, tmp_path, measured):
    ended = launch(
        tmp_path, "trainer.max_steps=2", f"checkpoint.monitor={monitor}", "checkpoint.save_top_k=1"
    )
    assert (
        ended.code == 2
        and f"unknown checkpoint.monitor {monitor!r}" in ended.err
        and message in ended.err
    ), ended.err
    assert not list(tmp_path.iterdir())
    assert (
        launch(
            tmp_path, "trainer.max_steps=2", "checkpoint.monitor=loss", "checkpoint.save_top_k=1"
        ).code
        == 0
    )
    measured("named before any work")


# ---- prompts -------------------------------------------------------------------------------------

PROMPTS = [
    "a/../../x",
    "../../x",
    "/etc/passwd",
    "x" * 4096,
    "🦊" * 1000,
    "CON",
    "nul.txt",
    "two\nlines",
    "a\0b",
    "-x",
    "--help",
    "${x}",
    "${oc.env:HOME}",
    "",
    " ",
    ".",
    "..",
    "~",
    "1984",
    "yes",
    "null",
    "it's: 3",
    "[a]",
    "{a: b}",
    "a fox # red",
    "\\",
    "%s",
    "a\tb",
    # fmt: skip
    "\u202eabc",
    "e\u0301",
    "&anchor *x",
    "!!python/object:os.system",
    "a=b",
    "\u2028",
    "٣",
]


@row("A5", "Prompt as path / YAML")
@pytest.mark.parametrize(
    "prompt, source",
    [
        *((prompt, "command line") for prompt in PROMPTS),
        *((prompt, "prompt file") for prompt in PROMPTS[::4]),
    ],
)
def test_a_prompt_stays_text_and_its_folder_below_the_root(prompt, source, tmp_path, measured):
    """What is stored is the prompt to the letter, also after parsed.yaml was read back; a folder of
    that name can be made.
    """
    if source == "prompt file":
        (tmp_path / "prompt.txt").write_bytes(prompt.encode())
        given = f"system.prompt_processor.prompt_file={tmp_path}/prompt.txt"
    else:
        given = f"system.prompt_processor.prompt={prompt}"
    root = tmp_path / "outputs"
    cfg = load_config(DEMO, cli_args=[f"exp_root_dir={root}", given])  # whose tag is the prompt
    folder = Path(cfg.trial_dir)
    folder.mkdir(parents=True)
    dump_config(folder / "parsed.yaml", cfg)
    again = load_config(folder / "parsed.yaml")
    for text in (cfg.system.prompt_processor.prompt, again.system.prompt_processor.prompt):
        assert text == prompt and type(text) is str
    assert again.trial_dir == cfg.trial_dir and folder.resolve().parent == (root / "demo").resolve()
    slug, at, _ = folder.name.partition("@")
    assert (
        at and len(slug.encode()) <= 64 + 9
    )  # and a hyphen and eight digits of its hash, where it isn't the prompt itself
    measured("verbatim, below the root")


@row("A5", "Prompt as path / YAML")
def test_different_prompts_have_different_folders(measured):
    """Also those that are alike in their first 64 bytes, or once the letters that file systems
    forbid are replaced.
    """
    prompts = [
        *PROMPTS,
        "x" * 4095,
        "🦊" * 999,
        "a_.._.._x",
        "two_lines",
        "a?b",
        "a*b",
        "con",
        "a b",
        "a  b",
    ]
    cfgs = [
        load_config(DEMO, cli_args=[f"system.prompt_processor.prompt={prompt}"])
        for prompt in prompts
    ]
    names = {cfg.trial_name.partition("@")[0] for cfg in cfgs}
    # an empty prompt has no tag at all, only a time
    measured(len(prompts) - len(names), f"of {len(prompts)}", what="that share a folder", at_most=0)


# ---- signals -------------------------------------------------------------------------------------


@row("A5", "Ctrl-C / SIGTERM")
@pytest.mark.parametrize("name, code", [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129)])
@pytest.mark.parametrize("step", random.Random(5).sample(range(1, 5), 2))
def test_a_signal_at_a_random_step(name, code, step, whole, tmp_path, monkeypatch, measured):
    with monkeypatch.context() as patch:
        at_step(patch, step, lambda _: os.kill(os.getpid(), getattr(signal, name)))
        ended = launch(tmp_path, "trainer.max_steps=5")
    assert (
        ended.code == code
        and f"stopped at step {step}; to go on: " in ended.out
        and f"resume={ended.last}" in ended.out
    ), ended.err
    assert load_checkpoint(ended.last)["global_step"] == step
    assert not list(ended.folder.glob("save/*test*"))  # Lightning would go on to the test
    finished = launch(tmp_path, *EVERY_STEP, f"resume={ended.last}")
    assert finished.code == 0, finished.err
    measured(
        differences(whole.checkpoint(), finished.checkpoint()),
        "tensors",
        what="that differ after resuming",
        at_most=0,
    )


@row("A5", "Ctrl-C / SIGTERM")
def test_a_signal_while_views_are_validated(whole, tmp_path, monkeypatch, measured):
    """The checkpoint of that step, once the views are done; not that of the last one saved."""
    with monkeypatch.context() as patch:
        patch.setattr(
            GaussianDreamerSystem,
            "on_validation_epoch_end",
            lambda _: os.kill(os.getpid(), signal.SIGTERM),
        )
        ended = launch(
            tmp_path,
            "trainer.max_steps=5",
            "trainer.limit_val_batches=1",
            "trainer.val_check_interval=3",
        )
    assert ended.code == 143 and "stopped at step 3; to go on: " in ended.out, ended.err
    finished = launch(tmp_path, *EVERY_STEP, f"resume={ended.last}")
    assert finished.code == 0, finished.err
    measured(
        differences(whole.checkpoint(), finished.checkpoint()),
        "tensors",
        what="that differ after resuming",
        at_most=0,
    )


@row("A5", "Ctrl-C / SIGTERM")
def test_a_second_signal_stops_at_once(tmp_path, monkeypatch, measured):
    """In the middle of a step: the checkpoint of the step before is what is left, and the run can
    go on from it.
    """

    def impatient(system):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)

    at_step(monkeypatch, 3, impatient)
    ended = launch(tmp_path, *EVERY_STEP)
    assert (
        ended.code == 130 and "Traceback" not in ended.err and f"resume={ended.last}" in ended.out
    ), ended.err
    measured(
        3 - load_checkpoint(ended.last)["global_step"],
        "steps",
        what="lost to a second signal",
        at_most=1,
    )
