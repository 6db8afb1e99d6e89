"""Cases 17 to 19: how fast the error falls with the step, and what it is at the default.

The order shows where pieces of a ray are as long as the step: where faces of voxels and of the
warp's half cells, at which rays are cut too, are many steps apart.
"""

import math

import numpy as np
import pytest
import torch
from scipy.special import ndtr

from ntop.field.paper_sampler import trace_paper_rays
from ntop.field.rendering import trace_rays
from tests.numerics.scenes import (
    DEFAULT_STEP_M,
    brute_force,
    composed,
    cone,
    exact,
    order,
    posed_field,
    raw_of,
    rms,
    sigmoid,
)

BALL_DENSITY, BALL_M = 31.0, 0.05  # a homogeneous ball: 1/m, and its radius


def test_17_a_homogeneous_sphere_has_the_opacity_of_its_chord(margin):
    generator = np.random.default_rng(0)
    impact = BALL_M * generator.random(500)
    chord = 2 * np.sqrt(BALL_M**2 - impact**2)
    truth = -np.expm1(-BALL_DENSITY * chord)
    for samples in (1, 7, 512):
        tau = np.repeat((BALL_DENSITY * chord / samples)[:, None], samples, 1)
        clipped = composed(tau, np.ones((*tau.shape, 3)), torch.float32)
        margin.at_most(
            "clipped, fp32", np.abs(clipped.opacity.double().numpy() - truth).max(), 1e-6
        )
    # the mutant closes the last interval at 1e10 m, as HumanNeRF does
    tau = np.repeat((BALL_DENSITY * chord / 64)[:, None], 64, 1)
    tau[:, -1] = BALL_DENSITY * 1e10
    endless = composed(tau, np.ones((*tau.shape, 3))).opacity.numpy()
    margin.mutant_exceeds("last interval 1e10 long", np.abs(endless - truth).max(), 1e-6)


def optical_depths(rule, density, t, h):
    """Of the intervals [t, t + h], by one density at their left or middle, or by Gauss's two."""
    middle, gauss = t + h / 2, h / (2 * math.sqrt(3))
    match rule:
        case "left":
            return h * density(t)
        case "middle":
            return h * density(middle)
        case "gauss":
            return h / 2 * (density(middle - gauss) + density(middle + gauss))


def ball_alpha(rule, samples, impact, phase):
    """What a rule sees of the ball with samples that know nothing of where it begins."""
    half_chord = np.sqrt(BALL_M**2 - impact**2)[:, None]
    h = 4 * BALL_M / samples
    t = -2 * BALL_M + h * (np.arange(samples + 1) + phase[:, None] - 1)
    tau = optical_depths(rule, lambda t: BALL_DENSITY * (abs(t) < half_chord), t, h)
    return composed(tau, np.ones((*tau.shape, 3))).opacity.numpy()


def test_17_a_jump_that_is_not_clipped_caps_the_order_at_one(margin):
    generator = np.random.default_rng(0)
    impact, phase = BALL_M * np.sqrt(generator.random(4000)), generator.random(4000)
    truth = -np.expm1(-2 * BALL_DENSITY * np.sqrt(BALL_M**2 - impact**2))
    for rule in ("middle", "gauss"):
        errors = [rms(ball_alpha(rule, n, impact, phase) - truth) for n in (64, 128, 256, 512)]
        margin.at_least(f"unclipped, order, {rule}", order(errors), 0.9)
        margin.at_most(f"unclipped, order, {rule}", order(errors), 1.1)


def test_17_a_ball_in_a_grid_is_clipped_by_voxels(margin):
    """The ball as a jump between two nodes, a millimetre apart: no step resolves it."""
    middle = np.full(3, 0.06)
    posed = posed_field(
        lambda p: np.where(
            np.linalg.norm(p - middle, axis=1) < BALL_M, raw_of(np.array(BALL_DENSITY)), -12.0
        ),
        size_m=(0.12, 0.12, 0.12),
        voxel_m=0.001,
    )
    centre, directions = cone(middle, distance_m=0.7, spread_m=0.05, count=2000)
    fine = trace_rays(posed, centre, directions, settings=exact(0.00025)).alpha
    errors = [
        rms(trace_rays(posed, centre, directions, settings=exact(step)).alpha - fine)
        for step in (0.016, 0.008, 0.004)
    ]
    # rays are cut at the faces of voxels, so the error does not grow with the step
    margin.at_most("clipped by voxels, any step", max(errors), 1e-3)
    # the paper's samples, 19 to 5 mm apart, are not: order one through the same field and warp
    joints, phase = np.repeat(middle[None], 2, 0), np.random.default_rng(1).random(2000)
    errors = [
        rms(
            trace_paper_rays(
                posed, centre, directions, joints_world=joints, samples=samples, shift=phase
            ).alpha
            - fine
        )
        for samples in (33, 65, 129)
    ]
    margin.at_least("unclipped, order, paper's sampler", order(errors), 0.9)
    margin.mutant_exceeds("unclipped, paper's sampler", min(errors), 1e-3)


BLOB_DEPTH = 2.0  # a Gaussian blob's optical depth through its middle
BLOB_COLOUR_PER_M = 20.0  # of raw colour, along z


def blob_profiles(middle, width_m):
    """Raw density and raw colour of a Gaussian blob; the colour changes along the way."""
    peak = BLOB_DEPTH / (width_m * math.sqrt(2 * math.pi))

    def raw(points):
        squared = ((points - middle) ** 2).sum(1)
        return raw_of(peak * np.exp(-squared / (2 * width_m**2)))

    def colour(points):
        return np.repeat(BLOB_COLOUR_PER_M * (points - middle)[:, 2:], 3, 1)

    return raw, colour


def blob_truth(directions, *, distance_m, width_m):
    """Opacity in closed form; colour as the blob's own integral over its optical depth."""
    closest = distance_m * directions[:, 2]  # length to the point nearest the middle
    impact2 = distance_m**2 - closest**2
    total = BLOB_DEPTH * np.exp(-impact2 / (2 * width_m**2))
    t = np.linspace(-5.3 * width_m, 5.3 * width_m, 8001)
    peak = BLOB_DEPTH / (width_m * math.sqrt(2 * math.pi))
    density = peak * np.exp(-(t**2 + impact2[:, None]) / (2 * width_m**2))
    before = total[:, None] * ndtr(t / width_m)
    along = (closest[:, None] + t) * directions[:, 2:] - distance_m
    seen = np.trapezoid(np.exp(-before) * density * sigmoid(BLOB_COLOUR_PER_M * along), t, axis=1)
    return -np.expm1(-total), seen


def test_18_a_gaussian_blob_is_its_closed_form_at_the_default_step(margin):
    size, width, distance = (0.024, 0.024, 0.424), 0.04, 0.9
    middle = np.array(size) / 2
    raw, shown = blob_profiles(middle, width)
    posed = posed_field(raw, size_m=size, voxel_m=0.001, colour=shown)
    centre, directions = cone(middle, distance_m=distance, spread_m=0.008, count=300)
    alpha, colour = blob_truth(directions.numpy(), distance_m=distance, width_m=width)
    seen = trace_rays(posed, centre, directions, settings=exact(DEFAULT_STEP_M))
    margin.at_most("alpha at the default step", np.abs(seen.alpha - alpha).max(), 1e-4)
    margin.at_most("colour at the default step", np.abs(seen.rgb[:, 0] - colour).max(), 1e-4)


def step_errors(posed, rays, colour, steps):
    """Rms error of the first colour at each step."""
    return [rms(trace_rays(posed, *rays, settings=exact(s)).rgb[:, 0] - colour) for s in steps]


def test_18_a_gaussian_blob_converges_with_the_second_order(margin):
    # three voxels along each side, longer than 8 of the longest steps, and one cell of the warp:
    # a piece that ends at a face is shorter than the step, and hides a part of the order
    voxel, width = 0.128, 0.08
    size = 3 * voxel
    raw, shown = blob_profiles(np.full(3, size / 2), width)
    posed = posed_field(raw, size_m=(size,) * 3, voxel_m=voxel, colour=shown, cell_m=2.5 * size)
    rays = cone(np.full(3, size / 2), distance_m=0.9, spread_m=0.08, count=100)
    alpha, colour = brute_force(raw, shown, size_m=size, voxel_m=voxel, rays=rays, samples=8000)
    errors = step_errors(posed, rays, colour, (0.016, 0.008, 0.004, 0.002))
    margin.at_least("order of the rule", order(errors), 1.9)
    # two densities per piece: opacity is of the fourth order, and exact before colour is
    seen = trace_rays(posed, *rays, settings=exact(0.016))
    margin.at_most("alpha, any step", np.abs(seen.alpha - alpha).max(), 1e-6)


def slab_rule(rule, samples, *, start=0.0):
    """Rms colour error of a rule on a soft slab over 60 phases, compositing as specified.

    The slab (200/m) begins softly within a centimetre, a metre into a 2 m ray.
    """
    length = 2.0
    h = (length - start) / samples
    surface = 1 + h * (np.arange(60) / 60)[:, None]

    def density(t):
        return 200 * ndtr((t - surface) / 0.01)

    def colour(t):
        return np.repeat(sigmoid(30 * (t - surface))[..., None], 3, -1)

    t = start + h * np.arange(samples)[None]
    tau = optical_depths(rule, density, t, h)
    at = t if rule == "left" else t + h / 2
    seen = composed(tau, colour(np.broadcast_to(at, (60, samples))))
    return seen.rgb.numpy(), surface


def slab_errors(rule, counts, *, start=0.0):
    found = []
    for count in counts:
        # the truth belongs to the same phases: surfaces follow the coarse step
        fine, _ = slab_truth(count, start)
        found.append(rms(slab_rule(rule, count, start=start)[0] - fine))
    return found


def slab_truth(count, start, samples=16384):
    length = 2.0
    surface = 1 + (length - start) / count * (np.arange(60) / 60)[:, None]
    h = (length - start) / samples
    t = start + h * (np.arange(samples) + 0.5)[None]
    tau = 200 * ndtr((t - surface) / 0.01) * h
    colour = np.repeat(sigmoid(30 * (t - surface))[..., None], 3, -1)
    return composed(tau, colour).rgb.numpy(), surface


def test_19_two_densities_beat_one_on_a_soft_slab(margin):
    counts = (128, 256, 512)
    left, middle, gauss = (slab_errors(rule, counts) for rule in ("left", "middle", "gauss"))
    margin.at_least("order, midpoint", order(middle), 1.9)
    margin.at_least("order, Gauss-2", order(gauss), 1.9)
    margin.at_least("left over Gauss-2 at N=128", left[0] / gauss[0], 5)
    # a ray that starts inside the slab has an end that does not vanish: left falls to order one
    left, middle, gauss = (
        slab_errors(rule, counts, start=1.02) for rule in ("left", "middle", "gauss")
    )
    margin.at_least("order from inside, midpoint", order(middle), 1.9)
    margin.at_least("order from inside, Gauss-2", order(gauss), 1.9)
    margin.mutant_exceeds("2 - order of the left rule from inside", 2 - order(left), 0.1)


@pytest.mark.parametrize(
    ("voxel_m", "cell_m", "steps_m"),
    [(0.064, 0.48, (0.008, 0.004, 0.002, 0.001)), (0.002, 0.0096, (0.016, 0.008, 0.004))],
    ids=["long voxels", "short voxels"],
)
def test_19_a_soft_slab_converges_in_the_renderer(margin, voxel_m, cell_m, steps_m):
    size = 0.192
    middle = np.full(3, size / 2)

    def raw(points):
        return raw_of(200 * ndtr((points - middle)[:, 2] / 0.01))

    def shown(points):
        return np.repeat(30 * (points - middle)[:, 2:], 3, 1)

    posed = posed_field(raw, size_m=(size,) * 3, voxel_m=voxel_m, colour=shown, cell_m=cell_m)
    rays = cone(middle, distance_m=0.8, spread_m=0.03, count=100)
    _, colour = brute_force(raw, shown, size_m=size, voxel_m=voxel_m, rays=rays, samples=12000)
    errors = step_errors(posed, rays, colour, steps_m)
    if voxel_m > max(steps_m):
        margin.at_least("order, renderer, long voxels", order(errors), 1.9)
    else:
        # a piece never reaches over a face of a voxel, so longer steps cost nothing
        margin.at_most("colour, renderer, short voxels, any step", max(errors), 1e-4)
