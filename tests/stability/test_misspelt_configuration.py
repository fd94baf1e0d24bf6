"""Misspelt keys are rejected with a suggestion; prompts stay text."""

from dataclasses import fields
from pathlib import Path

import pytest
from omegaconf import OmegaConf, open_dict

from tests.launch import test_shipped_configs as test_configs
from tests.stability.rows import row
from tests.stability.small_runs import DEMO, launch
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch.config import dump_config, load_config
from threestudio_gaussiandreamer.launch.config_check import check_config, check_part

register_parts()


# ---- configuration -------------------------------------------------------------------------------


def keys_of(cfg, path=""):
    """Return every dotted key of a configuration except the sections' part names, whose keys are
    checked with them.
    """
    for key in cfg:
        yield f"{path}{key}"
        if hasattr(cfg._get_node(key), "keys"):
            yield from keys_of(cfg[key], f"{path}{key}.")


def misspelt(word: str) -> list[str]:
    """Return the word with one letter dropped, and with two letters exchanged, in its middle."""
    at = len(word) // 2
    return [word[:at] + word[at + 1 :], word[: at - 1] + word[at] + word[at - 1] + word[at + 1 :]]


def refusal(cfg, section: str, wrong: str, name: str) -> str:
    """Return the message about one additional key in a valid configuration; empty if it is
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
    """Every key of the shipped files, at every depth; the message contains the right word."""
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
        what="misspelt keys accepted, or without a correct suggestion",
        at_most=0,
    )


@row("A5", "Wrong config keys")
def test_every_option_of_every_part_misspelt_is_refused_with_the_right_one(measured):
    """Also options that no shipped file uses, nested groups included."""
    tried, failed = 0, []
    for place, config in test_configs.config_classes().items():
        name, _, group = place.partition(".")
        words = {field.name for field in fields(config)}
        for word in words:
            for wrong in set(misspelt(word)) - words:
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
        what="misspelt options accepted, or without a correct suggestion",
        at_most=0,
    )


@row("A5", "Wrong config keys")
def test_every_accepted_key_is_read(measured):
    read, classes = test_configs.names_that_are_read(), test_configs.config_classes()
    keys = [(name, field.name) for name, cls in classes.items() for field in fields(cls)]
    measured(
        sum(field not in read for _, field in keys),
        f"of {len(keys)} keys",
        what="never read",
        at_most=0,
    )


@row("A5", "Wrong config keys")
@pytest.mark.parametrize(
    "monitor, message",
    [("los", "did you mean 'loss'"), ("train/loss_sdss", "train/loss_sds"), ("val/psnr", "choose")],
)
def test_a_metric_that_is_never_logged_is_named_before_any_work(
    monitor, message, tmp_path, measured
):
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
    """The prompt is stored verbatim, also after parsed.yaml was read back; a folder of its name can
    be created.
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
    )  # with a hyphen and eight digits of its hash, unless it is the prompt itself
    measured("verbatim, below the root")


@row("A5", "Prompt as path / YAML")
def test_different_prompts_have_different_folders(measured):
    """Also those that share their first 64 bytes, or become equal when forbidden characters are
    replaced.
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
    measured(
        len(prompts) - len(names),
        f"of {len(prompts)}",
        what="prompts that share a folder",
        at_most=0,
    )
