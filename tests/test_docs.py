"""Files that README and docs/ name exist, and their commands and code run."""

import re
import shlex
from pathlib import Path

import pytest
import yaml

from benchmarks import tables
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.launch import experiment
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.config_check import check_config
from threestudio_gaussiandreamer.launch.options import find_config, parse_arguments
from tools import options

register_parts()
ROOT = Path(__file__).parent.parent
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
TEXTS = {str(path.relative_to(ROOT)): path.read_text() for path in DOCUMENTS}
LINKED = [*DOCUMENTS, *sorted((ROOT / "reports").glob("*.md"))]
TINY = [
    "data.width=16", "data.height=16", "data.eval_width=16", "data.eval_height=16",
    "data.n_test_views=2", "data.train_views=4", "system.geometry.grow.num_candidates=200",
    "system.evaluation.size=16", "system.evaluation.views=2", "trainer.max_steps=2",
    "trainer.enable_progress_bar=false", "use_timestamp=false", "tag=t",
]  # fmt: skip


def blocks(text: str, language: str) -> list[str]:
    """Return the fenced blocks in this language; "" for those without one."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.MULTILINE | re.DOTALL)


def launches() -> list[list[str]]:
    """Return the arguments of every launch.py and gaussiandreamer in a block of commands."""
    found = []
    for text in TEXTS.values():
        for block in blocks(text, "bash") + blocks(text, ""):
            for line in block.replace("\\\n", " ").splitlines():
                command = re.search(
                    r"(?:^|python )(?:launch\.py|gaussiandreamer) (.*--config.*)", line
                )
                found += [shlex.split(command[1], comments=True)] if command else []
    return found


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
    """Paths in backticks that begin with a folder of the repository, except what a run writes or a
    user adds.
    """
    for path in re.findall(
        r"`((?:configs|tests|benchmarks|docs|threestudio_gaussiandreamer|custom/threestudio)"
        r"[\w./-]*)`",
        TEXTS[name],
    ):
        assert (ROOT / path).exists(), f"{name} names {path}"


def test_make_targets_exist():
    makefile = (ROOT / "Makefile").read_text()
    for name, text in TEXTS.items():
        for target in re.findall(r"(?:^|`)make ([a-z][\w-]*)", text, re.MULTILINE):
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), f"{name} names make {target}"


def test_the_readme_shows_launches():
    assert len(launches()) >= 3


@pytest.mark.parametrize("arguments", launches(), ids=" ".join)
def test_a_launch_that_is_shown_is_accepted(arguments, tmp_path, monkeypatch):
    """Configuration, options and names; "..." stands for the user's own arguments."""
    args = parse_arguments([word for word in arguments if word != "..."])
    paths = [find_config(name).resolve() for name in args.config]
    overrides = [
        override
        for override in args.overrides
        if not any(override in options for options in PARTS.values())
        and not re.search("spiral-prior|density.every", override)
    ]  # extensions, tried below
    monkeypatch.chdir(tmp_path)
    check_config(load_config(*paths, cli_args=overrides))


def python_blocks() -> list[tuple[str, str]]:
    """Return (file name in the first line, source) of the extensions in docs/."""
    found = [
        (re.match(r"# (custom/\S+\.py)\n", block), block)
        for text in TEXTS.values()
        for block in blocks(text, "python")
    ]
    return [(match[1], block) for match, block in found if match]


# what the demo has to be told for each of them
PARTS = {
    "custom/spiral.py": ["system.geometry.prior_type=spiral-prior"],
    "custom/one_color.py": [
        "system.guidance_type=one-color-guidance",
        "system.geometry.prior.path=toy.glb",
    ],
    "custom/front_first.py": [
        "system.guidance.variant_type=front-first-variant",
        "system.guidance.variant.behind=0.2",
    ],
    "custom/smooth.py": ["system.loss.lambda_smooth_depth=1000", "system.loss.lambda_needles=10"],
    "custom/relocate.py": [
        "system.geometry.density_type=relocate-density",
        "system.geometry.density.every=1",
        "system.geometry.density.min_opacity=0.1",
        "system.geometry.budget=none",
    ],
    "custom/extent.py": ["system.exporter.formats=[ply,extent]"],
    "custom/sky.py": [
        "system.background_type=sky-background",
        "system.optimizer.params.background.lr=0.01",
    ],
}


def test_every_extension_that_is_shown_is_tried():
    assert {name for name, _ in python_blocks()} == set(PARTS)


@pytest.mark.parametrize(("name", "source"), python_blocks())
def test_an_extension_that_is_shown_trains(name, source, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("custom").mkdir()
    Path(name).write_text(source)
    code = experiment.main(
        ["--config", "demo.yaml", "--train", "--gpu", "cpu", *TINY, *PARTS[name]]
    )
    assert code == 0 and Path("outputs/demo/t/save/it2-export/gaussians.ply").is_file()


def test_the_documented_imports_exist():
    (block,) = (
        block
        for block in blocks(TEXTS["docs/extending.md"], "python")
        if block.startswith("from threestudio_gaussiandreamer import")
    )
    exec(block, {})


def test_the_command_of_the_example_for_ci_is_accepted(tmp_path, monkeypatch):
    (block,) = blocks(TEXTS["docs/extending.md"], "yaml")
    steps = yaml.safe_load(block)["jobs"]["smoke"]["steps"]
    words = shlex.split(steps[-1]["run"])
    assert words.pop(0) == "gaussiandreamer" and words.pop().endswith("=spiral-prior")
    monkeypatch.chdir(tmp_path)
    args = parse_arguments(words)
    check_config(load_config(*map(find_config, args.config), cli_args=args.overrides))


@pytest.mark.parametrize("page", tables.PAGES)
def test_the_measured_tables_are_of_these_numbers(page):
    assert (ROOT / page).read_text() == tables.text_of(page), "it is stale: run make docs"


def test_the_page_of_options_is_of_this_code():
    assert (ROOT / "docs/options.md").read_text() == options.text(), "it is stale: run make docs"
