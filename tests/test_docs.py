"""Files that README and docs/ name exist, and their commands and code run."""

import re
import shlex
from pathlib import Path

import pytest
import yaml

from benchmarks import tables
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_config
from threestudio_gaussiandreamer.launch.options import find_config, parse_arguments
from tools import options

register_parts()
ROOT = Path(__file__).parent.parent
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TEXTS = {str(path.relative_to(ROOT)): path.read_text() for path in DOCUMENTS}
LINKED = [*DOCUMENTS, *sorted((ROOT / "reports").glob("*.md"))]
LAUNCH = r"(?:^|python )(?:launch\.py|gaussiandreamer) (.*--config.*)"
EXTENSIONS = re.compile(
    "spiral-prior|one-color|front-first|variant.behind|smooth_depth|needles|relocate|density.every"
    "|,extent|sky-background|background.lr"
)
"""Options of the examples of docs/extending.md, which tests/promises/test_extending.py trains."""


def blocks(text: str, language: str) -> list[str]:
    """Return the fenced blocks in this language; "" for those without one."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def launches() -> list[list[str]]:
    """Return the arguments of every launch.py and gaussiandreamer in a block of commands."""
    found = []
    for text in TEXTS.values():
        for block in blocks(text, "bash") + blocks(text, ""):
            for line in block.replace("\\\n", " ").splitlines():
                command = re.search(LAUNCH, line)
                found += [shlex.split(command[1], comments=True)] if command else []
    assert len(found) >= 3
    return [list(words) for words in dict.fromkeys(map(tuple, found))]


def anchors(text: str) -> set[str]:
    """Return the anchors of a document's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", LINKED, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if re.match(r"https?:|mailto:", target):
            continue
        path, _, anchor = target.partition("#")
        file = page.parent / path if path else page
        assert file.exists(), f"{page} links to {target}"
        assert not anchor or anchor in anchors(file.read_text()), f"{page} links to {target}"


@pytest.mark.parametrize("name", TEXTS)
def test_files_that_are_named_exist(name):
    """Paths in backticks that begin with a folder of the repository."""
    folders = "configs|tests|benchmarks|docs|threestudio_gaussiandreamer|custom/threestudio"
    for path in re.findall(rf"`((?:{folders})[\w./-]*)`", TEXTS[name]):
        assert (ROOT / path).exists(), f"{name} names {path}"


def test_make_targets_exist():
    makefile = (ROOT / "Makefile").read_text()
    for name, text in TEXTS.items():
        for target in re.findall(r"(?:^|`)make ([a-z][\w-]*)", text, re.MULTILINE):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"{name} names make {target}"


@pytest.mark.parametrize("arguments", launches(), ids=" ".join)
def test_a_launch_that_is_shown_is_accepted(arguments, tmp_path, monkeypatch):
    """Configuration, options and names; "..." stands for the user's own arguments."""
    args = parse_arguments([word for word in arguments if word != "..."])
    paths = [find_config(name).resolve() for name in args.config]
    overrides = [text for text in args.overrides if not EXTENSIONS.search(text)]
    monkeypatch.chdir(tmp_path)
    check_config(load_config(*paths, cli_args=overrides))


def test_the_command_of_the_example_for_ci_is_accepted(tmp_path, monkeypatch):
    (block,) = blocks(TEXTS["docs/extending.md"], "yaml")
    steps = yaml.safe_load(block)["jobs"]["smoke"]["steps"]
    words = shlex.split(steps[-1]["run"])
    assert words.pop(0) == "gaussiandreamer" and words.pop().endswith("=spiral-prior")
    monkeypatch.chdir(tmp_path)
    args = parse_arguments(words)
    check_config(load_config(*map(find_config, args.config), cli_args=args.overrides))


@pytest.mark.parametrize("page", ["docs/options.md", *tables.PAGES])
def test_the_generated_pages_are_of_this_code_and_these_numbers(page):
    text = tables.text_of(page) if page in tables.PAGES else options.text()
    assert (ROOT / page).read_text() == text, "it is stale: run make docs"
