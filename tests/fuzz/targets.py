"""All fuzz targets: valid files, how to damage them, and what must hold.

``exercise`` reads a damaged file with the package and renders the result. It returns if the file
was read, raises UserError if it was rejected, and :class:`Misread` if the result isn't the file's
content. Any other exception is a crash."""

import numpy as np

from tests.fuzz import checkpoint_content, config_values, gltf_features, mutations
from tests.fuzz.array_targets import (
    ROWS,
    _saved,
    exercise_motions,
    exercise_npy_points,
    exercise_points,
    exercise_spz,
    motion_archives,
    point_archives,
    spz_files,
    texts,
)
from tests.fuzz.cloud_targets import (
    exercise_gaussians_ply,
    exercise_points_ply,
    gaussian_plys,
    point_plys,
)
from tests.fuzz.format_oracles import compressed_means, ksplat_means, sog_means, usda_means
from tests.fuzz.format_targets import (
    SOG,
    SPZ_4,
    exercise_counted,
    exercise_means,
    exercise_splat,
    files,
    glb_count,
    ksplats,
    splats,
    spz_count,
    unpacked,
)
from tests.fuzz.mesh_targets import (
    exercise_glb,
    exercise_gltf_features,
    exercise_mesh,
    exercise_obj,
    exercise_ply_mesh,
    meshes,
)
from tests.fuzz.mutations import TEXT
from tests.fuzz.page_targets import exercise_run_folder, run_folders
from tests.fuzz.run_targets import (
    COMMANDS,
    checkpoints,
    configurations,
    exercise_checkpoint,
    exercise_command,
    exercise_configuration,
)
from tests.fuzz.target import Target, require_picture
from threestudio_gaussiandreamer.formats.compressed_ply import read_compressed_ply
from threestudio_gaussiandreamer.formats.sog import load_sog
from threestudio_gaussiandreamer.formats.splat import read_ksplat
from threestudio_gaussiandreamer.formats.usda import read_usda


def mutant(name: str, seed: int, index: int) -> bytes:
    """Return the damaged file with this index."""
    target = TARGETS[name]
    rng = np.random.default_rng([seed, index, *name.encode()])
    return mutations.mutant(seeds(name), rng, target.mutators, target.packing)


_KNOWN: dict[str, list[bytes]] = {}


def seeds(name: str) -> list[bytes]:
    return _KNOWN.setdefault(name, TARGETS[name].seeds())


TARGETS: dict[str, Target] = {
    "ply-gaussians": Target(".ply", gaussian_plys, exercise_gaussians_ply, packing=mutations.PLY),
    "ply-points": Target(".ply", point_plys, exercise_points_ply, packing=mutations.PLY),
    "ply-mesh": Target(".ply", lambda: meshes("ply"), exercise_ply_mesh, packing=mutations.PLY),
    "glb": Target(".glb", lambda: meshes("glb"), exercise_glb, packing=mutations.GLB),
    "gltf-features": Target(
        ".glb", gltf_features.seeds, exercise_gltf_features, [gltf_features.other_file]
    ),
    "obj": Target(".obj", lambda: meshes("obj"), exercise_obj, TEXT),
    "stl": Target(".stl", lambda: meshes("stl"), exercise_mesh),
    "off": Target(".off", lambda: meshes("off"), exercise_mesh, TEXT),
    "checkpoint": Target(".ckpt", checkpoints, exercise_checkpoint, packing=mutations.ZIP),
    "configuration": Target(".yaml", configurations, exercise_configuration, TEXT, traced=False),
    "config-values": Target(
        ".txt",
        config_values.seeds,
        config_values.exercise,
        [config_values.extreme_option],
        traced=False,
    ),
    "checkpoint-content": Target(
        ".ckpt",
        checkpoint_content.seeds,
        lambda path: checkpoint_content.exercise(path, require_picture),
        [checkpoint_content.other_content],
    ),
    "command-line": Target(
        ".txt",
        lambda: [command.encode() for command in COMMANDS],
        exercise_command,
        TEXT,
        traced=False,
    ),
    "motion": Target(".npz", motion_archives, exercise_motions, packing=mutations.ZIP),
    "points-npz": Target(".npz", point_archives, exercise_points, packing=mutations.ZIP),
    "points-npy": Target(
        ".npy",
        lambda: [_saved(np.save, ROWS), _saved(np.save, ROWS[:, :3].astype(np.float32))],
        exercise_npy_points,
    ),
    "points-text": Target(".xyz", texts, exercise_points, TEXT),
    "run-folder": Target(".txt", run_folders, exercise_run_folder, TEXT, traced=False),
    "spz": Target(".spz", spz_files, exercise_spz, packing=mutations.GZIP),
    "spz-4": Target(
        ".spz",
        lambda: files(".spz", [(12, 0), (9, 1)], spz_version=4),
        exercise_counted(spz_count),
        packing=SPZ_4,
    ),
    "sog": Target(
        ".sog",
        lambda: files(".sog", [(12, 0), (9, 1)]),
        exercise_means(lambda path: load_sog(path)[0], sog_means),
        packing=SOG,
    ),
    "sog-folder": Target(
        ".sog",
        lambda: files(".sog", [(12, 0), (9, 1)]),
        exercise_means(lambda path: load_sog(unpacked(path))[0], sog_means),
        packing=SOG,
    ),
    "ksplat": Target(".ksplat", ksplats, exercise_means(read_ksplat, ksplat_means)),
    "glb-gaussians": Target(
        ".glb",
        lambda: files(".glb", [(12, 0), (9, 1)]),
        exercise_counted(glb_count),
        packing=mutations.GLB,
    ),
    "compressed-ply": Target(
        ".compressed.ply",
        lambda: files(".compressed.ply", [(12, 0), (260, 1)]),
        exercise_means(read_compressed_ply, compressed_means),
        packing=mutations.PLY,
    ),
    "splat": Target(".splat", splats, exercise_splat),
    "usda": Target(
        ".usda",
        lambda: files(".usda", [(12, 0), (9, 1)]),
        exercise_means(lambda path: read_usda(path)[0], usda_means),
        TEXT,
    ),
}
