"""``motion-prior``: the paper's avatars. A pose by text to motion, SMPL fitted to it, points on it.

=================  =================================================================================
option             meaning
=================  =================================================================================
motion             a text-to-motion model: MDM's ``model*.pt`` with its files beside it, or
                   ``toybox``; or joint positions as MDM gives them, its results.npy or another NPY
                   or NPZ: see below
body_model         the user's NPZ or PKL of SMPL, SMPL-H or SMPL-X (neutral), with the user's
                   licence; or ``toybox``
sample             which of the file's motions, or of the three that the model draws; null: any
frame              a number, from 0; or ``clip``: the frame whose body fits the text best, of 16 of
                   each motion
candidates         in place of a motion: mesh files of posed bodies, of which CLIP chooses the one
                   that fits the prompt best (the paper's appendix)
clip               any CLIP in transformers' format, a folder or an id of the hub, or ``toybox``
motion_text        the motion of the prompt; null, or with ``toybox``: found by the rules of
                   ``motion_text.py``
scale              half the longest side, world units
num_points         points uniform over the surface (the released code), or 0 for the vertices (the
                   paper)
color              ``random`` (the paper), ``grey``, [r, g, b] in [0, 1], or null for the mesh's own
                   colours
center             what is at the origin: the ``mean`` of the points (the released code), or the
                   middle of the body's ``box``
ground, ...        see ``priors/base.py``
=================  =================================================================================

Files of motions are MDM's ``results.npy``, a pickled dict, of which no code is run, or an NPZ, with
``motion`` (S, J, 3, F), and optionally ``lengths`` (S,) in frames; or an NPY with (S, J, 3, F), or
one motion as (J, 3, F) or (F, J, 3). J is 22 (HumanML3D) or 24 joints in SMPL's order; metres, y
up. The body is turned to face +x. A fit that is off by more than 50 mm in the mean is an error.

Where MDM runs elsewhere, ``motion_text.py`` prints the sentence to ask it for.

The body model is a file of SMPL, SMPL-H or SMPL-X, whose first 22 joints are the same, skinned as
in SMPL's paper. What is minimised over the rotations of all joints (axis-angle), a
translation and a few shape coefficients, summed over the frames, which share nothing:

    sum_j |joint_j - target_j|^2 / s^2 + pose |theta|^2 + shape |beta|^2
        + limits sum max(0, low - theta, theta - high)^2,   s = 10 mm

The limits keep knees and elbows from bending backwards, which positions alone would allow. First
the whole body is placed, then the pose is fitted under a strong prior, then under the final one."""

import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, List, NamedTuple, Optional

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..cameras import orbit_c2w
from ..core.devices import torch_threads
from ..core.errors import UserError
from ..core.extras import require_extra
from ..core.files import existing_file
from ..core.options import at_least, is_whole, one_of, satisfies
from ..formats.array_files import read_arrays
from ..formats.reading import reading, require
from ..gaussians.point_cloud import PointCloud
from ..host import info, register, warn
from ..meshes.load import load_mesh
from ..meshes.mesh import Mesh
from ..meshes.raycast import MeshCaster, over_background
from ..models.bundled import BODY, MOTION, model_part
from ..models.clip import PictureText, clip_source, text_features
from ..models.hub import Source, locate
from ..models.model_files import free_memory
from .base import COLOR, SCALE, Prior, points
from .body_pose import BODY_JOINTS, JOINTS, PARENTS, require_frame, world_mesh
from .karras import torch_generator
from .mesh import centred, colored_cloud, face_normals
from .motion_text import motion_sentence, reduced_prompt
from .text_to_motion import FRAMES, TextToMotion, load_motion_model, sample_motions

VIEW_AZIMUTHS = (-40.0, 0.0, 40.0)
VIEW_ELEVATION, VIEW_DISTANCE, VIEW_FOVY = 10.0, 3.2, math.radians(40)
PICTURE_SIZE = 224
MDM_CLIP, SAMPLES = "openai/clip-vit-base-patch32", 3
"""The CLIP that MDM was trained with, and how many motions are drawn."""
NUM_FRAMES = 16
"""Frames of each motion that CLIP chooses from, evenly spaced."""
ROUGH, FINE = 80, 300
"""Iterations of the fit for CLIP's pictures (error about 15 mm) and for the result (1 mm)."""
MAX_RESIDUAL_MM = 50.0
"""Mean distance of the joints from the motion's above which a fit is an error."""
LIGHT = np.array([0.7, 0.35, 0.62])
FRAME = satisfies(
    "'clip' or a number from 0", lambda value: value == "clip" or is_whole(value) and value >= 0
)
JOINT_COUNTS = (22, 24)


class Motions(NamedTuple):
    """Sequences of joint positions."""

    positions: Float[np.ndarray, "S F J 3"]
    """Metres, y up."""
    lengths: list[int]
    """Number of valid frames of each sample; later frames are padding."""


def read_motions(path: str) -> Motions:
    """Return a file's motions; UserError if missing, of another layout, empty or not finite."""
    with reading(path, "motion file") as file:
        arrays = read_arrays(file, "motion file", ["motion"], ["lengths"])
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
    return Motions(positions, lengths.tolist())


def _sample_frame_joint(motion: np.ndarray) -> Float[np.ndarray, "S F J 3"]:
    """Convert any of the layouts to (samples, frames, joints, 3)."""
    shape, ordered = motion.shape, np.zeros(0)
    samples = motion[None] if len(shape) == 3 else motion
    if samples.ndim == 4 and samples.shape[1] in JOINT_COUNTS and samples.shape[2] == 3:
        ordered = samples.transpose(0, 3, 1, 2)
    elif len(shape) == 3 and shape[1] in JOINT_COUNTS and shape[2] == 3:
        ordered = samples
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
        scale: float = field(default=1.0, metadata=SCALE)
        num_points: int = field(default=50_000, metadata=points(0))
        color: Any = field(default="random", metadata=COLOR)
        center: str = field(default="mean", metadata=one_of(("mean", "box")))
        REMOVED: ClassVar[dict[str, Any]] = {
            **Prior.Config.REMOVED,
            "num_frames": (NUM_FRAMES, f"it is {NUM_FRAMES}"),
            "clip_text": (None, "it is motion_text, or the prompt for candidates"),
            "fit_shape": (True, "the shape is fitted too"),
            "face_front": (True, "the body is turned to face the front"),
            "up": ("auto", "it is that of the kind of the candidates' files"),
            "front": (None, "it is that of the kind of the candidates' files"),
            "device": ("auto", "it is the run's device"),
            "max_residual_mm": (MAX_RESIDUAL_MM, f"it is {MAX_RESIDUAL_MM:g}"),
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
                    "SMPL-H or SMPL-X, or to toybox, the package's own"
                )

    cfg: Config
    joints: Optional[Float[np.ndarray, "K 3"]] = None
    """The chosen frame of the motion, metres, y up; saved beside the points."""

    def preflight(self) -> None:
        cfg, clips = self.cfg, []
        for path in cfg.candidates:
            existing_file(path, "body mesh")
        if cfg.motion:
            name = model_part(cfg.motion, MOTION)
            if is_model(name):
                load_motion_model(name)
                clips.append(motion_clip(name))
            lengths = [FRAMES] * SAMPLES if is_model(name) else read_motions(name).lengths
            offered_frames(lengths, cfg.sample, cfg.frame)
            load_body_model(model_part(cfg.body_model, BODY))
        if len(cfg.candidates) > 1 if cfg.candidates else cfg.frame == "clip":
            clips.append(clip_source(cfg.clip))
        for clip in clips:
            require_extra("diffusion", "transformers")
            locate(clip, download=False)

    def preflight_prompt(self, prompt: str) -> None:
        """Check that the prompt, or ``motion_text``, has an action that the model knows."""
        name = self.cfg.motion and model_part(self.cfg.motion, MOTION)
        if is_model(name):
            self._sentence(prompt, load_motion_model(name))

    def generate(self, prompt: str, generator: np.random.Generator) -> PointCloud:
        self.preflight()
        if paths := self.cfg.candidates:
            meshes = [load_mesh(path, scale=self.cfg.scale) for path in paths]
            best = self._best(meshes, prompt, paths) if len(meshes) > 1 else 0
            info(f"body: {paths[best]}")
            body = meshes[best]
        else:
            body = self._body_of_motion(prompt, generator)
        cloud = colored_cloud(body, self.cfg, generator)
        return centred(cloud) if self.cfg.center == "mean" else cloud

    def _sentence(self, prompt: str, model: TextToMotion) -> str:
        text = self.cfg.motion_text
        return text if text and not model.known else motion_sentence(text or prompt, model.known)

    def _motions(self, prompt: str, generator: np.random.Generator) -> tuple[Motions, str]:
        """Return the file's motions, or those that the model draws, and the text CLIP compares."""
        name, text = model_part(self.cfg.motion, MOTION), self.cfg.motion_text
        if not is_model(name):
            text = text or reduced_prompt(prompt)
            if text is None and self.cfg.frame == "clip":
                warn(
                    f"no verb of motion was found in {prompt!r}: set motion_text, for instance to "
                    "'Someone stands with open arms'"
                )
            return read_motions(name), text or prompt
        model = load_motion_model(name)
        sentence = self._sentence(prompt, model)
        info(f"motion: {sentence!r}")
        with torch_threads(1):  # of whose number the result doesn't depend then
            features = text_features(motion_clip(name), sentence)
            positions = sample_motions(model, features, SAMPLES, torch_generator(generator))
        # the bundled CLIP has seen persons in clothes only
        compared = text or prompt if model.known else sentence
        return Motions(positions, [FRAMES] * SAMPLES), compared

    def _body_of_motion(self, prompt: str, generator: np.random.Generator) -> Mesh:
        """Return the body of the chosen frame, with z up, facing +x, centred and scaled."""
        cfg, (motions, text) = self.cfg, self._motions(prompt, generator)
        model = load_body_model(model_part(cfg.body_model, BODY))
        choices = offered_frames(motions.lengths, cfg.sample, cfg.frame)
        targets = np.stack([motions.positions[choice] for choice in choices])
        names = [f"motion {sample}, frame {frame}" for sample, frame in choices]

        def fitted(targets: Float[np.ndarray, "F K 3"], iterations: int) -> tuple[Any, list[Mesh]]:
            fit = fit_bodies(model, targets, iterations=iterations)
            pairs = zip(posed_vertices(model, fit), targets, strict=True)
            meshes = [world_mesh(Mesh(v, model.faces), joints, cfg.scale) for v, joints in pairs]
            return fit.residuals, meshes

        one = len(choices) == 1
        best = 0 if one else self._best(fitted(targets, ROUGH)[1], text, names)
        # fitted separately, so that the result doesn't depend on the other choices
        (residuals,), (mesh,) = fitted(targets[[best]], FINE)
        worst, mean = int(residuals.argmax()), residuals.mean()
        found = f"{mean:.1f} mm mean, {residuals[worst]:.1f} mm at the {JOINTS[worst]}"
        if mean > MAX_RESIDUAL_MM:
            raise UserError(
                f"SMPL does not fit {names[best]}: its joints are off by {found}: are the "
                "positions in metres, y up and in SMPL's order? Choose another frame"
            )
        info(f"SMPL fitted to {names[best]}: {found}")
        self.joints = targets[best]
        return mesh

    def _best(self, meshes: list[Mesh], text: str, names: list[str]) -> int:
        """Return the index of the mesh whose pictures fit ``text`` best, by CLIP."""
        pictures = np.concatenate([body_pictures(mesh) for mesh in meshes])
        clip = PictureText(clip_source(self.cfg.clip), self.device)
        scores = clip.similarities(pictures, text).reshape(len(meshes), -1).mean(axis=1)
        del clip
        free_memory()
        found = (f"{name} {score:.4f}" for name, score in zip(names, scores, strict=True))
        info(f"CLIP for {text!r}: {', '.join(found)}")
        return int(scores.argmax())


def is_model(motion: str) -> bool:
    """Return whether a file is MDM's checkpoint, and not of motions."""
    return Path(motion).suffix == ".pt"


def motion_clip(path: str) -> Source:
    """Return the CLIP whose text features a model takes: one beside it, or the published models'.

    An export's is beside the model's folder."""
    near = [str(folder / "clip") for folder in Path(path).expanduser().parents[:2]]
    found = next(filter(os.path.isdir, near), MDM_CLIP)
    place = f"the folder or link {near[0]}"
    return clip_source(found, option=place, allow_bin=True)  # published in both formats


def offered_frames(lengths: list[int], sample: Optional[int], frame: Any) -> list[tuple[int, int]]:
    """Return the (motion, frame) pairs to choose from motions of these lengths, by the options."""
    count = len(lengths)
    if sample is not None and sample >= count:
        raise UserError(f"sample: there are {count} motions, from 0; there is no {sample}")
    if frame != "clip":
        require_frame(frame, lengths[sample or 0], f"motion {sample or 0}")
        return [(sample or 0, frame)]
    samples = range(count) if sample is None else [sample]
    frames = {s: np.linspace(0, lengths[s] - 1, NUM_FRAMES).round() for s in samples}
    return [(s, int(f)) for s in samples for f in np.unique(frames[s])]


def body_pictures(mesh: Mesh) -> Float[np.ndarray, "V H W 3"]:
    """Render the body in Lambertian grey on grey, from the front and from both sides of it."""
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
    return over_background(pictures, np.full(3, 0.5, np.float32))


# SMPL fitted to joint positions -------------------------------------------------------------------

FIELDS = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f")
"""Arrays of a body model's file that are used."""
SMPL_JOINTS, SHAPES = 24, 10
"""Joints of SMPL, and the shape coefficients that are used."""
TRUNK = [0, 1, 2, 3, 6, 9, 13, 14, 16, 17]
"""Pelvis, hips, spine, collars and shoulders, which move almost as one."""
UNIT = 0.01
"""Metres on a joint that weigh as one unit of the priors."""
SHAPE_WEIGHT = 0.01
LIMITS_WEIGHT = 1000.0
FIT_STAGES = ((1.0, 0.2), (0.02, 1.0))
"""Weight of the pose prior, and the share of the iterations, of each stage."""
DEGREES = math.pi / 180
KNEE = {0: (0, 150), 1: (-15, 15), 2: (-15, 15)}
ANKLE = {0: (-60, 60), 1: (-45, 45), 2: (-45, 45)}
LIMITS = {
    **{4: KNEE, 5: KNEE, 18: {1: (-150, 5)}, 19: {1: (-5, 150)}},  # elbows bend about y
    **{joint: dict.fromkeys(range(3), (-60, 60)) for joint in (3, 6, 9, 12, 15)},  # spine, head
    **{7: ANKLE, 8: ANKLE},
}
"""Joint: axis: (low, high), degrees."""


class BodyModel(NamedTuple):
    """A skinned body, float64 tensors."""

    template: Float[Tensor, "V 3"]
    """Metres, y up, looking along +z."""
    shape_directions: Float[Tensor, "V 3 B"]
    pose_directions: Float[Tensor, "P V3"]
    joint_regressor: Float[Tensor, "J V"]
    parents: Int[Tensor, " J"]
    weights: Float[Tensor, "V J"]
    faces: Int[np.ndarray, "F 3"]


class BodyFit(NamedTuple):
    """The bodies that were fitted to F frames."""

    pose: Float[Tensor, "F J 3"]
    """Axis-angle rotation of each joint, the whole body's first; radians."""
    shape: Float[Tensor, "F B"]
    translation: Float[Tensor, "F 3"]
    residuals: Float[np.ndarray, "F K"]
    """Distance of each fitted joint from where it should be, millimetres."""


def load_body_model(path: str) -> BodyModel:
    """Read the user's body model, an NPZ or SMPL's own PKL, of which no code is run; raise
    UserError if it is missing or not a body model."""
    kind = "body model (the NPZ or PKL of SMPL, SMPL-H or SMPL-X)"
    with reading(path, kind) as file:
        arrays = read_arrays(file, kind, FIELDS)
        _check(arrays)
    vertices, joints = len(arrays["v_template"]), len(arrays["J_regressor"])
    parents = torch.from_numpy(arrays["kintree_table"][0].astype(np.int64))
    parents[0] = -1
    directions = _tensor(arrays["posedirs"]).reshape(vertices * 3, 9 * (joints - 1))
    return BodyModel(
        template=_tensor(arrays["v_template"]),
        shape_directions=_tensor(arrays["shapedirs"][:, :, :SHAPES]),
        pose_directions=directions.T.contiguous(),
        joint_regressor=_tensor(arrays["J_regressor"]),
        parents=parents,
        weights=_tensor(arrays["weights"]),
        faces=arrays["f"].astype(np.int64),
    )


def fit_bodies(
    model: BodyModel, targets: Float[np.ndarray, "F K 3"], *, iterations: int = 300
) -> BodyFit:
    """Return bodies whose joints are where ``targets`` has them: 22 or 24 in SMPL's order, metres,
    y up. The last two of 24 are used when the model has no more."""
    joints = len(model.parents)
    wanted = _tensor(targets)[:, : SMPL_JOINTS if joints == SMPL_JOINTS else BODY_JOINTS]
    frames = len(wanted)
    pose = torch.zeros(frames, joints, 3, dtype=torch.float64)
    pose[:, 0], translation = _placed(model, wanted)
    shape = torch.zeros(frames, model.shape_directions.shape[-1], dtype=torch.float64)
    body = [tensor.requires_grad_() for tensor in (pose, shape, translation)]

    def errors() -> Tensor:
        return posed_joints(model, *body)[:, : wanted.shape[1]] - wanted

    with torch_threads(1):
        for weight, share in FIT_STAGES:
            optimiser = torch.optim.LBFGS(
                [pose, translation, shape],  # the order is that of the sums in the line search
                max_iter=int(share * iterations),
                history_size=20,
                line_search_fn="strong_wolfe",
                tolerance_change=1e-5,
            )

            def energy(weight: float = weight, optimiser: Any = optimiser) -> Tensor:
                optimiser.zero_grad()
                data = (errors() / UNIT).square().sum()
                priors = weight * pose[:, 1:].square().sum() + SHAPE_WEIGHT * shape.square().sum()
                value = data + priors + LIMITS_WEIGHT * beyond_limits(pose)
                value.backward()
                return value

            optimiser.step(energy)
    return BodyFit(*(t.detach() for t in body), (1000 * errors().norm(dim=-1)).detach().numpy())


def beyond_limits(pose: Float[Tensor, "F J 3"]) -> Tensor:
    """Return the sum of squares of the angles, in radians, by which rotations exceed ``LIMITS``."""
    rows = [(j, axis, *ends) for j, axes in LIMITS.items() for axis, ends in axes.items()]
    joints, axes, low, high = torch.tensor(rows, dtype=pose.dtype).T
    angles = pose[:, joints.long(), axes.long()]
    under, over = low * DEGREES - angles, angles - high * DEGREES
    return under.clamp_min(0).square().sum() + over.clamp_min(0).square().sum()


def posed_joints(
    model: BodyModel,
    pose: Float[Tensor, "F J 3"],
    shape: Float[Tensor, "F B"],
    translation: Float[Tensor, "F 3"],
) -> Float[Tensor, "F J 3"]:
    """Return the joint positions, which is cheaper than the whole body."""
    directions = torch.einsum("jv,vcb->jcb", model.joint_regressor, model.shape_directions)
    rest = model.joint_regressor @ model.template + torch.einsum("fb,jcb->fjc", shape, directions)
    return joint_frames(model, rotation_matrices(pose), rest)[1] + translation[:, None]


@torch.no_grad()
def posed_vertices(model: BodyModel, fit: BodyFit) -> Float[np.ndarray, "F V 3"]:
    """Return the surfaces of the fitted bodies, metres, y up: SMPL's linear blend skinning of the
    template with the offsets of shape and pose (Loper et al. 2015, equations 2 to 10)."""
    own = rotation_matrices(fit.pose)
    shaped = model.template + torch.einsum("fb,vcb->fvc", fit.shape, model.shape_directions)
    rest = model.joint_regressor @ shaped
    turns, places = joint_frames(model, own, rest)
    offsets = (own[:, 1:] - torch.eye(3, dtype=own.dtype)).flatten(1) @ model.pose_directions
    bent = shaped + offsets.unflatten(1, (-1, 3))
    blended = torch.einsum("vj,fjab->fvab", model.weights, turns)
    moved = torch.einsum("fvab,fvb->fva", blended, bent)
    shifts = places - torch.einsum("fjab,fjb->fja", turns, rest) + fit.translation[:, None]
    return (moved + model.weights @ shifts).numpy()


def joint_frames(
    model: BodyModel, own: Float[Tensor, "F J 3 3"], rest: Float[Tensor, "F J 3"]
) -> tuple[Float[Tensor, "F J 3 3"], Float[Tensor, "F J 3"]]:
    """Return the joints' rotations and places; their own ones are relative to their parents'."""
    first, *others = own.unbind(1)
    parents, turns, places = model.parents[1:], [first], [rest[:, 0]]
    for parent, rotation in zip(parents.tolist(), others, strict=True):
        turns.append(turns[parent] @ rotation)
    turned = torch.stack(turns, 1)
    bones = turned[:, parents] @ (rest[:, 1:] - rest[:, parents])[..., None]
    for parent, bone in zip(parents.tolist(), bones[..., 0].unbind(1), strict=True):
        places.append(places[parent] + bone)
    return turned, torch.stack(places, 1)


def rotation_matrices(vectors: Float[Tensor, "... 3"]) -> Float[Tensor, "... 3 3"]:
    """Return the matrices of axis-angles (Rodrigues' formula), differentiable at zero too."""
    angle = (vectors.square().sum(-1, keepdim=True) + 1e-16).sqrt()
    x, y, z = (vectors / angle).unbind(-1)
    none, angle = torch.zeros_like(x), angle[..., None]
    cross = torch.stack([none, -z, y, z, none, -x, -y, x, none], -1).unflatten(-1, (3, 3))
    turn = angle.sin() * cross + (1 - angle.cos()) * (cross @ cross)
    return torch.eye(3, dtype=vectors.dtype) + turn


def _placed(model: BodyModel, wanted: Float[Tensor, "F K 3"]) -> tuple[Tensor, Tensor]:
    """Return the axis-angles and translations (F, 3) to the nearest trunk (Kabsch 1976)."""
    from scipy.spatial.transform import Rotation

    joints = model.joint_regressor @ model.template
    rest, root, there = joints[TRUNK], joints[0], wanted[:, TRUNK]
    moved = there - there.mean(1, keepdim=True)
    covariance = torch.einsum("fkc,kd->fcd", moved, rest - rest.mean(0))
    u, _, vt = torch.linalg.svd(covariance)
    signs = torch.ones(len(wanted), 3, dtype=wanted.dtype)
    signs[:, 2] = torch.linalg.det(u @ vt).sign()
    rotation = u @ (signs[:, :, None] * vt)
    # the body turns about its first joint
    translation = there.mean(1) - torch.einsum("fcd,d->fc", rotation, rest.mean(0) - root) - root
    return _tensor(Rotation.from_matrix(rotation.numpy()).as_rotvec()), translation


def _check(arrays: dict[str, np.ndarray]) -> None:
    """Raise Unreadable unless the arrays are those of a body with SMPL's 22 joints or more."""
    vertices, joints = len(arrays["v_template"]), len(arrays["J_regressor"])
    expected = {
        "v_template": (vertices, 3),
        "shapedirs": (vertices, 3, *arrays["shapedirs"].shape[2:3]),
        "posedirs": (vertices, 3, 9 * (joints - 1)),
        "J_regressor": (joints, vertices),
        "weights": (vertices, joints),
        "kintree_table": (2, joints),
        "f": (len(arrays["f"]), 3),
    }
    parents, faces = arrays["kintree_table"].astype(np.int64), arrays["f"].astype(np.int64)
    shapes = ", ".join(f"{name} {arrays[name].shape}" for name in FIELDS)
    require(
        all(arrays[name].shape == shape for name, shape in expected.items())
        and all(np.isfinite(values).all() for values in arrays.values())
        and ((parents[0, 1:] >= 0) & (parents[0, 1:] < np.arange(1, joints))).all()
        and ((faces >= 0) & (faces < vertices)).all(),
        f"it is damaged, or has other arrays ({shapes}): finite numbers that fit each other were "
        "expected; get it again",
    )
    require(
        tuple(parents[0, 1:BODY_JOINTS]) == PARENTS[1:],
        f"it has another skeleton, of {joints} joints: those of SMPL, or {BODY_JOINTS} like them "
        "and others, were expected",
    )


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float64))
