import math

import torch

from ntop.conventions import VIEWS
from ntop.geometry.rigs import Rig, top_view_cameras

RIG = Rig(1.2, 1.0, 1000, 1000, 1000 / math.pi)
PELVIS = torch.tensor([0.7, -1.3, 0.95], dtype=torch.float64)


def test_cameras_stand_where_their_names_say():
    cameras = top_view_cameras(RIG, PELVIS)
    assert tuple(cameras) == VIEWS
    offsets = {view: camera.center_world - PELVIS for view, camera in cameras.items()}
    assert torch.allclose(offsets["e"], torch.tensor([1.0, 0.0, 1.2], dtype=torch.float64))
    assert torch.allclose(offsets["n"], torch.tensor([0.0, 1.0, 1.2], dtype=torch.float64))
    azimuths = [math.atan2(offsets[v][1], offsets[v][0]) % (2 * math.pi) for v in VIEWS[1:]]
    assert azimuths == sorted(azimuths)  # counter-clockwise from +x


def test_rotations_are_proper_and_the_paper_mirrors_e_and_w():
    for camera in top_view_cameras(RIG, PELVIS).values():
        assert torch.linalg.det(camera.rotation) == 1
    ours = top_view_cameras(RIG, PELVIS)
    paper = top_view_cameras(RIG, PELVIS, paper_compat=True)
    assert torch.allclose(paper["e"].center_world, ours["w"].center_world)
    assert torch.allclose(paper["n"].center_world, ours["n"].center_world)
