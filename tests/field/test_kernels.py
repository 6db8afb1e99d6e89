"""The kernels against their torch twins, values and gradients; laws of compositing."""

import math

import numba
import numpy as np
import pytest
import torch

from ntop.field import twin
from ntop.field.kernels.adjoint import train_rays
from ntop.field.kernels.march import RAYS_PER_CHUNK, render_rays
from ntop.field.kernels.tables import EMPTY_DENSITY
from ntop.field.learners import NO_SLOPES
from ntop.field.marching import EVERYWHERE
from ntop.field.packing import packed_density, packed_sheets
from tests.field.conftest import ball_grid, random_rays

STEP_M = 0.01
TWIN_STEP_M = 0.0005
RAYS = 300


def light_of(seed=2):
    light = 0.1 * np.random.default_rng(seed).normal(size=(9, 3))
    light[0] += 0.8
    return light


def rendered(grid, warp, origins, directions, *, offsets, light, stop=0.0, step_m=STEP_M):
    count = len(directions)
    colours, opacity = np.empty((count, 3), np.float32), np.empty(count, np.float32)
    depth, parts = np.empty(count, np.float32), np.empty(count, np.uint8)
    evaluations = np.zeros((-(-count // RAYS_PER_CHUNK), 2), np.int64)
    render_rays(
        grid.tables(), warp.tables, packed_density(grid), packed_sheets(grid.tables(), warp.tables),
        light, np.zeros((1, 1, 1), np.uint8), np.zeros(3), 1.0, np.zeros(1, np.int64), origins,
        directions, offsets, EVERYWHERE, step_m, np.inf, stop, 0.0, True, colours, opacity, depth,
        parts, evaluations,
    )  # fmt: skip
    return colours, opacity, depth, evaluations


def twin_field(grid, values, warp, origins, directions, offsets, *, step_m=STEP_M):
    samples = twin.place_samples(
        warp.tables, torch.from_numpy(origins), torch.from_numpy(directions),
        torch.from_numpy(offsets), step_m=step_m, count=round(2 / step_m),
    )  # fmt: skip
    return twin.field_at(grid.tables(), values, warp.tables, samples)


def test_rendered_rays_converge_to_the_twin(full_warp):
    ball, count = ball_grid(dtype=np.float64), 40
    origins, directions = random_rays(count)
    offsets = np.random.default_rng(0).random(count)
    light = light_of()
    raw, normals = twin_field(
        ball, torch.from_numpy(ball.values), full_warp, origins, directions, np.full(count, 0.5),
        step_m=TWIN_STEP_M,
    )  # fmt: skip
    expected = twin.seen_rays(
        raw, normals, torch.from_numpy(light), step_m=TWIN_STEP_M, empty_density=EMPTY_DENSITY
    )
    errors = []
    for step_m in (0.008, 0.004, 0.002):
        colours, opacity, _, _ = rendered(
            ball, full_warp, origins, directions, offsets=offsets, light=light, step_m=step_m
        )
        opacity_error = np.abs(opacity - expected.opacity.numpy()).max()
        errors.append(max(opacity_error, np.abs(colours - expected.rgb.numpy()).max()))
    assert (expected.opacity > 0.5).float().mean() > 0.3
    print(errors)
    assert errors[-1] < 2e-4
    assert errors[0] > 3 * errors[1] > 9 * errors[2]  # at least second order


def test_gradients_equal_autograd_of_the_twin(full_warp):
    grid = ball_grid(dtype=np.float64)
    count = RAYS
    origins, directions = random_rays(count, seed=5)
    generator = np.random.default_rng(7)
    offsets, light = generator.random(count), light_of()
    targets, backgrounds = generator.random((count, 3)), generator.random((count, 3))
    mattes = (generator.random(count) > 0.4).astype(np.float64)
    weights = generator.uniform(0.2, 1, (2, count))
    gain = 0.1 * generator.normal(size=(1, 2, 3))
    gradients = np.zeros((1, *grid.values.shape))
    touched = np.zeros((1, len(grid.positions)), np.uint8)
    light_gradients, gain_gradients = np.zeros((1, 9, 3)), np.zeros((1, 1, 2, 3))
    train_rays(
        grid.tables(), full_warp.tables, light, gain, np.zeros(count, np.int64),
        np.zeros(count, np.int64), origins, directions, offsets, targets, mattes, weights[0],
        weights[1], backgrounds, NO_SLOPES, STEP_M, 0.0, 0.03, gradients, touched, light_gradients,
        gain_gradients, np.zeros((1, 3)),
    )  # fmt: skip

    values = torch.from_numpy(grid.values.copy()).requires_grad_()
    torch_light = torch.from_numpy(light.copy()).requires_grad_()
    torch_gain = torch.from_numpy(gain[0].copy()).requires_grad_()
    raw, normals = twin_field(grid, values, full_warp, origins, directions, offsets)
    seen = twin.seen_rays(raw, normals, torch_light, step_m=STEP_M)
    photograph = twin.Photograph(
        *(torch.from_numpy(a) for a in (targets, mattes, backgrounds, weights[0], weights[1]))
    )
    twin.ray_losses(seen, photograph, torch_gain, entropy_weight=0.03).sum().backward()
    expected = values.grad.numpy()
    expected[:64] = 0  # the void is not learned
    got = gradients[0].copy()
    got[:64] = 0
    assert np.abs(expected).max() > 0.01
    assert np.abs(got - expected).max() < 1e-4 * np.abs(expected).max()
    # light skips samples that weigh less than 1e-3
    light_expected = torch_light.grad.numpy()
    assert np.abs(light_gradients[0] - light_expected).max() < 0.02 * np.abs(light_expected).max()
    assert np.allclose(gain_gradients[0, 0], torch_gain.grad.numpy(), rtol=1e-5, atol=1e-6)


def test_the_twin_passes_gradcheck():
    generator = torch.Generator().manual_seed(0)
    raw = torch.randn(4, 6, 4, generator=generator, dtype=torch.float64) * 3
    normals = torch.nn.functional.normalize(
        torch.randn(4, 6, 3, generator=generator, dtype=torch.float64), dim=-1
    )
    light = torch.from_numpy(light_of())

    def loss(values, coefficients):
        seen = twin.seen_rays(values, normals, coefficients, step_m=STEP_M)
        return seen.rgb, seen.opacity

    arguments = (raw.requires_grad_(), light.requires_grad_())
    assert torch.autograd.gradcheck(loss, arguments)


@pytest.mark.parametrize("depth", [0.0, 1e-4, 0.3, 60.0])
def test_weights_and_passing_light_sum_to_one(depth):
    tau = torch.full((3, 1024), depth, dtype=torch.float64)
    seen = twin.composite(tau, torch.ones(3, 1024, 3, dtype=torch.float64))
    assert (seen.rgb[:, 0] + seen.transmittance - 1).abs().max() < 1e-12


def test_a_homogeneous_ball_has_the_opacity_of_its_chord(full_warp):
    grid = ball_grid()
    grid.values[64:, 0] = -12.0
    raw = 2.0
    inner = np.stack(np.meshgrid(*[np.arange(4)] * 3, indexing="ij"), -1).reshape(-1, 3)
    nodes = (4 * grid.positions[1:, None] + inner).reshape(-1, 3) * grid.voxel_m
    grid.values[64:][np.abs(nodes - 0.3).max(1) <= 0.1 + 1e-9, 0] = raw
    origins, directions = np.array([[0.3, 0.3, -1.0]]), np.array([[0.0, 0.0, 1.0]])
    _, opacity, _, _ = rendered(
        grid, full_warp, origins, directions, offsets=np.array([0.5]), light=light_of()
    )
    density = 100 * math.log1p(math.exp(raw))
    assert 1 - opacity[0] < math.exp(-0.2 * density) * 1.05


def test_early_stop_changes_no_more_than_the_light_left(ball, full_warp):
    origins, directions = random_rays(RAYS)
    offsets = np.full(RAYS, 0.5)
    exact, _, _, many = rendered(
        ball, full_warp, origins, directions, offsets=offsets, light=light_of()
    )
    for stop in (1e-4, 1e-3, 1e-2):
        stopped, _, _, fewer = rendered(
            ball, full_warp, origins, directions, offsets=offsets, light=light_of(), stop=stop
        )
        assert np.abs(stopped - exact).max() <= stop * 1.5  # light may exceed one
        assert fewer.sum() < many.sum()


def test_same_bytes_whatever_the_number_of_threads(ball, full_warp):
    origins, directions = random_rays(2000)
    results = []
    before = numba.get_num_threads()
    for threads in {1, before}:
        numba.set_num_threads(threads)
        results.append(
            rendered(
                ball, full_warp, origins, directions, offsets=np.full(2000, 0.5), light=light_of()
            )
        )
    numba.set_num_threads(before)
    for other in results[1:]:
        assert all(a.tobytes() == b.tobytes() for a, b in zip(results[0], other, strict=True))


def test_rays_that_miss_everything_see_nothing(ball, full_warp):
    origins = np.array([[5.0, 5.0, 5.0]] * 3)
    directions = np.array([[1.0, 0, 0], [0, 0, 1.0], [0.0, -1.0, 0]])
    colours, opacity, depth, evaluations = rendered(
        ball, full_warp, origins, directions, offsets=np.full(3, 0.5), light=light_of()
    )
    assert not colours.any()
    assert not opacity.any()
    assert not depth.any()
    assert evaluations.sum() == 0
