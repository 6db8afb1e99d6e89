import math

import numpy as np
import pytest
import torch

from ntop.body.model import BodyModel, load_body_model
from ntop.body.skeletons import SMPL24_NAMES, SMPL24_PARENTS
from ntop.body.skinning import BodyPose, coco17_points, pose_body, pose_joints, rest_body


def small_model(*, num_vertices: int = 7, with_pose_offsets: bool = True) -> BodyModel:
    """A random float64 body: no anatomy, every array in play."""
    random = np.random.default_rng(5)

    def rows_of_one(*shape: int) -> torch.Tensor:
        values = random.uniform(0, 1, shape)
        return torch.from_numpy(values / values.sum(-1, keepdims=True))

    return BodyModel(
        v_template=torch.from_numpy(random.normal(size=(num_vertices, 3))),
        shapedirs=torch.from_numpy(0.1 * random.normal(size=(num_vertices, 3, 10))),
        posedirs=torch.from_numpy(0.1 * random.normal(size=(num_vertices, 3, 207)))
        if with_pose_offsets
        else None,
        joint_regressor=rows_of_one(24, num_vertices),
        lbs_weights=rows_of_one(num_vertices, 24),
        parents=SMPL24_PARENTS,
        faces=torch.tensor([[0, 1, 2]]),
        coco17_regressor=rows_of_one(17, num_vertices),
    )


def random_pose(*batch: int, scale: float = 0.6, dtype: torch.dtype = torch.float64) -> BodyPose:
    random = torch.Generator().manual_seed(2)

    def values(size: int) -> torch.Tensor:
        return scale * torch.randn(*batch, size, generator=random, dtype=dtype)

    return BodyPose(values(10), values(3), values(69), values(3))


def rotation_twin(vector: np.ndarray) -> np.ndarray:
    """Rodrigues, spelled out in scalars."""
    angle = math.sqrt(sum(x * x for x in vector))
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def skinning_twin(model: BodyModel, pose: BodyPose) -> tuple[np.ndarray, np.ndarray]:
    """SMPL (Loper et al. 2015, eq. 2-4 and 6-10) as plain loops over vertices and joints."""
    template, shapedirs = model.v_template.numpy(), model.shapedirs.numpy()
    vectors = np.concatenate([pose.global_orient.numpy(), pose.body_pose.numpy()]).reshape(24, 3)
    rotations = [rotation_twin(vector) for vector in vectors]
    features = np.concatenate([(r - np.eye(3)).ravel() for r in rotations[1:]])
    shaped = np.empty_like(template)
    for v in range(len(template)):
        for c in range(3):
            shaped[v, c] = template[v, c] + sum(
                shapedirs[v, c, b] * pose.betas[b].item() for b in range(10)
            )
    rest_joints = [
        sum(model.joint_regressor[j, v].item() * shaped[v] for v in range(len(template)))
        for j in range(24)
    ]
    chain, bones = [], []
    for j, parent in enumerate(model.parents):
        local = np.eye(4)
        local[:3, :3] = rotations[j]
        local[:3, 3] = rest_joints[j] if parent < 0 else rest_joints[j] - rest_joints[parent]
        chain.append(local if parent < 0 else chain[parent] @ local)
        to_origin = np.eye(4)
        to_origin[:3, 3] = -rest_joints[j]
        bones.append(chain[j] @ to_origin)
    vertices = np.empty_like(template)
    for v in range(len(template)):
        posed = shaped[v] + model.posedirs[v].numpy() @ features
        blended = sum(model.lbs_weights[v, j].item() * bones[j] for j in range(24))
        vertices[v] = (blended @ np.append(posed, 1.0))[:3] + pose.transl.numpy()
    joints = np.stack([transform[:3, 3] for transform in chain]) + pose.transl.numpy()
    return vertices, joints


def test_identity_pose_is_the_template():
    model = load_body_model()
    zero = BodyPose(torch.zeros(10), torch.zeros(3), torch.zeros(69), torch.zeros(3))
    posed = pose_body(model, zero)
    torch.testing.assert_close(posed.vertices, model.v_template, atol=1e-6, rtol=0)  # metres
    rest = rest_body(model, zero.betas)
    torch.testing.assert_close(posed.vertices, rest.vertices, atol=1e-6, rtol=0)
    torch.testing.assert_close(posed.joints, rest.joints, atol=1e-6, rtol=0)
    identity = torch.eye(4).expand(24, 4, 4)
    torch.testing.assert_close(posed.posed_from_rest, identity, atol=1e-6, rtol=0)


def test_skinning_equals_its_double_loop_twin():
    model, pose = small_model(), random_pose()
    posed = pose_body(model, pose)
    vertices, joints = skinning_twin(model, pose)
    np.testing.assert_allclose(posed.vertices, vertices, atol=1e-12)
    np.testing.assert_allclose(posed.joints, joints, atol=1e-12)
    np.testing.assert_allclose(pose_joints(model, pose), joints, atol=1e-12)


def test_leading_dimensions_are_free():
    model, pose = small_model(), random_pose(2, 3)
    batch = pose_body(model, pose)
    assert batch.vertices.shape == (2, 3, 7, 3)
    assert coco17_points(model, batch.vertices).shape == (2, 3, 17, 3)
    one = BodyPose(
        pose.betas[1, 2], pose.global_orient[1, 2], pose.body_pose[1, 2], pose.transl[1, 2]
    )
    torch.testing.assert_close(batch.vertices[1, 2], pose_body(model, one).vertices)
    torch.testing.assert_close(batch.posed_from_rest[1, 2], pose_body(model, one).posed_from_rest)


@pytest.mark.parametrize("scale", [0.0, 1e-9, 0.5])
def test_gradients_are_right_down_to_the_zero_pose(scale):
    model = small_model(num_vertices=3)
    pose = random_pose(scale=scale)
    inputs = [
        getattr(pose, name).clone().requires_grad_()
        for name in ("betas", "global_orient", "body_pose", "transl")
    ]

    def points(*values: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        posed = pose_body(model, BodyPose(*values))
        return posed.vertices, posed.joints

    assert torch.autograd.gradcheck(points, inputs, atol=1e-6, fast_mode=True)


def test_global_orient_turns_about_the_pelvis_and_transl_comes_last():
    model = load_body_model()
    betas = torch.linspace(-1, 1, 10)
    orient, transl = torch.tensor([0.3, -1.2, 0.5]), torch.tensor([1.0, 2.0, 3.0])
    posed = pose_body(model, BodyPose(betas, orient, torch.zeros(69), transl))
    rest = rest_body(model, betas)
    torch.testing.assert_close(posed.joints[0], rest.joints[0] + transl)
    before = (rest.vertices - rest.joints[0]).norm(dim=-1)
    after = (posed.vertices - posed.joints[0]).norm(dim=-1)
    torch.testing.assert_close(before, after, atol=2e-6, rtol=0)


def test_bone_transforms_are_rigid_and_carry_their_joints():
    model, pose = load_body_model(), random_pose(3, dtype=torch.float32)
    posed, rest = pose_body(model, pose), rest_body(model, pose.betas)
    rotation = posed.posed_from_rest[..., :3, :3]
    identity = torch.eye(3).expand_as(rotation)
    torch.testing.assert_close(rotation @ rotation.mT, identity, atol=5e-6, rtol=0)
    moved = (rotation @ rest.joints[..., None]).squeeze(-1) + posed.posed_from_rest[..., :3, 3]
    torch.testing.assert_close(moved, posed.joints, atol=3e-6, rtol=0)


def test_bending_the_left_elbow_moves_the_left_forearm_only():
    model = load_body_model()
    body_pose = torch.zeros(23, 3)
    body_pose[SMPL24_NAMES.index("left_elbow") - 1] = torch.tensor([0.0, -math.pi / 2, 0.0])
    zero = torch.zeros(3)
    posed = pose_body(model, BodyPose(torch.zeros(10), zero, body_pose.flatten(), zero))
    rest = rest_body(model, torch.zeros(10))
    forearm = posed.joints[20] - posed.joints[18]
    length = (rest.joints[20] - rest.joints[18]).norm()
    # forward is +z; 2 mm: the resting forearm is not exactly along x
    torch.testing.assert_close(forearm, torch.stack([zero[0], zero[1], length]), atol=2e-3, rtol=0)
    moved = (posed.vertices - rest.vertices).norm(dim=-1) > 1e-5
    weight = model.lbs_weights[:, [18, 20, 22]].sum(-1)
    assert (moved <= (weight > 0)).all()
    assert moved[weight > 0.5].all()


@pytest.fixture
def thread_count():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize("frames", [3, 9, 40])
def test_bytes_do_not_depend_on_threads_or_on_the_batch(thread_count, frames):
    model, pose = load_body_model(), random_pose(frames, dtype=torch.float32)
    posed = []
    for threads in (1, 2, 4):
        thread_count(threads)
        posed.append(pose_body(model, pose))
    single = BodyPose(*(getattr(pose, name)[1] for name in pose.__dataclass_fields__))
    alone = pose_body(model, single)
    for other in posed[1:]:
        assert torch.equal(other.vertices, posed[0].vertices)
        assert torch.equal(other.joints, posed[0].joints)
        points = coco17_points(model, other.vertices)
        assert torch.equal(points, coco17_points(model, posed[0].vertices))
    assert torch.equal(posed[0].vertices[1], alone.vertices)
