"""Faults known from other rasterisers: depth, wide images, cameras and sizes."""

import math

import torch

from tests.helpers.splatting_scenes import (
    NO_CUTOFFS,
    front_camera,
    one_gaussian,
    rasterize,
)
from tests.stability.backends import each_backend
from tests.stability.faults_rasteriser_cases import single, slope_error
from tests.stability.rows import row
from tests.stability.scenes import joined, plain_image
from threestudio_gaussiandreamer import cameras as host_cameras


@row("A0", "F10")
@each_backend
def test_f10_depth_has_a_gradient(backend, fault):
    """The derivative of the rendered depth by the Gaussian's depth; the emulation's backward pass
    ignores it.
    """

    def ours(z):
        means = torch.stack([torch.zeros_like(z), torch.zeros_like(z), z])[None].to(torch.float32)
        cloud = one_gaussian(scale=0.2).to(torch.float32)._replace(means=means)
        return (
            rasterize(*cloud, *single(front_camera(8, 8, 8.0)), 8, 8, backend=backend, **NO_CUTOFFS)
            .depth.double()
            .sum()
        )

    def truth(z):
        cloud = one_gaussian(scale=0.2)._replace(means=torch.stack([0 * z, 0 * z, z])[None])
        return rasterize(
            *cloud, *front_camera(8, 8, 8.0), 8, 8, backend="reference", **NO_CUTOFFS
        ).depth.sum()

    def ignored(z):
        return truth(z).detach() + 0 * z

    fault(
        lambda f: slope_error(f, 2.0, truth),
        ours=ours,
        emulation=ignored,
        at_most=1e-4,
        unit="relative",
    )


@row("A0", "F17")
@each_backend
def test_f17_a_sphere_is_round_on_a_wide_image(backend, fault):
    """Both axes have one focal length; the emulation uses the vertical field of view for
    the width.
    """
    fovy = torch.tensor([math.radians(50.0)])

    def one_angle_for_both(fovy, height, width):
        Ks = host_cameras.intrinsics(fovy, height, width)
        Ks[:, 0, 0] = 0.5 * width / torch.tan(0.5 * fovy)
        return Ks

    def deviation(intrinsics):
        Ks = intrinsics(fovy, 64, 128)
        sphere = one_gaussian(scale=0.2).to(torch.float32)
        alpha = rasterize(*sphere, torch.eye(4)[None], Ks, 128, 64, backend=backend).alpha[
            0, ..., 0
        ]
        across, down = ((alpha.sum(axis) > 0).sum() for axis in (0, 1))
        return abs(across - down).item() / 2

    fault(
        deviation,
        ours=host_cameras.intrinsics,
        emulation=one_angle_for_both,
        at_most=0.5,
        unit="px",
    )


@row("A0", "F26")
@each_backend
def test_f26_nothing_behind_the_camera_and_equal_depths_by_index(backend, fault):
    behind = one_gaussian((0.0, 0.0, -2.0), 0.3, 0.9)
    red, green = (
        one_gaussian((0.0, 0.0, 2.0), 0.3, 0.9, color) for color in ((1.0, 0, 0), (0, 1.0, 0))
    )

    def ours(cloud):
        return rasterize(
            *cloud.to(torch.float32), *single(front_camera(8, 8, 8.0)), 8, 8, backend=backend
        ).image[0]

    def unclipped_and_unstable(cloud):
        z = cloud.means[:, 2]
        backwards = torch.arange(len(z) - 1, -1, -1)  # an unstable sort may give this order
        return plain_image(
            cloud,
            8,
            8,
            8.0,
            torch.ones(len(z), dtype=torch.bool),
            backwards[z[backwards].argsort(stable=True)],
        )

    def deviation(draw):
        in_front = draw(joined(red, green))[4, 4]
        return float((draw(behind) != 0).sum()) + float(in_front[0] < in_front[1])

    fault(deviation, ours=ours, emulation=unclipped_and_unstable, unit="pixels or swaps")


@row("A0", "F27")
@each_backend
def test_f27_any_size_and_a_gaussian_behind_the_camera(backend, fault):
    """The emulation masks the means behind the camera but not the covariances, and renders 256 x
    256.
    """
    scene = joined(
        one_gaussian((0.0, 0.0, 2.0), 0.3),
        one_gaussian((0.0, 0.0, -2.0), 0.3),
        one_gaussian((0.3, 0.0, 3.0), 0.3),
    )

    def ours(cloud, width, height):
        return rasterize(
            *cloud.to(torch.float32),
            *single(front_camera(width, height, 8.0)),
            width,
            height,
            backend=backend,
        ).image[0]

    def half_masked(cloud, width, height):
        in_front = cloud.means[:, 2] > 0
        means, variances = cloud.means[in_front], cloud.scales[:, 0] ** 2
        return (means[:, :2] / variances[:, None]).sum() * torch.ones(256, 256, 3)

    def deviation(draw):
        return (draw(scene, 17, 9) - draw(scene.pick([0, 2]), 17, 9)).abs().max()

    fault(deviation, ours=ours, emulation=half_masked, raises=RuntimeError)


@row("A0", "F27")
@each_backend
def test_f27_the_size_that_was_asked_for(backend, fault):
    """Widths from 1 to 40, none of which is 256; counts missing or extra columns."""

    def ours(width, height):
        cloud = one_gaussian(scale=5.0).to(torch.float32)
        return rasterize(
            *cloud, *single(front_camera(width, height, 8.0)), width, height, backend=backend
        ).alpha[0, ..., 0]

    def deviation(draw):
        sizes = [(1, 1), (40, 1), (17, 9), (31, 33)]
        return sum(
            draw(*size).shape != size[::-1] or bool((draw(*size) == 0).any()) for size in sizes
        )

    fault(
        deviation,
        ours=ours,
        emulation=lambda width, height: torch.ones(256, 256),
        unit="of 4 sizes wrong",
    )
