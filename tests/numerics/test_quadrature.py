"""Cases 15, 20 to 24 and 28: from densities along a ray to a colour."""

import math

import numpy as np
import pytest
import torch

from ntop.conventions import ConfigError, DataError
from ntop.field import rendering, twin
from ntop.field.kernels.tables import VOID_RAW
from ntop.field.quality import RenderSettings
from ntop.field.rendering import trace_rays
from tests.numerics.scenes import DEFAULT_STEP_M, composed, cone, exact, posed_field, raw_of


def humannerf(tau, colour, dtype):
    """The compositing of HumanNeRF: 1 - exp, product of 1 - alpha + 1e-10."""
    alpha = 1 - torch.exp(-torch.from_numpy(tau).to(dtype))
    passing = torch.cumprod(1 - alpha + 1e-10, -1).roll(1, -1)
    passing[..., 0] = 1
    return ((alpha * passing)[..., None] * torch.from_numpy(colour).to(dtype)).sum(-2)


def ramp_ball():
    """A ball of radius 5 cm in a 16 cm box, opaque in its middle, its colour varying."""
    middle = np.full(3, 0.08)
    return posed_field(
        lambda p: 120 * (0.05 - np.linalg.norm(p - middle, axis=1)),
        size_m=(0.16, 0.16, 0.16),
        voxel_m=0.008,
        colour=lambda p: 30 * (p - middle),
    )


def ball_rays(count=400):
    return cone(np.full(3, 0.08), distance_m=0.7, spread_m=0.06, count=count)


def test_15_scaling_a_direction_changes_nothing(margin, monkeypatch):
    posed = ramp_ball()
    centre, directions = ball_rays()
    settings = exact(DEFAULT_STEP_M)
    unit = trace_rays(posed, centre, directions, settings=settings)
    assert unit.alpha.max() > 0.99
    for scale in (1e-3, 318.0, 1e3):
        scaled = trace_rays(posed, centre, scale * directions, settings=settings)
        margin.at_most("rgb", np.abs(scaled.rgb - unit.rgb).max(), 1e-5)
        margin.at_most("alpha", np.abs(scaled.alpha - unit.alpha).max(), 1e-5)
        margin.at_most("depth", np.abs(scaled.depth_m - unit.depth_m).max(), 1e-5, "m")
    # the mutant marches along whatever it is given
    monkeypatch.setattr(rendering, "unit_directions", lambda _, given: np.ascontiguousarray(given))
    mutant = trace_rays(posed, centre, 318.0 * directions, settings=settings)
    margin.mutant_exceeds("rgb, abs(d) ignored", np.abs(mutant.rgb - unit.rgb).max(), 1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_20_weights_and_passing_light_share_out_the_whole(margin, dtype):
    generator = np.random.default_rng(1)
    for samples in (1, 64, 1024):
        tau = 10 ** generator.uniform(-5, 1.5, (500, samples))
        colour = generator.random((500, samples, 3))
        seen = composed(tau, colour, dtype)
        white = composed(tau, np.ones((500, samples, 3)), dtype)
        limit = 4 * torch.finfo(dtype).eps * math.sqrt(samples)
        whole = white.rgb[:, 0] + white.transmittance - 1
        margin.at_most(f"sum of weights + T - 1, N={samples}", float(whole.abs().max()), limit)
        if dtype == torch.float64:
            passing = torch.prod(torch.exp(-torch.from_numpy(tau)) + 1e-10, -1)
            biased = humannerf(tau, np.ones((500, samples, 3)), dtype)[:, 0] + passing - 1
            margin.mutant_exceeds(
                f"1 - alpha + 1e-10, N={samples}", float(biased.abs().max()), limit
            )
        assert ((seen.opacity >= 0) & (seen.opacity <= 1)).all()
        low, high = (torch.from_numpy(f(colour, axis=1)) for f in (np.min, np.max))
        share = seen.rgb.double() / white.rgb.double()
        assert (share >= low - 1e-6).all() and (share <= high + 1e-6).all()
        # each weight by itself: the light of a single coloured sample
        for n in range(0, samples, max(1, samples // 16)):
            alone = np.zeros_like(colour)
            alone[:, n] = 1
            weight = composed(tau, alone, dtype).rgb
            assert ((weight >= 0) & (weight <= 1)).all()


def test_20_rendered_white_is_its_own_opacity(margin):
    posed = posed_field(
        lambda p: 800 * (0.05 - np.linalg.norm(p - 0.06, axis=1)),
        size_m=(0.12, 0.12, 0.12), voxel_m=0.006, colour=lambda p: np.full((len(p), 3), 40.0),
    )  # fmt: skip
    centre, directions = cone(np.full(3, 0.06), distance_m=0.7, spread_m=0.06, count=1000)
    seen = trace_rays(posed, centre, directions, settings=exact(DEFAULT_STEP_M))
    assert seen.alpha.min() == 0 and 0.99 < seen.alpha.max() <= 1
    margin.at_most("rgb - alpha of white", np.abs(seen.rgb - seen.alpha[:, None]).max(), 1e-6)


def mist(samples, generator, low=0.01, high=5.0):
    """Rays whose whole optical depth lies between `low` and `high`, in random pieces."""
    total = np.geomspace(low, high, 512)[:, None]
    share = generator.random((512, samples))
    return total * share / share.sum(1, keepdims=True), generator.random((512, samples, 3))


def test_21_single_precision_loses_nothing_that_is_seen(margin):
    generator = np.random.default_rng(2)
    scenes = {
        "mist": mist(1024, generator),
        "opaque": (60 * generator.random((512, 128)) ** 8, generator.random((512, 128, 3))),
        "thin": (np.full((512, 1024), 1e-4), generator.random((512, 1024, 3))),
    }
    for name, (tau, colour) in scenes.items():
        truth = composed(tau, colour).rgb
        single = composed(tau, colour, torch.float32).rgb.double()
        limit = 1e-7 if name == "thin" else 5e-7
        margin.at_most(f"{name}, fp32", float((single - truth).abs().max()), limit)
        halves = [a.astype(np.float16).astype(np.float64) for a in (tau, colour)]
        stored = composed(*halves, torch.float32).rgb.double()
        margin.at_most(f"{name}, stored in fp16", float((stored - truth).abs().max()), 3e-4)
        mutant = humannerf(tau, colour, torch.float32).double()
        if name != "opaque":
            margin.mutant_exceeds(
                f"{name}, 1 - exp and 1e-10", float((mutant - truth).abs().max()), limit
            )
    # the renderer: a thin homogeneous mist, a thousand steps long
    density = 0.2
    posed = posed_field(
        lambda p: np.full(len(p), raw_of(np.array(density))),
        size_m=(0.06, 0.06, 0.6), voxel_m=0.012, colour=lambda p: np.full((len(p), 3), 40.0),
    )  # fmt: skip
    seen = trace_rays(
        posed,
        torch.tensor([0.03, 0.03, -0.1], dtype=torch.float64),
        torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64),
        settings=exact(0.0005),
    )
    margin.at_most("rendered mist", abs(seen.rgb[0, 0] - seen.alpha[0]), 1e-7)
    truth = -math.expm1(-density * 0.6)
    margin.at_most("rendered mist, closed form", abs(seen.alpha[0] - truth), 1e-7)


@pytest.mark.parametrize("value", [math.inf, 1e30, -math.inf, -1e30, math.nan])
def test_22_broken_densities_never_make_nan_pixels(value):
    def raw(points):
        values = 100 * (0.05 - np.linalg.norm(points - 0.06, axis=1))
        values[:: len(values) // 7] = value
        return values

    posed = posed_field(raw, size_m=(0.12, 0.12, 0.12), voxel_m=0.006)
    centre, directions = cone(np.full(3, 0.06), distance_m=0.7, spread_m=0.06, count=500)
    for stop in (0.0, 1e-3):
        try:
            seen = trace_rays(
                posed, centre, directions, settings=exact(0.003, stop_transmittance=stop)
            )
        except DataError as error:
            assert "finite" in str(error)
            continue
        for part in (seen.rgb, seen.alpha, seen.depth_m):
            assert np.isfinite(part).all()
        assert ((seen.alpha >= 0) & (seen.alpha <= 1)).all()
    # compositing itself: an infinite depth is opaque, whatever lies behind it
    tau = np.array([[0.3, 1e30, 0.2], [math.inf, 1.0, math.inf], [0.0, 0.0, 0.0]])
    seen = composed(tau, np.ones((3, 3, 3)))
    assert torch.isfinite(seen.rgb).all()
    assert seen.opacity.tolist() == [1.0, 1.0, 0.0]


def test_22_broken_colours_are_an_error():
    posed = posed_field(
        lambda p: np.full(len(p), 2.0), size_m=(0.06, 0.06, 0.06), voxel_m=0.006,
        colour=lambda p: np.full((len(p), 3), math.nan),
    )  # fmt: skip
    centre, directions = cone(np.full(3, 0.03), distance_m=0.7, spread_m=0.02, count=10)
    with pytest.raises(DataError, match="finite"):
        trace_rays(posed, centre, directions, settings=exact(0.003))


@pytest.mark.parametrize("step", [0.0, -0.003, math.nan, math.inf])
def test_22_a_step_that_is_none_is_refused(step):
    with pytest.raises(ConfigError, match="step_m"):
        RenderSettings(step_m=step)


@pytest.mark.parametrize("depth", [0.0, -0.5, math.nan])
def test_22_a_piece_without_depth_is_refused(depth):
    with pytest.raises(ConfigError, match="piece_depth"):
        RenderSettings(piece_depth=depth)


@pytest.mark.parametrize("value", [math.nan, math.inf, -0.5])
@pytest.mark.parametrize(
    "name", ["stop_transmittance", "colour_floor", "phase", "extent", "edge_rays"]
)
def test_22_settings_that_mean_nothing_are_refused(name, value):
    """A colour_floor of NaN, for one, would give a black person without a word."""
    with pytest.raises(ConfigError, match=name):
        RenderSettings(**{name: value})


@pytest.mark.parametrize("direction", [[0.0, 0.0, 0.0], [math.nan, 0.0, 1.0], [math.inf, 0.0, 1.0]])
def test_22_directions_that_point_nowhere_are_refused(direction):
    posed = ramp_ball()
    directions = torch.tensor([[0.0, 0.0, 1.0], direction], dtype=torch.float64)
    with pytest.raises(DataError, match="direction"):
        trace_rays(posed, torch.zeros(3), directions, settings=exact(0.003))


def test_22_rays_without_samples_see_nothing():
    posed = ramp_ball()
    middle = torch.full((3,), 0.08, dtype=torch.float64)
    away = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    # the box lies behind: its interval is reversed
    behind = trace_rays(posed, middle + 2 * away, away[None], settings=exact(0.003))
    assert behind.alpha.tolist() == [0.0] and behind.evaluations == 0
    nothing = posed_field(lambda p: np.full(len(p), VOID_RAW), size_m=(0.16,) * 3, voxel_m=0.008)
    void = trace_rays(nothing, middle - 2 * away, away[None], settings=exact(0.003))
    assert void.alpha.tolist() == [0.0] and not void.rgb.any() and void.depth_m.tolist() == [0.0]
    none = trace_rays(posed, middle, torch.zeros(0, 3), settings=exact(0.003))
    assert none.rgb.shape == (0, 3)
    # N = 1: a step longer than the box
    one = trace_rays(posed, middle + 0.5 * away, -away[None], settings=exact(1.0))
    assert np.isfinite(one.rgb).all() and 0 <= one.alpha[0] <= 1


@pytest.mark.parametrize("stop", [1e-4, 1e-3, 1e-2])
def test_23_stopping_early_costs_no_more_than_the_light_left(margin, stop):
    posed = ramp_ball()
    centre, directions = ball_rays(4000)
    whole = trace_rays(posed, centre, directions, settings=exact(0.002))
    stopped = trace_rays(posed, centre, directions, settings=exact(0.002, stop_transmittance=stop))
    assert stopped.evaluations < whole.evaluations
    seen = whole.alpha > 0.02
    # over mid-grey: what was not marched is filled with the background
    on_grey = [rays.rgb + 0.5 * (1 - rays.alpha[:, None]) for rays in (stopped, whole)]
    difference = np.abs(on_grey[0] - on_grey[1]).max(1)[seen]
    margin.at_most(f"stop {stop:g}: pixel / bound", difference.max() / stop, 1)
    margin.at_most(f"stop {stop:g}: mean / bound", difference.mean() / stop, 0.4)


def test_24_neither_order_nor_company_changes_a_ray():
    posed = ramp_ball()
    centre, directions = ball_rays(1000)
    settings = RenderSettings()
    whole = trace_rays(posed, centre, directions, settings=settings)
    shuffled = torch.from_numpy(np.random.default_rng(3).permutation(1000))
    moved = trace_rays(posed, centre, directions[shuffled], settings=settings)
    few = trace_rays(posed, centre, directions[400:537], settings=settings)
    again = trace_rays(posed, centre, directions, settings=settings)
    for name in ("rgb", "alpha", "depth_m", "parts"):
        first = getattr(whole, name)
        assert getattr(moved, name).tobytes() == first[shuffled.numpy()].tobytes(), name
        assert getattr(few, name).tobytes() == first[400:537].tobytes(), name
        assert getattr(again, name).tobytes() == first.tobytes(), name


def test_28_compositing_has_right_and_finite_gradients(margin):
    generator = torch.Generator().manual_seed(4)
    raw = 4 * torch.randn(5, 7, 4, generator=generator, dtype=torch.float64)
    normals = torch.nn.functional.normalize(
        torch.randn(5, 7, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    light = torch.zeros(9, 3, dtype=torch.float64)
    light[0] = 1

    def seen(values):
        found = twin.seen_rays(values, normals, light, step_m=0.003)
        return found.rgb, found.opacity, found.transmittance

    assert torch.autograd.gradcheck(seen, (raw.requires_grad_(),))
    for dtype in (torch.float32, torch.float64):
        extreme = torch.linspace(-50, 90, 57, dtype=dtype)
        for alpha in (0.0, 1.0):  # of what lies before: nothing, or a wall
            wall = torch.full((57, 1, 4), 90.0 if alpha else -50.0, dtype=dtype)
            values = torch.cat([wall, extreme[:, None, None].expand(57, 1, 4)], 1)
            values = values.clone().requires_grad_()
            found = twin.seen_rays(
                values, normals[:1, :2].to(dtype).expand(57, 2, 3), light.to(dtype), step_m=0.003
            )
            for part in (found.rgb, found.opacity, found.transmittance):
                assert torch.isfinite(part).all()
            (found.rgb.sum() + found.opacity.sum()).backward()
            margin.at_most(
                f"gradients that are not finite, {dtype}",
                int((~torch.isfinite(values.grad)).sum()), 0,
            )  # fmt: skip
    # the mutant: an infinite density times the zero length of a padded sample
    padded = torch.tensor([90.0], dtype=torch.float16, requires_grad=True)
    (torch.exp(padded) * torch.zeros(1, dtype=torch.float16)).backward()
    margin.mutant_exceeds("inf * 0", float(padded.grad), 0)
