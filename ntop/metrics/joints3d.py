"""3D pose scores: MPJPE, PA-MPJPE, PCK@150 and AUC, with one definition each (DATASETS 5.2).

Joints are in metres, `(sample, joint, 3)`; errors come out in millimetres. Root alignment moves the
root joint (index 0, the pelvis) of every sample onto the reference's; Procrustes alignment removes
a similarity *of the prediction* per sample, and never a reflection.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from ntop.conventions import DataError

MM_PER_M = 1000.0
PCK_THRESHOLD_MM = 150.0
# 31 thresholds; with "error < t" the first can never count, so a perfect AUC is 30/31 = 0.968
AUC_THRESHOLDS_MM = np.arange(0.0, 155.0, 5.0)
# a joint cloud whose second-largest extent is below this share of the largest is a line or a point
DEGENERATE_SHARE = 1e-6
DEGENERATE_VARIANCE_M2 = 1e-12

Joints = Float[np.ndarray, "sample joint 3"]


@dataclass(frozen=True)
class Alignment:
    """Predictions moved onto their references, and the samples where that is not unique."""

    joints: Joints
    degenerate: Bool[np.ndarray, " sample"]  # points on a line or a point, or not finite


@dataclass(frozen=True)
class PoseScores:
    """Means over joints, then over samples."""

    mpjpe_mm: float
    pa_mpjpe_mm: float
    pck150: float  # share of joints within 150 mm after root alignment
    auc: float  # mean PCK over 0, 5, ..., 150 mm; at most 30/31
    per_joint_mm: Float[np.ndarray, " joint"]
    num_samples: int
    num_degenerate: int  # left out of pa_mpjpe_mm


def score_poses(predicted: Joints, reference: Joints) -> PoseScores:
    """All scores of a set of poses.

    Raises:
        DataError: there is no pose, or a coordinate is not finite: every mean would be NaN.
    """
    if not len(predicted):
        raise DataError("3D scores of no pose: expected at least one predicted and reference pose")
    for name, joints in (("predicted", predicted), ("reference", reference)):
        bad = np.argwhere(~np.isfinite(joints).all(-1))
        if len(bad):
            sample, joint = bad[0]
            raise DataError(
                f"{name} joint {joint} of sample {sample} is {joints[sample, joint]} m, expected "
                f"finite numbers ({len(bad)} joints are not); leave such poses out or mend them"
            )
    errors_mm = joint_errors_mm(root_aligned(predicted, reference), reference)
    alignment = procrustes_aligned(predicted, reference)
    kept = ~alignment.degenerate
    aligned_mm = joint_errors_mm(alignment.joints[kept], reference[kept])
    return PoseScores(
        mpjpe_mm=float(errors_mm.mean()),
        pa_mpjpe_mm=float(aligned_mm.mean()) if kept.any() else float("nan"),
        pck150=share_within(errors_mm, PCK_THRESHOLD_MM),
        auc=float(np.mean([share_within(errors_mm, t) for t in AUC_THRESHOLDS_MM])),
        per_joint_mm=errors_mm.mean(0),
        num_samples=len(errors_mm),
        num_degenerate=int(alignment.degenerate.sum()),
    )


def joint_errors_mm(predicted: Joints, reference: Joints) -> Float[np.ndarray, "sample joint"]:
    """Euclidean distance of every joint."""
    return np.linalg.norm(predicted - reference, axis=-1) * MM_PER_M


def share_within(errors_mm: Float[np.ndarray, "sample joint"], threshold_mm: float) -> float:
    """Share of joints with an error strictly below the threshold."""
    return float(np.mean(errors_mm < threshold_mm))


def root_aligned(predicted: Joints, reference: Joints) -> Joints:
    """Predictions shifted so that their roots coincide with the references' roots."""
    return predicted - predicted[:, :1] + reference[:, :1]


def procrustes_aligned(predicted: Joints, reference: Joints) -> Alignment:
    """Each prediction under its best similarity (scale, rotation, shift) onto the reference.

    Kabsch-Umeyama (Umeyama 1991), centred first and in float64; the determinant is forced to +1,
    without which a mirrored skeleton would score zero. Where the rotation is not unique (points on
    a line or coinciding) or a value is not finite, the sample is flagged; it is then only shifted
    (or left as it is, if not finite).
    """
    aligned = predicted.astype(np.float64)
    degenerate = np.zeros(len(predicted), bool)
    for index, (source, target) in enumerate(
        zip(aligned, reference.astype(np.float64), strict=True)
    ):
        if not (np.isfinite(source).all() and np.isfinite(target).all()):
            degenerate[index] = True
            continue
        source_mean, target_mean = source.mean(0), target.mean(0)
        source_0, target_0 = source - source_mean, target - target_mean
        if _is_line(source_0) or _is_line(target_0):
            degenerate[index] = True
            aligned[index] = source_0 + target_mean
            continue
        left, singular, right = np.linalg.svd(source_0.T @ target_0)
        signs = np.ones(3)
        signs[-1] = np.sign(np.linalg.det(left @ right))  # a reflection is not a rotation
        rotation = (left * signs) @ right  # row vectors: target = source @ rotation
        scale = (singular * signs).sum() / (source_0**2).sum()
        aligned[index] = scale * source_0 @ rotation + target_mean
    return Alignment(aligned, degenerate)


def _is_line(centred: Float[np.ndarray, "joint 3"]) -> bool:
    extent = np.linalg.svd(centred, compute_uv=False)
    variance = (centred**2).mean()
    second = extent[1] if len(extent) > 1 else 0.0  # a single point has one singular value
    return variance < DEGENERATE_VARIANCE_M2 or second < DEGENERATE_SHARE * extent[0]
