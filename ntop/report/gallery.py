"""The pictures of the dataset itself: nine views with overlays, and what comes with an image."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import UInt8

from ntop.body.skeletons import COCO17_NAMES, COCO17_SKELETON, SMPL24_EDGES, SMPL24_NAMES
from ntop.conventions import MASK_ALPHA
from ntop.geometry.cameras import pixel_grid
from ntop.report.inputs import ActorFolders, Dataset
from ntop.report.page import Sheet
from ntop.report.pictures import (
    Picture,
    Skeleton,
    Square,
    depth_colours,
    on_colour,
    part_colours,
    picture,
    square_around,
    square_with,
)
from ntop.storage.images import read_depth, read_parts, read_rgba
from ntop.storage.keys import SetKey
from ntop.storage.renders import fisheye_camera
from ntop.storage.tables import Row

COMPASS = (("nw", "n", "ne"), ("w", "centre", "e"), ("sw", "s", "se"))  # north up
DIRECTIONS = {
    "centre": "centre", "e": "east", "ne": "north-east", "n": "north", "nw": "north-west",
    "w": "west", "sw": "south-west", "s": "south", "se": "south-east",
}  # fmt: skip
WINDOW_MARGIN = 1.25  # side of the common window over the largest person's box
OUTSIDE_GREY = (70, 73, 78)
INSIDE_GREY = (168, 170, 172)
OVERVIEW_SIDE_PX = 420
LAYER_VIEW = "e"


def skeletons_of(person: Row) -> tuple[Skeleton, ...]:
    """Both keypoint sets of one person, in the pixels of the whole image."""
    return tuple(
        Skeleton(
            name=name,
            points_px=np.array(person[f"keypoints2d_{name}_px"]).reshape(-1, 2),
            visibility=np.array(person[f"visibility_{name}"], np.uint8),
            edges=edges,
            labels=tuple(label.replace("_", " ") for label in names),
        )
        for name, edges, names in (
            ("coco17", COCO17_SKELETON, COCO17_NAMES),
            ("smpl24", SMPL24_EDGES, SMPL24_NAMES),
        )
    )


def cropped(skeletons: tuple[Skeleton, ...], window: Square) -> tuple[Skeleton, ...]:
    """Overlays in a window's pixels."""
    return tuple(
        Skeleton(s.name, window.moved(s.points_px), s.visibility, s.edges, s.labels)
        for s in skeletons
    )


def representative_sets(dataset: Dataset, actor: ActorFolders) -> dict[str, SetKey]:
    """Per rig the middle set of the actor's last action in which every view shows somebody.

    The last action by name is as good as any; the middle avoids the first pose, often a rest pose.
    """
    chosen: dict[str, SetKey] = {}
    for rig in sorted({key.rig for key in dataset.sets}):
        whole = [
            key
            for key, views in sorted(dataset.sets.items(), key=lambda item: str(item[0]))
            if (key.source, key.actor, key.rig) == (actor.source, actor.actor, rig)
            and all(row["persons"] for row in views.values())
        ]
        if whole:
            last = [key for key in whole if key.action == whole[-1].action]
            chosen[rig] = sorted(last, key=lambda key: key.frame)[len(last) // 2]
    return chosen


@dataclass(frozen=True)
class View:
    """One view of a set, cut to the person: its manifest row, a square RGBA image, overlays."""

    row: Row
    image: UInt8[np.ndarray, "side side 4"]
    skeletons: tuple[Skeleton, ...]

    @property
    def direction(self) -> str:
        """Where the camera is."""
        return DIRECTIONS[self.row["view"]]

    @property
    def size_px(self) -> tuple[float, float]:
        """Width and height of the person's box."""
        return tuple(self.row["persons"][0]["bbox_xywh_px"][2:])

    @property
    def num_seen(self) -> int:
        """How many of the 17 keypoints are visible."""
        return sum(flag == 2 for flag in self.row["persons"][0]["visibility_coco17"])


def cut_views(dataset: Dataset, key: SetKey) -> list[View]:
    """The views of a set in compass order, all cut with one window size."""
    views = dataset.sets[key]
    rows = [views[name] for line in COMPASS for name in line if name in views]
    boxes = [row["persons"][0]["bbox_xywh_px"] for row in rows]
    side = max(max(box[2:]) for box in boxes) * WINDOW_MARGIN
    cut = []
    for row, (left, top, width, height) in zip(rows, boxes, strict=True):
        window = square_with(centre=(left + width / 2, top + height / 2), side=side)
        image = window.of(read_rgba(dataset.image_path(row)))
        cut.append(View(row, image, cropped(skeletons_of(row["persons"][0]), window)))
    return cut


def contact_sheet(dataset: Dataset, key: SetKey, *, index: int) -> Sheet:
    """The nine views of a set in compass order, all with one window size; and one view's layers."""
    views = cut_views(dataset, key)
    pictures = []
    for view in views:
        width, height = view.size_px
        pictures.append(
            picture(
                view.image,
                alt=f"{view.direction} camera: the person seen from above, "
                f"{view.num_seen} of 17 keypoints visible",
                caption=f"{view.direction}: {width:.0f} × {height:.0f} px, "
                f"{view.num_seen} of 17 keypoints visible",
                skeletons=view.skeletons,
            )
        )
    title = f"{key.source}/{key.actor} · {key.action}, frame {key.frame} · rig {key.rig}"
    layer_row = dataset.sets[key].get(LAYER_VIEW, views[0].row)
    return Sheet(index, title, tuple(pictures), layers(dataset, layer_row))


def layers(dataset: Dataset, row: Row) -> tuple[Picture, ...]:
    """What is stored for one view: the whole image, alpha, depth and parts of the person."""
    rgba = read_rgba(dataset.image_path(row))
    window = square_around(rgba[..., 3] >= MASK_ALPHA, margin=0.08)
    alpha = window.of(rgba[..., 3])
    depth_m = window.of(read_depth(dataset.image_path(row, "depth_path")))
    parts = window.of(read_parts(dataset.image_path(row, "parts_path")))
    there = depth_m[depth_m > 0]
    reach = f"{there.min():.2f} to {there.max():.2f} m" if there.size else "nothing in view"
    view = DIRECTIONS[row["view"]]
    return (
        picture(
            image_circle(rgba, row),
            side_px=OVERVIEW_SIDE_PX,
            alt=f"whole fisheye image of the {view} camera with its image circle",
            caption=f"Whole image: {row['width']} × {row['height']} px, {view} camera; the light "
            f"disc is the image circle of {2 * np.degrees(row['max_theta_rad']):.0f}°",
        ),
        picture(alpha, alt="the person's soft mask", caption="Alpha: the mask is alpha ≥ 128"),
        picture(
            depth_colours(depth_m),
            alt="ray length in false colours, near is red",
            caption=f"Depth: ray length, {reach}, 0.1 mm steps",
        ),
        picture(
            part_colours(parts),
            alt="body parts in one colour each",
            caption=f"Parts: {len(np.unique(parts[parts > 0]))} of 24 in view",
        ),
    )


def image_circle(rgba: np.ndarray, row: Row) -> np.ndarray:
    """The image over a disc that marks the lens's field of view."""
    grid = pixel_grid(row["width"], row["height"], torch.float64)
    inside = fisheye_camera(row).lens.unproject(grid)[1].numpy()
    colours = np.where(inside[..., None], on_colour(rgba, INSIDE_GREY), OUTSIDE_GREY)
    return colours.astype(np.uint8)
