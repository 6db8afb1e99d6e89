"""Cases 13, 16 (cameras) and 37: rays against the grid's box, from anywhere, and back to points."""

import math
from dataclasses import replace

import numba
import numpy as np
import pytest
import torch

from ntop.annotation.keypoints import project_keypoints
from ntop.body.model import load_body_model
from ntop.body.skinning import BodyPose, pose_joints
from ntop.conventions import VIEWS
from ntop.field.kernels.tables import next_sample, start_ray
from ntop.field.quality import RenderSettings
from ntop.field.rendering import render_view, trace_rays
from ntop.field.warp import identity_warp
from ntop.geometry.cameras import Camera
from ntop.geometry.fisheyes import fisheye_lens
from ntop.geometry.ideal_fisheyes import Equidistant
from ntop.geometry.pinhole import Pinhole
from ntop.geometry.rigs import ROTATION_LOOKING_DOWN, Rig, top_view_cameras
from ntop.geometry.triangulation import camera_centers, camera_rays, triangulate
from ntop.report.blobs import ball
from tests.numerics.lenses import directions, family

CELLS = np.array([5, 4, 7])  # of the grid under test: a box of 5 x 4 x 7 cells


@numba.njit
def walk(warp, origins, rays, step, first, near, far, counts):
    """First sample and ends of each ray; with `counts`, also how many samples it meets."""
    for r in range(len(rays)):
        ray, near[r], far[r] = start_ray(warp, 0, origins[r], rays[r])
        k = max(0, math.ceil(near[r] / step - 0.5))
        first[r] = k
        if len(counts) > 0:
            counts[r] = 0
            while True:
                k, cell, _, _, _ = next_sample(warp, 0, ray, far[r], step, 0.5, k)
                if cell < 0:
                    break
                counts[r] += 1
                k += 1


def full_grid(cell):
    """A grid all of whose octants may hold density."""
    warp = identity_warp(np.zeros(3), (CELLS - 0.5) * cell, cell_m=cell).tables
    assert tuple(warp.dims[0]) == tuple(CELLS)
    return warp._replace(
        occupancy=np.full_like(warp.occupancy, 255), away=np.full_like(warp.away, 0)
    )


def walked(cell, origins, rays, *, step):
    """Number of samples that each ray meets."""
    first, near, far = np.empty((3, len(rays)))
    counts = np.empty(len(rays), np.int64)
    walk(full_grid(cell), np.ascontiguousarray(origins), rays, step, first, near, far, counts)
    return counts


def slab(cell, origins, rays):
    """Near and far end in extended precision; far < near: a miss."""
    low, high = np.zeros(3, np.longdouble), (CELLS * np.float64(cell)).astype(np.longdouble)
    o, d = origins.astype(np.longdouble), rays.astype(np.longdouble)
    near = np.zeros(len(rays), np.longdouble)
    far = np.full(len(rays), np.inf, np.longdouble)
    for axis in range(3):
        still = d[:, axis] == 0
        safe = np.where(still, np.longdouble(1), d[:, axis])
        t0, t1 = (low[axis] - o[:, axis]) / safe, (high[axis] - o[:, axis]) / safe
        within = (o[:, axis] >= low[axis]) & (o[:, axis] <= high[axis])
        near = np.where(still, near, np.maximum(near, np.minimum(t0, t1)))
        far = np.where(still, np.where(within, far, -1), np.minimum(far, np.maximum(t0, t1)))
    return near, far


def plane_hits(cell, origins, rays):
    """HumanNeRF's test: exactly two of six plane hits within 1e-6 of the box, in float32."""
    low, high = np.zeros(3, np.float32), (CELLS * cell).astype(np.float32)
    o, d = origins.astype(np.float32), rays.astype(np.float32).copy()
    d[np.abs(d) < 1e-5] = 1e-5
    found = np.zeros(len(rays), int)
    for axis in range(3):
        for border in (low[axis], high[axis]):
            at = o + ((border - o[:, axis]) / d[:, axis])[:, None] * d
            found += ((at >= low - 1e-6) & (at <= high + 1e-6)).all(1)
    return found == 2


@pytest.mark.parametrize("unit", [1.0, 1000.0], ids=["metres", "millimetres"])
def test_13_a_million_rays_and_the_box(unit, margin):
    generator = np.random.default_rng(13)
    cell, count = 0.3 * unit, 1_000_000
    size = CELLS * cell
    origins = size / 2 + generator.uniform(-3, 3, (count, 3)) * size
    targets = generator.uniform(-0.3, 1.3, (count, 3)) * size
    rays = (targets - origins).astype(np.float32).astype(np.float64)  # as a float32 camera's
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    near, far = slab(cell, origins, rays)
    length = far - near
    step = 1e-3 * cell
    first, begin, ours = np.empty((3, count))
    walk(full_grid(cell), origins, rays, step, first, begin, ours, np.empty(0, np.int64))
    spacing = 2 * np.spacing(np.abs(far).astype(np.float64) + np.abs(origins).max(1))
    met = begin < ours
    margin.at_most("rays through the box that miss it", int((~met & (length > spacing)).sum()), 0)
    margin.at_most("rays beside the box that meet it", int((met & (length < -spacing)).sum()), 0)
    hit = (first + 0.5) * step < ours
    # a ray whose stay is longer than a step has a sample
    lost = int((~hit & (length > step + spacing)).sum())
    margin.at_most("lost rays of a million", lost, 0)
    invented = int((hit & (length < -spacing)).sum())
    margin.at_most("rays that miss the box and are marched", invented, 0)
    hits = length > 0
    late = ((first - 0.5) * step - near.astype(np.float64))[hits].max()
    margin.at_most("first sample too late by", late / spacing.max(), 1, "x 2 ulp")
    early = np.abs(ours[hits] - far[hits].astype(np.float64)).max()
    margin.at_most("far end off by", early / spacing.max(), 1, "x 2 ulp")
    if unit > 1:
        dropped = int((~plane_hits(cell, origins, rays) & (length > step)).sum())
        margin.mutant_exceeds("HumanNeRF's box test in millimetres: lost", dropped, 0, "rays")


def test_13_no_sample_inside_is_lost(margin):
    generator = np.random.default_rng(31)
    cell, step, count = 0.02, 0.003, 10_000
    size = CELLS * cell
    origins = size / 2 + generator.uniform(-3, 3, (count, 3)) * size
    rays = generator.uniform(-0.1, 1.1, (count, 3)) * size - origins
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    counts = walked(cell, origins, rays, step=step)
    samples = (np.arange(300) + 0.5) * step
    tight = 1e-12
    lost = 0
    for part in range(0, count, 1000):
        rows = slice(part, part + 1000)
        at = origins[rows, None] + samples[:, None] * rays[rows, None]
        inside = ((at > tight) & (at < size - tight)).all(-1).sum(1)
        lost += int(np.maximum(inside - counts[rows], 0).sum())
    margin.at_most("samples inside the box that are not visited", lost, 0)


def special_rays(cell):
    """What breaks box tests: (origin, direction, must be hit, may be hit)."""
    x, y, z = CELLS * cell
    diagonal = np.array([1.0, 1.0, 0.0]) / math.sqrt(2)
    corner = np.array([x, y, 0.0]) / math.hypot(x, y)
    return [
        ((-1, y / 2, z / 2), (1, 0, 0), True, True),  # parallel to an axis
        ((-1, y / 2, z / 2), (1, -0.0, 0.0), True, True),  # minus zero
        ((-1, y / 2, z / 2), (1, 1e-40, -1e-40), True, True),  # denormal components
        ((-1, y / 2, z / 2), (-1, 0, 0), False, False),  # the box lies behind
        ((-1, 2 * y, z / 2), (1, 0, 0), False, False),  # beside, parallel
        ((x / 2, y / 2, z / 2), (0, 0, 1), True, True),  # from inside
        ((x / 2, y / 2, z / 2), tuple(diagonal), True, True),
        ((0, y / 2, z / 2), (1, 0, 0), True, True),  # from a face, inwards
        ((0, y / 2, z / 2), (-1, 0, 0), False, True),  # from a face, outwards
        ((-1, 0, z / 2), (1, 0, 0), True, True),  # along a lower face
        ((-1, y, z / 2), (1, 0, 0), False, True),  # along an upper face, which is no cell's
        ((-1, 0, 0), (1, 0, 0), True, True),  # along an edge
        ((-x, 0, z / 2), tuple(corner), False, True),  # touches the edge (0, y) only
        ((-1, -1, z / 2), tuple(-diagonal), False, False),
        ((x + 1, y + 1, z + 1), tuple(-np.ones(3) / math.sqrt(3)), False, True),  # near a corner
    ]


@pytest.mark.parametrize("cell", [0.02, 300.0, 1e-6], ids=["small", "millimetres", "micrometres"])
def test_13_special_rays(cell, margin):
    cases = special_rays(cell)
    origins = np.array([case[0] for case in cases], float)
    rays = np.array([case[1] for case in cases], float)
    near, far = slab(cell, origins, rays)
    step = 0.05 * cell
    counts = walked(cell, origins, rays, step=step)
    for index, (_, _, must, may) in enumerate(cases):
        met = counts[index] > 0
        assert met or not must, f"ray {index} is lost"
        assert may or not met, f"ray {index} is invented"
    expected = np.maximum((far - near) / step, 0).astype(float)
    must = np.array([case[2] for case in cases])
    difference = np.abs(counts - expected)[must].max()
    margin.at_most("samples met against length / step", difference, 1.5, "samples")


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_13_rays_that_are_none_end(bad):
    origins, rays = np.zeros((7, 3)) + 0.01, np.tile([0.0, 0.0, 1.0], (7, 1))
    for axis in range(3):
        rays[axis, axis] = bad
        origins[3 + axis, axis] = bad
    rays[6] = 0.0  # no direction at all
    counts = walked(0.02, origins, rays, step=0.003)
    assert counts.tolist() == [0] * 7


SETTINGS = RenderSettings(step_m=0.001, edge_rays=1)


def looking_down(lens, centre):
    """A camera above, image right = +x, image up = +y."""
    rotation = torch.tensor(ROTATION_LOOKING_DOWN, dtype=torch.float64)
    return Camera(lens, torch.tensor(centre, dtype=torch.float64), rotation)


def test_16_camera_inside_and_person_behind(margin):
    posed = ball(np.array([0.2, 0.1, 0.5]))
    lens = Equidistant(64 / math.pi, 32.0, 32.0, 64, 64, math.radians(120))
    inside = render_view(posed, looking_down(lens, (0.2, 0.1, 0.505)), settings=SETTINGS)
    assert all(np.isfinite(v).all() for v in (inside.rgb, inside.alpha, inside.depth_m))
    valid = lens.unproject(pixels_of(lens))[1].numpy()
    margin.at_least("alpha from inside the body", float(inside.alpha[valid].min()), 0.99)
    margin.at_most("alpha outside the image circle", float(inside.alpha[~valid].max()), 0)
    for place in ((0.2, 0.1, 0.1), (0.25, 0.1, 0.2)):  # the ball is above, hence behind
        behind = render_view(posed, looking_down(lens, place), settings=SETTINGS)
        margin.at_most("alpha of a body behind", float(behind.alpha.max()), 0)


def pixels_of(lens):
    """Centres of all pixels."""
    v, u = np.mgrid[: lens.height, : lens.width] + 0.5
    return torch.from_numpy(np.stack([u, v], -1))


@pytest.mark.parametrize("model", ["equidistant", "equisolid", "stereographic", "kannala_brandt"])
def test_16_a_raised_hand_beyond_90_degrees(model, margin):
    height, theta = 1.0, math.radians(104)
    size = 400
    lens = fisheye_lens(
        model, fx=60.0, fy=60.0, cx=200.0, cy=200.0, width=size, height=size,
        max_theta=math.radians(140),
        distortion=(0.02, -0.01, 0.002, 0.0) if model == "kannala_brandt" else (),
    )  # fmt: skip
    around = 0.6
    offset = 0.4 * np.array(
        [math.sin(theta) * math.cos(around), math.sin(theta) * math.sin(around)]
    )
    hand = np.array([offset[0], offset[1], height - 0.4 * math.cos(theta)])
    camera = looking_down(lens, (0.0, 0.0, height))
    view = render_view(ball(hand), camera, settings=SETTINGS)
    whole = render_view(ball(hand), camera, settings=RenderSettings(0.001, crop=False, edge_rays=1))
    margin.at_most("crop on against off", float(np.abs(view.alpha - whole.alpha).max()), 1e-6)
    label, seen = camera.project(torch.from_numpy(hand))
    assert seen
    v, u = np.mgrid[:size, :size] + 0.5
    weight = view.alpha.astype(float)
    assert weight.sum() > 5
    centroid = np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()
    margin.at_most("hand off its label", float(np.hypot(*(centroid - label.numpy()))), 0.5, "px")
    right = np.sign(centroid - 200) == np.sign([offset[0], -offset[1]])  # image up is +y
    assert right.all()


def test_16_cropping_is_exact_for_every_lens(margin):
    """Balls ahead, across, at the rim, behind, beside the image: the same image cropped or not."""
    size, generator = 120, torch.Generator().manual_seed(16)
    narrow = Pinhole(70.0, 75.0, 50.0, 66.0, size, size, (-0.2, 0.05, 1e-3, -2e-3, 0.0))
    wide = family(25.0, max_theta=math.radians(140), size=size)
    plain = RenderSettings(0.001, crop=False, edge_rays=1)
    theta = math.pi * torch.rand(8, generator=generator, dtype=torch.float64)
    azimuth = 2 * math.pi * torch.rand(8, generator=generator, dtype=torch.float64)
    places = directions(theta, azimuth)
    drawn = 0
    for lens in (*wide, narrow):
        # the last one straddles the rim
        at_rim = directions(lens.max_theta, azimuth[:1])
        for place in (*(0.25 * places), *(0.1 * places[::3]), *(0.2 * at_rim)):
            camera = looking_down(lens, (0.0, 0.0, 1.0))
            posed = ball((place @ camera.rotation + camera.center_world).numpy())
            cropped_view = render_view(posed, camera, settings=SETTINGS)
            whole = render_view(posed, camera, settings=plain)
            shift = float(np.abs(cropped_view.alpha - whole.alpha).max())
            margin.at_most(f"{lens.model}: crop on against off", shift, 1e-6)
            drawn += int(whole.alpha.max() > 0.5)
    assert drawn > 30


def test_16_no_ghost_in_the_corners(margin):
    size = 200
    lens = Equidistant(size / math.pi, 100.0, 100.0, size, size, math.radians(170))  # no mask
    camera = looking_down(lens, (0.6, 0.6, 1.2))
    view = render_view(
        ball(np.array([0.45, 0.45, 1.1])), camera,
        settings=RenderSettings(0.001, crop=False, edge_rays=1),
    )  # fmt: skip
    rays, _ = camera.rays(pixels_of(lens))
    beyond = (rays[..., 2] >= 0).numpy()  # the upper half of the world
    assert beyond.sum() > 0.2 * size**2
    margin.at_most("alpha beyond 90 degrees", float(view.alpha[beyond].max()), 0)
    assert view.alpha.max() > 0.9
    posed = ball(np.array([0.45, 0.45, 1.1]))
    paper = torch.where(torch.from_numpy(beyond)[..., None], -rays, rays)
    ghost = trace_rays(posed, camera.center_world, paper[beyond], settings=SETTINGS)
    margin.mutant_exceeds("the paper's ray: ghost's alpha", float(ghost.alpha.max()), 0)


def test_16_no_field_query_outside_the_image_circle(margin):
    posed = ball(np.array([0.0, 0.0, 0.5]))
    lens = Equidistant(300.0, 32.0, 32.0, 64, 64, math.radians(0.01))  # a circle of 0.05 px
    camera = looking_down(lens, (0.0, 0.0, 1.0))
    view = render_view(posed, camera, settings=RenderSettings(0.001, crop=False, edge_rays=1))
    margin.at_most("look-ups", view.evaluations, 0)
    assert view.alpha.max() == 0


def test_37_labels_triangulate_to_their_joints(margin):
    zeros = {"betas": 10, "global_orient": 3, "body_pose": 69, "transl": 3}
    pose = BodyPose(**{name: torch.zeros(n, dtype=torch.float64) for name, n in zeros.items()})
    joints = pose_joints(load_body_model(), pose)
    rig = Rig(1.2, 1.0, 1000, 1000, 1000 / math.pi)
    for lens in family(250.0):
        cameras = [
            replace(camera, lens=lens) for camera in top_view_cameras(rig, joints[0]).values()
        ]
        labels = torch.stack([project_keypoints(joints, camera).pixels for camera in cameras], 1)
        rays, covered = camera_rays(cameras, labels)
        found = triangulate(camera_centers(cameras), rays, covered.double())
        assert covered.all() and found.valid.all()
        error = (found.points_world - joints).norm(dim=-1).max().item()
        margin.at_most(f"{lens.model}: nine views", error, 1e-6, "m")
    pair = [cameras[VIEWS.index("e")], cameras[VIEWS.index("w")]]
    between = 0.5 * (pair[0].center_world + pair[1].center_world)
    rays = torch.stack([between - camera.center_world for camera in pair])
    rays = rays / rays.norm(dim=-1, keepdim=True)
    found = triangulate(camera_centers(pair), rays, torch.ones(2))
    assert not found.valid
    margin.at_least("condition on the baseline", found.condition.item(), 1e6)
