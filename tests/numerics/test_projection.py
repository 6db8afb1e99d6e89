"""Cases 1 to 6: pixel <-> ray, values and gradients, at the centre, at 90 degrees, at the rim."""

import math
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
    WIDE,
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


@pytest.mark.parametrize("precision", PRECISIONS, ids=BITS.values())
@pytest.mark.parametrize("focal", FOCALS)
def test_01_round_trip(focal, precision, margin):
    generator = torch.Generator().manual_seed(0)
    random = SIZE * torch.rand(100_000, 2, generator=generator, dtype=torch.float64).to(precision)
    for lens in (*family(focal), pinhole(max(focal, 500.0))):
        ideal = isinstance(lens, Equidistant | Equisolid | Stereographic)
        # at 2000 px per radian one ulp of a stereographic 170 degrees is already 7e-12 px
        extra = (169.9,) if ideal and focal < 1000 else ()
        for pixels, theta in (
            table_1_pixels(lens, precision, extra_degrees=extra),
            (random[lens.unproject(random)[1]], None),
        ):
            error, rays = round_trip(lens, pixels)
            if theta is None:  # the random ones lie on the image's own domain; the rim may round
                error = error[error.isfinite()]
                rays, pixels = rays.double(), pixels
                theta = torch.atan2(rays[:, :2].norm(dim=-1), rays[:, 2])[: len(error)]
            if precision == torch.float64:
                margin.at_most(f"{lens.model} fp64", float(error.max()), 1e-11, "px")
            else:
                scale = ulp(max(SIZE, float(pixels.abs().max())), precision)
                worst = float((error / (scale * condition(theta))).max())
                margin.at_most(f"{lens.model} fp32, in ulp(W) x condition", worst, 8)
    lens = family(focal)[0]
    beyond = lens.project(directions(torch.tensor(math.radians(100)), azimuths(400)))[0]
    mutant, _ = lens.project(paper_rays(beyond.to(precision), focal, CENTRE))
    shift = float((mutant.double() - beyond).norm(dim=-1).min())
    margin.mutant_exceeds("the paper's tan at 100 degrees", shift, 1, "px")
    near, theta = directions(torch.tensor(1e-4), azimuths(400)).float(), 1e-4
    exact = focal * theta * near.double()[:, :2] / near.double()[:, :2].norm(dim=-1)[:, None]
    shift = float((acos_projection(near, focal, 0.0) - exact).norm(dim=-1).max())
    margin.mutant_exceeds("acos at 1e-4 rad, fp32", shift, 8 * ulp(0.5 * focal * theta, torch.float32), "px")
