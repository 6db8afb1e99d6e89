"""Cases 16, 29 and 30: where cameras may stand, and what a grid of raw values means."""

import math

import numpy as np
import pytest
import torch
from scipy.ndimage import map_coordinates

from ntop.body.model import load_body_model
from ntop.body.skinning import pose_body
from ntop.field import twin
from ntop.field.canonical import Occupancy, refined_grid
from ntop.field.culling import body_pixels
from ntop.field.kernels.tables import VOID_RAW
from ntop.field.quality import RenderSettings
from ntop.field.rendering import render_view, trace_rays
from ntop.geometry.cameras import Camera, Equidistant, Pinhole, pixel_grid
from ntop.geometry.rigs import ROTATION_LOOKING_DOWN, Rig, top_view_cameras
from tests.numerics.avatars import analytic_avatar, posed_at, standing
from tests.numerics.scenes import (
    EXACT,
    cone,
    density_of,
    grid_of,
    posed_field,
    rms,
)

DOWN = torch.tensor(ROTATION_LOOKING_DOWN, dtype=torch.float64)
SIZE = 160


def wide_lens(max_theta_deg):
    """A square image whose corners see 127 degrees; valid up to `max_theta_deg`."""
    return Equidistant(SIZE / math.pi, SIZE / 2, SIZE / 2, SIZE, SIZE, math.radians(max_theta_deg))


def ball_at(center_world, radius_m=0.05):
    """An opaque ball."""
    reach = 1.5 * radius_m
    return posed_field(
        lambda p: 2000 * (radius_m - np.linalg.norm(p - reach, axis=1)),
        size_m=(2 * reach,) * 3,
        voxel_m=radius_m / 5,
        low_world=tuple(np.asarray(center_world) - reach),
    )


@pytest.fixture(scope="module")
def person():
    """The analytic avatar standing with an arm raised, and its joints."""
    pose = standing(raised_arm=True)
    joints = pose_body(load_body_model(), pose).joints
    return posed_at(analytic_avatar(), pose), joints


def test_16_a_hand_above_the_camera_is_seen_where_it_is(margin):
    theta, azimuth = math.radians(104), 0.7
    away = torch.tensor(
        [math.sin(theta) * math.cos(azimuth), math.sin(theta) * math.sin(azimuth), math.cos(theta)]
    )
    camera = Camera(wide_lens(130), torch.tensor([0.3, -0.2, 2.0], dtype=torch.float64), DOWN)
    hand = camera.center_world + 0.5 * (away.double() @ DOWN)
    rendering = render_view(ball_at(hand.numpy()), camera)
    assert (rendering.alpha > 0.9).any()
    v, u = np.mgrid[:SIZE, :SIZE] + 0.5
    centroid = [float((x * rendering.alpha).sum() / rendering.alpha.sum()) for x in (u, v)]
    label, seen = camera.project(hand)
    assert bool(seen)
    margin.at_most("distance from the label", math.dist(centroid, label.tolist()), 0.1, "px")
    # the mutant: the paper's ray (f tan(theta)) in the label's pixel looks the other way
    paper = trace_rays(
        ball_at(hand.numpy()), camera.center_world,
        paper_directions(camera, label[None]), settings=RenderSettings(),
    )  # fmt: skip
    margin.mutant_exceeds("1 - alpha at the label, tan ray", 1 - float(paper.alpha[0]), 0.1)


def paper_directions(camera, pixels):
    """World directions by the paper's formula: (r cos phi, r sin phi, f) with r = f tan(theta)."""
    lens = camera.lens
    a, b = pixels[..., 0] - lens.cx, pixels[..., 1] - lens.cy
    rho = torch.hypot(a, b)
    r = lens.focal * torch.tan(rho / lens.focal)
    ray = torch.stack([r * a / rho, r * b / rho, torch.full_like(r, lens.focal)], -1)
    return torch.nn.functional.normalize(ray, dim=-1) @ camera.rotation


@pytest.mark.parametrize(("height", "radius"), [(1.2, 1.0), (1.0, 0.5)])
def test_16_corners_beyond_ninety_degrees_show_no_ghost(margin, person, height, radius):
    posed, joints = person
    rig = Rig(height, radius, SIZE, SIZE, SIZE / math.pi, math.radians(130))
    for view, camera in top_view_cameras(rig, joints[0]).items():
        if view not in ("ne", "nw", "sw", "se"):
            continue
        pixels = pixel_grid(SIZE, SIZE, torch.float64)
        off_axis = torch.hypot(pixels[..., 0] - SIZE / 2, pixels[..., 1] - SIZE / 2)
        beyond = (off_axis > SIZE / 2 * 1.2).numpy()  # farther than 108 degrees from the axis
        rendering = render_view(posed, camera, settings=RenderSettings(crop=False))
        assert (rendering.alpha > 0.5).any()
        margin.at_most("alpha in the corners", float(rendering.alpha[beyond].max()), 0)
        assert not rendering.rgb[beyond].any()
        mutant = trace_rays(
            posed, camera.center_world, paper_directions(camera, pixels[beyond]),
            settings=RenderSettings(),
        )  # fmt: skip
        ghost = (mutant.alpha > 0.5).sum() / (rendering.alpha > 0.5).sum()
        margin.mutant_exceeds("ghost's share of the person, tan ray", float(ghost), 0.04)


def test_16_cameras_inside_the_box_and_inside_the_body_see_finite_things(person):
    posed, joints = person
    pelvis, head = joints[0], joints[15]
    inside_box = pelvis + torch.tensor([0.3, 0.3, 0.3], dtype=torch.float64)
    for centre in (inside_box, pelvis, head):
        for lens in (wide_lens(130), Pinhole(80.0, 80.0, 80.0, 80.0, SIZE, SIZE)):
            rendering = render_view(posed, Camera(lens, centre, DOWN))
            for values in (rendering.rgb, rendering.alpha, rendering.depth_m):
                assert np.isfinite(values).all()
            assert ((rendering.alpha >= 0) & (rendering.alpha <= 1)).all()
    # from within nothing but the body is seen, and nothing of it behind the camera
    within = render_view(posed, Camera(wide_lens(80), pelvis, DOWN))
    pixels = pixel_grid(SIZE, SIZE, torch.float64).reshape(-1, 2)
    inner = wide_lens(78).unproject(pixels)[1].reshape(SIZE, SIZE).numpy()
    assert within.alpha[inner].min() > 0.99
    assert within.depth_m[inner].min() > 0


def test_16_a_person_behind_a_pinhole_is_not_seen(person):
    posed, joints = person
    lens = Pinhole(80.0, 80.0, 80.0, 80.0, SIZE, SIZE)
    up = torch.diag(torch.tensor([1.0, 1.0, 1.0], dtype=torch.float64))
    above = joints[0] + torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)
    for crop in (True, False):
        behind = render_view(posed, Camera(lens, above, up), settings=RenderSettings(crop=crop))
        assert not behind.alpha.any() and not behind.rgb.any()
    assert render_view(posed, Camera(lens, above, DOWN)).alpha.max() > 0.99


def test_16_culling_keeps_the_hand_that_is_beyond_ninety_degrees(person):
    posed, joints = person
    # the hand hangs over a camera at the height of the head
    centre = joints[15] + torch.tensor([0.6, 0.0, 0.0], dtype=torch.float64)
    camera = Camera(wide_lens(170), centre, DOWN)
    culled = render_view(posed, camera, settings=RenderSettings(edge_rays=1))
    whole = render_view(posed, camera, settings=RenderSettings(edge_rays=1, crop=False))
    assert (whole.alpha > 0.5).sum() > 50
    assert np.array_equal(culled.alpha, whole.alpha)
    assert (body_pixels(posed.warp, camera) | (whole.alpha == 0)).all()


def linear(points):
    return 1.5 + points @ np.array([3.0, -2.0, 4.0])


def test_29_a_linear_field_is_interpolated_exactly(margin):
    voxel, size = 0.02, (0.14, 0.22, 0.30)  # whole bricks: nodes at the faces
    grid = grid_of(
        linear, size_m=size, voxel_m=voxel, colour=lambda p: np.repeat(linear(p)[:, None], 3, 1)
    )
    # the kernel: the field resampled at 7 mm, which meets every part of a voxel
    everything = Occupancy(np.ones((40, 60, 80), np.uint8), np.zeros(3), 0.004)
    fine = refined_grid(grid, everything, voxel_m=0.007)
    within = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    nodes = ((4 * fine.positions[1:, None] + within) * 0.007).reshape(-1, 3)
    covered = (nodes < np.array(size) - 1e-6).all(1)
    assert covered.sum() > 3000
    error = np.abs(fine.values[64:] - linear(nodes)[:, None])[covered]
    margin.at_most("kernel, resampled", float(error.max()), 1e-6)
    outside = (nodes > np.array(size) + 1e-6).any(1)
    assert outside.any()
    assert (fine.values[64:, 0][outside] == VOID_RAW).all()
    # the twin, anywhere: corners, borders, outside
    generator = np.random.default_rng(0)
    points = generator.uniform(0, 1, (4000, 3)) * size
    points[:8] = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)]) * size
    points[:8] -= 1e-6 * np.sign(points[:8])  # the last nodes themselves are outside
    points[8:200, 0] = 0.0  # on a face
    posed = posed_field(linear, size_m=size, voxel_m=voxel)
    raw = twin_raw(posed, points)
    margin.at_most("twin, random points", np.abs(raw - linear(points)).max(), 1e-6)
    for axis in range(3):
        for side in (-1e-3, size[axis] + 1e-3):
            off = points.copy()
            off[:, axis] = side
            assert (twin_raw(posed, off) == VOID_RAW).all()
    half = linear(points + voxel / 2)
    margin.mutant_exceeds("half a cell off", np.abs(half - linear(points)).max(), 1e-6)
    stretched = points * (np.array(size) / voxel) / (np.array(size) / voxel + 1)
    margin.mutant_exceeds(
        "align_corners mixed up", np.abs(linear(stretched) - linear(points)).max(), 1e-6
    )


def twin_raw(posed, points):
    """Raw density at points of the box, through the twin of the field's look-up."""
    directions = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).expand(len(points), 3)
    samples = twin.place_samples(
        posed.warp.tables, torch.from_numpy(points), directions,
        torch.zeros(len(points), dtype=torch.float64), step_m=1.0, count=1,
    )  # fmt: skip
    values = torch.from_numpy(posed.grid.values.astype(np.float64))
    raw, _ = twin.field_at(posed.grid.tables(), values, posed.warp.tables, samples)
    return raw[:, 0, 0].numpy()


RADIUS_M, VOXEL_M = 0.3, 2 / 128  # a grid of 128 cells over 2 m
RAW_PER_M = 400.0


def test_30_activation_follows_interpolation(margin):
    middle = np.full(3, 0.3594)

    def raw(points):
        return RAW_PER_M * (RADIUS_M - np.linalg.norm(points - middle, axis=-1))

    nodes = 48
    size = ((nodes - 1) * VOXEL_M,) * 3
    posed = posed_field(raw, size_m=size, voxel_m=VOXEL_M)
    centre, directions = cone(middle, distance_m=1.2, spread_m=0.2, count=400)
    ours = trace_rays(
        posed, centre, directions, settings=RenderSettings(step_m=0.0005, **EXACT)
    ).depth_m
    t = 0.8 + 0.00005 * (np.arange(12000) + 0.5)
    points = centre.numpy() + t[:, None] * directions.numpy()[:, None]
    truth = median_depth(density_of(raw(points)), t)
    margin.at_most("depth, rms", 1e3 * rms(ours - truth), 0.3, "mm")
    at = np.stack(np.meshgrid(*[VOXEL_M * np.arange(nodes)] * 3, indexing="ij"), -1)
    density = density_of(raw(at))
    looked_up = map_coordinates(
        density, (points / VOXEL_M).reshape(-1, 3).T, order=1, mode="nearest", prefilter=False
    ).reshape(points.shape[:2])
    mutant = median_depth(looked_up, t)
    margin.mutant_exceeds("density interpolated, depth, rms", 1e3 * rms(mutant - truth), 0.3, "mm")


def median_depth(density, t):
    """Length at which half of the light is gone (rays, samples)."""
    thickness = np.cumsum(density, 1) * (t[1] - t[0])
    return np.array([np.interp(math.log(2), s, t + (t[1] - t[0]) / 2) for s in thickness])
