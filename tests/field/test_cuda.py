"""The GPU's kernels against the CPU's and the twin: simulated, or on a GPU where there is one."""

import copy
import math
import os
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numba import cuda

from ntop.field import twin
from ntop.field.canonical import Occupancy, PartLabels
from ntop.field.checkpoints import TrainingState
from ntop.field.kernels.tables import TINY_M
from ntop.field.learners import CpuLearner, StepRule
from ntop.field.marching import MarchRule, Rays, march_on_cpu
from ntop.field.packing import packed_scene
from ntop.field.posing import PosedAvatar
from ntop.field.quality import RenderSettings
from ntop.field.rendering import render_view
from ntop.field.views import RayBatch
from ntop.field.warp import identity_warp, joined
from ntop.geometry.cameras import Camera
from ntop.geometry.ideal_fisheyes import Equidistant
from tests.field.conftest import ball_grid, random_rays
from tests.field.test_kernels import light_of, twin_field

ROOT = Path(__file__).parents[2]
MARCHED, TRAINED = 24, 12
STEP_M = 0.01
# of colours between sheets that disagree, as the CPU's own when directions change by an ulp: 1.1e-5
# of 20,000 rays with steps of a micrometre over faces, 6e-8 with steps of a nanometre
JUMPS = max(1e-6, 10 * TINY_M)
SIMULATED = {"NUMBA_ENABLE_CUDASIM": "1", "NUMBA_DISABLE_JIT": "1", "CUDA_VISIBLE_DEVICES": "0"}
RULE = StepRule(
    step_m=STEP_M, stop=0.0, matte_weight=0.5, entropy_weight=0.03,
    smoothness=np.full(4, 1e-3), edge=np.full(4, 0.1), body_weight=1e-3,
    rates=np.array([0.3, 0.1, 0.1, 0.1]), betas=(0.9, 0.99), low=np.full(4, -12.0),
    high=np.full(4, 12.0),
)  # fmt: skip


def warps():
    """One pose with single sheets, and one whose every other cell has a second, 2 cm away."""
    warp = identity_warp(np.zeros(3), np.full(3, 0.62), cell_m=0.031)
    one = warp.tables._replace(
        occupancy=np.full_like(warp.tables.occupancy, 255),
        away=np.zeros_like(warp.tables.away),
    )
    moved = one.nodes + np.array([0.02, 0, 0, 0, 0, 0], np.float32)
    sheets = one.sheets.copy()
    sheets[::2, 1] = sheets[::2, 0] + len(one.nodes)
    two = one._replace(sheets=sheets, nodes=np.concatenate([one.nodes, moved]))
    return warp, one, two


def march_case():
    _, one, two = warps()
    origins, directions = random_rays(MARCHED)
    generator = np.random.default_rng(3)
    labels = PartLabels(generator.integers(1, 24, (7, 7, 7), np.uint8), np.zeros(3), 0.1)
    tables = joined([one, two])
    scene = packed_scene(ball_grid(), tables, light_of().astype(np.float32), labels)
    poses = np.arange(MARCHED) % 2
    rays = Rays(poses, origins, directions, generator.random(MARCHED))
    return scene, rays, MarchRule(STEP_M, math.inf, 0.0, 0.0, skipping=True)  # a bound jumps


def view_case():
    warp, _, two = warps()
    labels = PartLabels(np.ones((1, 1, 1), np.uint8), np.zeros(3), 1.0)
    light = light_of().astype(np.float32)
    posed = PosedAvatar(ball_grid(), replace(warp, tables=two), light, labels)
    lens = Equidistant(10.0, 4.0, 4.0, 8, 8, math.radians(90))
    centre = torch.tensor([0.3, 0.3, 0.9], dtype=torch.float64)
    down = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    return posed, Camera(lens, centre, down), RenderSettings(step_m=STEP_M, colour_floor=0.0)


def batch_of(seed):
    origins, directions = random_rays(TRAINED, seed=seed)
    generator = np.random.default_rng(seed)
    return RayBatch(
        poses=np.arange(TRAINED) % 2, cameras=np.arange(TRAINED) % 3, origins=origins,
        directions=directions, offsets=generator.random(TRAINED),
        backgrounds=generator.random((TRAINED, 3), np.float32),
        targets=generator.random((TRAINED, 3), np.float32),
        mattes=(generator.random(TRAINED) > 0.4).astype(np.float32),
        colour_weights=generator.uniform(0.2, 1, TRAINED).astype(np.float32),
        matte_weights=generator.uniform(0.2, 1, TRAINED).astype(np.float32),
    )  # fmt: skip


def slopes_of(batch):
    """Another loss' slopes in what is seen."""
    return np.random.default_rng(8).normal(size=(len(batch.poses), 3))


def learn_case():
    _, one, two = warps()
    gain = 0.1 * np.random.default_rng(4).normal(size=(3, 2, 3))
    nothing = Occupancy(np.zeros((1, 1, 1), np.uint8), np.zeros(3), 1.0)
    grid = ball_grid()
    state = TrainingState.fresh(grid=grid, occupancy=nothing, light=light_of(), gain=gain)
    anchors = np.zeros(len(grid.values), np.float32)
    return state, joined([one, two]), anchors, [batch_of(5), batch_of(6)], RULE


def run(folder, variables):
    """What `tests.field.cuda_simulation` computes of the cases, and the cases."""
    cases = {"march": march_case(), "view": view_case(), "learn": learn_case()}
    cases["slopes"] = slopes_of(cases["learn"][3][0])
    (folder / "cases").write_bytes(pickle.dumps(cases))
    subprocess.run(
        [sys.executable, "-m", "tests.field.cuda_simulation", folder / "cases", folder / "found"],
        cwd=ROOT, env={**os.environ, **variables}, check=True, timeout=300,
    )  # fmt: skip
    return cases, pickle.loads((folder / "found").read_bytes())


@pytest.fixture(
    scope="module",
    params=["simulator", pytest.param("device", marks=pytest.mark.gpu)],
)
def computed(request, tmp_path_factory):
    if request.param == "device" and not cuda.is_available():
        pytest.skip("there is no GPU")
    variables = SIMULATED if request.param == "simulator" else {"CUDA_VISIBLE_DEVICES": "0"}
    return run(tmp_path_factory.mktemp("cuda"), variables)


def test_marched_rays_equal_the_cpu_kernels(computed):
    cases, found = computed
    expected, got = march_on_cpu(*cases["march"]), found["march"]
    assert found["words"].startswith("GPU kernels on ")
    assert (expected.opacity > 0.5).mean() > 0.3
    # rounding decides at a face whether a ray is over it or goes on by `TINY_M` in the old octant;
    # where every other cell has a second sheet of other colours, these jump there
    off = np.abs(got.colours - expected.colours).max(1)
    one_sheet = cases["march"][1].poses == 0
    assert off[one_sheet].max() < 1e-6
    assert off.max() < JUMPS
    assert np.abs(got.opacity - expected.opacity).max() < 1e-6
    assert np.abs(got.depth_m - expected.depth_m).max() < 1e-6
    assert (got.parts == expected.parts).all()
    assert len(np.unique(got.parts)) > 3
    assert 0.8 < got.samples / expected.samples < 1.2


def test_a_view_equals_the_cpus(computed):
    cases, found = computed
    posed, camera, settings = cases["view"]
    expected, got = render_view(posed, camera, settings=settings), found["view"]
    assert (expected.alpha > 0.5).sum() > 5
    assert np.abs(got.alpha - expected.alpha).max() < 1e-6
    light, expected_light = (view.rgb * view.alpha[..., None] for view in (got, expected))
    assert np.abs(light - expected_light).max() < JUMPS
    assert (got.parts == expected.parts).all()


def test_sums_of_a_batch_equal_the_cpu_kernels(computed):
    cases, found = computed
    state, tables, anchors, batches, rule = cases["learn"]
    learner = CpuLearner(state, tables, anchors, blocks=1)
    for batch, got in zip(batches, found["sums"], strict=True):
        expected = learner.accumulate(batch, rule)
        for name in ("losses", "light", "gain"):
            one, other = getattr(got, name), getattr(expected, name)
            assert np.abs(other).max() > 0.01
            assert np.abs(one - other).max() < 1e-6 * np.abs(other).max()
    expected = learner._gradients[0]
    expected[:64] = 0
    got = found["gradients"] / found["units"]
    assert np.abs(got - expected).max() < 1e-6 * np.abs(expected).max()
    assert (found["touched"] == learner.touched()).all()


def test_what_rays_see_equals_the_cpu_kernels(computed):
    cases, found = computed
    state, tables, anchors, batches, rule = cases["learn"]
    expected = CpuLearner(state, tables, anchors, blocks=1).seen(batches[0], rule)
    assert (expected[:, 3] > 0.5).mean() > 0.2
    assert np.abs(found["seen"] - expected).max() < 1e-6


def test_gradients_with_extra_slopes_equal_the_cpu_kernels(computed):
    cases, found = computed
    state, tables, anchors, batches, rule = cases["learn"]
    learner = CpuLearner(state, tables, anchors, blocks=1)
    sums = learner.accumulate(batches[0], rule, slopes_of(batches[0]))
    expected = learner._gradients[0]
    expected[:64] = 0
    got = found["extra_gradients"] / found["units"]
    assert np.abs(got - expected).max() < 1e-6 * np.abs(expected).max()
    assert np.abs(found["extra_gain"] - sums.gain).max() < 1e-6 * np.abs(sums.gain).max()
    without = CpuLearner(state, tables, anchors, blocks=1)
    without.accumulate(batches[0], rule)
    assert np.abs(got - without._gradients[0]).max() > 0.1 * np.abs(expected).max()


def test_gradients_equal_autograd_of_the_twin(computed):
    cases, found = computed
    state, _, _, batches, _ = cases["learn"]
    _, one, two = warps()
    values = torch.from_numpy(state.grid.values.astype(np.float64)).requires_grad_()
    total = torch.zeros((), dtype=torch.float64)
    for batch in batches:
        for pose, tables in enumerate((one, two)):
            total = total + twin_loss(state, values, batch, batch.poses == pose, tables)
    total.backward()
    expected = values.grad.numpy()
    expected[:64] = 0
    got = found["gradients"] / found["units"]
    assert np.abs(got - expected).max() < 1e-4 * np.abs(expected).max()


def twin_loss(state, values, batch, chosen, tables):
    warp = replace(warps()[0], tables=tables)
    raw, normals = twin_field(
        state.grid, values, warp, batch.origins[chosen], batch.directions[chosen],
        batch.offsets[chosen],
    )  # fmt: skip
    light = torch.from_numpy(state.light)
    seen = twin.seen_rays(raw, normals, light, step_m=STEP_M)
    arrays = (
        batch.targets, batch.mattes, batch.backgrounds, batch.colour_weights,
        batch.matte_weights * RULE.matte_weight,
    )  # fmt: skip
    photograph = twin.Photograph(*(torch.from_numpy(a[chosen].astype(np.float64)) for a in arrays))
    gains = torch.from_numpy(state.gain[batch.cameras[chosen]])
    losses = [
        twin.ray_losses(
            twin.Composite(
                seen.rgb[r : r + 1], seen.opacity[r : r + 1], seen.transmittance[r : r + 1]
            ),
            twin.Photograph(**{k: v[r : r + 1] for k, v in vars(photograph).items()}),
            gains[r],
            entropy_weight=RULE.entropy_weight,
        )
        for r in range(int(chosen.sum()))
    ]
    return torch.cat(losses).sum()


def test_sums_do_not_depend_on_the_order_of_rays(computed):
    _, found = computed
    assert (found["shuffled_gradients"] == found["gradients"]).all()
    assert np.abs(found["gradients"]).max() > 0


def test_learned_values_equal_the_cpus(computed):
    cases, found = computed
    state, tables, anchors, batches, rule = copy.deepcopy(cases["learn"])
    learner, before = CpuLearner(state, tables, anchors, blocks=3), state.grid.values.copy()
    for batch in batches:
        learner.accumulate(batch, rule)
    learner.learn(learner.touched(), rule)
    learner.accumulate(batches[0], rule)
    learner.learn(learner.touched(), rule)
    got = found["state"]
    assert np.abs(state.grid.values - before).max() > 0.1
    assert (got.counts == state.counts).all()
    assert np.abs(got.first - state.first).max() < 1e-5 * np.abs(state.first).max()
    assert np.abs(got.second - state.second).max() < 1e-5 * np.abs(state.second).max()
    # Adam divides by a gradient's size: where that is rounding, so is the step
    off = np.abs(got.grid.values - state.grid.values)
    assert np.quantile(off, 0.999) < 1e-5
    assert off.max() < 0.02
    assert found["left"] == 0


def test_broken_numbers_are_refused(computed):
    _, found = computed
    assert "not finite" in found["broken"]
