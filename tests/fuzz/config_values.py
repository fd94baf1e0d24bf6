"""Generator of extreme option values: overrides of the demo's configuration, one per line.

Options of every registered part, of the trainer and of the checkpoints are drawn; the value is an
extreme number, a text, a list, a section, the name of any part, or a value of the right type.
"""

import copy
import dataclasses
import inspect
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from omegaconf import OmegaConf

from tests.fuzz.mutations import NUMBERS, TOKENS
from threestudio_gaussiandreamer.host import find, names, pl
from threestudio_gaussiandreamer.launch import config
from threestudio_gaussiandreamer.launch.config_check import check_config

DEMO = Path(__file__).parents[2] / "configs" / "demo.yaml"
SMALL = [
    *("data.width=16", "data.height=16", "data.eval_width=16", "data.eval_height=16"),
    *("data.n_test_views=2", "data.train_views=4", "system.geometry.prior.num_points=80"),
    *("system.evaluation.size=16", "use_timestamp=false", "tag=t"),
]
SUFFIXES = {
    "-prior": "system.geometry.prior",
    "-guidance": "system.guidance",
    "-prompt-processor": "system.prompt_processor",
    "-exporter": "system.exporter",
    "-background": "system.background",
    "-material": "system.material",
    "-cloud": "system.geometry",
    "-splatting": "system.renderer",
    "-datamodule": "data",
    "-system": "system",
}
"""Section in which a part is configured, by the ending of its name."""
TEXTS = [token.decode("latin-1") for token in TOKENS if b"\0" not in token and b"\n" not in token]
LISTS = [
    *("[]", "[1]", "[1,2]", "[2,1]", "[0,0]", "[1,2,3]", "[0,1,0.5,10]", "[0,-1,1e38,5]"),
    *("[1e39,1]", "[a,b]", "[[1],[2]]", "[null,1]", "[.nan,.inf]", "[-1e30,1e30]", "[true,false]"),
    *("{}", "{a: 1}", "{enabled: true, start: 5, stop: 5}", "{start: 0, every: 0}"),
]
PLAIN = [
    *("null", "true", "false", "auto", "none", "0", "1", "2", "-1", "0.5", "0.999", "1e-30"),
    *("16384", "16385", "100000", "1000000", "2147483647", "1e30", "1e38", "3.5e38", "180", "90"),
    *("9" * 19, "9" * 20, "9" * 400, "9" * 5000, "1" + "0" * 308 + ".0", ".nan", "-.inf"),
]
MOST_PIXELS = 1 << 16
"""Largest batch that is made to test an accepted configuration."""


def seeds() -> list[bytes]:
    return [b"seed=3", b"system.geometry.prior_type=random-prior\nseed=5"]


def extreme_option(data: bytes, rng: np.random.Generator) -> bytes:
    """Append an option with an extreme value."""
    lines = options()[rng.integers(len(options()))]
    key, values = lines[-1], [*PLAIN, *LISTS, *TEXTS, *(n.decode() for n in NUMBERS), *names()]
    chosen = values[rng.integers(len(values))]
    return data + "\n".join(["", *lines[:-1], f"{key}={chosen}"]).encode()


@cache
def options() -> list[tuple[str, ...]]:
    """Return each option's key, after the overrides that choose its part."""
    found: list[tuple[str, ...]] = [
        (field.name,) for field in dataclasses.fields(config.ExperimentConfig)
    ]
    found += [("system.optimizer.args.eps",), ("system.optimizer.args.betas",)]
    found += [("system.loss.lambda_sds",), ("system.loss.lambda_opaque",)]
    for section, owner in (("trainer", pl.Trainer), ("checkpoint", pl.callbacks.ModelCheckpoint)):
        parameters = inspect.signature(owner.__init__).parameters
        found += [(f"{section}.{name}",) for name in parameters if name != "self"]
    for name in names():
        section = next((s for ending, s in SUFFIXES.items() if name.endswith(ending)), None)
        config_class = getattr(find(name), "Config", None)
        if section is not None and config_class is not None:
            keys = _keys(config_class, section)
            found += [(f"{section}_type={name}", key) for key in keys]
    return found


def _keys(config_class: type, section: str) -> Iterator[str]:
    for field in dataclasses.fields(config_class):
        yield f"{section}.{field.name}"
        if dataclasses.is_dataclass(field.type):
            yield from _keys(field.type, f"{section}.{field.name}")


def exercise(path: Path) -> None:
    """What is accepted can be built: its cameras, a batch of them where that is small, and the
    system with its parts.
    """
    overrides = path.read_bytes().decode("utf-8", errors="surrogateescape").split("\n")
    demo = copy.deepcopy(small_demo())
    with mock.patch.object(config, "read_yaml", lambda path: demo):
        cfg = config.load_config(DEMO, cli_args=overrides)
    check_config(cfg)
    if not cfg.data_type.endswith("datamodule") or cfg.system_type != "gaussiandreamer-system":
        return
    data = find(cfg.data_type)(cfg.data)
    if pixels(cfg.data) <= MOST_PIXELS and views(cfg.data) <= MOST_PIXELS:
        data.setup("fit")
        next(iter(data.train_dataloader()))
        next(iter(data.val_dataloader()))
    if cfg.system.get("weights") is None:
        find(cfg.system_type)(cfg.system)


@cache
def small_demo() -> Any:
    """The demo's configuration, small; reading YAML is what another generator tries."""
    demo = OmegaConf.merge(config.read_yaml(DEMO), config.parse_overrides(SMALL))
    return OmegaConf.to_container(demo)


def pixels(cfg: Any) -> int:
    sides = [cfg.get(name, 64) for name in ("height", "width", "batch_size")]
    counts = [max(side) if not isinstance(side, int) else side for side in sides]
    evaluated = cfg.get("eval_height", 512) * cfg.get("eval_width", 512)
    return max(int(np.prod(counts, dtype=np.float64)), evaluated)


def views(cfg: Any) -> int:
    return max(cfg.get(name, 1) for name in ("train_views", "n_val_views", "n_test_views"))
