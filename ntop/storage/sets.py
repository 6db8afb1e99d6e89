"""Set files: one JSON per body pose with SMPL parameters, 3D keypoints and the virtual cameras.

It is the paper's "annotation file per 9-view set". All pixels follow our convention (the first
pixel's centre at 0.5), all rotations are camera_from_world, row-major.
"""

import json
from pathlib import Path
from typing import Any

from ntop.storage.atomic import write_bytes
from ntop.storage.files import content_row
from ntop.storage.tables import Row

CAMERA_KEYS = (
    "camera_model", "width", "height", "focal_px", "cx_px", "cy_px", "max_theta_rad",
    "center_world_m", "rotation_camera_from_world", "focal_y_px", "distortion",
)  # fmt: skip
VIEW_KEYS = ("sample_id", "image_path", "depth_path", "parts_path", "image_sha256", "persons")
# columns that say the same in every view of a set
BODY_KEYS = ("betas", "global_orient_rad", "body_pose_rad", "transl_m", "joints3d_world_m")
SET_KEYS = (
    "split", "source", "actor", "action", "rig", "frame", "height_above_pelvis_m", "ring_radius_m",
    "seed", "avatar_sha256", "background_id",
)  # fmt: skip


def set_record(rows: list[Row], *, body: Row) -> dict[str, Any]:
    """The record of a set from its manifest rows in view order; `body`: any of its render rows."""
    return {
        **{key: rows[0][key] for key in SET_KEYS},
        "bodies": [
            {
                "person_id": body["actor"],
                **{key: body[key] for key in BODY_KEYS},
                "coco17_world_m": body["coco17_world_m"],
            }
        ],
        "views": {
            row["view"]: {
                "camera": {key: row[key] for key in CAMERA_KEYS},
                **{key: row[key] for key in VIEW_KEYS if key != "persons"},
                "persons": [
                    {key: value for key, value in person.items() if key not in BODY_KEYS}
                    for person in row["persons"]
                ],
            }
            for row in rows
        },
    }


def write_set(record: dict[str, Any], *, folder: Path) -> Row:
    """Write a set's file below `sets/`; returns its record (schema FILE) there."""
    place = "/".join(record[key] for key in ("split", "source", "actor", "action", "rig"))
    name = f"sets/{place}/{record['frame']:06d}.json"
    content = (json.dumps(record, separators=(",", ":"), allow_nan=False) + "\n").encode()
    write_bytes(folder / name, content)
    return content_row(name, content)
