"""One Parquet schema per stage: the true interface between the stages.

Columns carry unit and frame in their name. Paths are relative to the table's folder, so that a
result folder can be moved. Pixels follow our convention (first centre at 0.5).
"""

import pyarrow as pa

from ntop.conventions import NUM_BETAS, NUM_JOINTS

STRING, INT32, INT64, FLOAT64 = pa.string(), pa.int32(), pa.int64(), pa.float64()


def vector(length: int, kind: pa.DataType = FLOAT64) -> pa.DataType:
    """A list of fixed length."""
    return pa.list_(kind, length)


ACTOR_KEY = [("source", STRING), ("actor", STRING), ("action", STRING), ("frame", INT32)]
VIEW_KEY = [*ACTOR_KEY, ("view", STRING)]
RENDER_KEY = [*ACTOR_KEY[:3], ("rig", STRING), *VIEW_KEY[3:]]

# A still image, or one frame of a video: `image_index` is the 0-based frame in `image_path`,
# -1 for a still. Nothing is re-encoded. `reason` is empty where the frame is usable.
FRAME = pa.schema(
    [
        *VIEW_KEY,
        ("image_path", STRING),
        ("image_index", INT32),
        ("width", INT32),
        ("height", INT32),
        ("reason", STRING),
    ]
)

# One camera per action: a video may be a letter-boxed copy of the calibrated image.
CAMERA = pa.schema(
    [
        ("source", STRING),
        ("actor", STRING),
        ("action", STRING),
        ("view", STRING),
        ("model", STRING),
        ("width", INT32),
        ("height", INT32),
        ("fx_px", FLOAT64),
        ("fy_px", FLOAT64),
        ("cx_px", FLOAT64),
        ("cy_px", FLOAT64),
        ("distortion", vector(5)),
        ("center_world_m", vector(3)),
        ("rotation_camera_from_world", vector(9)),
    ]
)

# What a finished folder holds (ntop.storage.files); paths are relative to it.
FILE = pa.schema([("path", STRING), ("num_bytes", INT64), ("sha256", STRING)])

# Soft matte, 8 bit, as large as the frame. `confidence` in [0, 1].
MASK = pa.schema(
    [
        *VIEW_KEY,
        ("mask_path", STRING),
        ("confidence", FLOAT64),
        ("method", STRING),
        ("reason", STRING),
    ]
)

# `skeleton` names the order (ntop.body.skeletons); NaN-free: a missing point has confidence 0.
KEYPOINTS2D = pa.schema(
    [
        *VIEW_KEY,
        ("skeleton", STRING),
        ("keypoints_px", pa.list_(FLOAT64)),
        ("confidence", pa.list_(FLOAT64)),
    ]
)

BODY_COLUMNS = [
    ("betas", vector(NUM_BETAS)),
    ("global_orient_rad", vector(3)),
    ("body_pose_rad", vector(69)),
    ("transl_m", vector(3)),
]

# One body pose per frame; `betas` is the same in all rows of an actor.
BODY = pa.schema(
    [
        *ACTOR_KEY,
        *BODY_COLUMNS,
        ("joints3d_world_m", vector(3 * NUM_JOINTS)),
        ("error_mm", FLOAT64),
        ("reason", STRING),
    ]
)

# One row per training step; the watched PSNR is NaN where it was not measured.
CURVE = pa.schema(
    [
        ("step", INT32),
        ("loss", FLOAT64),
        ("psnr_person_db", FLOAT64),
        ("watched_psnr_db", FLOAT64),
    ]
)

# Where training moved a camera (`frame` -1: all of the action's) or, with an empty `view`, the
# person in one frame: world axes, a turn about the camera's centre or the pelvis, then the shift.
REFINEMENT = pa.schema(
    [
        ("action", STRING),
        ("view", STRING),
        ("frame", INT32),
        ("rotation_rad", vector(3)),
        ("translation_m", vector(3)),
    ]
)

# What completes `camera_model`, `focal_px`, `cx_px`, `cy_px`, `max_theta_rad` (decision 0017): the
# vertical focal length, and k1..k4 of a Kannala-Brandt lens (empty for the others). They came
# later: a table without them reads as null, which means square pixels and no distortion.
LENS_COLUMNS = [("focal_y_px", FLOAT64), ("distortion", pa.list_(FLOAT64))]

# A rendered view: its files, its camera, its place over the person, and what it was made from.
IMAGE_COLUMNS = [
    ("image_path", STRING),
    ("depth_path", STRING),
    ("parts_path", STRING),
    ("image_sha256", STRING),
    ("width", INT32),
    ("height", INT32),
    ("camera_model", STRING),
    ("focal_px", FLOAT64),
    ("cx_px", FLOAT64),
    ("cy_px", FLOAT64),
    ("max_theta_rad", FLOAT64),
    ("center_world_m", vector(3)),
    ("rotation_camera_from_world", vector(9)),
    ("height_above_pelvis_m", FLOAT64),
    ("ring_radius_m", FLOAT64),
    ("seed", INT64),
    ("avatar_sha256", STRING),
    ("background_id", STRING),
]

# One row per rendered view.
RENDER = pa.schema(
    [
        ("sample_id", STRING),
        *RENDER_KEY,
        *IMAGE_COLUMNS,
        *BODY_COLUMNS,
        ("joints3d_world_m", vector(3 * NUM_JOINTS)),
        ("coco17_world_m", vector(51)),
        *LENS_COLUMNS,
    ]
)

PERSON = pa.struct(
    [
        ("person_id", STRING),
        ("bbox_xywh_px", vector(4)),
        ("area_px", INT64),
        ("keypoints2d_coco17_px", vector(34)),
        ("visibility_coco17", vector(17, pa.int8())),
        ("keypoints2d_smpl24_px", vector(2 * NUM_JOINTS)),
        ("visibility_smpl24", vector(NUM_JOINTS, pa.int8())),
        ("joints3d_world_m", vector(3 * NUM_JOINTS)),
        ("joints3d_camera_m", vector(3 * NUM_JOINTS)),
        *BODY_COLUMNS,
    ]
)

# One row per rendered view; `rle` is the COCO run-length code of the mask (compressed, ASCII).
KEYPOINTS = pa.schema([("sample_id", STRING), ("persons", pa.list_(PERSON)), ("rle", STRING)])

# One row per image of a dataset (DESIGN.md section 7).
MANIFEST = pa.schema(
    [
        ("sample_id", STRING),
        ("split", STRING),
        ("source", STRING),
        ("actor", STRING),
        ("action", STRING),
        ("rig", STRING),
        ("view", STRING),
        ("frame", INT32),
        *IMAGE_COLUMNS,
        ("persons", pa.list_(PERSON)),
        *LENS_COLUMNS,
    ]
)
