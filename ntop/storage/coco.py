"""COCO keypoint files: streamed, deterministic, one record per line.

COCO counts pixels from the centre of the first one, so `keypoints` are ours minus 0.5; boxes span
pixel edges in both. Points outside the image have v = 0 and x = y = 0; `keypoints2d_px` keeps the
unclipped projection in our convention. Loaders ignore the extra keys.
"""

import json
from collections.abc import Container, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from ntop.body.skeletons import (
    COCO17_NAMES,
    COCO17_SIGMAS,
    COCO17_SKELETON,
    SMPL24_EDGES,
    SMPL24_NAMES,
    SMPL24_SIGMAS,
)
from ntop.conventions import PIXEL_CENTRE, DataError
from ntop.storage.remedies import remedy
from ntop.storage.tables import Row

CATEGORY_ID = 1
COPIED_CHARS = 1 << 16  # at a time, when the two halves of a file are joined


@dataclass(frozen=True)
class Skeleton:
    """A keypoint set as COCO sees it; `name` completes the columns' and the files' names."""

    name: str
    keypoints: tuple[str, ...]
    edges: tuple[tuple[int, int], ...]
    sigmas: tuple[float, ...]

    def category(self) -> dict[str, Any]:
        """COCO's category record; its skeleton counts from one."""
        return {
            "id": CATEGORY_ID,
            "name": "person",
            "supercategory": "person",
            "keypoints": list(self.keypoints),
            "skeleton": [[a + 1, b + 1] for a, b in self.edges],
            "sigmas": list(self.sigmas),
        }


COCO17 = Skeleton("coco17", COCO17_NAMES, COCO17_SKELETON, COCO17_SIGMAS)
SMPL24 = Skeleton("smpl24", SMPL24_NAMES, SMPL24_EDGES, SMPL24_SIGMAS)

# what an image's record carries beyond COCO: who, when, and the camera to project with
IMAGE_KEYS = (
    "sample_id", "source", "actor", "action", "rig", "view", "frame", "depth_path", "parts_path",
    "camera_model", "focal_px", "cx_px", "cy_px", "max_theta_rad", "center_world_m",
    "rotation_camera_from_world", "focal_y_px", "distortion",
)  # fmt: skip
SMPL_KEYS = ("betas", "global_orient_rad", "body_pose_rad", "transl_m")


def image_record(row: Row, *, image_id: int) -> dict[str, Any]:
    """COCO's image record of one manifest row; `file_name` is relative to the dataset's folder."""
    return {
        "id": image_id,
        "file_name": row["image_path"],
        "width": row["width"],
        "height": row["height"],
        **{key: row[key] for key in IMAGE_KEYS},
    }


def annotation_record(
    person: Row,
    skeleton: Skeleton,
    *,
    annotation_id: int,
    image: dict[str, Any],
    rle: str,
    keypoints3d_world_m: list[float],
) -> dict[str, Any]:
    """COCO's annotation record of one person in one view; ids start at 1 (0 breaks matching)."""
    pixels = person[f"keypoints2d_{skeleton.name}_px"]
    visibility = person[f"visibility_{skeleton.name}"]
    triplets: list[float] = []
    for index, v in enumerate(visibility):
        u, w = pixels[2 * index : 2 * index + 2]
        triplets += [u - PIXEL_CENTRE, w - PIXEL_CENTRE, v] if v else [0, 0, 0]
    return {
        "id": annotation_id,
        "image_id": image["id"],
        "category_id": CATEGORY_ID,
        "iscrowd": 0,
        "bbox": person["bbox_xywh_px"],
        "area": person["area_px"],
        "segmentation": {"size": [image["height"], image["width"]], "counts": rle},
        "keypoints": triplets,
        "num_keypoints": sum(v > 0 for v in visibility),
        "person_id": person["person_id"],
        "keypoints2d_px": pixels,
        "keypoints3d_world_m": keypoints3d_world_m,
        "smpl": {key: person[key] for key in SMPL_KEYS},
    }


class CocoWriter:
    """Appends records to one COCO file; memory does not grow with the number of images."""

    def __init__(self, images: TextIO, annotations: TextIO, skeleton: Skeleton) -> None:
        """Write image records and annotation records to two streams; see `coco_writer`."""
        self._images, self._annotations, self._skeleton = images, annotations, skeleton
        self._num_images = self._num_annotations = 0

    def add(self, row: Row, *, rle: str, keypoints3d_world_m: list[float]) -> None:
        """Add one manifest row with its persons (a view in which nobody is seen has none)."""
        self._num_images += 1
        image = image_record(row, image_id=self._num_images)
        _append(self._images, image, first=self._num_images == 1)
        for person in row["persons"]:
            self._num_annotations += 1
            record = annotation_record(
                person,
                self._skeleton,
                annotation_id=self._num_annotations,
                image=image,
                rle=rle,
                keypoints3d_world_m=keypoints3d_world_m,
            )
            _append(self._annotations, record, first=self._num_annotations == 1)


@contextmanager
def coco_writer(path: Path, *, skeleton: Skeleton, info: dict[str, Any]) -> Iterator[CocoWriter]:
    """A writer whose file is complete when the block ends.

    Not atomic: a dataset is built in a work folder and published as a whole.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    rest = path.with_suffix(".annotations")
    with path.open("w") as images, rest.open("w+") as annotations:
        images.write(f'{{"info":{_json(info)},\n"licenses":[],\n"categories":')
        images.write(f'{_json([skeleton.category()])},\n"images":[')
        yield CocoWriter(images, annotations, skeleton)
        images.write('\n],\n"annotations":[')
        annotations.seek(0)
        while block := annotations.read(COPIED_CHARS):
            images.write(block)
        images.write("\n]}\n")
    rest.unlink()


def read_coco(path: Path, *, file_names: Container[str]) -> dict[str, Any]:
    """The part of a COCO file that is about some images; the others cost no memory.

    Relies on what `CocoWriter` does: one record per line.

    Raises:
        DataError: it cannot be read, or another program has laid it out anew.
    """
    document: dict[str, Any] = {"categories": [], "images": [], "annotations": []}
    ids, section = set(), ""
    try:
        with path.open() as stream:
            for line in stream:
                if line.startswith('"'):
                    section, rest = line.split('":', 1)
                    section = section[1:]
                    if section == "categories":
                        document[section] = json.loads(rest.rstrip(",\n"))
                elif not line.startswith("{"):
                    continue
                elif section == "images" and _between(line, '"file_name":"', '"') in file_names:
                    record = json.loads(line.rstrip(",\n"))
                    ids.add(record["id"])
                    document[section].append(record)
                elif section == "annotations" and int(_between(line, '"image_id":', ",")) in ids:
                    document[section].append(json.loads(line.rstrip(",\n")))
    except (OSError, ValueError) as error:
        raise DataError(f"cannot read {path}: {error}; {remedy(path)}") from error
    if section != "annotations":
        raise DataError(
            f'{path}: no line that starts with "annotations"; expected one record per line, as '
            f"assemble writes them: it is cut off or was laid out anew; {remedy(path)}"
        )
    return document


def _between(line: str, before: str, after: str) -> str:
    return line.partition(before)[2].partition(after)[0]


def _append(stream: TextIO, record: dict[str, Any], *, first: bool) -> None:
    stream.write(("\n" if first else ",\n") + _json(record))


def _json(value: Any) -> str:
    # Python prints floats so that they read back bit for bit; NaN would not be JSON
    return json.dumps(value, separators=(",", ":"), allow_nan=False)
