"""Set files: one JSON per body pose with SMPL parameters, 3D keypoints and the virtual cameras.

It is the paper's "annotation file per 9-view set". All pixels follow our convention (the first
pixel's centre at 0.5), all rotations are camera_from_world, row-major.
"""

import json
from pathlib import Path
from typing import Any

from ntop.conventions import DataError
from ntop.storage.files import content_row
from ntop.storage.remedies import remedy
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


def set_path(row: Row) -> str:
    """Where a set's file lies in a dataset, from its record or any of its manifest rows."""
    place = "/".join(row[key] for key in ("split", "source", "actor", "action", "rig"))
    return f"sets/{place}/{row['frame']:06d}.json"


def read_set(row: Row, *, folder: Path) -> dict[str, Any]:
    """The record of the set that a manifest row belongs to.

    Raises:
        DataError: the file is missing or not JSON.
    """
    path = folder / set_path(row)
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise DataError(f"cannot read {path}: {error}; {remedy(path)}") from error


def write_set(record: dict[str, Any], *, folder: Path) -> Row:
    """Write a set's file below `sets/`; returns its record (schema FILE) there.

    Not atomic: a dataset is built in a work folder and published as a whole. Waiting for the disk
    after each of 63 thousand files would take longer than all the rest.
    """
    name = set_path(record)
    content = (json.dumps(record, separators=(",", ":"), allow_nan=False) + "\n").encode()
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return content_row(name, content)
