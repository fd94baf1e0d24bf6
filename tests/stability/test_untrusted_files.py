"""A5: untrusted input. PLY files of other programs, pickles in every file that is read, and no
network.
"""

import ast
import os
import pickle
import re
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.stability.rows import row
from tests.stability.small_runs import launch
from tests.stability.untrusted_files_cases import PACKAGE
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.ply import read_gaussians, read_points, write_gaussians
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.models import model_files
from threestudio_gaussiandreamer.models.embedding_cache import EmbeddingCache
from threestudio_gaussiandreamer.priors.cache import read_cache
from threestudio_gaussiandreamer.priors.motion import read_motions
from threestudio_gaussiandreamer.priors.point_cloud import load_points
from threestudio_gaussiandreamer.priors.smpl_fit import load_body_model
from threestudio_gaussiandreamer.priors.weights import read_state_dict

register_parts()


# ---- PLY -----------------------------------------------------------------------------------------

GAUSSIAN = [
    *"xyz",
    "f_dc_0",
    "f_dc_1",
    "f_dc_2",
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
]


def ply(rows: np.ndarray, names=GAUSSIAN, encoding="binary_little_endian", count=None) -> bytes:
    count = len(rows) if count is None else count
    header = [
        "ply",
        f"format {encoding} 1.0",
        f"element vertex {count}",
        *(f"property float {name}" for name in names),
        "end_header\n",
    ]
    if encoding == "ascii":
        body = "".join(" ".join(map(repr, row.tolist())) + "\n" for row in rows).encode()
    else:
        body = rows.astype("<f4" if encoding.endswith("little_endian") else ">f4").tobytes()
    return "\n".join(header).encode() + body


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
    "NaN rows": ply(numbers(9) * [[np.nan]] * 9),
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
    (tmp_path / "a.ply").write_bytes(FOREIGN[what])
    arrays, expected = read_gaussians(tmp_path / "a.ply"), numbers(9)
    assert np.array_equal(read_points(tmp_path / "a.ply").points, expected[:, :3])
    wrong = (
        (arrays.means != expected[:, :3]).sum()
        + (arrays.quats != expected[:, 10:]).sum()
        + (arrays.sh[:, 0] != expected[:, 3:6]).sum()
    )
    measured(wrong, "numbers", what="read incorrectly", at_most=0)


@row("A5", "Corrupted/foreign PLY")
@pytest.mark.parametrize("what", BROKEN)
def test_a_damaged_ply_is_an_error_in_little_memory(what, tmp_path, measured):
    (tmp_path / "a.ply").write_bytes(BROKEN[what])
    tracemalloc.start()
    with pytest.raises(UserError, match="a.ply"):
        read_gaussians(tmp_path / "a.ply")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    measured(peak / 1e6, "MB", what="peak memory for a file with a wrong count", at_most=1.0)


@row("A5", "Corrupted/foreign PLY")
def test_500_mutants_are_read_or_refused_in_little_memory(tmp_path, measured):
    """Bytes changed, removed, repeated or truncated, in header and rows of each of the files above;
    `make fuzz` also checks what was read.
    """
    path, draw, ended, peak = (
        tmp_path / "a.ply",
        np.random.default_rng(0),
        {"read": 0, "refused": 0},
        0,
    )
    for i in range(500):
        data = bytearray([*FOREIGN.values()][i % len(FOREIGN)])
        for _ in range(draw.integers(1, 4)):
            # every second time in the header, which a uniform choice would seldom hit
            at = int(draw.integers(len(data) if i % 2 else data.find(b"end_header") % len(data)))
            change = [
                bytes(draw.integers(0, 256, 1, np.uint8)),
                b"",
                bytes(data[at : at + 8]) * 2,
                b"9" * 12,
            ][draw.integers(4)]
            data[at : at + 1] = change
        path.write_bytes(data if draw.random() < 0.8 else data[: draw.integers(len(data))])
        tracemalloc.start()
        try:
            read_gaussians(path)
            ended["read"] += 1
        except UserError as error:
            assert "a.ply" in str(error)
            ended["refused"] += 1
        peak = max(peak, tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert min(ended.values()) > 50, ended
    measured(peak / 1e6, "MB", what="peak memory for 500 mutants", at_most=1.0)


@row("A5", "Corrupted/foreign PLY")
def test_an_empty_cloud_is_read_as_one(tmp_path, measured):
    shapes = (0, 3), (0, 4), (0, 3), (0,), (0, 1, 3)
    write_gaussians(tmp_path / "a.ply", Gaussians(*map(np.zeros, shapes)))
    assert len(read_gaussians(tmp_path / "a.ply").means) == 0
    measured("N = 0 read")


# ---- damaged files -------------------------------------------------------------------------------


class Bomb:
    """Creates a folder when it is unpickled."""

    def __init__(self, path: Path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


def bomb_checkpoint(path: Path, bomb: Bomb) -> Path:
    torch.save(
        {
            "state_dict": {},
            "epoch": 0,
            "global_step": 0,
            "pytorch-lightning_version": "2.6.6",
            "hparams": bomb,
        },
        path,
    )
    return path


def bomb_numpy(path: Path, bomb: Bomb, **names) -> Path:
    array = np.array([bomb], object)
    np.savez(path, **{name: array for name in names}) if path.suffix == ".npz" else np.save(
        path, array
    )
    return path


def refused(read) -> None:
    with pytest.raises(UserError):
        read()


def tiny_text_model(folder: Path) -> Path:
    transformers = pytest.importorskip("transformers")
    config = transformers.CLIPTextConfig(
        hidden_size=8,
        intermediate_size=8,
        num_hidden_layers=1,
        num_attention_heads=1,
        vocab_size=50,
    )
    config.save_pretrained(folder / "text_encoder")
    return folder


def open_bin(folder: Path, bomb: Bomb) -> None:
    transformers = pytest.importorskip("transformers")
    torch.save(
        {"text_model.embeddings.position_embedding.weight": bomb},
        tiny_text_model(folder) / "text_encoder" / "pytorch_model.bin",
    )
    refused(
        lambda: model_files.load_network(
            transformers.CLIPTextModel, folder, "text_encoder", allow_bin=True
        )
    )


def open_embedding(folder: Path, bomb: Bomb) -> None:
    pytest.importorskip("safetensors")
    cache = EmbeddingCache(str(folder), "a model")
    cache.path("a fox").write_bytes(pickle.dumps(bomb))
    assert cache.read("a fox") is None  # made again


def open_prior_cache(folder: Path, bomb: Bomb) -> None:
    assert read_cache(bomb_numpy(folder / "points.npz", bomb, key=1, points=1), "key") is None


def open_yaml(folder: Path, bomb: Bomb) -> None:
    (folder / "a.yaml").write_text(f"name: !!python/object/apply:os.mkdir ['{bomb.path}']\n")
    assert launch(folder, config=folder / "a.yaml").code == 2


def launched(option: str, stage: str = "--train"):
    def reader(folder: Path, bomb: Bomb) -> None:
        path = bomb_checkpoint(folder / "bomb.ckpt", bomb)
        ended = launch(folder / "out", option.format(path), "trainer.max_steps=1", stage=stage)
        assert ended.code == 2 and "could run code" in ended.err and "Traceback" not in ended.err, (
            ended.err
        )

    return reader


def renamed_pickle(folder: Path, bomb: Bomb) -> None:
    (folder / "body.npz").write_bytes(pickle.dumps(bomb))
    refused(lambda: load_body_model(str(folder / "body.npz")))


READERS = {
    "resume": launched("resume={}"),
    "resume to export": launched("resume={}", "--export"),
    "system.weights": launched("system.weights={}"),
    "system.geometry.weights": launched("system.geometry.weights={}:geometry"),
    "weights of Shap-E, Point-E": lambda folder, bomb: refused(
        lambda: read_state_dict(str(bomb_checkpoint(folder / "a.pt", bomb)), "Shap-E")
    ),
    "a bare pickle as .pt": lambda folder, bomb: refused(
        lambda: [
            (folder / "a.pt").write_bytes(pickle.dumps(bomb)),
            read_state_dict(str(folder / "a.pt"), "Shap-E"),
        ]
    ),
    "pytorch_model.bin": open_bin,
    "points .npy": lambda folder, bomb: refused(
        lambda: load_points(bomb_numpy(folder / "a.npy", bomb))
    ),
    "points .npz": lambda folder, bomb: refused(
        lambda: load_points(bomb_numpy(folder / "a.npz", bomb, points=1))
    ),
    "motion .npy": lambda folder, bomb: refused(
        lambda: read_motions(str(bomb_numpy(folder / "a.npy", bomb)))
    ),
    "motion .npz": lambda folder, bomb: refused(
        lambda: read_motions(str(bomb_numpy(folder / "a.npz", bomb, motion=1)))
    ),
    "body model .npz": lambda folder, bomb: refused(
        lambda: load_body_model(str(bomb_numpy(folder / "a.npz", bomb, v_template=1)))
    ),
    "body model, a pickle called .npz": renamed_pickle,
    "body model .pkl": lambda folder, bomb: refused(
        lambda: [
            (folder / "a.pkl").write_bytes(pickle.dumps(bomb)),
            load_body_model(str(folder / "a.pkl")),
        ]
    ),
    "cached prior": open_prior_cache,
    "cached text embedding": open_embedding,
    "configuration": open_yaml,
}


@row("A5", "Untrusted pickle")
@pytest.mark.parametrize("reader", READERS)
def test_nothing_that_is_opened_runs_code(reader, tmp_path, measured):
    bomb = Bomb(tmp_path / "exploded")
    READERS[reader](tmp_path, bomb)
    assert not (tmp_path / "exploded").exists()
    pickle.loads(pickle.dumps(bomb))
    assert (tmp_path / "exploded").exists()  # the bomb works when it is unpickled
    measured("nothing executed")


SAFE = {
    "torch.load": ("weights_only", True),
    "np.load": ("allow_pickle", False),
    "npy.read_array": ("allow_pickle", False),
}


NEVER = (
    "pickle.load",
    "pickle.loads",
    "yaml.load",
    "yaml.unsafe_load",
    "yaml.full_load",
    "torch.hub.load",
    "marshal.loads",
    "joblib.load",
    "shelve.open",
    "eval",
    "exec",
    "os.system",
    "dill.load",
)


def calls(path: Path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call):
            yield (
                ast.unparse(node.func),
                {keyword.arg: keyword.value for keyword in node.keywords},
                node.lineno,
            )


@row("A5", "Untrusted pickle")
def test_every_load_in_the_package_is_the_safe_one(measured):
    """Calls are named ``torch.load`` and ``np.load``, so that none is hidden by another name;
    benchmarks and launcher included.
    """
    unsafe, found = [], 0
    root = PACKAGE.parent
    for path in [*PACKAGE.rglob("*.py"), *(root / "benchmarks").glob("*.py"), root / "launch.py"]:
        source = path.read_text()
        assert not re.search(
            r"from (torch|numpy|numpy\.lib\.format) import .*(load|read_array)\b", source
        )
        for name, keywords, line in calls(path):
            if name in SAFE:
                found += 1
                keyword, value = SAFE[name]
                given = keywords.get(keyword)
                if not (isinstance(given, ast.Constant) and given.value is value):
                    unsafe.append(f"{path.name}:{line}: {name}")
            if name in NEVER:
                unsafe.append(f"{path.name}:{line}: {name}")
    assert found >= 4 and not unsafe, unsafe
    measured(len(unsafe), f"of {found} loads", what="unsafe loads", at_most=0)
