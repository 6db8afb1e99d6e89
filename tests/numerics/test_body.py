"""Cases 31-34: rotations, posing and its inverse, directions that are opposite."""

import itertools
import math

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ntop.body.fitting.initial import LIMBS, initial_pose
from ntop.body.landmarks import TORSO_NAMES, blend_landmarks, landmarks_on
from ntop.body.model import load_body_model
from ntop.body.motions import Motion, sample_motion
from ntop.body.skeletons import SMPL24_NAMES
from ntop.body.skinning import BodyPose, pose_body, pose_joints
from ntop.field.canonical import canonical_body
from ntop.field.kernels.posing import MIN_SCALE, vertex_maps, way_back
from ntop.field.posing import CELL_M
from ntop.field.warp import pose_warp
from ntop.geometry.rotations import (
    axis_angle_from_matrix,
    cross_matrix,
    matrix_from_axis_angle,
    matrix_from_quaternion,
    quaternion_from_matrix,
)
from ntop.geometry.triangulation import Triangulation
from tests.field.ways_back import ways_back

ANGLES_RAD = (
    0.0, 1e-12, 1e-8, 1e-4, 1e-3, 0.0099, 0.0101, 0.1, 1.0, math.pi / 2, 3.0, math.pi - 1e-2,
    math.pi - 1e-4, math.pi - 1e-6, math.pi,
)  # fmt: skip
BEYOND_RAD = (math.pi + 1e-4, 2 * math.pi - 1e-4, 2 * math.pi)
ALL_ANGLES_RAD = ANGLES_RAD + BEYOND_RAD
BOTH = pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["f32", "f64"])
R_LIMIT = {torch.float32: 6e-7, torch.float64: 1e-14}
LOG_LIMIT_RAD = {torch.float32: 1e-6, torch.float64: 1e-14}

LEFT_SHOULDER, RIGHT_SHOULDER, LEFT_ELBOW = 15, 16, 17  # rows of `body_pose`
BETAS = (0.0,) * 10


def vectors(angles_rad: tuple[float, ...], dtype: torch.dtype) -> torch.Tensor:
    """Axis-angle vectors of these lengths about random axes and about the coordinate axes."""
    generator = torch.Generator().manual_seed(31)
    axes = torch.randn(40, 3, generator=generator, dtype=torch.float64)
    axes = torch.cat([axes / axes.norm(dim=-1, keepdim=True), torch.eye(3).double()])
    angles = torch.tensor(angles_rad, dtype=torch.float64)
    return (angles[:, None, None] * axes).to(dtype)


def exact(axis_angle: torch.Tensor) -> torch.Tensor:
    """The oracle: the matrix exponential in float64 of the very numbers given."""
    return torch.linalg.matrix_exp(cross_matrix(axis_angle.double()))


def geodesic_rad(one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
    """Angle between two rotations, from |R1 - R2|_F = 2 sqrt(2) sin(angle / 2)."""
    chord = (one.double() - other.double()).flatten(-2).norm(dim=-1)
    return 2 * torch.asin((chord / math.sqrt(8)).clamp(max=1))


def orthogonality(matrices: torch.Tensor) -> float:
    return float((matrices @ matrices.mT - torch.eye(3).to(matrices)).abs().max())


def humannerf_rodrigues(axis_angle: torch.Tensor) -> torch.Tensor:
    """The mutant of table 6: an epsilon added below the root."""
    theta = torch.sqrt(1e-5 + (axis_angle**2).sum(-1))[..., None, None]
    cross = cross_matrix(axis_angle) / theta
    eye = torch.eye(3).to(axis_angle)
    return eye + torch.sin(theta) * cross + (1 - torch.cos(theta)) * cross @ cross


def acos_logarithm(matrices: torch.Tensor) -> torch.Tensor:
    """The mutant: the angle from the trace, the axis from the antisymmetric part."""
    trace = matrices.diagonal(dim1=-2, dim2=-1).sum(-1)
    angle = torch.acos((trace - 1) / 2)
    skew = (matrices - matrices.mT) / (2 * torch.sin(angle))[..., None, None]
    return angle[..., None] * torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], -1)


@BOTH
def test_31_rodrigues_equals_the_matrix_exponential(dtype, margin):
    r = vectors(ALL_ANGLES_RAD, dtype)
    matrices = matrix_from_axis_angle(r)
    margin.at_most("R, largest entry", float((matrices - exact(r)).abs().max()), R_LIMIT[dtype])
    margin.at_most("R R^T - 1", orthogonality(matrices), {torch.float32: 1e-6}.get(dtype, 1e-14))
    wrong = humannerf_rodrigues(r)
    error = float((wrong - exact(r)).abs().max())
    margin.mutant_exceeds("R with an epsilon below the root", error, R_LIMIT[dtype])
    margin.mutant_exceeds("its R R^T - 1", orthogonality(wrong), 1e-6)


@BOTH
def test_31_logarithm_and_quaternions_keep_the_rotation(dtype, margin):
    r = vectors(ALL_ANGLES_RAD, dtype)
    matrices = exact(r).to(dtype)
    back = axis_angle_from_matrix(matrices)
    quaternions = quaternion_from_matrix(matrices)
    limit = LOG_LIMIT_RAD[dtype]
    for what, again in (
        ("logarithm", exact(back)),
        ("quaternion", matrix_from_quaternion(quaternions)),
        ("scipy reads the quaternion", from_scipy(quaternions)),
    ):
        margin.at_most(what, float(geodesic_rad(again, exact(r)).max()), limit, "rad")
    longest = float(back.double().norm(dim=-1).max() - math.pi)
    margin.at_most("|log R| - pi", longest, {torch.float32: 5e-7}.get(dtype, 1e-15), "rad")
    wrong = geodesic_rad(exact(acos_logarithm(matrices)), exact(r))
    margin.mutant_exceeds("logarithm by acos of the trace", float(wrong.max()), limit, "rad")


def from_scipy(quaternions: torch.Tensor) -> torch.Tensor:
    """scipy's matrix of (w, x, y, z) quaternions."""
    flat = quaternions.double().reshape(-1, 4)[:, [1, 2, 3, 0]].numpy()
    return torch.from_numpy(Rotation.from_quat(flat).as_matrix()).reshape(
        *quaternions.shape[:-1], 3, 3
    )


@BOTH
def test_31_gradients_are_finite_from_zero_to_pi(dtype):
    r = vectors(ALL_ANGLES_RAD, dtype).requires_grad_()
    axis_angle_from_matrix(matrix_from_axis_angle(r)).square().sum().backward()
    assert r.grad.isfinite().all()
    matrices = exact(vectors(ANGLES_RAD, dtype)).to(dtype).requires_grad_()
    axis_angle_from_matrix(matrices).sum().backward()
    assert matrices.grad.isfinite().all()


def test_31_gradients_are_those_of_the_exponential(margin):
    worst = 0.0
    for angle in (0.0, 1e-8, 1e-3, 0.0099, 0.0101, 1.0, math.pi):
        r = vectors((angle,), torch.float64)[0, :5]
        ours = torch.autograd.functional.jacobian(matrix_from_axis_angle, r)
        expected = torch.autograd.functional.jacobian(exact, r)
        worst = max(worst, float((ours - expected).abs().max()))
    margin.at_most("dR/dr", worst, 1e-12)
    r = vectors((0.0, 1e-4), torch.float64)[:, :5]
    wrong = torch.autograd.functional.jacobian(humannerf_rodrigues, r)
    expected = torch.autograd.functional.jacobian(exact, r)
    error = float((wrong - expected).abs().max())
    margin.mutant_exceeds("dR/dr with an epsilon below the root", error, 1e-7)


def random_pose(count: int, dtype: torch.dtype, *, spread_rad: float = 0.6) -> BodyPose:
    """Bodies within about a metre of the origin, every joint turned at random."""
    generator = torch.Generator().manual_seed(33)

    def normal(size: int) -> torch.Tensor:
        return torch.randn(count, size, generator=generator, dtype=torch.float64)

    transl = normal(3).clamp(-1, 1)
    pose = (normal(10), normal(3), spread_rad * normal(69), transl)
    return BodyPose(*(values.to(dtype) for values in pose))


def wrapped(vectors_rad: torch.Tensor) -> torch.Tensor:
    """The same rotations the other way round: r (1 - 2 pi / |r|)."""
    joints = vectors_rad.unflatten(-1, (-1, 3))
    return (joints * (1 - 2 * math.pi / joints.norm(dim=-1, keepdim=True))).flatten(-2)


@BOTH
def test_32_a_pose_wrapped_by_a_turn_is_the_same_body(dtype, margin):
    model = load_body_model()
    pose = random_pose(8, torch.float64)
    other = BodyPose(pose.betas, wrapped(pose.global_orient), wrapped(pose.body_pose), pose.transl)
    assert (other.body_pose - pose.body_pose).abs().max() > 1
    one, two = (
        pose_body(model, BodyPose(*(v.to(dtype) for v in vars(p).values()))).vertices
        for p in (pose, other)
    )
    margin.at_most("mesh", float((one - two).norm(dim=-1).max()), 1e-6, "m")


def test_32_motions_turn_the_short_way_between_poses_on_either_side_of_pi(margin):
    axis = torch.tensor([0.36, 0.48, 0.8], dtype=torch.float64)
    before, after = axis * (math.pi - 0.1), -axis * (math.pi - 0.1)  # 0.2 rad apart
    ends = matrix_from_axis_angle(torch.stack([before, after]))
    assert float(geodesic_rad(ends[0], ends[1])) == pytest.approx(0.2, abs=1e-9)
    motion = Motion(
        times_s=torch.tensor([0.0, 1.0], dtype=torch.float64),
        quaternions=quaternion_from_matrix(ends)[:, None].expand(2, 24, 4),
        pelvis_world_m=torch.zeros(2, 3, dtype=torch.float64),
        leg_length_m=1.0,
        loops=False,
        leaves_floor=False,
    )
    sample = sample_motion(motion, torch.tensor([0.5]))
    middle = matrix_from_quaternion(sample.quaternions)[0, 0]
    limit = 0.1 + 1e-9
    for name, end in (("earlier", ends[0]), ("later", ends[1])):
        what = f"midpoint to the {name} pose"
        margin.at_most(what, float(geodesic_rad(middle, end)), limit, "rad")
    mean = matrix_from_axis_angle((before + after) / 2)
    distance = float(geodesic_rad(mean, ends[0]))
    margin.mutant_exceeds("mean of the axis-angle vectors", distance, limit, "rad")


def test_33_posing_in_float32_is_posing_in_float64(margin):
    model = load_body_model()
    single = random_pose(30, torch.float32)
    double = BodyPose(*(values.double() for values in vars(single).values()))
    rough, fine = pose_body(model, single), pose_body(model, double)
    # one unit in the last place is 1.2e-7 m at 1 m; labels and warps are float64
    margin.at_most(
        "vertices", float((rough.vertices - fine.vertices).norm(dim=-1).max()), 1e-6, "m"
    )
    margin.at_most("joints", float((rough.joints - fine.joints).norm(dim=-1).max()), 1e-6, "m")


BENDS = {
    f"{kind} {degrees}": (axis, sign * degrees)
    for kind, axis, sign in (("elbow", 1, -1), ("twist", 0, 1))
    for degrees in (30, 60, 90, 120, 150, 180)
}


def bent(name: str) -> BodyPose:
    """Upright, the left elbow bent or (candy wrapper) the forearm twisted by so many degrees."""
    axis, degrees = BENDS[name]
    body_pose = torch.zeros(23, 3, dtype=torch.float64)
    body_pose[LEFT_ELBOW, axis] = math.radians(degrees)
    return BodyPose(
        betas=torch.tensor(BETAS, dtype=torch.float64),
        global_orient=torch.tensor([math.pi / 2, 0, 0], dtype=torch.float64),
        body_pose=body_pose.flatten(),
        transl=torch.tensor([0.3, -0.2, 1.0], dtype=torch.float64),
    )


class Skin:
    """Random points of the arm's skin, where they come from, and what brings them back."""

    def __init__(self, name: str, *, count: int) -> None:
        self.model = load_body_model()
        self.body = body = canonical_body(self.model, BETAS)
        self.pose = bent(name)
        posed = pose_body(self.model, self.pose)
        self.vertices, bones = posed.vertices.numpy(), posed.posed_from_rest.numpy()
        arm = np.isin(body.parts[body.faces], (16, 18, 20)).all(1)  # left shoulder, elbow, wrist
        generator = np.random.default_rng(33)
        faces = body.faces[generator.choice(np.flatnonzero(arm), count)]
        self.corners, shares = faces, generator.dirichlet((1, 1, 1), count)
        self.points = np.einsum("nk,nkc->nc", shares, self.vertices[faces])
        self.truth = np.einsum("nk,nkc->nc", shares, body.vertices[faces])
        blend = np.einsum("vj,jab->vab", body.lbs_weights, bones[:, :3])
        linear = blend[..., :3] @ np.linalg.inv(body.canonical_from_rest[..., :3])
        self.condition = np.linalg.cond(np.einsum("nk,nkab->nab", shares, linear[faces]))
        self.vertex_condition = np.linalg.cond(linear)
        bones_forward = bones @ body.rest_from_canonical_bones
        self.maps = np.empty((len(self.vertices), 3, 4))
        vertex_maps(
            blend, body.canonical_from_rest, body.vertices, self.vertices, bones[:, :3],
            body.parts, self.maps,
        )  # fmt: skip
        weights = np.einsum("nk,nkj->nj", shares, body.lbs_weights[faces])
        inverses = np.linalg.inv(bones_forward)
        homogeneous = np.c_[self.points, np.ones(count)]
        self.averaged = np.einsum("nj,jab,nb->na", weights, inverses, homogeneous)[:, :3]
        affine = self.maps[faces]  # (point, corner, 3, 4)
        places = np.einsum("nkij,nj->nki", affine[..., :3], self.points) + affine[..., 3]
        self.affine_mean = np.einsum("nk,nkc->nc", shares, places)

    def error_mm(self, back: np.ndarray) -> np.ndarray:
        """Distance of canonical points (point, ..., 3) from the truth."""
        truth = self.truth.reshape(len(self.truth), *[1] * (back.ndim - 2), 3)
        return 1000 * np.linalg.norm(back - truth, axis=-1)

    def way_back(self, point: int, vertex: int) -> tuple[np.ndarray, float]:
        """The renderer's own inverse at one point: place, and distance to the skin (metres)."""
        body, record = self.body, np.empty(6)
        squared, _ = way_back(
            self.points[point], vertex, self.vertices, body.vertices, body.faces,
            body.ring_offsets, body.ring_faces, self.maps, body.normals, body.normals, record,
        )  # fmt: skip
        return record[:3], math.sqrt(squared)

    def nearest_root(self) -> np.ndarray:
        """Where the skin nearest to each point sends it: the first correspondence."""
        _, vertex = cKDTree(self.vertices).query(self.points)
        return np.stack([self.way_back(n, v)[0] for n, v in enumerate(vertex)])

    def best_root_mm(self, count: int) -> np.ndarray:
        """Over all roots (skin through the point) the smallest error."""
        near = cKDTree(self.vertices).query_ball_point(self.points[:count], 0.03)
        best = np.empty(count)
        for n, candidates in enumerate(near):
            found = [self.way_back(n, v) for v in candidates]
            roots = np.array([place for place, distance in found if distance < 1e-9])
            best[n] = 1000 * np.linalg.norm(roots - self.truth[n], axis=1).min()
        return best


POINT_LIMIT_MM = 0.1


@pytest.mark.parametrize("name", BENDS)
def test_33_the_skin_comes_back_where_it_came_from(name, margin):
    skin = Skin(name, count=800)
    fixed = skin.condition <= 100
    best = skin.best_root_mm(250)
    assert np.isfinite(best).all()
    # the map's translation is the skin's own: exact beyond condition 100 as well
    margin.at_most("inverse at a point, best of all roots", best.max(), POINT_LIMIT_MM, "mm")
    error = skin.error_mm(skin.nearest_root())
    missed = float((error[fixed] > POINT_LIMIT_MM).mean())
    # folds: there another part's skin is nearer to a vertex, and both ways back are true
    folded = 0.2 if name == "elbow 180" else 0.04
    margin.at_most(f"points nearer to another root, {name}", missed, folded)
    if name in ("elbow 30", "elbow 60", "twist 30", "twist 60", "twist 90"):
        margin.at_most("inverse at a point, nearest skin", error.max(), POINT_LIMIT_MM, "mm")
    averaged = np.median(skin.error_mm(skin.averaged)[skin.condition > 1.001])
    margin.mutant_exceeds("average of the bones' inverses, median", averaged, POINT_LIMIT_MM, "mm")
    affine = skin.error_mm(skin.affine_mean).max()
    margin.mutant_exceeds("mean of the corners' affine maps", affine, POINT_LIMIT_MM, "mm")


@pytest.mark.parametrize("name", ["twist 150", "twist 180", "elbow 180"])
def test_33_where_blending_collapses_the_map_is_bounded(name, margin):
    """The flag of a bad condition: the map becomes a rotation of bounded stretch, and proper."""
    skin = Skin(name, count=10)
    assert np.isfinite(skin.maps).all()
    stretches = np.linalg.svd(skin.maps[..., :3], compute_uv=False)
    margin.at_most("largest stretch of the inverse", stretches.max(), 1.001 / MIN_SCALE)
    bad = skin.vertex_condition > 100
    if bad.any():
        margin.at_least("least stretch beyond condition 100", stretches[bad].min(), 0.9)
        margin.at_least("least volume beyond it", np.linalg.det(skin.maps[bad, :, :3]).min(), 0.9)
    assert skin.vertex_condition.max() > (100 if name.endswith("180") else 3)


# what 12 mm cells with two correspondences cost: (95 %, shares of points beyond 0.1 and 10 mm);
# where three sides of hard bends meet in a cell, or a fold is thinner than one, some are lost
GRID_LIMITS_MM = {
    "elbow 30": (0.5, 0.25, 0.0),
    "elbow 60": (1.0, 0.35, 0.0),
    "elbow 90": (3.0, 0.4, 0.01),
    "elbow 120": (8.0, 0.4, 0.02),
    "elbow 150": (10.0, 0.4, 0.05),
    "elbow 180": (15.0, 0.4, 0.07),
    "twist 30": (0.5, 0.25, 0.0),
    "twist 60": (1.0, 0.35, 0.0),
    "twist 90": (3.0, 0.4, 0.005),
    "twist 120": (5.0, 0.4, 0.01),
    "twist 150": (10.0, 0.4, 0.06),
    "twist 180": (16.0, 0.4, 0.09),
}
GRID_MEDIAN_MM = 0.05


@pytest.mark.parametrize("name", GRID_LIMITS_MM)
def test_33_the_grid_adds_its_interpolation(name, margin):
    skin = Skin(name, count=1500)
    warp = pose_warp(skin.body, skin.model, skin.pose, cell_m=CELL_M, reach_m=0.05)
    assert np.isfinite(warp.tables.nodes).all()
    used = warp.tables.sheets[:, 0]
    assert ((used >= 0) & (used < len(warp.tables.nodes))).all()
    error = np.nanmin(skin.error_mm(ways_back(warp, skin.points)), axis=1)
    assert np.isfinite(error).all()
    most, beyond_stated, beyond_limb = GRID_LIMITS_MM[name]
    margin.at_most("warp grid, median, any bend", np.median(error), GRID_MEDIAN_MM, "mm")
    margin.at_most(f"warp grid at {name}, 95 %", np.quantile(error, 0.95), most, "mm")
    share = (error > POINT_LIMIT_MM).mean()
    margin.at_most(f"warp grid at {name}, share beyond 0.1 mm", share, beyond_stated)
    margin.at_most(f"warp grid at {name}, share beyond 10 mm", (error > 10).mean(), beyond_limb)
    averaged = np.median(skin.error_mm(skin.averaged)[skin.condition > 1.001])
    margin.mutant_exceeds(
        "average of bone inverses, median, any bend", averaged, GRID_MEDIAN_MM, "mm"
    )


def align_1_plus_cos(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """The mutant: R = I + K + K^2 / (1 + cos)."""
    x, y, z = np.cross(start, end)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.eye(3) + cross + cross @ cross / (1 + start @ end)


def improper(rotation: np.ndarray) -> float:
    """How far a matrix is from a proper rotation; NaN stays NaN."""
    with np.errstate(invalid="ignore"):
        defect = np.abs(rotation @ rotation.T - np.eye(3)).max()
        return float(max(defect, abs(np.linalg.det(rotation) - 1)))


LIMB_DIRECTIONS = (
    "rest", "opposite", "folded", "opposite and folded", "along the hinge", "against the hinge",
)  # fmt: skip


def limb_points(joints: torch.Tensor, names: tuple, hinge: tuple, how: str) -> torch.Tensor:
    """A limb's three joints, its bones opposite to, or along, what an alignment starts from."""
    start, middle, end = (joints[name] for name in names)
    upper, lower = middle - start, end - middle
    axis = torch.tensor(hinge, dtype=torch.float64)
    match how:
        case "opposite":
            upper, lower = -upper, -lower
        case "folded":
            lower = -lower
        case "opposite and folded":
            upper = -upper
        case "along the hinge":
            upper = lower = axis * upper.norm()
        case "against the hinge":
            upper, lower = -axis * upper.norm(), axis * lower.norm()
    return torch.stack([start, start + upper, start + upper + lower])


@pytest.mark.parametrize("how", LIMB_DIRECTIONS)
@pytest.mark.parametrize("offset_m", [0.0, 1e-12, 1e-7])
def test_34_limbs_opposite_to_their_rest_start_from_a_proper_rotation(how, offset_m, margin):
    """The fit's start is what aligns bones: limbs against their rest, folded, along the hinge."""
    model = load_body_model().to(torch.zeros(1, dtype=torch.float64))
    landmarks = landmarks_on(model, "coco17")
    blend = blend_landmarks(model, landmarks)
    rest = blend.template[..., :3].sum(-2)
    joints = {name: rest[landmarks.index(name)] for name in landmarks.names}
    points = rest.clone()
    for *names, hinge in LIMBS:
        chosen = limb_points(joints, tuple(names), hinge, how)
        for name, place in zip(names, chosen, strict=True):
            if name not in TORSO_NAMES:
                points[landmarks.index(name)] = place + offset_m * torch.tensor([1.0, -2.0, 0.5])
    count = len(points)
    found = Triangulation(
        points_world=points[None],
        valid=torch.ones(1, count, dtype=torch.bool),
        used=torch.ones(1, count, 4, dtype=torch.bool),
        angle_rad=torch.zeros(1, count, 4),
        condition=torch.ones(1, count),
    )
    pose = initial_pose(model, landmarks, blend, found)
    rotations = matrix_from_axis_angle(
        torch.cat([pose.global_orient, pose.body_pose], -1).unflatten(-1, (24, 3))
    )[0].numpy()
    margin.at_most("R R^T - 1, |det R - 1|", max(map(improper, rotations)), 1e-12)
    started = pose_joints(model, pose)[0]
    for start, middle, _, _ in LIMBS:
        bone = started[SMPL24_NAMES.index(middle)] - started[SMPL24_NAMES.index(start)]
        wanted = points[landmarks.index(middle)] - points[landmarks.index(start)]
        sine = torch.linalg.cross(bone, wanted).norm() / (bone.norm() * wanted.norm())
        angle = float(torch.atan2(sine, (bone @ wanted).sign() * (1 - sine**2).clamp(min=0).sqrt()))
        margin.at_most("bone against where it was seen", angle, 1e-9, "rad")


def test_34_the_formula_by_one_plus_cosine_is_no_rotation_there(margin):
    bones = np.eye(3)
    worst = 0.0
    for bone, tilt in itertools.product(bones, (0.0, 1e-9, 1e-8)):
        end = -bone + tilt * np.roll(bone, 1)
        defect = improper(align_1_plus_cos(bone, end / np.linalg.norm(end)))
        worst = defect if math.isnan(defect) else max(worst, defect)
        if math.isnan(worst):
            break
    margin.mutant_exceeds("1 / (1 + cos) at opposite bones", worst, 1e-12)
