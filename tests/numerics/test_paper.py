"""How the paper's own projection fails, and that ours does not: NUMERICS sections 0 to 1.

NToP (equations 2 and 3) builds a ray as q = (f tan(theta) cos(phi), f tan(theta) sin(phi), f) with
theta = rho / f, places cameras by "T = (x_p, y_p, h)" and samples between near and far of a box.
"""

import math

import numpy as np
import pytest
import torch

from ntop.body.model import load_body_model
from ntop.body.skinning import BodyPose, pose_body
from ntop.captures.studio.raycast import RayMesh
from ntop.conventions import VIEWS
from ntop.geometry.cameras import pixel_grid
from ntop.geometry.rigs import ROTATION_LOOKING_DOWN, Rig, top_view_cameras
from tests.numerics.lenses import CENTRE, SIZE, azimuths, directions, family, paper_rays

FOCAL = SIZE / math.pi  # 90 degrees at the middle of an edge
FINE, COARSE = torch.float64, torch.float32


@pytest.mark.parametrize("precision", [FINE, COARSE], ids=["fp64", "fp32"])
def test_table_1_the_papers_ray_at_each_angle(precision):
    lens = family(FOCAL)[0]
    quarter_pi = torch.tensor(math.pi / 2, dtype=precision).item()  # as the machine has it
    for degrees, expected in [
        (0.0, "not a number"),
        (1.0, "right"),
        (45.0, "right"),
        (89.0, "right"),
        (math.degrees(quarter_pi) if precision == COARSE else 90.0000001, "opposite"),
        (100.0, "opposite"),
        (130.0, "opposite"),
    ]:
        exact = directions(math.radians(degrees), azimuths(8))
        pixels, _ = lens.project(exact)
        ray = paper_rays(pixels.to(precision), FOCAL, CENTRE).double()
        unit = ray / ray.norm(dim=-1, keepdim=True)
        stable = lens.unproject(pixels.to(precision))[0].double()
        assert (stable - exact).norm(dim=-1).max() < 1e-6
        if expected == "not a number":
            assert unit.isnan().any()
        else:
            sign = 1 if expected == "right" else -1
            assert (unit - sign * exact).norm(dim=-1).max() < 2e-5, degrees
            length = FOCAL / abs(math.cos(math.radians(degrees)))
            if degrees in (1.0, 45.0, 89.0, 100.0, 130.0):
                assert ray.norm(dim=-1) == pytest.approx(np.full(8, length), rel=2e-5)


def standing_body():
    """The embedded body, arms down a little, pelvis at the origin, head up: vertices, faces."""
    model = load_body_model()
    body_pose = torch.zeros(69, dtype=torch.float64)
    body_pose[3 * 15 + 2], body_pose[3 * 16 + 2] = -1.1, 1.1  # shoulders: arms hang
    upright = torch.tensor([math.pi / 2, 0.0, 0.0], dtype=torch.float64)
    zero = torch.zeros(10, dtype=torch.float64)
    pose = BodyPose(zero, upright, body_pose, torch.zeros(3, dtype=torch.float64))
    body = pose_body(model, pose)
    vertices = body.vertices - body.joints[0]
    assert vertices[:, 2].max() > 0.6  # the head
    return vertices.numpy(), model.faces.numpy()


@pytest.mark.parametrize(
    ("height_m", "radius_m", "view", "least"),
    [(1.2, 1.0, "ne", 0.2), (1.0, 0.5, "ne", 0.1), (1.2, 1.0, "e", 0.0), (1.2, 1.0, "centre", 0.0)],
)
def test_ghosts_in_the_corners_of_an_unmasked_image(height_m, radius_m, view, least):
    rig = Rig(height_m, radius_m, SIZE, SIZE, FOCAL, math.radians(140))
    camera = top_view_cameras(rig, torch.zeros(3))[view]
    pixels = pixel_grid(SIZE, SIZE, FINE).reshape(-1, 2)
    rays, valid = camera.rays(pixels)
    beyond = (camera.lens.unproject(pixels)[0][:, 2] < 0).numpy()
    assert valid.all()
    assert beyond.mean() == pytest.approx(1 - math.pi / 4, abs=2e-3)  # 21.5 % of the image
    paper = paper_rays(pixels, FOCAL, CENTRE)
    paper = paper / paper.norm(dim=-1, keepdim=True) @ camera.rotation
    mesh = RayMesh(*standing_body())
    ours, theirs = np.zeros(len(rays), bool), np.zeros(len(rays), bool)
    ours[mesh.first_hits(camera.center_world.numpy(), rays.numpy()).ray] = True
    theirs[mesh.first_hits(camera.center_world.numpy(), paper.numpy()).ray] = True
    assert ours.sum() > 5000
    assert not (ours & beyond).any()  # nobody reaches up to the cameras
    assert np.array_equal(ours[~beyond], theirs[~beyond])  # inside 90 degrees both are right
    ghost = (theirs & beyond).sum() / ours.sum()
    assert least <= ghost < 0.6, f"{int((theirs & beyond).sum())} px, {ghost:.0%} of the subject"
    if least == 0:
        assert ghost < 0.05
    else:  # every ghost is the subject mirrored through the principal point, far out
        image = theirs.reshape(SIZE, SIZE)
        v, u = np.nonzero(image & beyond.reshape(SIZE, SIZE))
        assert ((u - CENTRE) > 0).all() and ((v - CENTRE) < 0).all()  # north-east corner


def test_the_papers_translation_mirrors_east_and_west():
    height, radius = 1.2, 1.0
    rotation = torch.tensor(ROTATION_LOOKING_DOWN, dtype=FINE)
    ours = top_view_cameras(Rig(height, radius, SIZE, SIZE, FOCAL), torch.zeros(3))
    for index, view in enumerate(VIEWS[1:]):
        azimuth = index * math.pi / 4
        place = torch.tensor(
            [radius * math.cos(azimuth), radius * math.sin(azimuth), height], dtype=FINE
        )
        centre = -(rotation.T @ place)  # o = -R^T T
        mirrored_place = place * torch.tensor([-1.0, 1.0, 1.0], dtype=FINE)
        assert torch.allclose(centre, mirrored_place)
        # only a reflection would put the centre where T says
        reflection = torch.diag(torch.tensor([-1.0, -1.0, -1.0], dtype=FINE))
        assert torch.allclose(-(reflection.T @ place), place)
        assert torch.linalg.det(reflection) == -1 and torch.linalg.det(rotation) == 1
        assert torch.allclose(ours[view].center_world, place)
    mirrored = top_view_cameras(
        Rig(height, radius, SIZE, SIZE, FOCAL), torch.zeros(3), paper_compat=True
    )
    swap = {"e": "w", "ne": "nw", "se": "sw", "w": "e", "nw": "ne", "sw": "se"}
    for view in VIEWS:
        expected = ours[swap.get(view, view)].center_world
        assert torch.allclose(mirrored[view].center_world, expected)


def test_planes_at_near_and_far_do_not_fit_a_fisheye():
    """Near and far along z, as a pinhole has them: metric steps grow with the angle.

    With q_z = 1 a step dt is dt / cos(theta) metres; forgetting |d| thins a sample of alpha 0.95.
    """
    for degrees, metric_mm, alpha in [(45, 14.1, 0.880), (60, 20, 0.777), (80, 57.6, 0.406),
                                      (89, 573, 0.051)]:  # fmt: skip
        theta = math.radians(degrees)
        pixel, _ = family(FOCAL)[0].project(directions(theta, azimuths(4)))
        ray = paper_rays(pixel, FOCAL, CENTRE) / FOCAL
        length = ray.norm(dim=-1)
        assert 10 * length == pytest.approx(np.full(4, metric_mm), rel=6e-3)
        tau = -math.log(1 - 0.95)  # of the true sample; divided by |d| where it is forgotten
        assert 1 - torch.exp(-tau / length) == pytest.approx(np.full(4, alpha), abs=2e-3)
    beyond = directions(math.radians(100), azimuths(4))
    assert (beyond[:, 2] < 0).all()  # a positive near plane excludes all that lies there
