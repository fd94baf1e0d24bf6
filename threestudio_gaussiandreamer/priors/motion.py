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
frame              a number, from 0; or ``clip``: the frame whose body fits the text best
num_frames         frames of each motion that ``clip`` chooses from, evenly spaced
candidates         in place of a motion: mesh files of posed bodies, of which CLIP chooses one (the
                   paper's appendix)
clip               any CLIP in transformers' format, a folder or an id of the hub
clip_text          the text that pictures are compared with; null: the motion for frames, the prompt
                   for candidates
motion_text        the motion of the prompt; null: found by the rules of ``motion_text.py``
fit_shape          fit SMPL's shape too; else its mean shape
max_residual_mm    the mean distance of the joints from the motion's above which a fit is an error
face_front         turn the body to look at azimuth 0; else it looks where the motion left it
up, front          of the candidates' files, ``+x`` to ``-z`` (see ``meshes/load.py``)
scale              half the longest side, world units
num_points         points uniform over the surface (the released code), or 0 for the vertices (the
                   paper)
color              ``random`` (the paper), ``grey``, [r, g, b] in [0, 1], or null for the mesh's own
                   colours
device             ``auto``: the run's GPU, or the CPU; for CLIP, the fit takes seconds on the CPU
ground, ...        see ``priors/base.py``
=================  =================================================================================

Files of motions are MDM's ``results.npy``, a pickled dict, of which no code is run, or an NPZ, with
``motion`` (S, J, 3, F), and optionally ``text`` (S,) strings and ``lengths`` (S,) frames; or an NPY
with (S, J, 3, F), or one motion as (J, 3, F) or (F, J, 3). J is 22 (HumanML3D) or 24 joints in
SMPL's order; metres, y up, as HumanML3D has them.

The motion itself comes from MDM, outside this package: for "Iron man kicks with his left leg" ask
it for "Someone kicks with the left leg". ``python -m threestudio_gaussiandreamer.priors.motion_text
"<prompt>"`` prints that sentence."""

import math
from dataclasses import dataclass, field
from typing import Any, List, NamedTuple, Optional

import numpy as np
import torch
from jaxtyping import Float

from ..cameras import orbit_c2w
from ..core.errors import UserError
from ..core.extras import require_extra
from ..core.files import existing_file
from ..core.options import at_least, in_range, is_whole, positive, satisfies
from ..formats.array_files import read_arrays
from ..gaussians.point_cloud import PointCloud
from ..host import info, register, warn
from ..meshes.load import load_mesh
from ..meshes.mesh import Mesh
from ..meshes.raycast import MeshCaster, over_background
from ..models.clip import clip_source, picture_similarities
from ..models.hub import Source, locate
from .base import COLOR, SCALE, Prior, chosen_device, points
from .mesh import colored_cloud, face_normals
from .motion_text import reduced_prompt
from .pose_files import require_frame
from .skeleton import JOINTS, world_mesh
from .smpl_fit import BodyFit, BodyModel, fit_bodies, load_body_model, posed_vertices

VIEW_AZIMUTHS = (-40.0, 0.0, 40.0)
VIEW_ELEVATION, VIEW_DISTANCE, VIEW_FOVY = 10.0, 3.2, math.radians(40)
PICTURE_SIZE = 224
ROUGH, FINE = 80, 300
"""Iterations of the fit for CLIP's pictures (error about 15 mm) and for the result (1 mm)."""
LIGHT = np.array([0.7, 0.35, 0.62])


FRAME = satisfies(
    "'clip' or a number from 0", lambda value: value == "clip" or is_whole(value) and value >= 0
)


Choice = tuple[int, int]
"""A motion and one of its frames."""


JOINT_COUNTS = (22, 24)
EXPECTED = "arrays (samples, 22 or 24 joints, 3, frames) were expected"


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
        UserError: missing, pickled, of another layout, without frames, or not finite; the message
            says what to do.
    """
    file = existing_file(path, "motion file")
    arrays = read_arrays(file, "motion file", ["motion"], ["text", "lengths"])
    positions = _sample_frame_joint(arrays["motion"], path)
    lengths = _lengths(arrays.get("lengths"), positions, path)
    texts = None if "text" not in arrays else [str(text) for text in np.atleast_1d(arrays["text"])]
    for sample, length in zip(positions, lengths, strict=True):
        if not np.isfinite(sample[:length]).all():
            raise UserError(
                f"motion file {path!r} has positions that are NaN or infinite: make it again"
            )
    return Motions(positions, texts, lengths)


def _sample_frame_joint(motion: np.ndarray, path: str) -> Float[np.ndarray, "S F J 3"]:
    """Convert any of the layouts to (samples, frames, joints, 3)."""
    shape = motion.shape
    if motion.dtype.kind not in "fiu":
        raise UserError(f"motion file {path!r} holds {motion.dtype}, not numbers: {EXPECTED}")
    if len(shape) == 4 and shape[1] in JOINT_COUNTS and shape[2] == 3:
        ordered = motion.transpose(0, 3, 1, 2)
    elif len(shape) == 3 and shape[0] in JOINT_COUNTS and shape[1] == 3:
        ordered = motion.transpose(2, 0, 1)[None]
    elif len(shape) == 3 and shape[1] in JOINT_COUNTS and shape[2] == 3:
        ordered = motion[None]
    else:
        hint = " (6 numbers for a joint are rotations: MDM's HumanML3D models give positions)"
        hint = hint if 6 in shape else ""
        raise UserError(f"motion file {path!r} holds an array {shape}: {EXPECTED}{hint}")
    if not ordered.size:
        raise UserError(f"motion file {path!r} holds an array {shape}, without a frame")
    return np.ascontiguousarray(ordered, np.float64)


def _lengths(
    lengths: Optional[np.ndarray], positions: Float[np.ndarray, "S F J 3"], path: str
) -> list[int]:
    samples, frames = positions.shape[:2]
    if lengths is None:
        return [frames] * samples
    whole = lengths.shape == (samples,) and lengths.dtype.kind in "iu"
    if not whole or not ((lengths >= 1) & (lengths <= frames)).all():
        raise UserError(
            f"motion file {path!r}: lengths must be {samples} whole numbers from 1 to "
            f"{frames}, got {lengths.tolist()}"
        )
    return [int(length) for length in lengths]


@register("motion-prior")
class MotionPrior(Prior):
    """Points on a body in the pose that fits the prompt."""

    @dataclass
    class Config(Prior.Config):
        motion: str = ""
        body_model: str = ""
        sample: Optional[int] = field(default=None, metadata=at_least(0))
        frame: Any = field(default="clip", metadata=FRAME)
        num_frames: int = field(default=16, metadata=in_range(1, 100_000))
        candidates: List[str] = field(default_factory=list)
        clip: str = "openai/clip-vit-large-patch14"
        clip_text: Optional[str] = None
        motion_text: Optional[str] = None
        fit_shape: bool = True
        max_residual_mm: float = field(default=50.0, metadata=positive("millimetres"))
        face_front: bool = True
        up: str = "auto"
        front: Optional[str] = None
        scale: float = field(default=1.0, metadata=SCALE)
        num_points: int = field(default=50_000, metadata=points(0))
        color: Any = field(default="random", metadata=COLOR)
        device: str = "auto"

        @staticmethod
        def check(cfg: Any) -> None:
            _check_source(cfg)

    cfg: Config

    def preflight(self) -> None:
        if self.cfg.candidates:
            for path in self.cfg.candidates:
                existing_file(path, "body mesh")
        else:
            read_motions(self.cfg.motion)
            load_body_model(self.cfg.body_model)
            require_extra("smpl", "smplx")
        if self._needs_clip():
            require_extra("diffusion", "transformers")
            chosen_device(self.cfg.device, self.device)
            locate(self._clip(), download=False)

    def generate(self, prompt: str, generator: np.random.Generator) -> PointCloud:
        self.preflight()
        of = self._chosen_candidate if self.cfg.candidates else self._body_of_motion
        mesh = of(prompt)
        cloud = colored_cloud(mesh, self.cfg, generator)
        return cloud._replace(points=cloud.points - cloud.points.mean(axis=0))

    def _needs_clip(self) -> bool:
        return len(self.cfg.candidates) > 1 if self.cfg.candidates else self.cfg.frame == "clip"

    def _clip(self) -> Source:
        return clip_source(self.cfg.clip)

    def _chosen_candidate(self, prompt: str) -> Mesh:
        cfg, best = self.cfg, 0
        axes = {"scale": cfg.scale, "up": cfg.up, "front": cfg.front}
        meshes = [load_mesh(path, **axes) for path in cfg.candidates]
        if len(meshes) > 1:
            best = self._best(meshes, cfg.clip_text or prompt, cfg.candidates)
        info(f"body: {cfg.candidates[best]}")
        return meshes[best]

    def _body_of_motion(self, prompt: str) -> Mesh:
        """Return the body of the chosen frame, in the world's pose."""
        motions, model = read_motions(self.cfg.motion), load_body_model(self.cfg.body_model)
        if motions.texts:
            info(f"{self.cfg.motion}: {', '.join(sorted(set(motions.texts)))}")
        choices = offered_frames(motions, self.cfg.sample, self.cfg.frame, self.cfg.num_frames)
        targets = np.stack([motions.positions[choice] for choice in choices])
        names = [f"motion {sample}, frame {frame}" for sample, frame in choices]
        best = 0
        if len(choices) > 1:
            _, rough = self._fitted(model, targets, ROUGH)
            best = self._best(rough, self.cfg.clip_text or self._motion_text(prompt), names)
        # fitted separately, so that the result doesn't depend on the other choices
        fit, meshes = self._fitted(model, targets[[best]], FINE)
        report_residuals(fit.residuals[0], names[best], self.cfg.max_residual_mm)
        return meshes[0]

    def _fitted(
        self, model: BodyModel, targets: Float[np.ndarray, "F K 3"], iterations: int
    ) -> tuple[BodyFit, list[Mesh]]:
        """Return bodies fitted to joints, also as meshes with z up, centred and scaled."""
        fit = fit_bodies(model, targets, fit_shape=self.cfg.fit_shape, iterations=iterations)
        options = {"scale": self.cfg.scale, "face_front": self.cfg.face_front}
        pairs = zip(posed_vertices(model, fit), targets, strict=True)
        return fit, [world_mesh(Mesh(found, model.faces), at, **options) for found, at in pairs]

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
        device = chosen_device(self.cfg.device, self.device)
        pictures = np.concatenate([body_pictures(mesh) for mesh in meshes])
        scores = picture_similarities(self._clip(), pictures, text, device=device)
        scores = scores.reshape(len(meshes), -1).mean(axis=1)
        found = (f"{name} {score:.4f}" for name, score in zip(names, scores, strict=True))
        info(f"CLIP for {text!r}: {', '.join(found)}")
        return int(scores.argmax())


def offered_frames(
    motions: Motions, sample: Optional[int], frame: Any, num_frames: int
) -> list[Choice]:
    """Return the frames to choose from.

    Args:
        sample: index of a motion; None for all.
        frame: index of a frame, which is then the only choice, or "clip".
        num_frames: number of evenly spaced frames of each motion, for "clip".

    Raises:
        UserError: there is no such motion or frame.
    """
    count = len(motions.lengths)
    if sample is not None and not 0 <= sample < count:
        raise UserError(
            f"sample: the file has {count} motions, numbered from 0; there is no {sample}"
        )
    if frame != "clip":
        require_frame(frame, motions.lengths[sample or 0], f"motion {sample or 0}")
        return [(sample or 0, frame)]
    samples = range(count) if sample is None else [sample]
    return [
        (s, int(f))
        for s in samples
        for f in np.unique(np.linspace(0, motions.lengths[s] - 1, num_frames).round())
    ]


def report_residuals(residuals: Float[np.ndarray, "K"], name: str, limit: float) -> None:
    """Log the distances of the body's joints from the motion's, millimetres.

    Raises:
        UserError: the mean distance exceeds ``limit``.
    """
    worst = int(residuals.argmax())
    found = f"{residuals.mean():.1f} mm mean, {residuals[worst]:.1f} mm at the {JOINTS[worst]}"
    if residuals.mean() > limit:
        raise UserError(
            f"SMPL does not fit {name}: its joints are off by {found} (max_residual_mm is "
            f"{limit:g}): are the positions in metres, y up and"
            " in SMPL's order? Choose another frame or raise max_residual_mm"
        )
    info(f"SMPL fitted to {name}: {found}")


def body_pictures(mesh: Mesh) -> Float[np.ndarray, "V H W 3"]:
    """Render the body in shaded grey on white, from the front and from both sides of the front."""
    vertices = mesh.vertices / np.abs(mesh.vertices).max()
    caster = MeshCaster(shaded(Mesh(vertices, mesh.faces)))
    ones = torch.ones(len(VIEW_AZIMUTHS))
    azimuths, at = torch.tensor(VIEW_AZIMUTHS), (VIEW_ELEVATION * ones, VIEW_DISTANCE * ones)
    views = orbit_c2w(at[0], azimuths, at[1]).numpy()
    pictures = caster.render_views([(c2w, VIEW_FOVY) for c2w in views], PICTURE_SIZE, PICTURE_SIZE)
    return over_background(pictures, np.ones(3, np.float32))


def shaded(mesh: Mesh) -> Mesh:
    """Return ``mesh`` with grey vertex colours by Lambertian shading."""
    normals = np.zeros_like(mesh.vertices)
    for corner in range(3):
        np.add.at(normals, mesh.faces[:, corner], face_normals(mesh))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    grey = 0.25 + 0.6 * np.maximum(normals @ LIGHT, 0.0)
    return mesh._replace(vertex_colors=np.repeat(grey[:, None], 3, axis=1).astype(np.float32))


def _check_source(cfg: Any) -> None:
    if bool(cfg.motion) == bool(cfg.candidates):
        raise UserError(
            "motion: set it to a file of joint positions (with body_model), or set candidates "
            f"to mesh files of posed bodies, not {'both' if cfg.motion else 'neither'}"
        )
    if cfg.motion and not cfg.body_model:
        raise UserError(
            "body_model: set it to your NPZ or PKL of SMPL (https://smpl.is.tue.mpg.de), SMPL-H or "
            "SMPL-X; the package brings none"
        )
