"""Configurations: loading, text that stays text, folders, and the check of every key."""

import os
import re
import time
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.launch.cases import load
from threestudio_gaussiandreamer.core.checkpoint_file import save_file
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch.config import dump_config, load_config
from threestudio_gaussiandreamer.launch.run_folder import safe_name

PROMPT = "system.prompt_processor.prompt"
PROMPTS = [
    *("1984", "~", "a fox: red", "robot #1", "${x}", "\\${a} \\\\${b}\\", 'it\'s a "fox"'),
    *("../../etc/passwd", "a \U0001f98a fox", "-x --train", "two\nlines", "x" * 4096, ""),
]


def test_sections_interpolations_and_overrides(folder):
    cfg = load("trainer.max_steps=12", "data.views=3", "seed=7")
    assert cfg.trainer.max_steps == cfg.checkpoint.every_n_train_steps == 12
    assert (cfg.data.views, cfg.seed, cfg.tag) == (3, 7, "a_red_ball")
    assert re.fullmatch(r"outputs/tiny/a_red_ball@\d{8}-\d{6}", cfg.trial_dir)
    assert os.listdir(folder) == ["tiny.yaml"]
    # later files and the command line win
    Path("more.yaml").write_text("seed: 4\ntrainer: {max_steps: 9}\ndata: null\n")
    cfg = load_config("tiny.yaml", "more.yaml", cli_args=["seed=5"])
    assert (cfg.seed, cfg.trainer.max_steps, cfg.trainer.log_every_n_steps) == (5, 9, 2)
    assert dict(cfg.data) == {}


def test_resolvers_of_threestudio(folder):
    expected = {
        **{"add:1,2": 3, "sub:1,2": -1, "mul:3,2": 6, "div:1,2": 0.5, "idiv:5,2": 2},
        **{"basename:a/b.yaml": "b.yaml", "rmspace:'a b',_": "a_b", "tuple2:3": [3.0, 3.0]},
        **{"gt0:1": True, "not:true": False, "cmaxgt0:[0,0.0,1.0,5]": True},
        "cmaxgt0orcmaxgt0:0,0.0": False,
        "calc_exp_lr_decay_rate:0.25,2": 0.5,
    }
    cfg = load(*(f"system.x{i}=${{{text}}}" for i, text in enumerate(expected)))
    assert [cfg.system[f"x{i}"] for i in range(len(expected))] == [*expected.values()]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("resume=", "resume= has no value: write resume=auto, a file, or resume=null"),
        ("abc", "'abc' isn't an override: expected key=value"),
        ("=3", "isn't an override"),
        ("~system", "isn't an override"),
        ("data.views=[1", "the value of data.views isn't valid YAML"),
        ("seed=-1", "seed: expected a number from 0 to 4294967295, got -1"),
        ("seed=x", "seed: expected a whole number, got 'x'"),
        ("system=3", "system is 3; expected keys and values"),
        ("system=???", "no value for system"),
        ("system=[]", "system is a list in one and a section in another"),
        ("data.views=${nothing}", "data.views: Interpolation key 'nothing' not found"),
        ("data.views=${nothing:1}", "data.views: Unsupported interpolation type nothing"),
        ("data.views=${div:1,0}", "division"),
    ],
)
def test_a_bad_override_is_named(folder, override, message):
    with pytest.raises(UserError, match=re.escape(message)):
        load(override)


def test_missing_values_are_all_named(folder):
    text = "system: {prompt_processor: {prompt: '???'}, a: '${system.prompt_processor.prompt}'}\n"
    Path("open.yaml").write_text(text)
    Path("data.yaml").write_text("data: {views: '???'}")
    with pytest.raises(UserError, match="no value for data.views, system.prompt_processor.prompt"):
        load_config("open.yaml", "data.yaml")
    given = ["data.views=1", f"{PROMPT}=x"]
    assert load_config("open.yaml", "data.yaml", cli_args=given).system.a == "x"


LEVELS = (b", ".join(9 * [b"*a%d" % (i - 1) if i else b"x"]) for i in range(9))
LAUGHS = b"".join(b"a%d: &a%d [%s]\n" % (i, i, level) for i, level in enumerate(LEVELS))
"""Nine levels of nine references each."""


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"a: " + 500 * b"[" + 500 * b"]", "at most 32 levels deep"),
        (b"a: &a [*a]", "hold fewer than"),
        (LAUGHS, "hold fewer than"),
        (b"a: &a {b: 1}\nc: {<<: *a}\non: 3", "has a key that isn't a word, on"),
        (b"trainer:\n  1e3: x", "has a key that isn't a word, 1e3: quote it"),
        (b"a:\n  ? [b]\n  : x", "has a key that isn't a word, a sequence"),
        (b"a: [1", "isn't valid YAML: line 1, column 6: expected"),
        (b"name: a\nname: b", "isn't valid YAML: line 2"),
        (b"a: !!python/object/apply:os.system ['touch pwned']", "isn't valid YAML"),
        (b"\x89PNG\r\n\x1a\n", "isn't UTF-8: 'utf-8' codec can't decode"),
        (b"a:\n\tb: 1", "line 2, column 1"),
        (b"seed: " + 5000 * b"9", "isn't valid YAML: Exceeds the limit"),
        (b"prompt: a fox: red", "isn't valid YAML: line 1, column 14"),
    ],
)
def test_a_bad_file_is_named(folder, content, message):
    Path("bad.yaml").write_bytes(content)
    with pytest.raises(UserError, match=f"bad.yaml.*{re.escape(message)}"):
        load_config("bad.yaml")
    assert not Path("pwned").exists()


@pytest.mark.parametrize("prompt", PROMPTS)
def test_a_prompt_is_text_and_is_read_back_from_the_parsed_file(folder, prompt):
    # a second reference to the prompt must be text too
    twins = ["system.twin=${system.prompt_processor.prompt}", "system.third=${system.twin}"]
    cfg = load(f"{PROMPT}={prompt}", *twins, f"description={prompt}")
    dump_config("parsed.yaml", cfg)
    for loaded in (cfg, load_config("parsed.yaml")):
        system = loaded.system
        found = system.prompt_processor.prompt, system.twin, system.third, loaded.description
        assert set(found) == {prompt}
        assert loaded.tag == prompt.replace(" ", "_")
        assert loaded.trial_dir == cfg.trial_dir


def test_a_harmful_tag_becomes_a_slug_with_a_hash():
    for text in ("a_red_ball", "v1.2-final", "Pikachu,_4k", "\u00e9t\u00e9"):
        assert safe_name(text) == text
    for text in ("a:b", "..", ".hidden", "-rf", "a ", 65 * "x", "\n"):
        assert safe_name(text) != text and re.search(r"-[0-9a-f]{8}$", safe_name(text))
    assert len({safe_name(text) for text in ("a/b", "a:b", "a_b", "A/b", "a\\b")}) == 5
    # normalising takes quadratic time in the number of combining characters: 23 minutes for a MiB
    started = time.process_time()
    assert re.search(r"-[0-9a-f]{8}$", safe_name("a" + "\u0301\u0323" * 250_000))
    assert time.process_time() - started < 1


@settings(max_examples=15)
@given(st.text(), st.integers(0, 30))
@example("a fox " * 20, 1)
@example("a" * 55 + "\U0001f98a-0123abcd", 1)
@example("\ud800", 1)
def test_the_name_of_a_name_is_itself(text, times):
    name = safe_name(text * times)
    assert safe_name(name) == name and len(name.encode()) <= 64 + 9


def test_a_name_that_cannot_be_a_folders_is_reported(folder, caplog):
    cfg = load("name=a/b")
    said = f"name is 'a/b', which can't be a folder's: the run is in {cfg.exp_dir}"
    assert said in caplog.text


def test_prompts_in_a_yaml_are_text_where_yaml_reads_a_number(folder):
    for written in ("1984", "yes", "1e3", "0x10", "'a: b'"):
        text = f"system: {{prompt_processor: {{prompt: {written}}}}}\ntag: {written}\n"
        Path("more.yaml").write_text(text)
        cfg = load_config("tiny.yaml", "more.yaml")
        assert cfg.system.prompt_processor.prompt == cfg.tag == written.strip("'")


def test_a_prompt_from_a_file(folder):
    Path("prompt.txt").write_text("\ufeffa fox: red\n${x}\n", encoding="utf-8")
    cfg = load("system.prompt_processor.prompt_file=prompt.txt")
    assert dict(cfg.system.prompt_processor) == {"prompt": "a fox: red\n${x}"}
    assert cfg.trial_name.startswith("a_fox__red___x_-")
    with pytest.raises(UserError, match="prompt_file.* 'nothing.txt' does not exist"):
        load("system.prompt_processor.prompt_file=nothing.txt")
    with pytest.raises(UserError, match="both prompt and prompt_file"):
        load("system.prompt_processor.prompt_file=prompt.txt", f"{PROMPT}=x")


def test_paths_may_hold_what_yaml_reads_otherwise(folder):
    cfg = load("exp_root_dir=out #1", "system.weights=a: b.ckpt", "resume=[x].ckpt")
    assert (cfg.exp_root_dir, cfg.system.weights, cfg.resume) == ("out #1", "a: b.ckpt", "[x].ckpt")
    assert load("resume=null").resume is None


def test_a_timestamp_never_leaves_the_output_root(folder):
    for timestamp in ("../..", "/../x", "a/b", "a\\b", r'"x\0y"'):
        with pytest.raises(UserError, match="timestamp is .*; expected a part of a folder's name"):
            load(f"timestamp={timestamp}")
    with pytest.raises(UserError, match="timestamp is '..'"):
        load("tag=", "timestamp='..'")


def test_the_home_folder_is_expanded_once(folder, monkeypatch):
    monkeypatch.setenv("HOME", "/home/someone")
    cfg = load("exp_root_dir=~/runs", "use_timestamp=false")
    assert cfg.exp_root_dir == "/home/someone/runs"
    assert cfg.trial_dir == "/home/someone/runs/tiny/a_red_ball"
    with pytest.raises(UserError, match="exp_root_dir is '~missing-user/x', and there is no such"):
        load("exp_root_dir=~missing-user/x")
    assert load("exp_root_dir=./~odd").exp_root_dir == "./~odd"
    assert load("resume=~/last.ckpt").resume == "/home/someone/last.ckpt"


def test_without_timestamp_or_with_several_gpus_the_folder_is_the_tag(folder):
    for how in ({"cli_args": ["use_timestamp=false"]}, {"n_gpus": 2}):
        cfg = load_config("tiny.yaml", **how)
        assert cfg.trial_dir == "outputs/tiny/a_red_ball" and not cfg.new_folder
        how["cli_args"] = [*how.get("cli_args", []), "tag="]
        with pytest.raises(UserError, match="a run needs a tag .* with several GPUs"):
            load_config("tiny.yaml", **how)


def test_resume_auto_takes_the_newest_run_of_the_tag(folder):
    assert load("resume=auto").resume is None
    checkpoint = {"state_dict": {}, "epoch": 0, "global_step": 3}
    for moment in ("20200101-000000", "20210101-000000"):
        save_file(f"outputs/tiny/a_red_ball@{moment}/ckpts/last.ckpt", checkpoint)
    save_file("outputs/tiny/a_red_ball_2@20220101-000000/ckpts/last.ckpt", checkpoint)
    cfg = load("resume=auto")
    assert cfg.trial_dir == "outputs/tiny/a_red_ball@20210101-000000"
    assert cfg.resume == cfg.trial_dir + "/ckpts/last.ckpt"
    # a damaged last checkpoint falls back to the one before
    save_file(cfg.resume, checkpoint)
    Path(cfg.resume).write_bytes(b"damaged")
    assert load("resume=auto").resume == cfg.trial_dir + "/ckpts/last-prev.ckpt"
    # and the parsed file does not resume again
    dump_config("parsed.yaml", load("resume=a.ckpt"))
    assert load_config("parsed.yaml").resume is None
