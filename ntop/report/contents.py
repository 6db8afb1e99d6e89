"""What the images show, counted over the whole dataset: subject sizes, poses, joints in frame.

The manifest is read in batches and only counted, so that memory does not grow with the images.
"""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Float, Int

from ntop.body.skeletons import SMPL24_NAMES
from ntop.conventions import NUM_JOINTS
from ntop.report.charts import Chart, Line, bar_chart, line_chart
from ntop.storage import schemas
from ntop.storage.tables import open_table, reading

BATCH_ROWS = 4096
SIZE_STEP_PX, SIZE_BINS = 10, 400  # boxes up to 4000 px, larger ones in the last bin
ANGLE_STEP_DEG, ANGLE_BINS = 5, 36
PELVIS, NECK = SMPL24_NAMES.index("pelvis"), SMPL24_NAMES.index("neck")
KNEES_HIPS_ANKLES = tuple(
    tuple(SMPL24_NAMES.index(f"{side}_{name}") for name in ("hip", "knee", "ankle"))
    for side in ("left", "right")
)


def _zeros(*shape: int) -> np.ndarray:
    return np.zeros(shape, np.int64)


@dataclass
class Contents:
    """Counts over all subjects; a subject is one person in one image."""

    subjects: int = 0
    widths: Int[np.ndarray, " bin"] = field(default_factory=lambda: _zeros(SIZE_BINS))
    heights: Int[np.ndarray, " bin"] = field(default_factory=lambda: _zeros(SIZE_BINS))
    inclinations: Int[np.ndarray, " bin"] = field(default_factory=lambda: _zeros(ANGLE_BINS))
    knee_angles: Int[np.ndarray, " bin"] = field(default_factory=lambda: _zeros(ANGLE_BINS))
    in_frame: Int[np.ndarray, " joint"] = field(default_factory=lambda: _zeros(NUM_JOINTS))
    visible: Int[np.ndarray, " joint"] = field(default_factory=lambda: _zeros(NUM_JOINTS))

    def add(self, persons: pa.StructArray) -> None:
        """Count some subjects, given as the manifest's persons."""
        count = len(persons)
        if count == 0:
            return

        def column(name: str, *shape: int) -> np.ndarray:
            values = persons.field(name).flatten().to_numpy(zero_copy_only=False)
            return values.reshape(count, *shape)

        boxes = column("bbox_xywh_px", 4)
        joints = column("joints3d_world_m", NUM_JOINTS, 3)
        seen = column("visibility_smpl24", NUM_JOINTS)
        self.subjects += count
        self.widths += _counted(boxes[:, 2] / SIZE_STEP_PX, SIZE_BINS)
        self.heights += _counted(boxes[:, 3] / SIZE_STEP_PX, SIZE_BINS)
        up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), (count, 3))
        trunk = angles_deg(joints[:, NECK] - joints[:, PELVIS], up)
        self.inclinations += _counted(trunk / ANGLE_STEP_DEG, ANGLE_BINS)
        for hip, knee, ankle in KNEES_HIPS_ANKLES:
            thigh, shank = joints[:, knee] - joints[:, hip], joints[:, ankle] - joints[:, knee]
            bent = angles_deg(thigh, shank)
            self.knee_angles += _counted(bent / ANGLE_STEP_DEG, ANGLE_BINS)
        self.in_frame += (seen > 0).sum(axis=0)
        self.visible += (seen == 2).sum(axis=0)


def angles_deg(
    a: Float[np.ndarray, "count 3"], b: Float[np.ndarray, "count 3"]
) -> Float[np.ndarray, " count"]:
    """The angle between two vectors in [0, 180] degrees, well behaved near both ends."""
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(axis=1)))


def read_contents(manifest: Path) -> Contents:
    """Count over a dataset's manifest.

    Raises:
        DataError: it cannot be read.
    """
    contents = Contents()
    with open_table(manifest, schema=schemas.MANIFEST) as file, reading(manifest):
        for batch in file.iter_batches(BATCH_ROWS, columns=["persons"]):
            contents.add(batch.column("persons").flatten())
    return contents


def contents_charts(contents: Contents) -> dict[str, Chart]:
    """Histograms by name; shares are of all subjects, so that datasets can be compared."""
    total = contents.subjects
    if not total:
        return {}
    last = int(np.flatnonzero(contents.widths + contents.heights)[-1]) + 1
    charts = {
        "subject size": line_chart(
            [
                _steps("width", contents.widths[:last] / total, SIZE_STEP_PX, kind=0),
                _steps("height", contents.heights[:last] / total, SIZE_STEP_PX, kind=1),
            ],
            title="Size of the box around the mask",
            x_label=f"pixels, in steps of {SIZE_STEP_PX}",
            y_label="% of subjects",
        ),
        "pose": line_chart(
            [
                _steps("trunk against upright", contents.inclinations / total, ANGLE_STEP_DEG),
                _steps("bend of a knee", contents.knee_angles / 2 / total, ANGLE_STEP_DEG, kind=1),
            ],
            title="Poses: lean of the trunk and bend of the knees",
            x_label=f"degrees, in steps of {ANGLE_STEP_DEG}",
            y_label="% of subjects",
        ),
    }
    for name, title, counts in (
        ("joints in frame", "Joints inside the image circle", contents.in_frame),
        ("joints visible", "Joints neither outside nor hidden", contents.visible),
    ):
        shares = {
            joint.replace("_", " "): float(100 * share)
            for joint, share in zip(SMPL24_NAMES, counts / total, strict=True)
        }
        charts[name] = bar_chart(shares, title=f"{title}, share of subjects", unit="%")
    return charts


def _steps(name: str, shares: np.ndarray, step: float, *, kind: int = 0) -> Line:
    """A histogram's outline, in percent."""
    edges = np.arange(len(shares) + 1) * step
    x = np.repeat(edges, 2)
    y = np.concatenate([[0.0], np.repeat(100 * shares, 2), [0.0]])
    return Line(name, x.tolist(), y.tolist(), kind)


def _counted(values: Float[np.ndarray, " count"], bins: int) -> Int[np.ndarray, " bin"]:
    return np.bincount(np.clip(values.astype(np.int64), 0, bins - 1), minlength=bins)
