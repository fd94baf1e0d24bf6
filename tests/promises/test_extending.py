"""The extension interface of docs/extending.md: its examples, as they were and as they are, are
registered from ``custom/`` and train.
"""

import ast
import json
import re
from pathlib import Path

import pytest

from .commands import DATA, ROOT, SMOKE, launch, refused

OVERRIDES = {
    "spiral": ["system.geometry.prior_type=spiral-prior", "system.geometry.prior.turns=2"],
    "one_color": ["system.guidance_type=one-color-guidance"],
    "front_first": [
        "system.guidance.variant_type=front-first-variant",
        "system.guidance.variant.behind=0.2",
    ],
    "smooth": ["system.loss.lambda_smooth_depth=1000", "system.loss.lambda_needles=10"],
    "relocate": [
        "system.geometry.density_type=relocate-density",
        "system.geometry.density.every=1",
        "system.geometry.density.min_opacity=0.1",
        "system.geometry.budget=none",
    ],
    "sky": [
        "system.background_type=sky-background",
        "system.optimizer.params.background.lr=0.01",
    ],
    "extent": ["system.exporter.formats=[ply,extent]"],
    "still": ["system.guidance_type=still-guidance", "system.guidance.guidance_scale=10"],
}
"""What a run has to be told for each."""
WRONG = {
    "spiral": ("system.geometry.prior.turn=2", "did you mean 'system.geometry.prior.turns'"),
    "front_first": ("system.guidance.variant.behind=2", "system.guidance.variant.behind"),
    "relocate": ("system.geometry.density.every=0", "system.geometry.density.every"),
}
"""A wrong value of an option of theirs, and the message."""


def blocks(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)


FROZEN = blocks(DATA / "extending.txt")
SHOWN = [block for page in sorted((ROOT / "docs").glob("*.md")) for block in blocks(page)]
EXAMPLES = {
    f"{Path(match[1]).stem}-{number}": block
    for number, block in enumerate({ast.dump(ast.parse(b)): b for b in SHOWN + FROZEN}.values())
    if (match := re.match(r"# (custom/\S+\.py)\n", block))
}


def placed(example: str) -> list[str]:
    """Write an example to ``custom/``; return its overrides."""
    name = example.rpartition("-")[0]
    Path("custom").mkdir()
    Path(f"custom/{name}.py").write_text(EXAMPLES[example])
    return OVERRIDES[name]


@pytest.mark.parametrize("example", EXAMPLES)
def test_an_example_trains(example):
    overrides = placed(example)
    where = ["use_timestamp=false", "tag=t", "trainer.max_steps=4", "data.n_test_views=1"]
    result = launch(*SMOKE, *where, *overrides)
    assert result.code == 0, result.err
    run = Path("outputs/smoke/t")
    assert (run / "save/it4-export/gaussians.ply").is_file()
    assert list((run / "code/custom").glob("*.py"))
    if example.startswith("extent"):
        extent = json.loads((run / "save/it4-export/extent.json").read_text())
        assert extent["count"] > 0 and extent["low"] < extent["high"]


@pytest.mark.parametrize("name", WRONG)
def test_options_of_a_part_are_checked_like_ours(name):
    overrides = placed(next(example for example in EXAMPLES if example.startswith(name)))
    override, message = WRONG[name]
    refused(launch(*SMOKE, *overrides, override), message)
    assert not Path("outputs").exists()


def test_parts_in_custom_are_listed_and_failures_named():
    placed(next(iter(EXAMPLES)))
    lines = launch("--list-parts").out.splitlines()
    assert {"prior", "  spiral-prior", "  mesh-prior", "  sds-variant"} <= set(lines)
    Path("custom/broken.py").write_text("import nothing_of_this_name")
    refused(launch(*SMOKE), "custom/broken.py", "nothing_of_this_name")
    Path("custom/broken.py").rename("custom/broken_disabled.py")
    assert "  spiral-prior" in launch("--list-parts").out


def test_the_documented_imports_exist():
    found = [
        b for b in (*FROZEN, *SHOWN) if b.startswith("from threestudio_gaussiandreamer import")
    ]
    assert found
    for block in found:
        exec(block, {})
