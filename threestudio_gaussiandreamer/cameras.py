"""Cameras: conventions and conversion.

World: right-handed, z up; azimuth 0 = +x is the front, azimuth 90 = +y. Angles of a view
(elevation, azimuth) are in degrees, ``fovy`` is vertical and in radians. The host's cameras are
OpenGL: the columns of ``c2w`` are right, up, back. The rasteriser's cameras are OpenCV:
``viewmats`` map world to camera coordinates with x right, y down, z forward; ``Ks`` are in pixels,
with pixel centres at +0.5. Images are (B, H, W, C) with row 0 at the top."""

import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Optional

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from .core.streams import generator


class Orbit(NamedTuple):
    """Cameras on spheres around the origin, looking at it."""

    elevation: Float[Tensor, " B"]
    """Degrees above the horizon."""
    azimuth: Float[Tensor, " B"]
    """Degrees from +x towards +y."""
    distance: Float[Tensor, " B"]
    """World units."""
    fovy: Float[Tensor, " B"]
    """Radians, vertical."""

    @property
    def c2w(self) -> Float[Tensor, "B 4 4"]:
        return orbit_c2w(self.elevation, self.azimuth, self.distance)

    def rows(self, index: Any) -> "Orbit":
        """Select cameras; ``index`` is anything that indexes a tensor's first dimension."""
        return Orbit(*(values[index] for values in self))


def look_at(
    position: Float[Tensor, "B 3"], center: Float[Tensor, "B 3"], up: Float[Tensor, "B 3"]
) -> Float[Tensor, "B 4 4"]:
    """Return the OpenGL ``c2w`` of cameras at ``position`` that look at ``center``, or along -x if
    they are there; +x is the top of the image if they look along ``up``.
    """
    offset = center - position
    x_axis = torch.tensor([1.0, 0, 0], dtype=up.dtype, device=up.device).expand_as(up)
    nowhere = offset.norm(dim=-1, keepdim=True) < 1e-12
    forward = F.normalize(torch.where(nowhere, -x_axis, offset), dim=-1)
    right = torch.linalg.cross(forward, up)
    degenerate = right.norm(dim=-1, keepdim=True) < 1e-6
    instead = torch.linalg.cross(forward, x_axis)
    right = F.normalize(torch.where(degenerate, instead, right), dim=-1)
    up = torch.linalg.cross(right, forward)
    c2w = torch.eye(4, dtype=position.dtype, device=position.device).repeat(len(position), 1, 1)
    c2w[:, :3] = torch.stack([right, up, -forward, position], -1)
    return c2w


def orbit_c2w(
    elevation_deg: Float[Tensor, " B"],
    azimuth_deg: Float[Tensor, " B"],
    distance: Float[Tensor, " B"],
    center: Float[Tensor, "B 3"] | None = None,
    up: Float[Tensor, "B 3"] | None = None,
) -> Float[Tensor, "B 4 4"]:
    """Return the OpenGL ``c2w`` of cameras on spheres around the origin: degrees above the horizon
    and from +x towards +y, and world units. ``center`` are the points that they look at, by default
    the origin; ``up`` is +z by default.
    """
    elevation, azimuth = torch.deg2rad(elevation_deg), torch.deg2rad(azimuth_deg)
    along, z = distance * torch.cos(elevation), distance * torch.sin(elevation)
    position = torch.stack([along * torch.cos(azimuth), along * torch.sin(azimuth), z], -1)
    center = torch.zeros_like(position) if center is None else center
    up = position.new_tensor([0.0, 0.0, 1.0]).expand_as(position) if up is None else up
    return look_at(position, center, up)


def focal_length(fovy: Float[Tensor, " B"], height: int) -> Float[Tensor, " B"]:
    """Return the focal length in pixels, for both axes: ``f = H / (2 tan(fovy / 2))``."""
    return 0.5 * height / torch.tan(0.5 * fovy)


def intrinsics(fovy: Float[Tensor, " B"], height: int, width: int) -> Float[Tensor, "B 3 3"]:
    """Return pinhole matrices in pixels, with the principal point at the image's centre."""
    axes = _constant(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.0)), fovy.dtype, fovy.device)
    centre = ((0.0, 0.0, 0.5 * width), (0.0, 0.0, 0.5 * height), (0.0, 0.0, 1.0))
    focal = focal_length(fovy, height)[:, None, None]
    return torch.addcmul(_constant(centre, fovy.dtype, fovy.device), focal, axes)


def to_opencv(
    c2w: Float[Tensor, "B 4 4"], fovy: Float[Tensor, " B"], height: int, width: int
) -> tuple[Float[Tensor, "B 4 4"], Float[Tensor, "B 3 3"]]:
    """Convert the host's OpenGL cameras to ``(viewmats, Ks)``: y and z axes are flipped."""
    flip = _constant(((1.0,), (-1.0,), (-1.0,), (1.0,)), c2w.dtype, c2w.device)
    return world_to_camera(c2w) * flip, intrinsics(fovy, height, width)


def world_to_camera(c2w: Float[Tensor, "B 4 4"]) -> Float[Tensor, "B 4 4"]:
    """Invert rigid motions by transposing their rotations; for others the result is wrong."""
    rotation = c2w[:, :3, :3].transpose(1, 2)
    translation = -torch.bmm(rotation, c2w[:, :3, 3:])
    last = _constant(((0.0, 0.0, 0.0, 1.0),), c2w.dtype, c2w.device).expand(len(c2w), 1, 4)
    return torch.cat([torch.cat([rotation, translation], 2), last], 1)


@functools.lru_cache(maxsize=64)
def _constant(
    rows: tuple[tuple[float, ...], ...], dtype: torch.dtype, device: torch.device
) -> Float[Tensor, "rows columns"]:
    """Return a matrix, which isn't to be changed; each step needs the same ones."""
    with torch.inference_mode(False):  # else it couldn't serve training later
        return torch.tensor(rows, dtype=dtype, device=device)


def ray_directions(
    c2w: Float[Tensor, "B 4 4"],
    fovy: Float[Tensor, " B"],
    height: int,
    width: int,
    normalize: bool = True,
) -> Float[Tensor, "B H W 3"]:
    """Return the directions of the rays through the pixel centres, in world coordinates, of unit
    length, or without ``normalize`` with 1 along the view axis.
    """
    like = {"dtype": c2w.dtype, "device": c2w.device}
    rows, columns = (torch.arange(n, **like) + 0.5 - 0.5 * n for n in (height, width))
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    focal = focal_length(fovy, height)[:, None, None]
    axial = torch.full_like(x, -1.0).expand(len(c2w), -1, -1)
    directions = torch.stack([x / focal, -y / focal, axial], -1)
    directions = directions @ c2w[:, None, :3, :3].transpose(-1, -2)
    return F.normalize(directions, dim=-1) if normalize else directions


def surface_points(
    depth: Float[Tensor, "B h w"],
    c2w: Float[Tensor, "B _ 4"],
    focal: Float[Tensor, " B"],
    aspect: float = 1.0,
) -> Float[Tensor, "B 3 h w"]:
    """Return the world coordinates of the points on the rendered surface, from ``depth`` along the
    optical axis at the centres of h x w pixels, OpenGL cameras, whose fourth row isn't needed, the
    :func:`focal_length` for this height, and ``aspect``, the width of a pixel over its height.
    """
    height, width = depth.shape[1:]
    plane = _image_plane(height, width, depth.device).type_as(depth)
    pixels = torch.addcmul(
        _constant(((0.0, 0.0, 1.0),), focal.dtype, focal.device),
        focal[:, None],
        _constant(((1 / aspect, 1.0, 0.0),), focal.dtype, focal.device),
    )
    axes = c2w[:, :3, :3] / pixels[:, None]
    # the product is that of half integers: with depths in it, TF32 would round them
    points = torch.addcmul(c2w[:, :3, 3:], axes @ plane, depth.flatten(1)[:, None])
    return points.unflatten(2, (height, width))


@functools.lru_cache(maxsize=8)
def _image_plane(height: int, width: int, device: torch.device) -> Float[Tensor, "3 hw"]:
    """Return the rays through the pixel centres at focal length 1, -1 along the optical axis."""
    with torch.inference_mode(False):  # else it couldn't serve training later
        rows, columns = (torch.arange(n, device=device) + 0.5 - n / 2 for n in (height, width))
        y, x = torch.meshgrid(-rows, columns, indexing="ij")
        return torch.stack([x, y, -torch.ones_like(x)]).flatten(1)


def projection(
    fovy: Float[Tensor, " B"], aspect: float, near: float = 0.01, far: float = 100.0
) -> Float[Tensor, "B 4 4"]:
    """Return threestudio's projection matrices (y negated: the top row has NDC y = -1)."""
    tan = torch.tan(0.5 * fovy)
    matrix = torch.zeros(len(fovy), 4, 4, dtype=fovy.dtype, device=fovy.device)
    matrix[:, 0, 0], matrix[:, 1, 1], matrix[:, 3, 2] = 1.0 / (tan * aspect), -1.0 / tan, -1.0
    matrix[:, 2, 2] = -(far + near) / (far - near)
    matrix[:, 2, 3] = -2.0 * far * near / (far - near)
    return matrix


class OrbitRanges(NamedTuple):
    """Of training views, in degrees and world units; the defaults are the paper's."""

    elevation: tuple[float, float] = (-10.0, 60.0)
    azimuth: tuple[float, float] = (-180.0, 180.0)
    distance: tuple[float, float] = (1.5, 4.0)
    fovy_deg: tuple[float, float] = (40.0, 70.0)


def sample_orbit(
    batch: int,
    ranges: OrbitRanges,
    rng: torch.Generator,
    uniform_azimuth: bool = True,
    by_angle: Optional[bool] = None,
) -> Orbit:
    """Draw ``batch`` training views.

    As in threestudio, the elevations of a batch are uniform in angle with probability 1/2, and
    otherwise uniform on the sphere (uniform in the sine); ``by_angle`` sets which. With
    ``uniform_azimuth`` the azimuth range has one view in each of ``batch`` equal sectors."""
    drawn, u = _draw_by_angle(rng), torch.rand(4, batch, generator=rng)
    by_angle = drawn if by_angle is None else by_angle
    elevation = _lerp(ranges.elevation, u[0])
    if not by_angle:
        sines = [math.sin(math.radians(e)) for e in ranges.elevation]
        elevation = torch.rad2deg(torch.asin(_lerp(sines, u[0]).clamp(-1.0, 1.0)))
    sector = (u[1] + torch.arange(batch)) / batch if uniform_azimuth else u[1]
    fovy = torch.deg2rad(_lerp(ranges.fovy_deg, u[3]))
    return Orbit(elevation, _lerp(ranges.azimuth, sector), _lerp(ranges.distance, u[2]), fovy)


def sample_view_groups(
    batch: int,
    n_view: int,
    ranges: OrbitRanges,
    rng: torch.Generator,
    uniform_azimuth: bool = True,
) -> Orbit:
    """Draw ``batch`` training views in groups of ``n_view``: those of a group are at one elevation
    and distance, with one field of view, at azimuths 360 / ``n_view`` degrees apart.
    """
    orbit = sample_orbit(batch // n_view, ranges, rng, uniform_azimuth)
    views = orbit.rows(torch.arange(batch // n_view).repeat_interleave(n_view))
    turn = 360.0 / n_view * torch.arange(n_view).repeat(batch // n_view)
    return views._replace(azimuth=(views.azimuth + turn + 180) % 360 - 180)


def _draw_by_angle(rng: torch.Generator) -> bool:
    return bool(torch.rand(1, generator=rng) < 0.5)


def _lerp(ends: Sequence[float], u: Tensor) -> Tensor:
    return ends[0] + (ends[1] - ends[0]) * u


def held_out_orbit(count: int = 24) -> Orbit:
    """Return the fixed views that a run is evaluated on and never trained with: azimuths evenly
    spaced over 360 degrees, four elevations, three distances, a vertical field of view of 50.
    """
    index = torch.arange(count)
    elevation = torch.tensor([0.0, 15.0, 30.0, 45.0])[index % 4]
    distance = torch.tensor([2.0, 2.6, 3.2])[index % 3]
    fovy = torch.full((count,), math.radians(50.0))
    return Orbit(elevation, 360.0 * index / count, distance, fovy)


def camera_pool(count: int, ranges: OrbitRanges, seed: int, stream: str = "camera-pool") -> Orbit:
    """Draw ``count`` fixed training views, stratified in azimuth, from streams of their own.

    The elevation of each view is uniform in angle with probability 1/2, and otherwise uniform on
    the sphere: the distribution of many batches of :func:`sample_orbit`."""
    rng = generator(seed, stream)
    pool = sample_orbit(count, ranges, rng)
    by_angle = _draw_by_angle(generator(seed, stream))  # what the line above drew
    other = sample_orbit(count, ranges, generator(seed, stream, 1), by_angle=not by_angle)
    mix = torch.rand(count, generator=rng) < 0.5
    return pool._replace(elevation=torch.where(mix, pool.elevation, other.elevation))
