"""Follow one person through the frames of a view; nobody else takes his place.

The first frame decides who he is: of all people detected, the one whose region is largest and most
central. From then on his region comes from the landmarks of the frame before, as in MediaPipe;
where that fails, the detections are searched, but only close to where he was last.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from ntop.masks.detection import Detection, detect_people
from ntop.masks.landmarks import Pose, estimate_pose, locate_person
from ntop.masks.network import Network
from ntop.masks.regions import Region

MIN_POSE_SCORE = 0.5
MAX_JUMP = 0.35  # of the region's side, between two consecutive frames
MAX_SIZE_RATIO = 1.4  # of the regions' sides; arms raised or a deep bend change it by 1.25
CENTRALITY = 0.5  # how much of his size a person at the image's corner loses in the choice


@dataclass(frozen=True)
class Networks:
    """The two networks of the pose pipeline."""

    detector: Network
    landmarks: Network


@dataclass(frozen=True)
class Sighting:
    """The person in one frame, or `pose` None and the reason why not."""

    pose: Pose | None
    reason: str


def follow_person(
    networks: Networks, image: UInt8[np.ndarray, "height width 3"], last: Pose | None
) -> Sighting:
    """The person last seen as `last` (None: not yet seen) in the next frame."""
    if last is not None:
        sighting = _look_closely(networks, image, near=last.next_region, last=last)
        if sighting.pose is not None:
            return sighting
    people = detect_people(networks.detector, image)
    if last is not None:
        people = [p for p in people if not _moved_too_far(p.region, last.next_region)]
    if not people:
        where = "detected" if last is None else "detected near his last place"
        return Sighting(None, f"no person {where}")
    near = _main_person(people, image, None if last is None else last.next_region)
    return _look_closely(networks, image, near=near.region, last=last)


def _look_closely(
    networks: Networks, image: np.ndarray, *, near: Region, last: Pose | None
) -> Sighting:
    """The person in the region `near`: the first look finds his place, the others measure."""
    region, score = locate_person(networks.landmarks, image, near)
    refusal = _refusal(region, score, last)
    if refusal:
        return Sighting(None, refusal)
    before_px = None if last is None else last.landmarks_px
    pose = estimate_pose(networks.landmarks, image, region, before_px=before_px)
    refusal = _refusal(pose.next_region, pose.pose_score, last)
    return Sighting(None, refusal) if refusal else Sighting(pose, "")


def _main_person(people: list[Detection], image: np.ndarray, last: Region | None) -> Detection:
    """The largest, most central person; or the one closest to the last place."""
    if last is not None:
        return min(people, key=lambda p: _distance_px(p.region, last))
    height, width = image.shape[:2]
    middle = Region(width / 2, height / 2, 1.0, 0.0)
    corner = math.hypot(width, height) / 2
    return max(
        people,
        key=lambda p: p.region.side_px * (1 - CENTRALITY * _distance_px(p.region, middle) / corner),
    )


def _refusal(region: Region, pose_score: float, last: Pose | None) -> str:
    """Why what is seen in `region` is not the person, or nothing."""
    if pose_score < MIN_POSE_SCORE:
        return f"pose score {pose_score:.2f} below {MIN_POSE_SCORE}"
    return "" if last is None else _moved_too_far(region, last.next_region)


def _moved_too_far(region: Region, last: Region) -> str:
    jump = _distance_px(region, last) / last.side_px
    ratio = max(region.side_px / last.side_px, last.side_px / max(region.side_px, 1e-6))
    if jump > MAX_JUMP or ratio > MAX_SIZE_RATIO:
        return f"the person found moved by {jump:.2f} of his size and grew or shrank {ratio:.2f}x"
    return ""


def _distance_px(one: Region, other: Region) -> float:
    return math.hypot(one.centre_u_px - other.centre_u_px, one.centre_v_px - other.centre_v_px)
