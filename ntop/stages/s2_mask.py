"""Stage mask: frames -> soft person mattes and 2D keypoints with confidence.

| written below `out` | what |
|---|---|
| `masks.parquet` (schema MASK) | per frame and view: path, confidence in [0, 1], method, reason |
| `masks/{action}/{view}/{frame}.png` | 8-bit soft matte, as large as the frame |
| `keypoints2d.parquet` (KEYPOINTS2D) | 33 MediaPipe keypoints in our continuous pixels |

What the source provides is not computed again: with its own keypoints only masks are written, with
its own masks only keypoints. A frame without a usable person becomes an empty matte, keypoints of
confidence 0, and a row with the reason.
"""

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from ntop.config.sections import MaskConfig
from ntop.conventions import DataError
from ntop.masks.background import temporal_median
from ntop.masks.consensus import GROUPS, naming
from ntop.masks.landmarks import NUM_KEYPOINTS
from ntop.masks.network import Network
from ntop.masks.plates import Plate, PlateBuilder
from ntop.masks.segmentation import (
    Segmentation,
    edge_radius_px,
    has_person,
    segment_difference,
    segment_person,
    unusable,
)
from ntop.masks.tracking import Networks, Sighting, follow_person
from ntop.storage import schemas
from ntop.storage.atomic import atomic_folder
from ntop.storage.files import check_files, record_files
from ntop.storage.frames import iterate_frames
from ntop.storage.images import read_matte, write_matte
from ntop.storage.pace import Pace
from ntop.storage.remedies import remedy
from ntop.storage.tables import Row, read_table, write_table

Picture = UInt8[np.ndarray, "height width 3"]

SKELETON = "mediapipe33"
KEY = ("source", "actor", "action", "frame", "view")
PLATE_FRAMES = 50  # of a view, evenly spread, to piece the scene together from
MEDIAN_FRAMES = 25  # of a view, evenly spread, for a plate by temporal median


@dataclass(frozen=True)
class Job:
    """What the stage must do, and where the files lie."""

    config: MaskConfig
    capture: Path
    packages: Path
    out: Path

    @property
    def wants_masks(self) -> bool:
        """Whether the source leaves the masks to this stage."""
        return "masks" not in self.config.provides

    @property
    def wants_keypoints(self) -> bool:
        """Whether the source leaves the keypoints to this stage."""
        return "keypoints2d" not in self.config.provides

    @property
    def seeks_person(self) -> bool:
        """Whether frames are looked at by the networks, before they are segmented."""
        return self.wants_keypoints or self.config.method == "mediapipe"


def main(config: MaskConfig, capture: Path, packages: Path, out: Path) -> None:
    """Segment the actor and find his keypoints in every frame of a capture.

    Args:
        config: method, networks, folder of hand-corrected masks, what the source provides.
        capture: folder of the capture stage: `frames.parquet`, pictures, optionally `plates/`.
        packages: folder of fetched packages with the networks.
        out: folder to write; it appears by one rename.

    Raises:
        DataError: unreadable frames or networks, a hand-corrected mask of another size than its
            frame, or not one frame of the actor with a usable mask, or with keypoints.
    """
    networks = (config.detector, config.landmarks)
    check_files(capture, *(packages / Path(name).parts[0] for name in networks))
    with atomic_folder(out) as folder:
        segment_capture(Job(config, capture, packages, folder))
        record_files(folder)


def segment_capture(job: Job) -> None:
    """Process all views of a capture and write the tables.

    Raises:
        DataError: see `main`.
    """
    capture, out = job.capture, job.out
    table = read_table(capture / "frames.parquet", schema=schemas.FRAME)
    rows = sorted(table, key=lambda row: (row["action"], row["view"], row["frame"]))
    views = [list(g) for _, g in groupby(rows, key=lambda row: (row["action"], row["view"]))]
    # One thread per core: networks and OpenCV compute outside Python's lock, and what comes out
    # of a view does not depend on the other views.
    usable = sum(not row["reason"] for row in rows)
    pace = Pace("mask", total=usable * (job.seeks_person + job.wants_masks), unit="looks")
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        done = list(pool.map(lambda view: process_view(job, view, pace), views))
    masks = [mask for view, _ in done for mask in view]
    points = [point for _, view in done for point in view]
    if job.wants_masks:
        if all(mask["confidence"] == 0 for mask in masks):
            reasons = "; ".join(sorted({mask["reason"] for mask in masks})[:3])
            raise DataError(_nothing_usable(capture, f"mask ({reasons})"))
        write_table(masks, schema=schemas.MASK, path=out / "masks.parquet")
    if job.wants_keypoints:
        if not any(any(point["confidence"]) for point in points):
            raise DataError(_nothing_usable(capture, "keypoint"))
        write_table(points, schema=schemas.KEYPOINTS2D, path=out / "keypoints2d.parquet")


def process_view(job: Job, rows: list[Row], pace: Pace) -> tuple[list[Row], list[Row]]:
    """Mask and keypoint rows of one view's frames; writes the mattes.

    The frames are decoded twice: to follow the person and learn what is behind him, then to
    segment.
    """
    usable = [row for row in rows if not row["reason"]]
    sightings, plate = _follow(job, usable, pace)
    votes = sum((s.pose.votes for s in sightings if s.pose), np.zeros(len(GROUPS), int))
    # continuity named left and right alike in all frames; the majority of all looks says which
    order = naming(votes < 0)[:NUM_KEYPOINTS]
    points = [_keypoint_row(row, s, order) for row, s in zip(usable, sightings, strict=True)]
    masks = []
    if job.wants_masks:
        segment = _segmenter(job, usable, plate)
        frames = zip(_in_time(job, usable), sightings, strict=True)
        for (row, image), sighting in frames:
            masks.append(_mask_row(job, row, segment(image, sighting)))
            pace.step()
    for row in rows:
        if row["reason"]:
            lost = Sighting(None, row["reason"])
            points.append(_keypoint_row(row, lost, order))
            if job.wants_masks:
                shape = (row["height"], row["width"])
                masks.append(_mask_row(job, row, unusable(shape, lost.reason)))
    return masks, points


def _follow(job: Job, rows: list[Row], pace: Pace) -> tuple[list[Sighting], Plate | None]:
    """The person in every frame of a view, in time, and the scene behind him.

    Without need for the network nobody is sought, and the scene is unknown.
    """
    if not rows or not job.seeks_person:
        return [Sighting(None, "")] * len(rows), None
    detector, landmarks = job.config.detector, job.config.landmarks
    networks = Networks(Network(job.packages / detector), Network(job.packages / landmarks))
    scene = PlateBuilder((rows[0]["height"], rows[0]["width"]))
    stride = max(1, len(rows) // PLATE_FRAMES)
    sightings, last = [], None
    for index, (_, image) in enumerate(_in_time(job, rows)):
        sighting = follow_person(networks, image, last)
        sightings.append(sighting)
        last = sighting.pose or last
        if sighting.pose and index % stride == 0:
            person = sighting.pose.person_in_frame()
            scene.add(image, person, radius_px=edge_radius_px(sighting.pose))
        pace.step()
    return sightings, scene.finish()


def _segmenter(
    job: Job, rows: list[Row], plate: Plate | None
) -> Callable[[Picture, Sighting], Segmentation]:
    """How a frame of this view is segmented, by the configured method."""
    match job.config.method:
        case "mediapipe":
            return lambda image, sighting: segment_person(image, sighting, plate=plate)
        case "background":
            scene = _read_plate(job, rows)
            return lambda image, _: segment_difference(image, scene)


def _in_time(job: Job, rows: list[Row]) -> Iterator[tuple[Row, Picture]]:
    return iterate_frames(job.capture / "frames.parquet", rows)


def _read_plate(job: Job, rows: list[Row]) -> Picture:
    """The empty scene of a view: the capture's plate if it has one, else the median over time."""
    path = job.capture / "plates" / f"{rows[0]['action']}_{rows[0]['view']}.png"
    if not path.exists():
        chosen = rows[:: max(1, len(rows) // MEDIAN_FRAMES)]
        return temporal_median([image for _, image in _in_time(job, chosen)])
    bgr = cv2.imread(str(path), cv2.IMREAD_COLOR)
    size = (rows[0]["height"], rows[0]["width"])
    if bgr is None or bgr.shape[:2] != size:
        got = "no readable picture" if bgr is None else f"{bgr.shape[1]}x{bgr.shape[0]} px"
        raise DataError(
            f"background plate {path}: {got}, expected {size[1]}x{size[0]} px as the frames; "
            + remedy(path)
        )
    return cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB)


def _mask_row(job: Job, row: Row, found: Segmentation) -> Row:
    """The row of a frame's matte, computed or corrected by hand; writes the matte."""
    name = f"{row['action']}/{row['view']}/{row['frame']:06d}.png"
    method = job.config.method
    corrected = Path(job.config.overrides) / name if job.config.overrides else None
    if corrected is not None and corrected.exists():
        found, method = _read_override(corrected, row), "manual"
    write_matte(found.matte, path=job.out / "masks" / name)
    return {key: row[key] for key in KEY} | {
        "mask_path": f"masks/{name}",
        "confidence": found.confidence,
        "method": method,
        "reason": found.reason,
    }


def _read_override(path: Path, row: Row) -> Segmentation:
    matte = read_matte(path)
    height, width = matte.shape
    if (width, height) != (row["width"], row["height"]):
        raise DataError(
            f"hand-corrected mask {path} is {width}x{height} px, its frame "
            f"{row['width']}x{row['height']} px; save it in the frame's size"
        )
    if has_person(matte):
        return Segmentation(matte, 1.0, "")
    return Segmentation(matte, 0.0, "empty mask, by hand")


def _keypoint_row(row: Row, sighting: Sighting, order: np.ndarray) -> Row:
    """The row of a frame's keypoints, `order` naming left and right."""
    pose = sighting.pose
    landmarks = np.zeros((NUM_KEYPOINTS, 2)) if pose is None else pose.landmarks_px[order]
    confidence = np.zeros(NUM_KEYPOINTS) if pose is None else pose.confidence[order]
    return {key: row[key] for key in KEY} | {
        "skeleton": SKELETON,
        "keypoints_px": landmarks.ravel().tolist(),
        "confidence": confidence.tolist(),
    }


def _nothing_usable(capture: Path, what: str) -> str:
    return (
        f"{capture}: not one frame has a usable {what}; look at the pictures, choose another "
        "`mask.method`, or give hand-corrected masks in `mask.overrides`"
    )
