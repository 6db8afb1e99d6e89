"""Cases 1 to 6: pixel <-> ray, values and gradients, at the centre, at 90 degrees, at the rim."""

import math
from dataclasses import replace
from pathlib import Path

import mpmath
import numpy as np
import pytest
import torch

from ntop.conventions import PIXEL_CENTRE
from ntop.geometry.cameras import pixel_grid
from ntop.geometry.ideal_fisheyes import Equidistant, Equisolid, Stereographic
from ntop.geometry.kannala_brandt import KannalaBrandt
from tests.numerics.lenses import (
    CENTRE,
    FOCALS,
    PRECISIONS,
    SIZE,
    TABLE_1_DEGREES,
    acos_projection,
    azimuths,
    condition,
    directions,
    family,
    paper_rays,
    pinhole,
    plane_projection,
    ulp,
)

GOLDEN = Path(__file__).parents[1] / "golden/cycles_fisheye_rays.npz"
BITS = {torch.float32: "fp32", torch.float64: "fp64"}


def table_1_pixels(lens, precision, *, extra_degrees=()):
    """Pixels at the thetas of Table 1 inside the lens's domain, 400 azimuths each, and theta."""
    degrees = [d for d in (*TABLE_1_DEGREES, *extra_degrees) if math.radians(d) < lens.max_theta]
    theta = torch.tensor(degrees, dtype=torch.float64).deg2rad()[:, None].expand(-1, 400)
    pixels, _ = lens.project(directions(theta, azimuths(400)))
    return pixels.to(precision), theta


def round_trip(lens, pixels):
    """Distance [px] of pixel -> ray -> pixel; infinite for a lost ray."""
    rays, valid = lens.unproject(pixels)
    back, seen = lens.project(2.5 * rays)
    error = (back.double() - pixels.double()).norm(dim=-1)
    return torch.where(valid & seen, error, torch.inf), rays


@pytest.mark.parametrize("precision", PRECISIONS, ids=BITS.get)
@pytest.mark.parametrize("focal", FOCALS)
def test_01_round_trip(focal, precision, margin):
    generator = torch.Generator().manual_seed(0)
    random = SIZE * torch.rand(100_000, 2, generator=generator, dtype=torch.float64).to(precision)
    for lens in family(focal):
        ideal = isinstance(lens, Equidistant | Equisolid | Stereographic)
        # at 2000 px per radian one ulp of a stereographic 170 degrees is already 7e-12 px
        wide = ideal and not (isinstance(lens, Stereographic) and focal > 1000)
        grid, theta = table_1_pixels(lens, precision, extra_degrees=(169.99,) if wide else ())
        check_round_trip(lens, grid, theta, margin)
        # half an ulp from the rim a ray may round to the other side
        inner = replace(lens, max_theta=lens.max_theta * (1 - 1e-6))
        inside = random[inner.unproject(random)[1]]
        rays, _ = lens.unproject(inside.double())
        check_round_trip(lens, inside, torch.acos(rays[:, 2].clamp(-1, 1)), margin)
    lens = pinhole(max(focal, 500.0))
    rays, _ = lens.unproject(random.double())
    check_round_trip(lens, random, torch.acos(rays[:, 2].clamp(-1, 1)), margin)

    lens = family(focal)[0]
    beyond, _ = lens.project(directions(math.radians(100), azimuths(400)))
    mutant, _ = lens.project(paper_rays(beyond.to(precision), focal, CENTRE))
    shift = (mutant.double() - beyond).norm(dim=-1).min().item()
    margin.mutant_exceeds("the paper's tan at 100 degrees", shift, 8 * ulp(SIZE, precision), "px")
    near = directions(1e-4, azimuths(400)).to(precision)
    wrong = acos_projection(near, focal, 0.0).double()
    exact = focal * 1e-4 * near.double()[:, :2] / near.double()[:, :2].norm(dim=-1)[:, None]
    if precision == torch.float32:
        shift = (wrong - exact).norm(dim=-1).max().item()
        limit = 8 * ulp(focal * 1e-4, precision)
        margin.mutant_exceeds("acos at 1e-4 rad, fp32", shift, limit, "px")


def check_round_trip(lens, pixels, theta, margin):
    """Within 1e-11 px in float64, within 8 ulp times the condition in float32; none lost."""
    error, _ = round_trip(lens, pixels)
    if pixels.dtype == torch.float64:
        margin.at_most(f"{lens.model} fp64", error.max().item(), 1e-11, "px")
    else:
        worst = (error / (pixel_ulp(pixels) * condition(theta))).max().item()
        margin.at_most(f"{lens.model} fp32, in ulp(W) x condition", worst, 8)


def pixel_ulp(pixels):
    """Spacing of numbers at each pixel's own coordinates, at least that at the image's width."""
    exponents = pixels.abs().amax(-1).clamp(min=SIZE).log2().floor().double()
    return torch.exp2(exponents) * torch.finfo(pixels.dtype).eps


@pytest.mark.parametrize("precision", PRECISIONS, ids=BITS.get)
def test_01_far_outside_the_image_a_pixel_is_its_own_ruler(precision, margin):
    """A stereographic 170 degrees at 2000 px per radian: one ulp is 7e-12 px, or 4e-3 px."""
    [lens] = [one for one in family(2000.0) if isinstance(one, Stereographic)]
    theta = torch.tensor([150.0, 160.0, 169.99]).double().deg2rad()[:, None].expand(-1, 400)
    pixels = lens.project(directions(theta, azimuths(400)))[0].to(precision)
    error, _ = round_trip(lens, pixels)
    worst = (error / (pixel_ulp(pixels) * condition(theta))).max().item()
    margin.at_most(f"stereographic {BITS[precision]}, in ulp x condition", worst, 8)


@pytest.mark.parametrize("precision", PRECISIONS, ids=BITS.get)
def test_02_ray_directions_against_50_digits(precision, margin):
    focal, limit = 318.0, {torch.float32: 1e-6, torch.float64: 2e-15}[precision]
    for lens in family(focal):
        pixels, _ = table_1_pixels(lens, precision)
        pixels = pixels[:, ::40].reshape(-1, 2)
        rays, valid = lens.unproject(pixels)
        assert valid.all()
        errors = [ray_error(lens, p, r) for p, r in zip(pixels, rays, strict=True)]
        margin.at_most(f"{lens.model} {BITS[precision]}: ray", max(errors), limit, "rad")
        length = (rays.norm(dim=-1) - 1).abs().max().item() / torch.finfo(precision).eps
        margin.at_most("|d| - 1", length, 4, "eps")
    lens = family(focal)[0]
    at_100 = lens.project(directions(math.radians(100), azimuths(4)))[0].to(precision)
    for pixel, ray in zip(at_100, paper_rays(at_100, focal, CENTRE), strict=True):
        error = ray_error(lens, pixel, ray / ray.norm())
        margin.mutant_exceeds("the paper's ray at 100 degrees", error, limit, "rad")


def ray_error(lens, pixel, ray):
    """Length of the difference to the lens's law in 50 digits, at the pixel as it was rounded."""
    with mpmath.workdps(50):
        a, b = ((mpmath.mpf(float(p)) - mpmath.mpf(CENTRE)) / mpmath.mpf(lens.fx) for p in pixel)
        rho = mpmath.hypot(a, b)
        match lens.model:
            case Equidistant.model:
                theta = rho
            case Equisolid.model:
                theta = 2 * mpmath.asin(rho / 2)
            case Stereographic.model:
                theta = 2 * mpmath.atan(rho / 2)
            case KannalaBrandt.model:
                k = [mpmath.mpf(c) for c in lens.distortion]
                theta = mpmath.findroot(
                    lambda t: t * (1 + sum(c * t ** (2 * i + 2) for i, c in enumerate(k))) - rho,
                    (mpmath.mpf(0), mpmath.mpf(lens.max_theta)),
                    solver="anderson",
                )
        across = mpmath.sin(theta) / rho if rho else mpmath.mpf(1)
        exact = (a * across, b * across, mpmath.cos(theta))
        return float(
            mpmath.norm([mpmath.mpf(float(c)) - e for c, e in zip(ray, exact, strict=True)])
        )


@pytest.mark.parametrize("precision", PRECISIONS, ids=BITS.get)
def test_03_the_principal_point_and_the_antipode(precision, margin):
    focal = 318.0
    offsets = torch.tensor([0.0, 1e-20, -1e-20, 1e-6, -1e-6], dtype=precision)
    near = torch.cartesian_prod(offsets, offsets)
    for lens in (replace(lens, cx=0.0, cy=0.0) for lens in (*family(focal), pinhole(focal))):
        pixels = near.clone().requires_grad_()
        rays, valid = lens.unproject(pixels)
        across = gradients(rays, pixels)[:, 0]  # d(direction)/du
        assert valid.all() and rays.isfinite().all()
        expected = torch.tensor([1.0, 0.0, 0.0], dtype=precision)
        error = (across * focal - expected).abs().max().item()
        margin.at_most(f"{lens.model}: ray gradient x f", error, 1e-6)
        points = torch.cat([near, torch.ones_like(near[:, :1])], -1).requires_grad_()
        seen_at, seen = lens.project(points)
        down = gradients(seen_at, points)[:, 0]
        assert seen.all() and seen_at.isfinite().all()
        error = (down / focal - torch.tensor([1.0, 0.0], dtype=precision)).abs().max().item()
        margin.at_most(f"{lens.model}: projection gradient / f", error, 1e-6)
        behind = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, -1e-30], [0.0, 0.0, 0.0]])
        behind = behind.to(precision).requires_grad_()
        pixels, seen = lens.project(behind)
        assert not seen.any() and pixels.isfinite().all()
        assert torch.autograd.grad(pixels.sum(), behind)[0].isfinite().all()
    zero = torch.zeros(2, dtype=precision, requires_grad=True)
    paper = paper_rays(zero, focal, 0.0)
    margin.mutant_exceeds("the paper's ray at the centre", paper[0].item(), 1e-6)
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=precision, requires_grad=True)
    slope = torch.autograd.grad(acos_projection(axis, focal, 0.0)[0], axis)[0]
    margin.mutant_exceeds("acos: gradient on the axis", slope[0].item(), 1e-6)


def gradients(values, variables):
    """The derivative of every value by the first of its own variables."""
    columns = [
        torch.autograd.grad(values[:, i].sum(), variables, retain_graph=True)[0][:, 0]
        for i in range(values.shape[1])
    ]
    return torch.stack(columns, -1)[:, None]


@pytest.mark.parametrize("degrees", [89.99, 90, 90.01, 100, 130, 170])
def test_04_azimuth_and_antipodes_around_90_degrees(degrees, margin):
    theta, around, focal = math.radians(degrees), azimuths(400), 318.0
    rays = directions(theta, around)
    radius = {
        "equidistant": theta,
        "equisolid": 2 * math.sin(theta / 2),
        "stereographic": 2 * math.tan(theta / 2),
    }
    for lens in family(focal, max_theta=math.radians(171)):
        if theta > lens.max_theta:
            continue
        r = radius.get(lens.model) or theta * sum(
            k * theta ** (2 * i) for i, k in enumerate((1.0, *lens.distortion))
        )
        law = focal * r * torch.stack([around.cos(), around.sin()], -1) + CENTRE
        pixels, seen = lens.project(3 * rays)
        error = (pixels - law).norm(dim=-1).max().item()
        margin.at_most("distance from the law", error, 1e-11, "px")
        opposite, also_seen = lens.project(-3 * rays)
        apart = (pixels - opposite).norm(dim=-1).min().item()
        margin.at_least("distance to the antipode's image", apart, 1, "px")
        assert seen.all()
        assert also_seen.all() == (math.pi - theta <= lens.max_theta)
    if degrees > 90:
        exact, _ = family(focal)[0].project(rays)
        shift = (plane_projection(rays, focal, CENTRE) - exact).norm(dim=-1).min().item()
        margin.mutant_exceeds("x / z instead of atan2", shift, 1e-11, "px")
        lost = int((rays[:, 2] <= 0).sum())
        margin.mutant_exceeds("culled by z <= 0", lost, 0, "of 400 rays")


CYCLES = ("180_64x64", "180_63x63", "180_64x48", "220_64x64", "140_64x64")


@pytest.mark.parametrize("key", [*(f"eqd_fov{k}" for k in CYCLES), "eqs_lens8_sensor36_64x64"])
def test_05_rays_of_blender_cycles(key, margin):
    rays = torch.from_numpy(np.load(GOLDEN)[key].astype(np.float64))
    height, width, _ = rays.shape
    place = {"cx": width / 2, "cy": height / 2, "width": width, "height": height}
    if key.startswith("eqs"):
        lens = Equisolid(8 * width / 36, **place)
    else:
        fov = math.radians(int(key.split("fov")[1][:3]))
        # Cycles stretches the circle to the image: fy / fx = H / W
        lens = Equidistant(width / fov, **place, max_theta=fov / 2, aspect=height / width)
    good = torch.isfinite(rays).all(-1)
    pixels, seen = lens.project(rays[good])
    centres = pixel_grid(width, height, torch.float64)[good]
    assert seen.all()
    margin.at_most("residual", (pixels - centres).norm(dim=-1).max().item(), 0.005, "px")
    directions_, valid = lens.unproject(centres)
    assert valid.all()
    angle = torch.linalg.cross(directions_, rays[good], dim=-1).norm(dim=-1)
    margin.at_most("residual of rays x f", angle.max().item() * lens.fx, 0.005, "px")
    shift = (pixels - (centres - PIXEL_CENTRE)).norm(dim=-1).min().item()
    margin.mutant_exceeds("centres at +0.0", shift, 0.005, "px")
    assert shift == pytest.approx(0.707, abs=2e-3)
    if height != width:
        round_lens = replace(lens, focal=height / fov, aspect=1.0)
        shift = (round_lens.project(rays[good])[0] - centres).norm(dim=-1).max().item()
        margin.mutant_exceeds("one focal length for both axes", shift, 0.005, "px")


@pytest.mark.parametrize("degrees", [60, 90, 110, 170])
def test_06_the_rim(degrees, margin):
    quarter = pixel_grid(SIZE // 2, SIZE // 2, torch.float64)  # the others are its mirror images
    rho = np.hypot(*np.moveaxis(quarter.numpy().astype(np.longdouble) - CENTRE, -1, 0))
    for focal in (150.0, SIZE / math.pi):
        for lens in family(focal, max_theta=math.radians(degrees)):
            _, exact = lens.unproject(quarter)
            _, single = lens.unproject(quarter.float())
            margin.at_most("fp32 against fp64", int((exact != single).sum()), 0, "pixels")
            # a pixel is valid iff it lies within the circle of rays at `max_theta`
            circle, _ = lens.project(directions(lens.max_theta, azimuths(4)))
            rim = (circle - CENTRE).norm(dim=-1).mean().item()
            differ = int((exact.numpy() != (rho <= rim)).sum())
            margin.at_most("on the wrong side", differ, 0, "pixels")
            if rim < CENTRE:
                loose = replace(lens, max_theta=lens.max_theta * (1 - 1e-3))
                changed = int((loose.unproject(quarter)[1] != exact).sum())
                margin.mutant_exceeds("a rim a thousandth too small", changed, 0, "pixels")
