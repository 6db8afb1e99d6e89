"""Skeletons as data: joint names, parents, drawn edges, OKS sigmas, maps between them.

Sources: the SMPL joint order (Loper et al. 2015), the COCO keypoint order and sigmas (Lin et al.
2014, cocodataset.org), MediaPipe's 33 pose landmarks. SMPL-24 has no standard sigmas; ours take
COCO's value where the joint is shared and a like body part's value elsewhere.
"""

SMPL24_NAMES = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2",
    "left_ankle", "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar",
    "right_collar", "head", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow",
    "left_wrist", "right_wrist", "left_hand", "right_hand",
)  # fmt: skip
SMPL24_PARENTS = (
    -1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 20, 21,
)  # fmt: skip
SMPL24_EDGES = tuple((parent, joint) for joint, parent in enumerate(SMPL24_PARENTS) if parent >= 0)

COCO17_NAMES = (
    "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder",
    "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip",
    "left_knee", "right_knee", "left_ankle", "right_ankle",
)  # fmt: skip
# COCO's own skeleton, 0-based
COCO17_SKELETON = (
    (15, 13), (13, 11), (16, 14), (14, 12), (11, 12), (5, 11), (6, 12), (5, 6), (5, 7), (6, 8),
    (7, 9), (8, 10), (1, 2), (0, 1), (0, 2), (1, 3), (2, 4), (3, 5), (4, 6),
)  # fmt: skip

MEDIAPIPE33_NAMES = (
    "nose", "left_eye_inner", "left_eye", "left_eye_outer", "right_eye_inner", "right_eye",
    "right_eye_outer", "left_ear", "right_ear", "mouth_left", "mouth_right", "left_shoulder",
    "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_pinky",
    "right_pinky", "left_index", "right_index", "left_thumb", "right_thumb", "left_hip",
    "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle", "left_heel",
    "right_heel", "left_foot_index", "right_foot_index",
)  # fmt: skip
# coco17 = mediapipe33[MEDIAPIPE33_TO_COCO17]
MEDIAPIPE33_TO_COCO17 = tuple(MEDIAPIPE33_NAMES.index(name) for name in COCO17_NAMES)

COCO17_SIGMAS = (
    0.026, 0.025, 0.025, 0.035, 0.035, 0.079, 0.079, 0.072, 0.072, 0.062, 0.062, 0.107, 0.107,
    0.087, 0.087, 0.089, 0.089,
)  # fmt: skip
SMPL24_SIGMAS = (
    0.107, 0.107, 0.107, 0.107, 0.087, 0.087, 0.079, 0.089, 0.089, 0.079, 0.089, 0.089, 0.079,
    0.079, 0.079, 0.035, 0.079, 0.079, 0.072, 0.072, 0.062, 0.062, 0.062, 0.062,
)  # fmt: skip

# The SMPL bone whose flesh surrounds each keypoint: the label that `part_labels` gives there.
COCO17_PARTS = tuple(
    SMPL24_NAMES.index(name if name in SMPL24_NAMES else "head") for name in COCO17_NAMES
)
SMPL24_PARTS = tuple(range(len(SMPL24_NAMES)))
