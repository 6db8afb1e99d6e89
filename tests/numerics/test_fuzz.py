"""Case 42: any camera, pose, field and image size gives finite pixels and labels, or says why not.

Examples are derandomised: every run draws the same ones. "Never hang" is a bound on the work done
(density look-ups), not on a clock.
"""

import functools
import math
import resource
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from ntop.annotation.annotate import ViewImages, annotate_view
from ntop.body.model import load_body_model
from ntop.body.skinning import BodyPose
from ntop.conventions import MASK_ALPHA, NtopError
from ntop.field.avatar import Avatar, load_avatar, save_avatar
from ntop.field.canonical import (
    CanonicalGrid,
    canonical_body,
    dense_voxels,
    initial_grid,
    label_grid,
)
from ntop.field.kernels.tables import EMPTY_RAW
from ntop.field.posing import PosedAvatar
from ntop.field.quality import RenderSettings
from ntop.field.rendering import Rendering, render_view
from ntop.field.warp import MAX_NODES, occupied, pose_warp
from ntop.geometry.cameras import Camera, Lens
from ntop.geometry.ideal_fisheyes import Equidistant, Equisolid, Stereographic
from ntop.geometry.kannala_brandt import KannalaBrandt
from ntop.geometry.pinhole import Pinhole
from ntop.geometry.rotations import matrix_from_axis_angle
from ntop.metrics.images import Cutout, psnr_person_db
from ntop.report.inputs import Dataset
from ntop.storage import schemas
from ntop.storage.atomic import write_bytes
from ntop.storage.images import encode_depth, encode_parts, encode_rgba
from ntop.storage.png import decode_png
from ntop.storage.renders import body_columns
from ntop.storage.tables import write_table

BETAS = (0.0,) * 10
CELL_M, REACH_M = 0.06, 0.03
STRETCH = 6.0  # of canonical lengths against posed ones: no map of a vertex has as much
MEMORY_LIMIT_MB = 1500


@functools.cache
def field(kind: str) -> tuple[CanonicalGrid, np.ndarray, np.ndarray]:
    """A canonical grid, its occupancy's cells and their origin."""
    body = canonical_body(load_body_model(), BETAS)
    grid = initial_grid(body, voxel_m=0.03, outer_m=REACH_M, inner_m=REACH_M)
    values = grid.values.copy()
    noise = np.random.default_rng(42).normal(size=values[64:].shape)
    match kind:
        case "empty":
            values[:, 0] = -12
        case "solid":
            values[64:, 0] = 1e4
        case "noise":
            values[64:] = 50 * noise
        case "huge colours":
            values[64:, 1:] = 6e4 * noise[:, 1:]
    grid = replace(grid, values=values.astype(np.float32))
    return grid, dense_voxels(grid, raw_threshold=EMPTY_RAW), label_grid(body)


FIELDS = ("body", "empty", "solid", "noise", "huge colours")


def posed(kind: str, pose: BodyPose) -> PosedAvatar:
    """What `pose_avatar` makes, on a coarse grid, with the field's tables made once."""
    model = load_model()
    grid, occupancy, labels = field(kind)
    body = canonical_body(model, BETAS)
    warp = pose_warp(body, model, pose, cell_m=CELL_M, reach_m=REACH_M)
    light = np.zeros((9, 3), np.float32)
    light[0] = 1
    warp = replace(warp, tables=occupied(warp.tables, occupancy, extent=1.0))
    return PosedAvatar(grid=grid, warp=warp, light=light, labels=labels)


load_model = functools.cache(load_body_model)

ANY = st.sampled_from([math.nan, math.inf, -math.inf, 0.0, -1.0, 1e300, 1e-300])


def mostly(usual: st.SearchStrategy, odd: st.SearchStrategy) -> st.SearchStrategy:
    """One draw in forty is odd."""
    return st.integers(0, 39).flatmap(lambda n: odd if n == 0 else usual)


@st.composite
def lenses(draw) -> Callable[[], Lens]:
    """What makes a lens of any model, perhaps an impossible one (which raises)."""
    width = draw(mostly(st.integers(1, 24), st.sampled_from([0, -3, 1, 300])))
    height = draw(mostly(st.integers(1, 24), st.sampled_from([0, -3, 1, 300])))
    focal = draw(mostly(st.floats(0.5, 60), ANY))
    cx, cy = draw(st.floats(-5, 30)), draw(mostly(st.floats(-5, 30), ANY))
    size = {"cx": cx, "cy": cy, "width": width, "height": height}
    model = draw(st.sampled_from([Equidistant, Equisolid, Stereographic, KannalaBrandt, Pinhole]))
    if model is Pinhole:
        coefficients = draw(st.tuples(*[st.floats(-0.3, 0.3)] * 5))
        return partial(Pinhole, fx=focal, fy=focal * 1.1, distortion=coefficients, **size)
    max_theta = draw(mostly(st.floats(0.05, 3.1), ANY))
    if model is KannalaBrandt:
        coefficients = draw(st.tuples(*[st.floats(-0.1, 0.1)] * 4))
        fx, fy = focal, focal * 0.9
        size |= {"max_theta": max_theta, "distortion": coefficients}
        return partial(KannalaBrandt, fx=fx, fy=fy, **size)
    return partial(model, focal=focal, max_theta=max_theta, **size)


def vectors(size: int, bound: float) -> st.SearchStrategy:
    """Random vectors by seed (few draws, so that examples stay small), now and then an odd one."""

    def make(drawn: tuple[int, float]) -> torch.Tensor:
        seed, scale = drawn
        generator = torch.Generator().manual_seed(seed)
        return scale * torch.randn(size, generator=generator, dtype=torch.float64)

    scale = st.sampled_from([0.0, 1e-9, 0.1, 0.5, 1.0])
    usual = st.tuples(st.integers(0, 10**6), scale.map(lambda x: x * bound)).map(make)
    odd = ANY.map(lambda x: torch.full((size,), x, dtype=torch.float64))
    return mostly(usual, odd)


POSES = st.builds(BodyPose, vectors(10, 2.0), vectors(3, 3.0), vectors(69, 1.0), vectors(3, 2.0))


def turned_to(rotation: torch.Tensor, way: torch.Tensor) -> torch.Tensor:
    """A camera's rotation, turned by the smallest angle that makes it look along a world vector."""
    axis, way = rotation[2], way / way.norm()
    across = torch.linalg.cross(axis, way)
    angle = torch.atan2(across.norm(), axis @ way)
    turn = matrix_from_axis_angle(angle * across / across.norm())
    return rotation @ turn.T


def check_view(rendering: Rendering, camera: Camera, columns: dict) -> None:
    """Finite pixels in range, files that decode, labels that are numbers."""
    shape = (camera.lens.height, camera.lens.width)
    for values in (rendering.rgb, rendering.alpha, rendering.depth_m):
        assert values.shape[:2] == shape
        assert np.isfinite(values).all()
        assert values.min() >= 0
    assert max(rendering.rgb.max(), rendering.alpha.max()) <= 1
    stored = decode_png(encode_rgba(rendering.rgb, rendering.alpha))
    encode_parts(rendering.parts)
    if rendering.depth_m.max() < 6.5:  # files hold no more, and say so
        encode_depth(rendering.depth_m)
    mask = stored[..., 3] >= MASK_ALPHA
    assert not rendering.depth_m[~mask].any()
    row = columns | {"sample_id": "fuzz", "actor": "fuzz"}
    label = annotate_view(row, ViewImages(mask, rendering.depth_m, rendering.parts), camera=camera)
    assert len(label["persons"]) == bool(mask.any())
    for person in label["persons"]:
        for name, numbers in person.items():
            if name != "person_id":
                assert np.isfinite(np.array(numbers, float)).all(), name
        assert set(person["visibility_smpl24"]) <= {0, 1, 2}


OUTCOMES: Counter[str] = Counter()


@settings(
    max_examples=500,
    derandomize=True,
    deadline=None,
    database=None,
    phases=(Phase.explicit, Phase.generate),
    suppress_health_check=list(HealthCheck),
)
@given(
    make_lens=lenses(),
    center=vectors(3, 1.5),
    turn=vectors(3, 2.0),
    aimed=st.booleans(),
    pose=POSES,
    kind=st.sampled_from(FIELDS),
    step_m=mostly(st.sampled_from([0.01, 0.05, 0.3]), ANY),
    edge_rays=st.sampled_from([1, 4]),
)
def finite_or_refused(make_lens, center, turn, aimed, pose, kind, step_m, edge_rays):
    """One example; bad input may only end in an error that says what it is.

    Half of the cameras look at the body: of those that look anywhere, few see it, and how many
    depends on which constants hypothesis finds in the modules that are loaded.
    """
    try:
        lens = make_lens()
        rotation = matrix_from_axis_angle(turn)
        if aimed:
            rotation = turned_to(rotation, pose.transl - center)
        camera = Camera(lens, center, rotation)
        columns = body_columns(load_model(), pose)
        avatar = posed(kind, pose)
        settings_ = RenderSettings(step_m=step_m, edge_rays=edge_rays)
        rendering = render_view(avatar, camera, settings=settings_)
    except NtopError as error:
        assert len(str(error)) > 30, error
        OUTCOMES["refused"] += 1
        return
    tables = avatar.warp.tables
    # a ray crosses at most so many octants; in each, the faces of voxels on the way of either sheet
    # and the nodes of the lattice cut it into pieces: a look-up of the voxel, two densities a sheet
    octants = 2 * int(tables.dims[0].sum()) + 3
    faces = 3 * (STRETCH * avatar.warp.cell_m / avatar.grid.voxel_m + 1)
    length_m = float(np.linalg.norm(tables.dims[0])) * avatar.warp.cell_m
    pieces = octants * (2 * faces + 1) + length_m / step_m
    rays = lens.width * lens.height * (1 + (4 if edge_rays > 1 else 0))
    assert rendering.evaluations <= 5 * rays * pieces
    check_view(rendering, camera, columns)
    OUTCOMES["seen" if rendering.alpha.any() else "unseen"] += 1


def test_42_five_hundred_random_views_are_finite_or_refused(margin):
    OUTCOMES.clear()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    finite_or_refused()
    grown_mb = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024
    margin.at_most("memory", grown_mb, MEMORY_LIMIT_MB, "MB")
    margin.at_least("examples", sum(OUTCOMES.values()), 500)
    margin.at_least("views that show somebody", OUTCOMES["seen"], 50)
    margin.at_least("refused", OUTCOMES["refused"], 20)


def body_pose(**odd: float) -> BodyPose:
    """A standing body with one parameter that is no number."""
    zero = {"betas": 10, "global_orient": 3, "body_pose": 69, "transl": 3}
    values = {name: torch.zeros(size, dtype=torch.float64) for name, size in zero.items()}
    for name, value in odd.items():
        values[name][1] = value
    return BodyPose(**values)


@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("name", ["betas", "global_orient", "body_pose", "transl"])
def test_42_bodies_that_are_no_numbers_are_refused(name, value):
    pose = body_pose(**{name: value})
    with pytest.raises(NtopError, match="finite"):
        posed("body", pose)
    with pytest.raises(NtopError, match="finite"):
        body_columns(load_model(), pose)


def test_42_bodies_as_large_as_a_house_do_not_eat_the_memory():
    with pytest.raises(NtopError, match="at most"):
        posed("body", body_pose(betas=1e5))
    assert MAX_NODES * 16 < MEMORY_LIMIT_MB * 1e6


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"values": math.nan}, "1 in values"),
        ({"values": math.inf}, "1 in values"),
        ({"light": math.nan}, "1 in light"),
        ({"betas": math.nan}, "1 in betas"),
        ({"reach_m": math.nan}, "1 in lengths"),
        ({"reach_m": 0.0}, "1 in lengths"),
    ],
)
def test_42_avatars_of_a_diverged_training_are_refused(tmp_path, change, message):
    grid = field("body")[0]
    values, light = grid.values.copy(), np.zeros((9, 3), np.float32)
    values[100, 1] = change.get("values", values[100, 1])
    light[4, 2] = change.get("light", 0)
    betas = (change.get("betas", 0.0), *BETAS[1:])
    avatar = Avatar(replace(grid, values=values), light, betas, change.get("reach_m", 0.03), 7)
    save_avatar(avatar, tmp_path, write=write_bytes)
    with pytest.raises(NtopError, match=message):
        load_avatar(tmp_path)


@pytest.mark.parametrize("shape", [(0, 5), (5, 0), (0, 0)])
def test_42_images_without_pixels_are_refused(shape):
    with pytest.raises(NtopError, match="at least one pixel"):
        encode_rgba(np.zeros((*shape, 3)), np.zeros(shape))
    with pytest.raises(NtopError, match="at least one pixel"):
        encode_depth(np.zeros(shape))
    with pytest.raises(NtopError, match="at least one pixel"):
        encode_parts(np.zeros(shape, np.uint8))


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_42_pixels_that_are_no_numbers_are_neither_stored_nor_scored(value):
    rgb, alpha = np.full((4, 6, 3), 0.5), np.ones((4, 6))
    rgb[2, 3, 1] = value
    with pytest.raises(NtopError, match="1 values are not finite"):
        encode_rgba(rgb, alpha)
    with pytest.raises(NtopError, match="not finite"):
        psnr_person_db(Cutout(rgb, alpha), Cutout(np.full((4, 6, 3), 0.5), alpha))
    alpha[1, 1] = value
    with pytest.raises(NtopError, match="not finite"):
        encode_rgba(np.full((4, 6, 3), 0.5), alpha)


def test_42_a_camera_in_the_body_sees_finite_pixels():
    """Also one that stands on a vertex, where distance is zero."""
    pose = body_pose()
    avatar = posed("solid", pose)
    lens = Equidistant(focal=10.0, cx=16.0, cy=16.0, width=32, height=32, max_theta=3.0)
    columns = body_columns(load_model(), pose)
    for place in (columns["joints3d_world_m"][:3], canonical_body(load_model(), BETAS).vertices[7]):
        centre = torch.tensor(np.array(place), dtype=torch.float64)
        camera = Camera(lens, centre, torch.eye(3, dtype=torch.float64))
        check_view(render_view(avatar, camera), camera, columns)


def test_42_datasets_without_images_are_refused(tmp_path):
    write_table([], schema=schemas.MANIFEST, path=tmp_path / "manifest.parquet")
    with pytest.raises(NtopError, match="no rows"):
        Dataset.read(tmp_path)
