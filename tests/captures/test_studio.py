"""The studio against analytic truth: spheres by ray casting, labels on mattes, equal bytes."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial import ConvexHull

from ntop.body.model import BodyModel, load_body_model
from ntop.body.skeletons import SMPL24_NAMES
from ntop.captures.checks import check_capture
from ntop.captures.studio import capture_studio
from ntop.captures.studio.actors import ACTORS, Actor, dress_actor, pose_actor
from ntop.captures.studio.capture import one_pose, sequence_poses
from ntop.captures.studio.patterns import inside, stripes
from ntop.captures.studio.raycast import RayMesh, vertex_normals
from ntop.captures.studio.recording import grown, side_cameras
from ntop.captures.studio.room import empty_room
from ntop.captures.studio.views import (
    Scene,
    light_actor,
    linear_to_srgb,
    see,
    srgb_to_linear,
    studio_light,
)
from ntop.captures.studio.visibility import VISIBILITY, measure_limbs, true_visibility
from ntop.config.sections import CaptureConfig
from ntop.config.sources import StudioSource
from ntop.config.tables import Sequence
from ntop.conventions import MASK_ALPHA, ConfigError
from ntop.geometry.cameras import Camera, Pinhole
from ntop.geometry.rigs import Rig, top_view_cameras
from ntop.storage import schemas
from ntop.storage.images import read_depth, read_matte, read_parts, read_rgba
from ntop.storage.renders import fisheye_camera
from ntop.storage.tables import read_table

GREY = 127.0
NO_PACKAGES = Path("no-packages")  # authored motions need none


def sphere(*, radius: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices on a sphere and their convex hull's outward faces."""
    index = np.arange(count) + 0.5
    height, turn = 1 - 2 * index / count, index * math.pi * (3 - math.sqrt(5))
    ring = np.sqrt(1 - height**2)
    points = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], -1)
    faces = ConvexHull(points).simplices
    corners = points[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = (normals * corners.mean(1)).sum(1) < 0
    faces[inward] = faces[inward][:, ::-1]
    return radius * points, faces


def config(**settings: object) -> CaptureConfig:
    """A tiny capture with one true set."""
    rows = [
        {"action": "range", "first": 0, "last": 150, "step": 50, "use": "train",
         "motion": "authored:range"},
        {"action": "sit", "first": 40, "last": 40, "use": "render", "motion": "authored:sit",
         "truth": True},
    ]  # fmt: skip
    source = {
        "reader": "studio", "num_cameras": 4, "image_size_px": 96, "supersampling": 2, "seed": 3,
        "provides": ["masks", "keypoints2d", "bodies"],
    } | settings  # fmt: skip
    return CaptureConfig.model_validate(
        {
            "source_section": source,
            "sequences": [{"source": "studio", "actor": "plain"} | row for row in rows],
            "rigs": {"near": {"height_above_pelvis_m": 1.0, "ring_radius_m": 0.5}},
            "image": {"width_px": 200, "height_px": 200},
        }
    )


def record(out: Path, **settings: object) -> Path:
    """Record the tiny capture into a folder."""
    out.mkdir()
    capture_studio(
        config(**settings), source="studio", actor="plain", packages=NO_PACKAGES, out=out
    )
    return out


@pytest.fixture(scope="module")
def model() -> BodyModel:
    """The embedded body."""
    return load_body_model()


@pytest.fixture(scope="module")
def plain(model: BodyModel) -> Actor:
    """The actor in tight clothes."""
    return dress_actor("plain", model)


@pytest.fixture(scope="module")
def reaching(plain: Actor) -> Scene:
    """The plain actor in a pose with raised arms."""
    sequence = Sequence(
        source="studio", actor="plain", action="reach", first=30, last=30, use="render",
        motion="authored:reach",
    )  # fmt: skip
    poses = sequence_poses(sequence, plain, NO_PACKAGES)
    return light_actor(plain, pose_actor(plain, one_pose(poses, 0)), studio_light(3.5))


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny capture."""
    return record(tmp_path_factory.mktemp("studio") / "capture")


def test_a_sphere_is_hit_where_geometry_says() -> None:
    vertices, faces = sphere(radius=0.5, count=4000)
    center = np.array([1000.0, -2.0, 0.7])  # far from the origin: float32 must not hurt
    camera = center + np.array([0.0, 0.0, 2.0])
    angles = np.linspace(-0.2, 0.2, 41)  # the sphere spans asin(0.25) = 0.2527 rad
    directions = np.stack([np.sin(angles), np.zeros(41), -np.cos(angles)], -1)
    hits = RayMesh(vertices + center, faces).first_hits(camera, directions)
    expected = 2 * np.cos(angles) - np.sqrt(0.5**2 - (2 * np.sin(angles)) ** 2)
    assert len(hits.ray) == 41
    # sagitta of a facet with 2.8 cm edges: 0.2 mm, more where the ray is oblique
    assert hits.distance_m == pytest.approx(expected, abs=6e-4)
    places = hits.interpolate(vertices, faces) + center
    along_ray = camera + hits.distance_m[:, None] * directions
    assert np.abs(places - along_ray).max() < 2e-6  # metres; embree is float32


def test_normals_of_a_sphere_point_outwards() -> None:
    vertices, faces = sphere(radius=0.5, count=1000)
    normals = vertex_normals(vertices, faces)
    assert ((normals * vertices).sum(-1) / 0.5).min() > 0.999


def test_srgb_round_trip() -> None:
    values = np.linspace(0, 1, 256)
    assert linear_to_srgb(srgb_to_linear(values)) == pytest.approx(values, abs=1e-6)
    assert srgb_to_linear(np.array(0.5)) == pytest.approx(0.214041, abs=1e-6)


def test_light_is_stronger_than_pinned() -> None:
    light = studio_light(StudioSource(reader="studio").light_to_ambient)
    assert light.directional >= 3 * light.ambient
    assert light.directional + light.ambient == pytest.approx(1)
    assert np.linalg.norm(light.towards_light_world) == pytest.approx(1)


def test_edges_are_smooth_over_their_width() -> None:
    assert inside(np.array([-0.004, 0.0, 0.004])) == pytest.approx([0, 0.5, 1])
    across = np.linspace(0, 0.1, 10001)
    painted = stripes(across, period_m=0.05, width_m=0.02).mean()
    assert painted == pytest.approx(0.4, abs=1e-3)  # width over period
    steepest = np.abs(np.diff(stripes(across, period_m=0.05, width_m=0.02))).max() / 1e-5
    assert steepest <= 1.5 / 0.008 + 1  # no detail finer than the edge


@pytest.mark.parametrize("name", ACTORS)
def test_clothes_lie_outside_the_body_and_follow_it(name: str, model: BodyModel) -> None:
    actor = dress_actor(name, model)
    assert actor.lbs_weights.sum(1) == pytest.approx(1, abs=1e-5)
    skirt = np.unique(actor.faces[actor.surface > 0])
    assert (len(skirt) > 0) == (name == "loose")
    if len(skirt):
        normals = vertex_normals(actor.rest_vertices, actor.faces)[skirt]
        outwards = actor.rest_vertices[skirt] * (1, 0, 1)
        assert (normals * outwards).sum(1).min() > 0
        hips = [SMPL24_NAMES.index(f"{side}_hip") for side in ("left", "right")]
        assert actor.lbs_weights[skirt][:, hips].sum(1).max() > 0.5
    chest = actor.marks.joint("spine3")
    body = slice(0, len(model.v_template))
    near = np.abs(actor.texture_points[body] - chest).max(1) < 0.12
    moved = (actor.rest_vertices - actor.texture_points)[body][near]
    assert np.linalg.norm(moved, axis=1).min() > 0.002  # metres of cloth


def test_an_unknown_actor_is_refused(model: BodyModel) -> None:
    with pytest.raises(ConfigError, match="no actor 'ghost'"):
        dress_actor("ghost", model)


def test_supersampling_converges(reaching: Scene) -> None:
    """Coverage and colours with rays on outlines only, against many rays everywhere."""
    lens = Pinhole(fx=130, fy=130, cx=60, cy=60, width=120, height=120)
    camera = side_cameras(StudioSource(reader="studio"))["cam02"]
    camera = Camera(lens, camera.center_world, camera.rotation)
    usual, fine = (see(reaching, camera, supersampling=count) for count in (4, 16))
    assert np.abs(usual.alpha - fine.alpha).max() <= 0.2
    assert abs(usual.alpha.sum() / fine.alpha.sum() - 1) < 0.003
    solid = (usual.alpha == 1) & (fine.alpha == 1)
    assert np.sqrt(((usual.rgb - fine.rgb)[solid] ** 2).mean()) < 0.03  # 2 cm pixels
    assert ((usual.depth_m > 0) == (np.rint(usual.alpha * 255) >= MASK_ALPHA)).all()
    assert ((usual.depth_m > 0) == (usual.parts > 0)).all()


def test_depth_is_the_ray_length_of_a_vertex(reaching: Scene) -> None:
    """Vertices that the mesh itself says are first on their ray appear at their distance."""
    rig = Rig(1.2, 1.0, width=1000, height=1000, focal_px=1000 / math.pi)
    pelvis = torch.from_numpy(reaching.posed.joints_world[0])
    camera = top_view_cameras(rig, pelvis)["ne"]
    view = see(reaching, camera, supersampling=2)
    vertices = reaching.posed.vertices_world
    pixels, seen = camera.project(torch.from_numpy(vertices))
    distance = np.linalg.norm(vertices - camera.center_world.numpy(), axis=1)
    u, v = pixels.numpy().astype(int).T
    shown = view.depth_m[v, u]
    facing = (reaching.posed.normals_world * (camera.center_world.numpy() - vertices)).sum(1)
    first = seen.numpy() & (shown > 0) & (np.abs(shown - distance) < 0.01) & (facing > 0.5)
    assert first.sum() > 500
    # a pixel is 4 mm wide at 1.3 m, its surface oblique by up to 60 degrees
    assert np.median(np.abs(shown - distance)[first]) < 0.001


def test_visibility_of_a_person_from_above(reaching: Scene, plain: Actor) -> None:
    rig = Rig(1.2, 1.0, width=1000, height=1000, focal_px=1000 / math.pi)
    pelvis = torch.from_numpy(reaching.posed.joints_world[0])
    cameras = top_view_cameras(rig, pelvis)
    radii = measure_limbs(plain)
    assert (radii.smpl24_m > 0.015).all()
    assert (radii.smpl24_m < 0.25).all()
    _, smpl24 = true_visibility(reaching, radii, cameras["centre"])
    shown = dict(zip(SMPL24_NAMES, smpl24, strict=True))
    assert shown["head"] == 2
    assert shown["left_wrist"] == 2
    for hidden in ("pelvis", "spine1", "left_foot"):
        assert shown[hidden] == 1  # below head and shoulders
    turned_away = Camera(cameras["centre"].lens, pelvis - 5, cameras["centre"].rotation)
    coco17, _ = true_visibility(reaching, radii, turned_away)
    assert (coco17 == 0).all()


def test_the_room_is_continuous_and_seen_everywhere() -> None:
    camera = side_cameras(StudioSource(reader="studio", image_size_px=64))["cam01"]
    plate = empty_room(camera)
    assert plate.shape == (64, 64, 3)
    assert plate.min() > 0.3
    assert plate.max() <= 1


def test_mattes_grow_and_shrink_by_whole_pixels() -> None:
    matte = np.zeros((9, 9), np.float32)
    matte[3:6, 3:6] = 1
    assert grown(matte, 1).sum() == 9 + 4 * 3
    assert grown(matte, -1).sum() == 1
    assert grown(matte, 0) is matte


def test_a_capture_passes_the_checks_of_every_reader(capture: Path) -> None:
    check_capture(capture)
    assert len(read_table(capture / "frames.parquet", schema=schemas.FRAME)) == 4 * 4
    assert len(read_table(capture / "bodies.parquet", schema=schemas.BODY)) == 4
    assert len(list((capture / "plates").iterdir())) == 4


def test_exact_keypoints_lie_on_the_mattes(capture: Path) -> None:
    rows = read_table(capture / "keypoints2d.parquet", schema=schemas.KEYPOINTS2D)
    for row in rows:
        place = f"masks/{row['action']}/{row['view']}/{row['frame']:06d}.png"
        matte = read_matte(capture / place)
        u, v = np.array(row["keypoints_px"]).reshape(-1, 2).astype(int).T
        assert (matte[v, u] > 0).all()


def test_truth_is_written_like_a_rendering(capture: Path) -> None:
    truth = capture / "truth"
    rows = read_table(truth / "renders.parquet", schema=schemas.RENDER)
    labels = read_table(truth / "visibility.parquet", schema=VISIBILITY)
    assert [row["view"] for row in rows] == [row["view"] for row in labels]
    assert len(rows) == 9
    for row, label in zip(rows, labels, strict=True):
        rgba = read_rgba(truth / row["image_path"])
        mask = rgba[..., 3] >= MASK_ALPHA
        assert mask.sum() > 200
        assert ((read_depth(truth / row["depth_path"]) > 0) == mask).all()
        assert ((read_parts(truth / row["parts_path"]) > 0) == mask).all()
        joints = torch.tensor(row["joints3d_world_m"], dtype=torch.float64).reshape(-1, 3)
        pixels, _ = fisheye_camera(row).project(joints)
        u, v = pixels.numpy().astype(int).T
        on_body = np.array(label["visibility_smpl24"]) == 2
        assert mask[v[on_body], u[on_body]].mean() > 0.9


def test_a_person_in_mean_part_colours_is_a_poor_likeness(capture: Path) -> None:
    """What DESIGN.md pins: at most 20 dB in the true box, both composited on grey."""
    truth = capture / "truth"
    rows = read_table(truth / "renders.parquet", schema=schemas.RENDER)
    images = [read_rgba(truth / row["image_path"]).astype(np.float64) for row in rows]
    labels = [read_parts(truth / row["parts_path"]) for row in rows]
    colours = {
        part: np.concatenate([i[p == part][:, :3] for i, p in zip(images, labels, strict=True)])
        for part in np.unique(np.concatenate([p[p > 0] for p in labels]))
    }
    scores = []
    for image, parts in zip(images, labels, strict=True):
        painted = image[..., :3].copy()  # soft rims keep their colour: to the baseline's benefit
        for part, seen in colours.items():
            painted[parts == part] = seen.mean(0)
        v, u = np.nonzero(image[..., 3] >= MASK_ALPHA)
        box = np.s_[v.min() : v.max() + 1, u.min() : u.max() + 1]
        alpha = image[..., 3:] / 255
        reference, baseline = (c * alpha + GREY * (1 - alpha) for c in (image[..., :3], painted))
        error = ((reference - baseline)[box] ** 2).mean()
        scores.append(10 * math.log10(255**2 / error))
    assert np.mean(scores) <= 20


def test_noise_reaches_what_is_given_and_not_the_pictures(capture: Path, tmp_path: Path) -> None:
    noisy = record(
        tmp_path / "noisy",
        pose_noise_mm=20,
        calibration_noise_px=2,
        mask_growth_px=2,
        keypoint_noise_px=1,
    )
    for path in sorted((capture / "images").rglob("*.png")):
        assert path.read_bytes() == (noisy / path.relative_to(capture)).read_bytes()
    bodies = read_table(noisy / "bodies.parquet", schema=schemas.BODY)
    assert 5 < np.mean([row["error_mm"] for row in bodies]) < 80
    exact, moved = (
        read_table(folder / "keypoints2d.parquet", schema=schemas.KEYPOINTS2D)
        for folder in (capture, noisy)
    )
    shift = np.subtract([r["keypoints_px"] for r in moved], [r["keypoints_px"] for r in exact])
    assert shift.std() == pytest.approx(1, abs=0.1)
    place = "masks/range/cam01/000000.png"
    assert read_matte(noisy / place).sum() > 1.2 * read_matte(capture / place).sum()
    assert (noisy / "cameras.parquet").read_bytes() != (capture / "cameras.parquet").read_bytes()


def test_the_same_settings_give_the_same_bytes(capture: Path, tmp_path: Path) -> None:
    threads = torch.get_num_threads()
    torch.set_num_threads(2 if threads == 1 else 1)
    try:
        again = record(tmp_path / "again")
    finally:
        torch.set_num_threads(threads)
    files = sorted(path.relative_to(capture) for path in capture.rglob("*") if path.is_file())
    assert files == sorted(p.relative_to(again) for p in again.rglob("*") if p.is_file())
    for path in files:
        assert (capture / path).read_bytes() == (again / path).read_bytes(), path
