"""Cases 7 to 12: other implementations, inversion, placement, transformed images, derivatives."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from ntop.conventions import PIXEL_CENTRE, VIEWS, DataError
from ntop.geometry import radial_polynomial
from ntop.geometry.cameras import Camera
from ntop.geometry.ideal_fisheyes import Equidistant, Equisolid, Stereographic
from ntop.geometry.jacobians import pixel_by_point, ray_by_pixel, solid_angle
from ntop.geometry.kannala_brandt import KannalaBrandt
from ntop.geometry.monotone import monotone_limit
from ntop.geometry.opencv import opencv_parameters
from ntop.geometry.pinhole import Pinhole
from ntop.geometry.rigs import Rig, top_view_cameras
from ntop.geometry.rotations import matrix_from_axis_angle
from ntop.geometry.windows import cropped, mirrored, resized, rolled, turned
from tests.numerics import lenses
from tests.numerics.lenses import azimuths, directions, family, pinhole

KB_SETS = {
    "zero": (0.0, 0.0, 0.0, 0.0),
    "mild": lenses.MILD,
    "action camera": lenses.WIDE_ANGLE,
    "TUM-VI": lenses.TUM_VI,
    "-0.12": lenses.BARREL,
    "9 theta^3": lenses.STRONG,
    "opencv #23961": lenses.OPENCV_23961,
    "folding": lenses.FOLDING,
}


def random_points(count, *, half_angle, generator):
    """Points within an angle of the axis, 0.3 to 3 m away."""
    theta = half_angle * torch.rand(count, generator=generator, dtype=torch.float64).sqrt()
    around = 2 * math.pi * torch.rand(count, generator=generator, dtype=torch.float64)
    away = 0.3 + 2.7 * torch.rand(count, generator=generator, dtype=torch.float64)
    return directions(theta, around) * away[:, None]


def test_07_opencv_in_its_domain(margin):
    generator = torch.Generator().manual_seed(7)
    zero = np.zeros(3)
    for _ in range(20):
        k = (torch.rand(4, generator=generator, dtype=torch.float64) - 0.5) * 0.1
        focal = 200 + 400 * torch.rand(2, generator=generator, dtype=torch.float64)
        distortion = tuple(k.tolist())
        limit = min(math.radians(89), monotone_limit(distortion))
        lens = KannalaBrandt(*focal.tolist(), 500.3, 480.9, 1000, 960, limit, distortion)
        points = random_points(500, half_angle=limit, generator=generator)
        ours, seen = lens.project(points)
        matrix, coefficients = (np.array(values) for values in opencv_parameters(lens))
        theirs, _ = cv2.fisheye.projectPoints(
            points[:, None].numpy(), zero, zero, matrix, coefficients
        )
        theirs = torch.from_numpy(theirs[:, 0])
        assert seen.all()
        shift = (ours - PIXEL_CENTRE - theirs).abs().max().item()
        margin.at_most("fisheye", shift, 1e-6, "px")
        shift = (ours - theirs).abs().min().item()
        margin.mutant_exceeds("without the half pixel", shift, 1e-6, "px")
    points = random_points(1000, half_angle=math.radians(40), generator=generator)
    for lens in (pinhole(1680.0), replace(pinhole(500.0), fy=510.0, cx=477.0)):
        ours, _ = lens.project(points)
        parameters = [np.array(values) for values in opencv_parameters(lens)]
        theirs, _ = cv2.projectPoints(points.numpy(), zero, zero, *parameters)
        shift = np.abs(ours.numpy() - PIXEL_CENTRE - theirs[:, 0]).max()
        margin.at_most("pinhole", float(shift), 1e-6, "px")
    behind = directions(math.radians(100), azimuths(50))
    lens = replace(lenses.family(318.0)[0], max_theta=math.radians(110))
    exact, _ = lens.project(behind)
    matrix = np.array([[318.0, 0, 499.5], [0, 318.0, 499.5], [0, 0, 1]])
    theirs, _ = cv2.fisheye.projectPoints(behind[:, None].numpy(), zero, zero, matrix, np.zeros(4))
    shift = np.abs(exact.numpy() - PIXEL_CENTRE - theirs[:, 0]).max()
    margin.mutant_exceeds("OpenCV itself at 100 degrees", float(shift), 1e-6, "px")


@pytest.mark.parametrize("name", KB_SETS)
def test_08_inversion_of_kannala_brandt(name, margin):
    k = KB_SETS[name]
    fold = monotone_limit(k)
    rim = min(math.radians(110), fold)
    focal = 500 / beyond_radius(rim, k).item()  # an image circle of 1000 px
    lens = KannalaBrandt(focal, focal, 0.0, 0.0, 1000, 1000, rim, k)
    theta = torch.linspace(0, lens.max_theta, 20_001, dtype=torch.float64)
    radius = theta * radial_polynomial.ratio(theta * theta, k)
    found, iterations = radial_polynomial.solve(radius, k, limit=lens.max_theta)
    residual = (found * radial_polynomial.ratio(found * found, k) - radius).abs()
    margin.at_most("residual fp64", residual.max().item(), 1e-12)
    margin.at_most("iterations", iterations, 12)
    single = radial_polynomial.inverse(radius.float(), k, limit=lens.max_theta).double()
    again = single * radial_polynomial.ratio(single * single, k)
    error = (again - radius.float().double()).abs().max().item() * focal
    margin.at_most("residual fp32", error, 1e-4, "px")

    inner = (radius[1:-1:400] * 0.999).clone().requires_grad_()
    solve = lambda r: radial_polynomial.inverse(r, k, limit=lens.max_theta)  # noqa: E731
    assert torch.autograd.gradcheck(solve, inner, eps=1e-6, atol=1e-6, rtol=1e-4)
    at = solve(inner)
    slope = radial_polynomial.slope(at * at, k)
    gradient = torch.autograd.grad(at.sum(), inner)[0]
    margin.at_most("gradient x slope - 1", (gradient * slope - 1).abs().max().item(), 1e-12)

    outside = torch.tensor([[1.001, 0.0], [0.0, -3.0]], dtype=torch.float64)
    rays, valid = lens.unproject(outside * focal * radius.max())
    assert not valid.any() and rays.isfinite().all()
    if fold < math.pi:
        with pytest.raises(DataError, match="folds there"):
            replace(lens, max_theta=1.001 * fold)
        beyond = directions(min(fold * 1.05, 3.1), azimuths(8))
        assert not lens.project(beyond)[1].any()
        # without a declared domain the fold puts rays from outside into the image
        back = radius.max() - beyond_radius(fold * 1.05, k)
        margin.mutant_exceeds("inside the image from beyond the fold", back.item(), 0, "focal")
    if name in ("opencv #23961", "folding", "-0.12"):
        guess = radius.clone()  # ten plain Newton steps from theta_d, clamped at 90 degrees
        guess = guess.clamp(max=math.pi / 2)
        for _ in range(10):
            value = guess * radial_polynomial.ratio(guess * guess, k)
            guess = guess - (value - radius) / radial_polynomial.slope(guess * guess, k)
        miss = (guess - theta).abs().nan_to_num(math.inf).max().item()
        margin.mutant_exceeds("plain Newton: theta", miss, 1e-4, "rad")


def beyond_radius(theta, k):
    """r(theta), wherever."""
    theta = torch.tensor(theta, dtype=torch.float64)
    return theta * radial_polynomial.ratio(theta * theta, k)


@pytest.mark.parametrize("distance", [0.0, 5.0, 5e3, 1e6])
def test_09_far_from_the_origin(distance, margin):
    turn = matrix_from_axis_angle(torch.tensor([0.3, -0.8, 0.4], dtype=torch.float64))
    centre = distance * torch.tensor([0.6, -0.64, 0.48], dtype=torch.float64)
    generator = torch.Generator().manual_seed(9)
    pixels = 1000 * torch.rand(20_000, 2, generator=generator, dtype=torch.float64)
    for lens in (*family(318.0), pinhole(500.0)):
        camera = Camera(lens, centre.float(), turn.float())
        ours, valid = camera.rays(pixels.float())
        exact, _ = Camera(lens, centre, turn).rays(pixels.float().double())
        error = (ours.double() - exact)[valid].norm(dim=-1).max().item()
        margin.at_most("direction fp32", error, 1e-6, "rad")
    if distance >= 5e3:
        lens = family(318.0)[0]
        unit, _ = lens.unproject(pixels.float())
        translation = -(turn.float() @ centre.float())
        far = (unit - translation) @ turn.float()  # q_w = R^T (q - t), then d = q_w - o
        mutant = far - centre.float()
        mutant = mutant.double() / mutant.double().norm(dim=-1, keepdim=True).clamp(min=1e-30)
        exact = lens.unproject(pixels.float().double())[0] @ turn
        error = (mutant - exact).norm(dim=-1).max().item()
        margin.mutant_exceeds("direction as q_w - o", error, 1e-6, "rad")


def test_10_placement_of_the_nine_cameras(margin):
    rig = Rig(1.2, 1.0, 1000, 1000, 1000 / math.pi)
    pelvis = torch.tensor([0.7, -1.3, 0.95], dtype=torch.float64)
    cameras = top_view_cameras(rig, pelvis)
    assert tuple(cameras) == VIEWS
    at = {view: camera.project(pelvis)[0] - 500 for view, camera in cameras.items()}
    margin.at_most("pelvis in `centre`", at["centre"].norm().item(), 1e-4, "px")
    # image up is north: who stands to the east sees the pelvis to the west
    for view, expected in (("e", (-1, 0)), ("n", (0, 1)), ("w", (1, 0)), ("s", (0, -1))):
        towards = at[view] / at[view].norm() - torch.tensor(expected, dtype=torch.float64)
        margin.at_most("pelvis opposite to the camera's place", towards.norm().item(), 1e-9)
    offsets = [cameras[view].center_world - pelvis for view in VIEWS[1:]]
    order = [math.atan2(y, x) % (2 * math.pi) for x, y, _ in (o.tolist() for o in offsets)]
    assert order == sorted(order)
    for camera in cameras.values():
        assert torch.linalg.det(camera.rotation).item() == 1
    # the paper's T = (x, y, h) as if it were a centre: mirrored, or under the floor
    wrong = -(cameras["e"].rotation.T @ (torch.tensor([1.0, 0.0, 1.2], dtype=torch.float64)))
    shift = Camera(rig.lens(), pelvis + wrong, cameras["e"].rotation).project(pelvis)[0] - 500
    margin.mutant_exceeds("T as centre", (shift - at["e"]).norm().item(), 1e-4, "px")
    mirrored_ring = top_view_cameras(rig, pelvis, paper_compat=True)["e"].project(pelvis)[0] - 500
    margin.mutant_exceeds("mirrored ring", (mirrored_ring - at["e"]).norm().item(), 1e-4, "px")


def all_lenses():
    """Not square, principal point off the centre, fx and fy apart."""
    ideal = [
        kind(318.0, 311.3, 250.9, 640, 480, math.radians(150), aspect=1.03)
        for kind in (Equidistant, Equisolid, Stereographic)
    ]
    return [
        *ideal,
        KannalaBrandt(318.0, 327.5, 311.3, 250.9, 640, 480, math.radians(100), lenses.MILD),
        Pinhole(500.0, 515.0, 311.3, 250.9, 640, 480, (-0.05, 0.14, 1e-3, -2e-3, 0.01)),
    ]


@pytest.mark.parametrize("lens", all_lenses(), ids=lambda lens: lens.model)
def test_11_transformed_images(lens, margin):
    generator = torch.Generator().manual_seed(11)
    points = random_points(2000, half_angle=0.8, generator=generator)
    u, v = lens.project(points)[0].unbind(-1)
    camera = Camera(lens, torch.zeros(3).double(), torch.eye(3).double())

    def expect(what, pixels, u_expected, v_expected):
        shift = (pixels - torch.stack([u_expected, v_expected], -1)).norm(dim=-1).max().item()
        margin.at_most(what, shift, 1e-9, "px")

    window = cropped(lens, left=120, top=45, width=300, height=200)
    expect("crop", window.project(points)[0], u - 120, v - 45)
    small = resized(lens, width=213, height=119)
    expect("resize", small.project(points)[0], u * 213 / 640, v * 119 / 480)
    flipped = points * torch.tensor([-1.0, 1.0, 1.0], dtype=torch.float64)
    expect("flip", mirrored(lens).project(flipped)[0], 640 - u, v)
    quarter = turned(camera)
    assert (quarter.lens.width, quarter.lens.height) == (480, 640)
    assert torch.linalg.det(quarter.rotation) == 1
    expect("quarter turn", quarter.project(points)[0], 480 - v, u)
    four = camera
    for _ in range(4):
        four = turned(four)
    expect("four quarter turns", four.project(points)[0], u, v)
    plain = {"distortion": (0.0,) * 5} if isinstance(lens, Pinhole) else {}
    if isinstance(lens, Pinhole | KannalaBrandt):
        simple = replace(lens, fy=lens.fx, **plain)
    else:
        simple = replace(lens, aspect=1.0)
    level = Camera(simple, camera.center_world, camera.rotation)
    offset = level.project(points)[0] - torch.tensor([simple.cx, simple.cy], dtype=torch.float64)
    angle = 0.3
    x, y = offset.unbind(-1)
    turned_u = simple.cx + x * math.cos(angle) - y * math.sin(angle)
    turned_v = simple.cy + x * math.sin(angle) + y * math.cos(angle)
    expect("roll", rolled(level, angle_rad=angle).project(points)[0], turned_u, turned_v)

    half_pixel = replace(small, cx=(lens.cx + 0.5) * 213 / 640 - 0.5)
    shift = (half_pixel.project(points)[0] - small.project(points)[0]).norm(dim=-1).max().item()
    margin.mutant_exceeds("resize about integer centres", shift, 1e-9, "px")
    swapped = cropped(lens, left=45, top=120, width=300, height=200).project(points)[0]
    shift = (swapped - window.project(points)[0]).norm(dim=-1).max().item()
    margin.mutant_exceeds("left and top swapped", shift, 1e-9, "px")


def test_12_solid_angle_and_jacobians(margin):
    generator = torch.Generator().manual_seed(12)
    focal = 318.0
    for lens in (*family(focal), replace(pinhole(500.0), distortion=(0.0,) * 5)):
        limit = 0.98 * min(lens.max_theta, math.radians(160))
        theta = 0.01 + (limit - 0.01) * torch.rand(5000, generator=generator, dtype=torch.float64)
        rays = directions(theta, azimuths(5000))
        pixels, _ = lens.project(rays)
        law = {
            "equidistant": theta.sin() / theta,
            "equisolid": torch.ones_like(theta),
            "stereographic": (theta / 2).cos() ** 4,
            "pinhole_radtan": theta.cos() ** 3,
        }.get(lens.model)
        if law is None:
            squared = theta * theta
            radius = theta * radial_polynomial.ratio(squared, lens.distortion)
            law = theta.sin() / (radius * radial_polynomial.slope(squared, lens.distortion))
        relative = (solid_angle(lens, pixels) * lens.fx**2 / law - 1).abs().max().item()
        margin.at_most(f"{lens.model}: solid angle", relative, 1e-6)
        distance = 1.7
        forward = pixel_by_point(lens, distance * rays)
        identity = distance * forward @ ray_by_pixel(lens, pixels) - torch.eye(2).double()
        margin.at_most("pixel by ray by pixel - 1", identity.abs().max().item(), 1e-6)
        along = (forward @ rays[..., None]).abs().max().item() / lens.fx
        margin.at_most("a pixel moves along its ray by", along, 1e-6, "of f")
    at = pinhole(500.0).project(directions(0.5, azimuths(500)))[0]
    product = pixel_by_point(pinhole(500.0), pinhole(500.0).unproject(at)[0])
    identity = product @ ray_by_pixel(pinhole(500.0), at) - torch.eye(2).double()
    margin.at_most(
        "distorted pinhole: pixel by ray by pixel - 1", identity.abs().max().item(), 1e-6
    )
    u = torch.tensor([500.0 + focal * 1.2, 500.0], dtype=torch.float64)
    jacobian = torch.func.jacrev(lambda p: lenses.paper_rays(p, focal, 500.0))(u)
    area = torch.linalg.cross(jacobian[:, 0], jacobian[:, 1]).norm().item()
    expected = math.sin(1.2) / 1.2 / focal**2
    margin.mutant_exceeds("footprint from the paper's ray", abs(area / expected - 1), 1e-6)
