"""A5: runs that are killed, full disks, damaged and untrusted files, missing models, wrong keys."""

import ast
import contextlib
import ctypes
import os
import pickle
import random
import re
import signal
import socket
import struct
import sys
import time
import tracemalloc
from dataclasses import fields, is_dataclass
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

import threestudio_gaussiandreamer
from tests.helpers.ply_files import ply_bytes
from tests.promises.commands import full_disk
from tests.stability.backends import slow
from tests.stability.report import row
from tests.stability.small_runs import DEMO, EVERY_STEP, Ended, launch, refused, require_equal_ends
from threestudio_gaussiandreamer import host
from threestudio_gaussiandreamer import images as pictures
from threestudio_gaussiandreamer.core.checkpoint_file import load_checkpoint, load_file, save_file
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.ply import read_gaussians, read_points
from threestudio_gaussiandreamer.host.builtin.savers import write_video
from threestudio_gaussiandreamer.launch.config import dump_config, load_config
from threestudio_gaussiandreamer.launch.config_check import check_config, check_part
from threestudio_gaussiandreamer.models import hub, model_files
from threestudio_gaussiandreamer.models.model_files import read_state_dict
from threestudio_gaussiandreamer.models.text_encoders import EmbeddingCache
from threestudio_gaussiandreamer.priors.cache import read_cache
from threestudio_gaussiandreamer.priors.motion import load_body_model, read_motions
from threestudio_gaussiandreamer.priors.point_cloud import load_points
from threestudio_gaussiandreamer.training import system
from threestudio_gaussiandreamer.training.system import GaussianDreamerSystem

PACKAGE = Path(threestudio_gaussiandreamer.__file__).parent
FIVE = "trainer.max_steps=5"
HOOKS = ["ensure_cloud", "on_test_start", "on_test_epoch_end"]


def at_step(monkeypatch, step, act) -> None:
    """Call ``act(system)`` after so many steps, before the checkpoint of that step is written."""
    training_step = GaussianDreamerSystem.training_step

    def wrapped(self, batch, batch_idx):
        training_step(self, batch, batch_idx)
        if self.global_step == step:
            act(self)

    monkeypatch.setattr(GaussianDreamerSystem, "training_step", wrapped)


def content(step: int, size: int = 20_000) -> dict:
    means = torch.arange(float(size)) + step
    return {"state_dict": {"means": means}, "epoch": 0, "global_step": step}


@pytest.mark.slow
@row("A5", "Crash mid checkpoint")
def test_killed_at_random_moments_of_200_saves(tmp_path, measured):
    """The file stays intact and not older than the last save that the child has reported."""
    path, previous, rng = tmp_path / "last.ckpt", tmp_path / "last-prev.ckpt", random.Random(0)
    save_file(path, content(0))
    saved, kills, lost = 0, 0, 0
    while saved < 200 or kills < 20:
        read_end, write_end = os.pipe()
        child = os.fork()
        for step in range(saved + 1, 10_000) if child == 0 else ():
            save_file(path, content(step))
            os.write(write_end, struct.pack("i", step))
        time.sleep(rng.uniform(0.01, 0.08))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        os.close(write_end)
        told = os.read(read_end, 1 << 16)
        os.close(read_end)
        kills, told = kills + 1, struct.unpack("i", told[-4:])[0] if told else saved
        found = load_checkpoint(path)
        saved = found["global_step"]
        assert found["state_dict"]["means"].equal(content(saved)["state_dict"]["means"])
        lost += max(0, told - saved)
        assert not previous.exists() or load_checkpoint(previous)["global_step"] <= saved
    save_file(path, content(saved + 1))  # which removes partially written files
    assert {entry.name for entry in tmp_path.iterdir()} <= {"last.ckpt", "last-prev.ckpt"}
    measured(kills, "kills", what="kills in 200 saves or more", at_least=20)
    measured(lost, "saves", what="lost", at_most=0)


@contextlib.contextmanager
def permissions_count_for_root():
    """Drop two capabilities of the thread for a while: DAC_OVERRIDE and DAC_READ_SEARCH."""
    if os.geteuid():
        yield
        return
    libc, header = ctypes.CDLL(None, use_errno=True), (ctypes.c_uint32 * 2)(0x20080522, 0)
    before = (ctypes.c_uint32 * 6)()
    if libc.capget(header, before):
        pytest.skip("this system doesn't tell its capabilities")
    libc.capset(header, type(before)(before[0] & ~0b110, *before[1:]))
    try:
        yield
    finally:
        libc.capset(header, before)


def left_in(ended: Ended, *parts: str) -> list[str]:
    """Return the names of temporary files, and of those with one of these words."""
    parts, names = (".tmp", ".part", *parts), (path.name for path in ended.folder.rglob("*"))
    return [name for name in names if any(part in name for part in parts)]


@pytest.mark.slow
@row("A5", "Disk full, read-only")
def test_a_full_disk_in_the_middle_of_a_run(tmp_path, monkeypatch, measured):
    with contextlib.ExitStack() as full:
        at_step(monkeypatch, 3, lambda _: full.enter_context(full_disk(2000)))
        ended = refused(tmp_path, *EVERY_STEP, words=["File too large"])
    assert load_checkpoint(ended.last)["global_step"] == 2 and not left_in(ended, "step=3")
    measured("named error, exit code 2, earlier file intact, no temporary")


@pytest.mark.slow
@row("A5", "Disk full, read-only")
@pytest.mark.parametrize("hook", ["export", "score", *HOOKS])
def test_a_disk_that_is_full_by_then(hook, tmp_path, monkeypatch, measured):
    """While the prior is cached, views and video written, or the cloud exported."""
    owner = system.export if hook == "export" else GaussianDreamerSystem
    original = getattr(owner, hook)
    with contextlib.ExitStack() as full:

        def wrapped(self, *args):
            full.enter_context(full_disk(100))
            return original(self, *args)

        monkeypatch.setattr(owner, hook, wrapped)
        sizes = [f"data.eval_{side}=64" for side in ("width", "height")]
        ended = refused(tmp_path, "trainer.max_steps=1", *sizes, words=[])
    assert "cannot write" in ended.err or "could not be written" in ended.err
    assert not left_in(ended)
    measured("named error at every place that writes")


@row("A5", "Disk full, read-only")
@pytest.mark.parametrize("kind", ["mp4", "gif", "png"])
def test_a_partial_video_is_an_error(kind, tmp_path, measured):
    """The encoder may end without an error: an mp4 counts when it contains its index."""
    noise = np.random.default_rng(0).integers(0, 255, (4, 64, 64, 3), dtype=np.uint8)
    frames, path = [tmp_path / f"{i}.png" for i in range(4)], tmp_path / f"out.{kind}"
    for frame, picture in zip(frames, noise, strict=True):
        pictures.write(frame, picture)

    def write() -> None:
        if kind == "png":
            pictures.write(path, noise[0])
        else:
            write_video(str(path), frames, fps=5)

    def fails(limit: int) -> None:
        with full_disk(limit), pytest.raises(UserError, match=f"out.{kind}"):
            write()

    for limit in (0, 100, 3000):
        path.unlink(missing_ok=True)
        fails(limit)
        assert not path.exists()
        write()
        whole = path.read_bytes()
        fails(limit)
        assert path.read_bytes() == whole and len(list(tmp_path.iterdir())) == 5
    measured("named error, earlier file intact")


@row("A5", "Disk full, read-only")
def test_a_read_only_output_root_is_named_before_any_work(tmp_path, measured):
    tmp_path.chmod(0o555)
    with permissions_count_for_root():
        ended = refused(tmp_path, *EVERY_STEP, words=["can't be written: Permission denied"])
    tmp_path.chmod(0o755)
    assert "the cloud starts" not in ended.err and not list(tmp_path.iterdir())
    measured("named before any work")


def damage(path: Path, how: str, rng: random.Random) -> None:
    data = bytearray(path.read_bytes())
    if how == "truncated":
        del data[rng.randrange(len(data)) :]
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
        damage(path, how, rng)
        with pytest.raises(UserError, match=str(path)):
            load_file(path)
        refused += 1
    measured(refused - times, f"of {times}", what=f"{how} and loaded", at_most=0)


@pytest.mark.slow
@row("A5", "Corrupted checkpoint")
def test_a_damaged_checkpoint_is_refused_and_passed_over_by_resume_auto(whole, tmp_path, measured):
    """The last checkpoint and its copy are damaged; only the user may take another."""
    stopped = launch(tmp_path, "checkpoint.every_n_train_steps=1", "trainer.max_steps=3")
    for name in ("last.ckpt", "epoch=0-step=3.ckpt"):
        damage(stopped.last.with_name(name), "flipped", random.Random(1))
    words = str(stopped.last), "checksum", "last-prev.ckpt"
    refused(tmp_path, *EVERY_STEP, f"resume={stopped.last}", words=words)
    measured("refused, its path named")
    ended = launch(tmp_path, *EVERY_STEP, "resume=auto")
    taken = ended.err.split("resuming from")[-1]
    assert "step=2.ckpt" in taken or "last-prev.ckpt" in ended.err
    assert ended.err.count("is damaged") == 2  # what was passed over is named
    require_equal_ends(measured, whole, ended, "different after resume=auto")


groups_of = lambda c: c["optimizer_states"][0]["param_groups"]  # noqa: E731
with_means = lambda value: lambda c: c["state_dict"].update({"geometry.means": value})  # noqa: E731

INCONSISTENT = {
    "without loops": (lambda c: c.pop("loops"), "it has no loops"),
    "0-d means": (with_means(torch.tensor(1.0)), "geometry.means"),
    "a mean more": (with_means(torch.zeros(121, 3)), "geometry.log_scales"),
    "means as a list": (with_means([1.0, 2.0]), "geometry.means"),
    "no means": (lambda c: c["state_dict"].pop("geometry.means"), "geometry.means"),
    "moments of another size": (lambda c: groups_of(c).pop(), "another configuration"),
    "a word": (lambda c: c.update(global_step="three"), "no valid global_step"),
}


@row("A5", "Corrupted checkpoint")
@pytest.mark.parametrize("what", INCONSISTENT)
def test_an_inconsistent_checkpoint_is_named(what, whole, tmp_path, measured):
    """Its checksum is valid, but its content is not: untrained at step 0, or incomplete."""
    change, message = INCONSISTENT[what]
    checkpoint, path = whole.checkpoint(), tmp_path / "made.ckpt"
    change(checkpoint)
    save_file(path, checkpoint)
    options = *EVERY_STEP, "trainer.max_steps=9", f"resume={path}"
    refused(tmp_path / "run", *options, words=["made.ckpt", message])
    assert not (tmp_path / "run").exists()
    measured("named error, nothing written")


@row("A5", "Ctrl-C / SIGTERM")
@pytest.mark.parametrize("stop", [("TERM", 143, 2), *slow(("INT", 130, 3), ("HUP", 129, 4))])
def test_a_signal_at_a_random_step(stop, whole, tmp_path, monkeypatch, measured):
    name, code, step = stop
    with monkeypatch.context() as patch:
        at_step(patch, step, lambda _: os.kill(os.getpid(), getattr(signal, f"SIG{name}")))
        ended = launch(tmp_path, FIVE, code=code)
    assert f"stopped at step {step}; to resume: " in ended.out, ended.out
    assert f"resume={ended.last}" in ended.out
    assert load_checkpoint(ended.last)["global_step"] == step
    assert not list(ended.folder.glob("save/*test*"))  # Lightning would continue with the test
    finished = launch(tmp_path, *EVERY_STEP, f"resume={ended.last}")
    require_equal_ends(measured, whole, finished, "different after resuming")


@row("A5", "Ctrl-C / SIGTERM")
def test_a_second_signal_stops_at_once(tmp_path, monkeypatch, measured):
    """In the middle of a step: the checkpoint of the previous step remains."""
    at_step(monkeypatch, 3, lambda _: [os.kill(os.getpid(), signal.SIGINT) for _ in range(2)])
    ended = launch(tmp_path, *EVERY_STEP, code=130)
    assert f"resume={ended.last}" in ended.out
    late = 3 - load_checkpoint(ended.last)["global_step"]
    measured(late, "steps", what="lost by a second signal", at_most=1)


TAKEN = "from threestudio_gaussiandreamer.host import register\n@register('mesh-prior')\nclass A: 0"
MODULES = {
    "ImportError": ("import nothing_of_this_name", "custom/part.py:1: ModuleNotFoundError"),
    "syntax": ("def f(:", "custom/part.py:1: "),
    "a damaged file": ("import json\njson.loads('{')", "custom/part.py:2: JSONDecodeError"),
    "an exception": ("\n\nraise RuntimeError('broken')", "custom/part.py:3: RuntimeError: broken"),
    "sys.exit(0)": ("import sys\nsys.exit(0)", "custom/part.py:2: SystemExit: 0"),
    "a name that is taken": (TAKEN, "custom/part.py:2"),
}


@row("A5", "Failed custom module")
@pytest.mark.parametrize("what", MODULES)
def test_a_module_that_fails_is_named_with_its_line(what, tmp_path, monkeypatch, measured):
    monkeypatch.chdir(tmp_path)
    Path("custom").mkdir()
    source, message = MODULES[what]
    Path("custom/part.py").write_text(source)
    refused(tmp_path / "out", FIVE, words=["can't be imported", message])
    assert not (tmp_path / "out").exists()
    measured("named error at load")


@row("A5", "Failed custom module")
def test_a_part_that_calls_sys_exit_in_the_middle_of_a_run_is_named(
    tmp_path, monkeypatch, measured
):
    """``sys.exit()`` means success, but the run is incomplete."""
    monkeypatch.setattr(GaussianDreamerSystem, "training_step", lambda *args: sys.exit())
    words = f"{Path(__file__).name}:", "ended the run with sys.exit(None)"
    refused(tmp_path, "trainer.max_steps=1", words=words)
    measured("named, exit code 2")


refuse = Mock(side_effect=OSError(101, "Network is unreachable"))


@row("A5", "Hub offline")
@pytest.mark.parametrize(
    "what", ["sockets blocked", "no answer to connecting", "no answer to a name", "HF_HUB_OFFLINE"]
)
def test_a_missing_model_is_named_within_seconds(what, tmp_path, monkeypatch, measured):
    """Where nobody answers, a tenth of the users' timeout stands for it."""
    pytest.importorskip("huggingface_hub.hf_api")  # not while the time is measured
    constants = pytest.importorskip("huggingface_hub.constants")
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", what == "HF_HUB_OFFLINE")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    scale = 1.0
    if what == "sockets blocked":
        monkeypatch.setattr(socket.socket, "connect", refuse)
    elif what != "HF_HUB_OFFLINE":
        assert hub.TIMEOUT <= 4.5
        scale = hub.TIMEOUT / 0.5
        monkeypatch.setattr(hub, "TIMEOUT", 0.5)
    if what == "no answer to a name":
        monkeypatch.setattr(socket, "getaddrinfo", lambda *args, **kwargs: time.sleep(30))
    elif what == "no answer to connecting":
        silent = socket.create_server(("127.0.0.1", 0))
        monkeypatch.setenv("HF_ENDPOINT", f"http://127.0.0.1:{silent.getsockname()[1]}")
    message = "hf download .*--local-dir models/model`; then set "
    message += ".*pretrained_model_name_or_path to that folder"
    start = time.monotonic()
    with pytest.raises(UserError, match=message):
        hub.find_model("missing/model", ("unet", "vae"))
    seconds = (time.monotonic() - start) * scale
    measured(seconds, "s", what="time to the message", at_most=5.0)


@pytest.mark.slow
@row("A5", "Hub offline")
def test_the_guidance_without_weights_asks_no_network(tmp_path, monkeypatch, measured):
    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    launch(tmp_path, "trainer.max_steps=2")
    measured("a whole run without a socket")


def config_classes():
    """Return the Config of every part of this package by name, nested dataclasses included."""
    found = {}
    for name in host.names():
        part = host.find(name)
        config = getattr(part, "Config", None)
        if part.__module__.startswith(PACKAGE.name) and is_dataclass(config):
            found[name] = config
            nested = (f for f in fields(config) if is_dataclass(f.type))
            found |= {f"{name}.{field.name}": field.type for field in nested}
    return found


def names_that_are_read():
    """Return attributes, words of strings and parameters in the package's code."""
    directions = ("front", "side", "back", "overhead")
    read = {"renderer_type", *(f"prompt_{direction}" for direction in directions)}  # by getattr
    for path in PACKAGE.rglob("*.py"):
        tree = ast.parse(path.read_text())
        docstrings = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
                read.add(node.attr)
            elif isinstance(node, ast.arg):
                read.add(node.arg)
            elif isinstance(getattr(node, "value", None), str) and id(node) not in docstrings:
                read |= set(node.value.replace(".", " ").split())
    return read


COMPUTED = "exp_dir trial_name trial_dir n_gpus timestamp resume description use_timestamp".split()
FOX = ["system.prompt_processor.prompt=a fox"]


def keys_of(cfg, path=""):
    """Return every dotted key of a configuration except the sections' part names."""
    for key in cfg:
        yield f"{path}{key}"
        if hasattr(cfg._get_node(key), "keys"):
            yield from keys_of(cfg[key], f"{path}{key}.")


def misspelt(word: str) -> set[str]:
    """Return the word with one letter dropped, and with two letters exchanged, in its middle."""
    at = len(word) // 2
    exchanged = word[: at - 1] + word[at] + word[at - 1] + word[at + 1 :]
    return {word[:at] + word[at + 1 :], exchanged} - {word}


MISSPELT = "misspelt {} accepted, or without a correct suggestion"


@pytest.mark.slow
@row("A5", "Wrong config keys")
def test_every_key_misspelt_by_one_letter_is_refused_with_the_right_one(measured):
    tried, failed = set(), []
    for name in ("demo", "gaussiandreamer", "gaussiandreamer-official"):
        path = DEMO.with_stem(name)
        cfg = load_config(path, cli_args=FOX)
        check_config(cfg)
        keys = set(keys_of(cfg)).difference(COMPUTED, tried)
        tried |= keys
        for key in keys:
            section, dot, word = key.rpartition(".")
            for wrong in misspelt(word) if len(word) > 1 else ():
                wrong = section + dot + wrong
                with pytest.raises(UserError) as caught:
                    changed = cfg.copy() if section else load_config(path, cli_args=[f"{wrong}=1"])
                    OmegaConf.update(changed, wrong, 1, force_add=True)
                    check_config(changed)
                failed += [] if word in str(caught.value) else [wrong]
    assert not failed and len(tried) > 100, failed
    measured(len(failed), f"of {len(tried)} keys", what=MISSPELT.format("keys"), at_most=0)


@row("A5", "Wrong config keys")
def test_every_option_of_every_part_misspelt_is_refused_with_the_right_one(measured):
    """Also options that no shipped file uses, nested groups included."""
    tried, failed = 0, []
    for place, config in config_classes().items():
        name, _, group = place.partition(".")
        words = {field.name for field in fields(config)}
        for word in words:
            for wrong in misspelt(word) - words:
                tried += 1
                with pytest.raises(UserError) as caught:
                    check_part("part", name, {group: {wrong: 1}} if group else {wrong: 1})
                failed += [] if word in str(caught.value) else [(place, wrong)]
    assert not failed and tried > 400, failed
    unit, what = f"of {tried} misspelt options", MISSPELT.format("options")
    measured(len(failed), unit, what=what, at_most=0)


@pytest.mark.slow
@row("A5", "Wrong config keys")
def test_every_accepted_key_is_read(measured):
    read, classes = names_that_are_read(), config_classes()
    keys = [field.name for cls in classes.values() for field in fields(cls)]
    unread = sum(key not in read for key in keys)
    measured(unread, f"of {len(keys)} keys", what="never read", at_most=0)


@row("A5", "Wrong config keys")
def test_a_metric_that_is_never_logged_is_named_before_any_work(tmp_path, measured):
    options = "checkpoint.monitor=train/loss_sdss", "checkpoint.save_top_k=1"
    words = "unknown checkpoint.monitor 'train/loss_sdss'", "train/loss_sds'"
    refused(tmp_path, *options, words=words)
    assert not list(tmp_path.iterdir())
    measured("named before any work")


PROMPTS = [
    "a/../../x", "../../x", "/etc/passwd", "x" * 4096, "🦊" * 1000, "CON", "nul.txt",
    "two\nlines", "a\0b", "-x", "--help", "${x}", "${oc.env:HOME}", "", " ", ".", "..", "~",
    "1984", "yes", "null", "it's: 3", "[a]", "{a: b}", "a fox # red", "\\", "%s", "a\tb",
    "\u202eabc", "e\u0301", "&anchor *x", "!!python/object:os.system", "a=b", "\u2028", "٣",
]  # fmt: skip
ALIKE = "x" * 4095, "🦊" * 999, "a_.._.._x", "two_lines", "a?b", "a*b", "con", "a b", "a  b"


@row("A5", "Prompt as path / YAML")
@pytest.mark.parametrize("source", [*slow("command line"), "prompt file"])
def test_a_prompt_stays_text_and_its_folder_below_the_root(source, tmp_path, measured):
    """Also read back; prompts of one slug, or of equal first 64 bytes, have different folders."""
    names, prompts = set(), PROMPTS[::4] if source == "prompt file" else [*PROMPTS, *ALIKE]
    for number, prompt in enumerate(prompts):
        given = f"system.prompt_processor.prompt={prompt}"
        if source == "prompt file":
            (tmp_path / "prompt.txt").write_bytes(prompt.encode())
            given = f"system.prompt_processor.prompt_file={tmp_path}/prompt.txt"
        root = tmp_path / f"outputs{number}"
        cfg = load_config(DEMO, cli_args=[f"exp_root_dir={root}", given])  # its tag is the prompt
        folder = Path(cfg.trial_dir)
        folder.mkdir(parents=True)
        dump_config(folder / "parsed.yaml", cfg)
        again = load_config(folder / "parsed.yaml")
        for text in (cfg.system.prompt_processor.prompt, again.system.prompt_processor.prompt):
            assert text == prompt and type(text) is str
        assert again.trial_dir == cfg.trial_dir
        assert folder.resolve().parent == (root / "demo").resolve()
        # with a hyphen and eight digits of its hash, unless it is the prompt itself
        slug, at, _ = folder.name.partition("@")
        assert at and len(slug.encode()) <= 64 + 9
        names.add(slug)  # an empty prompt has no tag at all, only a time
    measured("verbatim, below the root")
    shared = len(prompts) - len(names)
    measured(shared, f"of {len(prompts)}", what="prompts that share a folder", at_most=0)


GAUSSIAN = [*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"]
GAUSSIAN += [f"rot_{i}" for i in range(4)]


def ply(rows: np.ndarray, names=GAUSSIAN, encoding="binary_little_endian", count=None) -> bytes:
    columns = {name: ("float", column) for name, column in zip(names, rows.T, strict=True)}
    return ply_bytes(columns, encoding, count=count)


def numbers(count: int, columns: int = len(GAUSSIAN)) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(count, columns)).astype(np.float32)


FOREIGN = {
    "ascii": ply(numbers(9), encoding="ascii"),
    "big-endian": ply(numbers(9), encoding="binary_big_endian"),
    "extra properties": ply(np.hstack([numbers(9), numbers(9, 2)]), [*GAUSSIAN, "nx", "mine"]),
    "in another order": ply(numbers(9)[:, ::-1], GAUSSIAN[::-1]),
    "degree 0, so no f_rest": ply(numbers(9)),
}
BROKEN = {
    "rotations missing": ply(numbers(9)[:, :10], GAUSSIAN[:10]),
    "a count of 1e12": ply(numbers(9), count=10**12),
    "a count of 1e12, ascii": ply(numbers(9), encoding="ascii", count=10**12),
    "a negative count": ply(numbers(9), count=-1),
    "cut short": ply(numbers(9))[:-20],
    "no header": b"solid nothing\n",
    "empty": b"",
}


@row("A5", "Corrupted/foreign PLY")
@pytest.mark.parametrize("what", FOREIGN)
def test_a_ply_of_another_program_is_read_correctly(what, tmp_path, measured):
    path, expected = tmp_path / "a.ply", numbers(9)
    path.write_bytes(FOREIGN[what])
    arrays = read_gaussians(path)
    assert np.array_equal(read_points(path).points, expected[:, :3])
    read = np.hstack([arrays.means, arrays.sh[:, 0], arrays.quats])
    wrong = (read != np.hstack([expected[:, :6], expected[:, 10:]])).sum()
    measured(wrong, "numbers", what="read incorrectly", at_most=0)


@row("A5", "Corrupted/foreign PLY")
@pytest.mark.parametrize("what", BROKEN)
def test_a_damaged_ply_is_an_error_in_little_memory(what, tmp_path, measured):
    (tmp_path / "a.ply").write_bytes(BROKEN[what])
    tracemalloc.start()
    with pytest.raises(UserError, match="a.ply"):
        read_gaussians(tmp_path / "a.ply")
    peak = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    measured(peak, "MB", what="peak memory for a file with a wrong count", at_most=1.0)


class Bomb:
    """Creates a folder when it is unpickled."""

    def __init__(self, path: Path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


def write_bomb(path: Path, bomb: Bomb, *arrays: str) -> None:
    """Write a file whose careless reader unpickles the bomb, in the .npz in each of ``arrays``."""
    array = np.array([bomb], object)
    if arrays:
        np.savez(path, **dict.fromkeys(arrays, array))
    elif path.suffix == ".npy":
        np.save(path, array)
    elif path.suffix in (".ckpt", ".bin") or path.stem == "checkpoint":
        checkpoint = {"state_dict": {}, "epoch": 0, "global_step": 0, "hparams": bomb}
        weights = {"text_model.embeddings.position_embedding.weight": bomb}
        torch.save({**checkpoint, **weights, "pytorch-lightning_version": "2.6.6"}, path)
    elif path.suffix == ".yaml":
        path.write_text(f"name: !!python/object/apply:os.mkdir ['{bomb.path}']\n")
    else:
        path.write_bytes(pickle.dumps(bomb))


def refuses(read):
    return lambda path: pytest.raises(UserError, read, str(path))


def open_bin(path: Path) -> None:
    transformers = pytest.importorskip("transformers")
    small = dict(hidden_size=8, intermediate_size=8, vocab_size=50)
    config = transformers.CLIPTextConfig(num_hidden_layers=1, num_attention_heads=1, **small)
    config.save_pretrained(path.parent / "text_encoder")
    path.rename(path.parent / "text_encoder" / path.name)
    part = transformers.CLIPTextModel, path.parent, "text_encoder"
    pytest.raises(UserError, model_files.load_network, *part, allow_bin=True)


def open_embedding(path: Path) -> None:
    pytest.importorskip("safetensors")
    cache = EmbeddingCache(str(path.parent), "a model")
    path.rename(cache.path("a fox"))
    assert cache.read("a fox") is None  # made again


def open_prior_cache(path: Path) -> None:
    assert read_cache(path, "key") is None


def start(option: str, path: Path, stage: str = "--train") -> None:
    options = option.format(path), "trainer.max_steps=1"
    refused(path.parent / "out", *options, stage=stage, words=["could run code"])


shape_weights = refuses(lambda path: read_state_dict(path, "Shap-E"))
points, motions = refuses(lambda path: load_points(Path(path))), refuses(read_motions)
body = refuses(load_body_model)
READERS = {
    "resume": ("bomb.ckpt", partial(start, "resume={}")),
    "resume to export": ("bomb.ckpt", partial(start, "resume={}", stage="--export")),
    "system.weights": ("bomb.ckpt", partial(start, "system.weights={}")),
    "system.geometry.weights": ("bomb.ckpt", partial(start, "system.geometry.weights={}:geometry")),
    "weights of Shap-E, Point-E": ("checkpoint.pt", shape_weights),
    "a bare pickle as .pt": ("a.pt", shape_weights),
    "pytorch_model.bin": ("pytorch_model.bin", open_bin),
    "points .npy": ("a.npy", points),
    "points .npz": ("a.npz", points, "points"),
    "motion .npy": ("a.npy", motions),
    "motion .npz": ("a.npz", motions, "motion"),
    "body model .npz": ("a.npz", body, "v_template"),
    "body model, a pickle called .npz": ("body.npz", body),
    "body model .pkl": ("a.pkl", body),
    "cached prior": ("points.npz", open_prior_cache, "key", "points"),
    "cached text embedding": ("a.pickle", open_embedding),
    "configuration": ("a.yaml", lambda path: launch(path.parent, config=path, code=2)),
}


@row("A5", "Untrusted pickle")
@pytest.mark.parametrize("reader", READERS)
def test_nothing_that_is_opened_runs_code(reader, tmp_path, measured):
    bomb, (name, read, *arrays) = Bomb(tmp_path / "exploded"), READERS[reader]
    write_bomb(tmp_path / name, bomb, *arrays)
    read(tmp_path / name)
    assert not (tmp_path / "exploded").exists()
    pickle.loads(pickle.dumps(bomb))
    assert (tmp_path / "exploded").exists()  # the bomb works when it is unpickled
    measured("nothing executed")


SAFE = dict.fromkeys(("np.load", "npy.read_array"), ("allow_pickle", False))
SAFE["torch.load"] = "weights_only", True
NEVER = "pickle.load pickle.loads yaml.load yaml.unsafe_load yaml.full_load torch.hub.load".split()
NEVER += "marshal.loads joblib.load shelve.open eval exec os.system dill.load".split()


@row("A5", "Untrusted pickle")
def test_every_load_in_the_package_is_the_safe_one(measured):
    unsafe, found, root = [], 0, PACKAGE.parent
    hidden = r"from (torch|numpy|numpy\.lib\.format) import .*(load|read_array)\b"
    for path in [*PACKAGE.rglob("*.py"), *(root / "benchmarks").glob("*.py"), root / "launch.py"]:
        source = path.read_text()
        assert not re.search(hidden, source)
        calls = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call))
        for node in calls:
            name = ast.unparse(node.func)
            if name in SAFE:
                found += 1
                keyword, value = SAFE[name]
                given = {k.arg: getattr(k.value, "value", None) for k in node.keywords}
                unsafe += [] if given.get(keyword) is value else [(path.name, node.lineno, name)]
            unsafe += [(path.name, node.lineno, name)] if name in NEVER else []
    assert found >= 4 and not unsafe, unsafe
    measured(len(unsafe), f"of {found} loads", what="unsafe loads", at_most=0)
