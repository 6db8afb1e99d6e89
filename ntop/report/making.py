"""How an image comes about: capture, mask, body, avatar, fisheye, keypoints of one actor."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from ntop.body.model import BodyModel
from ntop.conventions import MASK_ALPHA
from ntop.report.capture import FrameKey, Recording
from ntop.report.gallery import (
    INSIDE_GREY,
    cropped,
    image_circle,
    representative_sets,
    skeletons_of,
)
from ntop.report.heldout import Renderer
from ntop.report.inputs import Dataset
from ntop.report.mesh import shaded_body
from ntop.report.page import Strip
from ntop.report.pictures import (
    Skeleton,
    Square,
    on_colour,
    picture,
    square_around,
    square_with,
    with_matte,
)
from ntop.report.truth import stored
from ntop.storage.images import eight_bit, read_rgba
from ntop.storage.renders import fisheye_camera

PANEL_SIDE_PX = 360
MARGIN = 0.06
OVERVIEW = "e"  # a ring camera shows the person from the side and above


@dataclass(frozen=True)
class Panel:
    """One picture of the strip: a square image, what it is, and keypoints to draw over it."""

    name: str
    text: str
    image: UInt8[np.ndarray, "side side channel"]
    skeletons: tuple[Skeleton, ...] = ()


def making_panels(
    dataset: Dataset, recording: Recording, *, model: BodyModel, render: Renderer
) -> tuple[Panel, ...]:
    """The panels of one actor; recorded ones are left out where there is no recorded body."""
    return (
        *_recorded_panels(recording, model=model, render=render),
        *_rendered_panels(dataset, recording),
    )


def making_strip(
    dataset: Dataset, recording: Recording, *, model: BodyModel, render: Renderer
) -> Strip:
    """The panels as a row of the page."""
    pictures = tuple(
        picture(
            panel.image,
            alt=f"{panel.name}: {panel.text}",
            caption=f"{panel.name}: {panel.text}",
            side_px=PANEL_SIDE_PX,
            skeletons=panel.skeletons,
        )
        for panel in making_panels(dataset, recording, model=model, render=render)
    )
    return Strip(recording.folders.name, pictures)


def recorded_key(recording: Recording) -> FrameKey | None:
    """A frame to show: first view with a picture, a matte and a body, middle of its frames."""
    keys = sorted(
        key
        for key in recording.mattes
        if key in recording.frames
        and key[:2] in recording.bodies
        and (key[0], key[2]) in recording.cameras
    )
    if not keys:
        return None
    first_view = min(view for _, _, view in keys)
    candidates = [key for key in keys if key[2] == first_view]
    return candidates[len(candidates) // 2]


def _recorded_panels(
    recording: Recording, *, model: BodyModel, render: Renderer
) -> tuple[Panel, ...]:
    key = recorded_key(recording)
    if key is None:
        return ()
    action, frame, view = key
    photo, matte = recording.picture(key), recording.matte(key)
    camera, pose = recording.cameras[action, view], recording.pose((action, frame))
    window = square_around(matte >= MASK_ALPHA / 255, margin=MARGIN)
    faded = with_matte(photo, np.zeros(matte.shape, np.uint8))
    drawn = shaded_body(model, pose, camera)
    overlaid = np.where(drawn[..., 3:] > 0, drawn, faded)
    return (
        Panel("Capture", f"{view}, {action} frame {frame}", window.of(photo)),
        Panel("Mask", "the person, softly cut out", window.of(with_matte(photo, eight_bit(matte)))),
        Panel("Body", "one shape per actor, one pose per frame", window.of(overlaid)),
        Panel("Avatar", "a radiance field in that pose", window.of(stored(render(pose, camera)))),
    )


def _rendered_panels(dataset: Dataset, recording: Recording) -> tuple[Panel, ...]:
    chosen = representative_sets(dataset, recording.folders)
    if not chosen:
        return ()
    key = chosen[max(chosen)]  # the higher rig by name
    views = dataset.sets[key]
    row = views.get(OVERVIEW, next(iter(views.values())))
    camera = fisheye_camera(row)
    rgba = read_rgba(dataset.image_path(row))
    person = row["persons"][0]
    left, top, width, height = person["bbox_xywh_px"]
    window = square_with(
        centre=(left + width / 2, top + height / 2), side=max(width, height) * (1 + 2 * MARGIN)
    )
    whole = Square(0, 0, max(camera.lens.width, camera.lens.height))
    return (
        Panel(
            "Fisheye",
            f"{key.action} frame {key.frame} from the ceiling",
            whole.of(image_circle(rgba, row)),
        ),
        Panel(
            "Keypoints",
            "filled: visible, hollow: occluded",
            window.of(on_colour(rgba, INSIDE_GREY)),
            cropped(skeletons_of(person)[:1], window),
        ),
    )
