"""Reader of Qualisys recordings: a `.qca.txt` calibration and one video per camera and action.

Calibration file (XML): lengths in mm, pixels in subpixels of 1/64, integer pixel centres, image
size from `fov_video`. The rows of its rotation matrix M are the camera's right, up and backward
axes in the world, (x, y, z) is the camera's centre:

    camera_from_world rotation  R = diag(1, -1, -1) M        centre in the world  C = (x, y, z)
"""

import os
import re
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import torch

from ntop.config.sources import QualisysSource
from ntop.config.tables import Sequence
from ntop.conventions import PIXEL_CENTRE, DataError
from ntop.geometry.cameras import Camera, Pinhole
from ntop.storage import schemas
from ntop.storage.atomic import atomic_path
from ntop.storage.cameras import CameraKey, write_cameras
from ntop.storage.frames import count_frames, video_size_px
from ntop.storage.tables import Row, write_table

SUBPIXELS = 64.0
METRES_PER_UNIT = 1e-3
# the file's axes are right, up, backward; ours right, down, forward
OPENCV_FROM_QUALISYS = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))

SizePx = tuple[int, int]  # width, height


def capture_qualisys(
    settings: QualisysSource,
    *,
    source: str,
    actor: str,
    sequences: Iterable[Sequence],
    packages: Path,
    out: Path,
) -> None:
    """Write frames.parquet, cameras.parquet and footage/{action}/{view}.mp4 below `out`.

    The videos are hard links (copies across devices): nothing is re-encoded.

    Raises:
        DataError: a camera or video is missing, a video is damaged or of a size that does not
            belong to the calibration, the views of an action differ in length, or a declared
            frame does not exist.
    """
    package = packages / settings.package
    calibration_path = package / settings.calibration
    calibrated = read_qca(calibration_path, pose2sim_compat=settings.pose2sim_compat)
    missing = sorted(set(settings.views) - set(calibrated))
    if missing:
        raise DataError(
            f"{calibration_path}: no camera {', '.join(missing)}; it holds "
            f"{', '.join(sorted(calibrated))}; correct `views` of source {source!r}"
        )
    cameras: dict[CameraKey, Camera] = {}
    rows: list[Row] = []
    for action, frames in _frames_by_action(sequences).items():
        if action not in settings.trials:
            raise DataError(
                f"{source}/{actor}: action {action!r} is declared, but not among the trials of "
                f"the source, {', '.join(sorted(settings.trials))}; add it to `trials`"
            )
        folder = package / settings.trials[action].videos
        videos = find_videos(folder, views=settings.views)
        _check_lengths(videos, action=action, frames=frames)
        for view, video in videos.items():
            camera = camera_for_video(
                calibrated[view],
                size_px=video_size_px(video),
                letterbox_sizes_px=settings.letterbox_sizes_px,
                where=str(video),
            )
            cameras[action, view] = camera
            image_path = f"footage/{action}/{view}{video.suffix.lower()}"
            _link(video, out / image_path)
            rows += [
                {
                    "source": source,
                    "actor": actor,
                    "action": action,
                    "frame": frame,
                    "view": view,
                    "image_path": image_path,
                    "image_index": frame,
                    "width": camera.lens.width,
                    "height": camera.lens.height,
                    "reason": "",
                }
                for frame in frames
            ]
    write_cameras(cameras, source=source, actor=actor, path=out / "cameras.parquet")
    write_table(rows, schema=schemas.FRAME, path=out / "frames.parquet")


def normalised_view(name: str) -> str:
    """One spelling for a camera's name: `cam_01`, `Cam01` and `cam-01` are all `cam01`."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


def read_qca(path: Path, *, pose2sim_compat: bool) -> dict[str, Camera]:
    """The cameras of a Qualisys `.qca.txt` file by normalised name, in our conventions.

    `pose2sim_compat` divides the distortion by 64, as Pose2Sim does; the checkerboards of its own
    demo fit the undivided values.

    Raises:
        DataError: no such file, no XML, a camera without a needed number, two cameras of one name,
            or a rotated or skewed image, which this reader does not support.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except OSError as error:
        raise DataError(
            f"cannot read calibration {path}: {error.strerror}; fetch or copy it, then run again"
        ) from error
    except ElementTree.ParseError as error:
        raise DataError(f"{path} is no Qualisys calibration: {error}; export it again") from error
    cameras: dict[str, Camera] = {}
    for element in root.iterfind("cameras/camera"):
        name = normalised_view(element.get("serial", ""))
        if not name or name in cameras:
            raise DataError(f"{path}: camera serial {element.get('serial')!r} is empty or doubled")
        cameras[name] = _camera(
            element, where=f"{path} camera {name}", pose2sim_compat=pose2sim_compat
        )
    if not cameras:
        raise DataError(f"{path}: no <camera> below <cameras>; expected a Qualisys .qca.txt export")
    return cameras


def camera_for_video(
    camera: Camera, *, size_px: SizePx, letterbox_sizes_px: Iterable[SizePx], where: str
) -> Camera:
    """The calibrated camera as it applies to a video of the given size.

    A letter-boxed copy shows the whole calibrated image, scaled by one factor to fit and centred
    between bars. Our pixel coordinates span the image, so that scale and bar are exact: 1088x1920
    in 1080x1920 gives 1080/1088 and bars of 7.06 px above and below, as measured in the recording.

    Raises:
        DataError: the size is neither the calibrated one nor declared as a letter-boxed copy.
    """
    lens = camera.lens
    calibrated = lens.width, lens.height
    if size_px == calibrated:
        return camera
    if size_px not in [tuple(size) for size in letterbox_sizes_px]:
        raise DataError(
            f"{where}: video is {size_px[0]}x{size_px[1]} px, its camera is calibrated for "
            f"{calibrated[0]}x{calibrated[1]} px; if the video is a scaled copy of the whole "
            "image between bars, add its size to `letterbox_sizes_px`, otherwise use the original"
        )
    width, height = size_px
    scale = min(width / lens.width, height / lens.height)
    return replace(
        camera,
        lens=replace(
            lens,
            fx=lens.fx * scale,
            fy=lens.fy * scale,
            cx=lens.cx * scale + (width - lens.width * scale) / 2,
            cy=lens.cy * scale + (height - lens.height * scale) / 2,
            width=width,
            height=height,
        ),
    )


def find_videos(folder: Path, *, views: Iterable[str]) -> dict[str, Path]:
    """The .mp4 file of each view in a folder, whatever the spelling of its name.

    Raises:
        DataError: a view has no video, or more than one.
    """
    found: dict[str, list[Path]] = {}
    for path in sorted(folder.glob("*.mp4")):
        found.setdefault(normalised_view(path.stem), []).append(path)
    for view in views:
        if len(found.get(view, [])) != 1:
            names = [path.name for path in found.get(view, [])] or "none"
            raise DataError(
                f"{folder}: expected one video {view}.mp4, got {names}; the folder holds "
                f"{', '.join(sorted(found)) or 'no .mp4 file'}; fetch or copy it, then run again"
            )
    return {view: found[view][0] for view in views}


def _camera(element: ElementTree.Element, *, where: str, pose2sim_compat: bool) -> Camera:
    # an unknown rotation or skew would give plausible, wrong pixels: refuse
    if _number(element, "viewrotation", where=where) != 0:
        raise DataError(
            f"{where}: viewrotation is {element.get('viewrotation')}, only 0 is supported; "
            "export calibration and videos unrotated"
        )
    image = _child(element, "fov_video", where=where)
    intrinsic = _child(element, "intrinsic", where=where)
    transform = _child(element, "transform", where=where)
    if _number(intrinsic, "skew", where=where) != 0:
        raise DataError(f"{where}: skew is {intrinsic.get('skew')}, only 0 is supported")
    left, top = (_number(image, name, where=where) for name in ("left", "top"))
    right, bottom = (_number(image, name, where=where) for name in ("right", "bottom"))
    fx, fy, cx, cy = (
        _number(intrinsic, name, where=where) / SUBPIXELS
        for name in ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
    )
    names = ["radialDistortion1", "radialDistortion2"]
    names += ["tangentalDistortion1", "tangentalDistortion2", "radialDistortion3"]
    divisor = SUBPIXELS if pose2sim_compat else 1.0
    axes = torch.tensor(
        [
            [_number(transform, f"r{row}{column}", where=where) for column in (1, 2, 3)]
            for row in (1, 2, 3)
        ],
        dtype=torch.float64,
    )
    centre = [_number(transform, axis, where=where) * METRES_PER_UNIT for axis in ("x", "y", "z")]
    return Camera(
        lens=Pinhole(
            fx=fx,
            fy=fy,
            cx=cx - left + PIXEL_CENTRE,  # the file's pixel centres are integers
            cy=cy - top + PIXEL_CENTRE,
            width=round(right - left + 1),
            height=round(bottom - top + 1),
            distortion=tuple(_number(intrinsic, name, where=where) / divisor for name in names),
        ),
        center_world=torch.tensor(centre, dtype=torch.float64),
        rotation=OPENCV_FROM_QUALISYS @ axes,
    )


def _child(element: ElementTree.Element, tag: str, *, where: str) -> ElementTree.Element:
    child = element.find(tag)
    if child is None:
        raise DataError(f"{where}: element <{tag}> is missing; export the calibration again")
    return child


def _number(element: ElementTree.Element, name: str, *, where: str) -> float:
    text = element.get(name)
    try:
        return float(text)
    except (TypeError, ValueError) as error:
        raise DataError(
            f"{where}: <{element.tag}> {name} is {text!r}, expected a number; "
            "export the calibration again"
        ) from error


def _frames_by_action(sequences: Iterable[Sequence]) -> dict[str, list[int]]:
    """Union of the declared frames, per action, ascending."""
    frames: dict[str, set[int]] = {}
    for sequence in sequences:
        frames.setdefault(sequence.action, set()).update(sequence.frames)
    return {action: sorted(chosen) for action, chosen in sorted(frames.items())}


def _check_lengths(videos: dict[str, Path], *, action: str, frames: list[int]) -> None:
    lengths = {view: count_frames(path) for view, path in videos.items()}
    folder = next(iter(videos.values())).parent
    if len(set(lengths.values())) != 1:
        listed = ", ".join(f"{view} {length}" for view, length in lengths.items())
        raise DataError(
            f"{folder}: the views of action {action!r} differ in their number of frames: {listed}; "
            "synchronised cameras give equal numbers: copy the videos again or trim them alike"
        )
    length = next(iter(lengths.values()))
    if frames[0] < 0 or frames[-1] >= length:
        raise DataError(
            f"{folder}: action {action!r} declares frames {frames[0]}..{frames[-1]}, its videos "
            f"hold 0..{length - 1}; correct config/sequences.tsv"
        )


def _link(video: Path, target: Path) -> None:
    with atomic_path(target) as temporary:
        try:
            os.link(video.resolve(), temporary)
        except OSError:  # another device, or a file system without hard links
            shutil.copyfile(video, temporary)
