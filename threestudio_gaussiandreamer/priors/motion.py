"""``motion-prior``: the paper's avatars. A pose from a text-to-motion model, SMPL fitted to it,
points on its surface.

=================  =================================================================================
option             meaning
=================  =================================================================================
motion             joint positions as MDM gives them, its results.npy or another NPY or NPZ: see
                   below
body_model         the user's NPZ or PKL of SMPL, SMPL-H or SMPL-X (neutral), with the user's
                   licence
sample             which of the file's motions; null: any
frame              a number, from 0; or ``clip``: the frame whose body fits the text best, of 16 of
                   each motion
candidates         in place of a motion: mesh files of posed bodies, of which CLIP chooses the one
                   that fits the prompt best (the paper's appendix)
clip               any CLIP in transformers' format, a folder or an id of the hub
motion_text        the motion of the prompt; null: found by the rules of ``motion_text.py``
max_residual_mm    the mean distance of the joints from the motion's above which a fit is an error
scale              half the longest side, world units
num_points         points uniform over the surface (the released code), or 0 for the vertices (the
                   paper)
color              ``random`` (the paper), ``grey``, [r, g, b] in [0, 1], or null for the mesh's own
                   colours
ground, ...        see ``priors/base.py``
=================  =================================================================================

Files of motions are MDM's ``results.npy``, a pickled dict, of which no code is run, or an NPZ, with
``motion`` (S, J, 3, F), and optionally ``text`` (S,) strings and ``lengths`` (S,) frames; or an NPY
with (S, J, 3, F), or one motion as (J, 3, F) or (F, J, 3). J is 22 (HumanML3D) or 24 joints in
SMPL's order; metres, y up, as HumanML3D has them. The body is turned to face +x.

The motion itself comes from MDM, outside this package: for "Iron man kicks with his left leg" ask
it for "Someone kicks with the left leg". ``python -m threestudio_gaussiandreamer.priors.motion_text
"<prompt>"`` prints that sentence."""

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar, List, NamedTuple, Optional

import numpy as np
import torch
from jaxtyping import Float

from ..cameras import orbit_c2w
from ..core.errors import UserError
from ..core.extras import require_extra
from ..core.files import existing_file
from ..core.options import at_least, is_whole, positive, satisfies
from ..formats.array_files import read_arrays
from ..formats.reading import reading, require
from ..gaussians.point_cloud import PointCloud
from ..host import info, register, warn
from ..meshes.load import load_mesh
from ..meshes.mesh import Mesh
from ..meshes.raycast import MeshCaster, over_background
from ..models.clip import clip_source, picture_similarities
from ..models.hub import locate
from .base import COLOR, SCALE, Prior, points
from .body_pose import JOINTS, require_frame, world_mesh
from .mesh import centred, colored_cloud, face_normals
from .motion_text import reduced_prompt
from .smpl_fit import fit_bodies, load_body_model, posed_vertices

VIEW_AZIMUTHS = (-40.0, 0.0, 40.0)
VIEW_ELEVATION, VIEW_DISTANCE, VIEW_FOVY = 10.0, 3.2, math.radians(40)
PICTURE_SIZE = 224
NUM_FRAMES = 16
"""Frames of each motion that CLIP chooses from, evenly spaced."""
ROUGH, FINE = 80, 300
"""Iterations of the fit for CLIP's pictures (error about 15 mm) and for the result (1 mm)."""
LIGHT = np.array([0.7, 0.35, 0.62])
FRAME = satisfies(
    "'clip' or a number from 0", lambda value: value == "clip" or is_whole(value) and value >= 0
)
JOINT_COUNTS = (22, 24)


class Motions(NamedTuple):
    """Sequences of joint positions."""

    positions: Float[np.ndarray, "S F J 3"]
    """Metres, y up."""
    texts: Optional[list[str]]
    lengths: list[int]
    """Number of valid frames of each sample; later frames are padding."""


def read_motions(path: str) -> Motions:
    """Return the motions of an NPZ or NPY file.

    Raises:
        UserError: missing, of another layout, without frames, or not finite.
    """
    with reading(path, "motion file") as file:
        arrays = read_arrays(file, "motion file", ["motion"], ["text", "lengths"])
        positions = _sample_frame_joint(arrays["motion"])
        samples, frames = positions.shape[:2]
        lengths = arrays.get("lengths", np.full(samples, frames))
        whole = lengths.shape == (samples,) and lengths.dtype.kind in "iu"
        require(
            whole and ((lengths >= 1) & (lengths <= frames)).all(),
            f"lengths must be {samples} whole numbers from 1 to {frames}, got {lengths.tolist()}",
        )
        for sample, length in zip(positions, lengths, strict=True):
            finite = np.isfinite(sample[:length]).all()
            require(finite, "it has positions that are NaN or infinite: make it again")
    texts = None if "text" not in arrays else [str(text) for text in np.atleast_1d(arrays["text"])]
    return Motions(positions, texts, lengths.tolist())


def _sample_frame_joint(motion: np.ndarray) -> Float[np.ndarray, "S F J 3"]:
    """Convert any of the layouts to (samples, frames, joints, 3)."""
    ordered, shape = np.zeros(0), motion.shape
    if len(shape) == 4 and shape[1] in JOINT_COUNTS and shape[2] == 3:
        ordered = motion.transpose(0, 3, 1, 2)
    elif len(shape) == 3 and shape[0] in JOINT_COUNTS and shape[1] == 3:
        ordered = motion.transpose(2, 0, 1)[None]
    elif len(shape) == 3 and shape[1] in JOINT_COUNTS and shape[2] == 3:
        ordered = motion[None]
    require(
        motion.dtype.kind in "fiu" and ordered.size > 0,
        f"it holds an array {shape} of {motion.dtype}: (samples, 22 or 24 joints, 3, frames) "
        "numbers were expected (6 for a joint are rotations; MDM's HumanML3D models give "
        "positions)",
    )
    return np.ascontiguousarray(ordered, np.float64)


@register("motion-prior")
class MotionPrior(Prior):
    """Points on a body in the pose that fits the prompt."""

    @dataclass
    class Config(Prior.Config):
        motion: str = ""
        body_model: str = ""
        sample: Optional[int] = field(default=None, metadata=at_least(0))
        frame: Any = field(default="clip", metadata=FRAME)
        candidates: List[str] = field(default_factory=list)
        clip: str = "openai/clip-vit-large-patch14"
        motion_text: Optional[str] = None
        max_residual_mm: float = field(default=50.0, metadata=positive("millimetres"))
        scale: float = field(default=1.0, metadata=SCALE)
        num_points: int = field(default=50_000, metadata=points(0))
        color: Any = field(default="random", metadata=COLOR)
        REMOVED: ClassVar[dict[str, Any]] = {
            **Prior.Config.REMOVED,
            "num_frames": (NUM_FRAMES, f"it is {NUM_FRAMES}"),
            "clip_text": (None, "it is motion_text, or the prompt for candidates"),
            "fit_shape": (True, "the shape is fitted too"),
            "face_front": (True, "the body is turned to face the front"),
            "up": ("auto", "it is that of the kind of the candidates' files"),
            "front": (None, "it is that of the kind of the candidates' files"),
            "device": ("auto", "it is the run's device"),
        }

        @staticmethod
        def check(cfg: Any) -> None:
            if bool(cfg.motion) == bool(cfg.candidates):
                raise UserError(
                    "motion: set it to a file of joint positions (with body_model), or set "
                    "candidates to mesh files of posed bodies, not "
                    f"{'both' if cfg.motion else 'neither'}"
                )
            if cfg.motion and not cfg.body_model:
                raise UserError(
                    "body_model: set it to your NPZ or PKL of SMPL (https://smpl.is.tue.mpg.de), "
                    "SMPL-H or SMPL-X; the package brings none"
                )

    cfg: Config

    def preflight(self) -> None:
        cfg = self.cfg
        if cfg.candidates:
            for path in cfg.candidates:
                existing_file(path, "body mesh")
        else:
            read_motions(cfg.motion)
            load_body_model(cfg.body_model)
            require_extra("smpl", "smplx")
        if len(cfg.candidates) > 1 if cfg.candidates else cfg.frame == "clip":
            require_extra("diffusion", "transformers")
            locate(clip_source(cfg.clip), download=False)

    def generate(self, prompt: str, generator: np.random.Generator) -> PointCloud:
        self.preflight()
        of = self._chosen_candidate if self.cfg.candidates else self._body_of_motion
        return centred(colored_cloud(of(prompt), self.cfg, generator))

    def _chosen_candidate(self, prompt: str) -> Mesh:
        paths = self.cfg.candidates
        meshes = [load_mesh(path, scale=self.cfg.scale) for path in paths]
        best = self._best(meshes, prompt, paths) if len(meshes) > 1 else 0
        info(f"body: {paths[best]}")
        return meshes[best]

    def _body_of_motion(self, prompt: str) -> Mesh:
        """Return the body of the chosen frame, with z up, facing +x, centred and scaled."""
        cfg, motions = self.cfg, read_motions(self.cfg.motion)
        model = load_body_model(cfg.body_model)
        if motions.texts:
            info(f"{cfg.motion}: {', '.join(sorted(set(motions.texts)))}")
        choices = offered_frames(motions, cfg.sample, cfg.frame)
        targets = np.stack([motions.positions[choice] for choice in choices])
        names = [f"motion {sample}, frame {frame}" for sample, frame in choices]

        def fitted(targets: Float[np.ndarray, "F K 3"], iterations: int) -> tuple[Any, list[Mesh]]:
            fit = fit_bodies(model, targets, iterations=iterations)
            pairs = zip(posed_vertices(model, fit), targets, strict=True)
            meshes = [world_mesh(Mesh(v, model.faces), joints, cfg.scale) for v, joints in pairs]
            return fit.residuals, meshes

        best = 0
        if len(choices) > 1:
            best = self._best(fitted(targets, ROUGH)[1], self._motion_text(prompt), names)
        # fitted separately, so that the result doesn't depend on the other choices
        (residuals,), (mesh,) = fitted(targets[[best]], FINE)
        worst, mean = int(residuals.argmax()), residuals.mean()
        found = f"{mean:.1f} mm mean, {residuals[worst]:.1f} mm at the {JOINTS[worst]}"
        if mean > cfg.max_residual_mm:
            raise UserError(
                f"SMPL does not fit {names[best]}: its joints are off by {found}: are the "
                "positions in metres, y up and in SMPL's order? Choose another frame or raise "
                f"max_residual_mm ({cfg.max_residual_mm:g})"
            )
        info(f"SMPL fitted to {names[best]}: {found}")
        return mesh

    def _motion_text(self, prompt: str) -> str:
        text = self.cfg.motion_text or reduced_prompt(prompt)
        if text is None:
            warn(
                f"no verb of motion was found in {prompt!r}: set motion_text, for instance to "
                "'Someone stands with open arms'"
            )
        return text or prompt

    def _best(self, meshes: list[Mesh], text: str, names: list[str]) -> int:
        """Return the index of the mesh whose pictures fit ``text`` best, by CLIP."""
        pictures = np.concatenate([body_pictures(mesh) for mesh in meshes])
        clip = clip_source(self.cfg.clip)
        scores = picture_similarities(clip, pictures, text, device=self.device)
        scores = scores.reshape(len(meshes), -1).mean(axis=1)
        found = (f"{name} {score:.4f}" for name, score in zip(names, scores, strict=True))
        info(f"CLIP for {text!r}: {', '.join(found)}")
        return int(scores.argmax())


def offered_frames(motions: Motions, sample: Optional[int], frame: Any) -> list[tuple[int, int]]:
    """Return the (motion, frame) pairs to choose from: of one motion, or of all if ``sample`` is
    None; one frame, or evenly spaced ones if ``frame`` is "clip".
    """
    count = len(motions.lengths)
    if sample is not None and sample >= count:
        raise UserError(f"sample: the file has {count} motions, from 0; there is no {sample}")
    if frame != "clip":
        require_frame(frame, motions.lengths[sample or 0], f"motion {sample or 0}")
        return [(sample or 0, frame)]
    samples = range(count) if sample is None else [sample]
    frames = {s: np.linspace(0, motions.lengths[s] - 1, NUM_FRAMES).round() for s in samples}
    return [(s, int(f)) for s in samples for f in np.unique(frames[s])]


def body_pictures(mesh: Mesh) -> Float[np.ndarray, "V H W 3"]:
    """Render the body in Lambertian grey on white, from the front and from both sides of it."""
    normals = np.zeros_like(mesh.vertices)
    for corner in range(3):
        np.add.at(normals, mesh.faces[:, corner], face_normals(mesh))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    grey = (0.25 + 0.6 * np.maximum(normals @ LIGHT, 0.0)).astype(np.float32)
    vertices, colors = mesh.vertices / np.abs(mesh.vertices).max(), np.repeat(grey[:, None], 3, 1)
    caster = MeshCaster(Mesh(vertices, mesh.faces, vertex_colors=colors))
    azimuths, ones = torch.tensor(VIEW_AZIMUTHS), torch.ones(len(VIEW_AZIMUTHS))
    views = orbit_c2w(VIEW_ELEVATION * ones, azimuths, VIEW_DISTANCE * ones).numpy()
    pictures = caster.render_views([(c2w, VIEW_FOVY) for c2w in views], PICTURE_SIZE, PICTURE_SIZE)
    return over_background(pictures, np.ones(3, np.float32))
