import torch

from ntop.body.model import EMBEDDED_BODY_PATH, load_body_model, part_labels
from ntop.body.skeletons import COCO17_NAMES, COCO17_PARTS, SMPL24_NAMES, SMPL24_PARENTS
from ntop.body.skinning import coco17_points, rest_body

# Zero-pose joints of Anny's SOMA rig at middling phenotypes (a youth of 1.638 m), metres.
SOMA_STATURE_M = 1.638
SOMA_JOINTS = {
    "pelvis": (0, 0, 0), "left_hip": (0.10, -0.07, 0.02), "right_hip": (-0.10, -0.08, 0.02),
    "spine1": (0, 0.04, 0), "left_knee": (0.10, -0.47, 0.02), "right_knee": (-0.10, -0.47, 0.02),
    "spine2": (0, 0.11, 0), "left_ankle": (0.10, -0.86, 0.02), "right_ankle": (-0.10, -0.86, 0.02),
    "spine3": (0, 0.18, -0.01), "left_foot": (0.10, -0.91, 0.14),
    "right_foot": (-0.10, -0.91, 0.14), "neck": (0, 0.42, -0.01),
    "left_collar": (0.02, 0.39, 0.04), "right_collar": (-0.02, 0.39, 0.04),
    "head": (0, 0.54, 0.03), "left_shoulder": (0.15, 0.39, -0.01),
    "right_shoulder": (-0.15, 0.39, -0.01), "left_elbow": (0.40, 0.39, -0.01),
    "right_elbow": (-0.41, 0.39, -0.01), "left_wrist": (0.65, 0.39, -0.01),
    "right_wrist": (-0.65, 0.39, -0.01),
}  # fmt: skip


def stature_m(vertices: torch.Tensor) -> float:
    return float(vertices[:, 1].max() - vertices[:, 1].min())


def test_embedded_body_has_smpls_layout():
    model = load_body_model()
    vertices = len(model.v_template)
    assert model.shapedirs.shape == (vertices, 3, 10)
    assert model.posedirs is None
    assert model.parents == SMPL24_PARENTS
    assert int(model.faces.max()) == vertices - 1
    for array in (model.lbs_weights, model.joint_regressor, model.coco17_regressor):
        assert array.dtype == torch.float32
        assert float(array.min()) >= 0
        torch.testing.assert_close(array.sum(-1), torch.ones(len(array)), atol=1e-5, rtol=0)
    assert EMBEDDED_BODY_PATH.stat().st_size < 2_000_000


def test_embedded_joints_are_the_soma_rigs():
    model = load_body_model()
    rest = rest_body(model, torch.zeros(10))
    scale = stature_m(rest.vertices) / SOMA_STATURE_M
    for name, position in SOMA_JOINTS.items():
        expected = scale * torch.tensor(position)
        error = (rest.joints[SMPL24_NAMES.index(name)] - expected).norm()
        assert error < 0.02, f"{name}: {error:.3f} m"  # an adult is not a scaled youth


def test_embedded_body_is_an_upright_adult_facing_forward():
    model = load_body_model()
    vertices = model.v_template
    assert 1.65 < stature_m(vertices) < 1.80
    corners = vertices[model.faces]
    volume_m3 = (corners[:, 0] * torch.linalg.cross(corners[:, 1], corners[:, 2])).sum() / 6
    assert 0.05 < volume_m3 < 0.09  # positive: the faces wind outwards
    left_toe = vertices[part_labels(model) == SMPL24_NAMES.index("left_foot")].mean(0)
    assert left_toe[0] > 0.05
    assert left_toe[2] > 0.1
    assert abs(float(vertices[:, 0].max() + vertices[:, 0].min())) < 0.005


def test_betas_are_standard_deviations_with_stature_first():
    model = load_body_model()
    root_mean_square = model.shapedirs.square().sum(1).mean(0).sqrt()
    assert root_mean_square.argmax() == 0
    assert root_mean_square[-1] < 0.1 * root_mean_square[0]
    tall = rest_body(model, torch.tensor([1.0] + [0.0] * 9))
    short = rest_body(model, torch.tensor([-1.0] + [0.0] * 9))
    assert 0.12 < stature_m(tall.vertices) - stature_m(short.vertices) < 0.22
    knees = [SMPL24_NAMES.index("left_hip"), SMPL24_NAMES.index("left_knee")]
    thigh = [float(body.joints[knees].diff(dim=0).norm()) for body in (tall, short)]
    assert thigh[0] > 1.04 * thigh[1]  # joints follow the shape


def test_coco_keypoints_lie_where_their_names_say():
    model = load_body_model()
    rest = rest_body(model, torch.zeros(10))
    points = dict(zip(COCO17_NAMES, coco17_points(model, rest.vertices), strict=True))
    joints = dict(zip(SMPL24_NAMES, rest.joints, strict=True))
    assert points["nose"][2] > points["left_eye"][2] > points["left_ear"][2]
    assert points["left_eye"][1] > points["nose"][1]
    for name in COCO17_NAMES[1:]:
        assert (points[name][0] > 0) == name.startswith("left"), name
    for name in COCO17_NAMES[5:]:
        assert (points[name] - joints[name]).norm() < 0.04, name  # skin marks beside the joints


def test_keypoints_sit_on_the_part_that_carries_them():
    model = load_body_model()
    rest = rest_body(model, torch.zeros(10))
    labels = part_labels(model)
    points = coco17_points(model, rest.vertices)
    for name, point, part in zip(COCO17_NAMES, points, COCO17_PARTS, strict=True):
        nearest = (rest.vertices - point).norm(dim=-1).topk(200, largest=False).indices
        assert part in labels[nearest], name
