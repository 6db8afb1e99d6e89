"""Tables of calibrated perspective cameras, one row per action and view."""

from pathlib import Path

import torch

from ntop.conventions import DataError
from ntop.geometry.cameras import Camera, Pinhole
from ntop.storage import schemas
from ntop.storage.tables import Row, read_table, write_table

ORTHONORMAL_TOLERANCE = 1e-6  # of R R^T - 1; calibration files hold 6-16 digits

CameraKey = tuple[str, str]  # action, view


def camera_row(camera: Camera, *, source: str, actor: str, action: str, view: str) -> Row:
    """The row of schema CAMERA that stores a perspective camera.

    Raises:
        DataError: the lens is not perspective; fisheye cameras live in the render tables.
    """
    lens = camera.lens
    if not isinstance(lens, Pinhole):
        raise DataError(
            f"{source}/{actor} {action} {view}: lens model {lens.model!r} in a table of capture "
            f"cameras; expected {Pinhole.model!r}"
        )
    return {
        "source": source,
        "actor": actor,
        "action": action,
        "view": view,
        "model": lens.model,
        "width": lens.width,
        "height": lens.height,
        "fx_px": lens.fx,
        "fy_px": lens.fy,
        "cx_px": lens.cx,
        "cy_px": lens.cy,
        "distortion": list(lens.distortion),
        "center_world_m": camera.center_world.tolist(),
        "rotation_camera_from_world": camera.rotation.flatten().tolist(),
    }


def camera_from_row(row: Row) -> Camera:
    """The camera of one row, in float64.

    Raises:
        DataError: another lens model, a focal length or size that is not positive, or a matrix
            that is not a proper rotation.
    """
    where = f"{row['source']}/{row['actor']} {row['action']} {row['view']}"
    if row["model"] != Pinhole.model:
        raise DataError(f"{where}: lens model {row['model']!r}, expected {Pinhole.model!r}")
    if min(row["fx_px"], row["fy_px"], row["width"], row["height"]) <= 0:
        raise DataError(
            f"{where}: focal ({row['fx_px']}, {row['fy_px']}) px and size {row['width']}x"
            f"{row['height']} px must be positive"
        )
    rotation = torch.tensor(row["rotation_camera_from_world"], dtype=torch.float64).reshape(3, 3)
    defect = (rotation @ rotation.T - torch.eye(3, dtype=torch.float64)).abs().max().item()
    determinant = torch.linalg.det(rotation).item()
    if not (defect < ORTHONORMAL_TOLERANCE and determinant > 0):
        raise DataError(
            f"{where}: camera_from_world is no proper rotation (|R R^T - 1| = {defect:.2g}, "
            f"det = {determinant:.3f}, expected 0 and +1); the source's axes were read wrongly"
        )
    return Camera(
        lens=Pinhole(
            fx=row["fx_px"],
            fy=row["fy_px"],
            cx=row["cx_px"],
            cy=row["cy_px"],
            width=row["width"],
            height=row["height"],
            distortion=tuple(row["distortion"]),
        ),
        center_world=torch.tensor(row["center_world_m"], dtype=torch.float64),
        rotation=rotation,
    )


def read_cameras(path: Path) -> dict[CameraKey, Camera]:
    """All cameras of a table, by (action, view).

    Raises:
        DataError: unreadable table, an impossible camera, or two rows for one action and view.
    """
    cameras: dict[CameraKey, Camera] = {}
    for row in read_table(path, schema=schemas.CAMERA):
        key = row["action"], row["view"]
        if key in cameras:
            raise DataError(f"{path}: two cameras for action {key[0]!r}, view {key[1]!r}")
        cameras[key] = camera_from_row(row)
    return cameras


def write_cameras(cameras: dict[CameraKey, Camera], *, source: str, actor: str, path: Path) -> None:
    """Write the cameras of one actor as a table of schema CAMERA."""
    rows = [
        camera_row(camera, source=source, actor=actor, action=action, view=view)
        for (action, view), camera in cameras.items()
    ]
    write_table(rows, schema=schemas.CAMERA, path=path)
