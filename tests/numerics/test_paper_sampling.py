"""The paper's sampling, reproduced to document how it fails (findings 3 and 4 of the design).

HumanNeRF's 128 samples across the joints' box leave contour lines ("wood grain") wherever rays run
along the body: in a fisheye and in a pinhole at the same place alike.
"""

import math

import numpy as np
import pytest
import torch

from ntop.body.model import load_body_model
from ntop.body.skinning import pose_body
from ntop.field.paper_sampler import BOX_MARGIN_M, SAMPLES, box_interval, trace_paper_rays
from ntop.field.quality import RenderSettings
from ntop.field.rendering import trace_rays
from ntop.geometry.rigs import Rig, top_view_cameras
from ntop.metrics.stripes import lock_in
from ntop.report.stripes import pinhole_at, sampled_views
from tests.numerics.avatars import analytic_avatar, posed_at, standing
from tests.numerics.scenes import rms

SIZE = 400


@pytest.fixture(scope="module")
def person():
    joints = pose_body(load_body_model(), standing()).joints
    return posed_at(analytic_avatar(), standing()), joints


@pytest.fixture(scope="module")
def seen(person):
    """Interior pixels at (h=1.0, R=0.5), view e: rays, depth and converged colour, per lens."""
    posed, joints = person
    fisheye = top_view_cameras(Rig(1.0, 0.5, SIZE, SIZE, SIZE / math.pi), joints[0])["e"]
    found = {}
    for lens, camera in {"fisheye": fisheye, "pinhole": pinhole_at(fisheye, joints[0])}.items():
        settings = RenderSettings(step_m=0.002)
        mask = sampled_views(posed, camera, joints_world=joints.numpy(), settings=settings)[
            "ours"
        ].mask
        v, u = np.nonzero(mask)
        directions, _ = camera.rays(torch.from_numpy(np.stack([u, v], 1) + 0.5))
        fine = RenderSettings(step_m=0.0005, stop_transmittance=1e-5, colour_floor=0.0)
        truth = trace_rays(posed, camera.center_world, directions, settings=fine)
        found[lens] = camera.center_world, directions, truth, mask
    return found


def errors(person, seen, lens, *, samples=SAMPLES, shift=0.0):
    """The paper's error image, its rms in grey levels and its lock-in."""
    posed, joints = person
    centre, directions, truth, mask = seen[lens]
    rays = trace_paper_rays(
        posed, centre, directions, joints_world=joints.numpy(), samples=samples, shift=shift
    )
    error = np.zeros((*mask.shape, 3))
    error[mask] = rays.rgb - truth.rgb
    phase = np.zeros(mask.shape)
    phase[mask] = (truth.depth_m - rays.near_m) / rays.step_m
    return 255 * rms(error[mask] - error[mask].mean(0)), lock_in(error, phase, mask), rays


def test_steps_seen_from_above_are_centimetres(person, seen):
    for lens in seen:
        _, _, rays = errors(person, seen, lens)
        assert 0.009 < np.median(rays.step_m) < 0.018
    # from the side, the same sampler takes a third of that: the paper saw no stripes there
    _, joints = person
    side = joints[0].numpy() + np.array([0.0, 4.0, 0.0])
    near, far = box_interval(side, np.array([[0.0, -1.0, 0.0]]), joints.numpy())
    assert (far - near)[0] / (SAMPLES - 1) < 0.008


def test_stripes_are_there_in_fisheye_and_pinhole_alike_and_vanish_with_the_step(person, seen):
    found = {
        lens: [errors(person, seen, lens, samples=n)[1].amplitude for n in (128, 256, 512, 2048)]
        for lens in seen
    }
    for amplitudes in found.values():
        assert amplitudes[0] > 3
        assert amplitudes[0] > 1.5 * amplitudes[1] > 3 * amplitudes[2]
        assert amplitudes[3] < 0.05
    # the lens is not the cause
    assert found["pinhole"][0] == pytest.approx(found["fisheye"][0], rel=0.25)


def test_jitter_turns_stripes_into_noise_of_equal_rms(person, seen):
    generator = np.random.default_rng(0)
    for lens in seen:
        plain, stripes, _ = errors(person, seen, lens)
        shift = generator.random(len(seen[lens][1]))
        noisy, noise, _ = errors(person, seen, lens, shift=shift)
        assert stripes.z > 10 > 4 > noise.z
        assert noisy == pytest.approx(plain, rel=0.15)


def test_the_last_interval_makes_thin_air_opaque():
    """1e10 m of almost nothing: what leaves the box unabsorbed is absorbed in its last sample."""
    density, step = 1e-6, 0.01
    honest = 1 - math.exp(-density * step * SAMPLES)
    paper = 1 - math.exp(-density * step * (SAMPLES - 1)) * math.exp(-density * 1e10)
    assert honest < 2e-6
    assert paper == 1.0


def test_the_box_is_the_joints_and_a_margin():
    joints = np.array([[0.0, 0.0, 0.0], [0.2, 0.4, 1.0]])
    down = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    near, far = box_interval(np.array([0.1, 0.1, 3.0]), down, joints)
    assert near[0] == pytest.approx(2 - BOX_MARGIN_M) and far[0] == pytest.approx(3 + BOX_MARGIN_M)
    assert (far <= near)[1:].all()  # behind, and beside
    inside, out = box_interval(np.array([0.1, 0.1, 0.5]), down, joints)
    assert (inside == 0).all() and (out > 0).all()
