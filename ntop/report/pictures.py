"""Arrays become pictures of a page: crops, colourings, overlays, and data URIs.

Images are uint8 RGB or RGBA (straight alpha), `[v, u]`; points are in pixels, first centre at 0.5.
"""

import base64
import html
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from ntop.conventions import DataError

WEBP_QUALITY = 88
ERROR_SCALE = 0.25  # an error of a quarter of the value range reaches the colour map's end
OVERVIEW_GREY = 127


@dataclass(frozen=True)
class Skeleton:
    """Keypoints to draw over a picture, in its pixels; visibility as in the manifest (0, 1, 2)."""

    name: str
    points_px: Float[np.ndarray, "keypoint 2"]
    visibility: UInt8[np.ndarray, " keypoint"]
    edges: tuple[tuple[int, int], ...]
    labels: tuple[str, ...]

    def scaled(self, scale: float) -> "Skeleton":
        """The same for a resized picture."""
        return replace(self, points_px=self.points_px * scale)


@dataclass(frozen=True)
class Picture:
    """An encoded picture with the words a reader needs who cannot see it."""

    uri: str
    width: int
    height: int
    alt: str
    caption: str = ""
    skeletons: tuple[Skeleton, ...] = field(default=())


@dataclass(frozen=True)
class Square:
    """A square window of whole pixels; it may reach beyond the image."""

    left: int
    top: int
    side: int

    def of(self, image: np.ndarray) -> np.ndarray:
        """That part of an image, zero (transparent) where it reaches beyond."""
        height, width = image.shape[:2]
        out = np.zeros((self.side, self.side, *image.shape[2:]), image.dtype)
        top, left = max(self.top, 0), max(self.left, 0)
        bottom, right = min(self.top + self.side, height), min(self.left + self.side, width)
        if bottom > top and right > left:
            out[top - self.top : bottom - self.top, left - self.left : right - self.left] = image[
                top:bottom, left:right
            ]
        return out

    def moved(self, points_px: np.ndarray) -> np.ndarray:
        """Points in the window's own pixels."""
        return points_px - np.array([self.left, self.top], dtype=float)


def square_around(mask: Bool[np.ndarray, "height width"], *, margin: float) -> Square:
    """The square around a mask, widened by a share of its side; the whole image if it is empty."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return Square(0, 0, max(mask.shape))
    return square_with(
        centre=((columns[0] + columns[-1] + 1) / 2, (rows[0] + rows[-1] + 1) / 2),
        side=max(np.ptp(columns), np.ptp(rows)) * (1 + 2 * margin) + 1,
    )


def square_with(*, centre: tuple[float, float], side: float) -> Square:
    """A square by centre (u, v) and side, in whole pixels."""
    whole = max(int(np.ceil(side)), 8)
    return Square(round(centre[0] - whole / 2), round(centre[1] - whole / 2), whole)


def picture(
    image: np.ndarray,
    *,
    alt: str,
    caption: str = "",
    side_px: int | None = None,
    skeletons: tuple[Skeleton, ...] = (),
) -> Picture:
    """Encode an image as a data URI, its longer side reduced to `side_px`; overlays follow."""
    height, width = image.shape[:2]
    scale = 1.0 if side_px is None else min(1.0, side_px / max(height, width))
    if scale < 1:
        size = (max(1, round(width * scale)), max(1, round(height * scale)))
        image = cv2.resize(_premultiplied(image), size, interpolation=cv2.INTER_AREA)
        image = _straight(image)
    return Picture(
        uri=_data_uri(image),
        width=image.shape[1],
        height=image.shape[0],
        alt=alt,
        caption=caption,
        skeletons=tuple(skeleton.scaled(scale) for skeleton in skeletons),
    )


def skeleton_svg(overlay: Skeleton, *, width: int, height: int) -> str:
    """The overlay as an SVG element: visible keypoints filled, occluded ones hollow.

    A bone is drawn solid between two visible keypoints and dashed otherwise; keypoints outside the
    image circle (visibility 0) are left out.
    """
    unit = max(width, height) / 100
    parts = []
    shown = overlay.visibility > 0
    for start, end in overlay.edges:
        if not (shown[start] and shown[end]):
            continue
        (x1, y1), (x2, y2) = overlay.points_px[start], overlay.points_px[end]
        solid = overlay.visibility[start] == 2 and overlay.visibility[end] == 2
        parts.append(
            f'<line class="{"bone" if solid else "bone hidden-bone"}" '
            f'x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'
        )
    for index, (x, y) in enumerate(overlay.points_px):
        if not shown[index]:
            continue
        visible = overlay.visibility[index] == 2
        title = html.escape(f"{overlay.labels[index]}: {'visible' if visible else 'occluded'}")
        parts.append(
            f'<circle class="{"seen" if visible else "occluded"}" cx="{x:.1f}" cy="{y:.1f}" '
            f'r="{1.15 * unit:.2f}"><title>{title}</title></circle>'
        )
    name = html.escape(overlay.name, quote=True)
    return (
        f'<svg class="overlay {name}" viewBox="0 0 {width} {height}" aria-hidden="true" '
        f'style="--unit:{unit:.2f}px">{"".join(parts)}</svg>'
    )


def drawn_skeleton(image: UInt8[np.ndarray, "height width 3"], overlay: Skeleton) -> np.ndarray:
    """The overlay painted into a copy of an image (for pictures outside the page)."""
    shift = 4  # fractional bits of OpenCV's drawing coordinates
    canvas = np.ascontiguousarray(image)
    unit = max(canvas.shape[:2]) / 100

    def fixed(point: np.ndarray) -> tuple[int, int]:
        # OpenCV's pixel centres are integers
        return round((point[0] - 0.5) * 2**shift), round((point[1] - 0.5) * 2**shift)

    for start, end in overlay.edges:
        if overlay.visibility[start] > 0 and overlay.visibility[end] > 0:
            ends = fixed(overlay.points_px[start]), fixed(overlay.points_px[end])
            thickness = max(1, round(0.7 * unit))
            cv2.line(canvas, *ends, (250, 204, 21), thickness, cv2.LINE_AA, shift)
    for point, visible in zip(overlay.points_px, overlay.visibility, strict=True):
        radius = round(1.4 * unit * 2**shift)
        if visible == 2:
            cv2.circle(canvas, fixed(point), radius, (234, 88, 12), -1, cv2.LINE_AA, shift)
        if visible > 0:
            width = max(1, round(0.4 * unit))
            cv2.circle(canvas, fixed(point), radius, (255, 255, 255), width, cv2.LINE_AA, shift)
    return canvas


def on_colour(
    rgba: UInt8[np.ndarray, "height width 4"], colour: tuple[int, int, int]
) -> UInt8[np.ndarray, "height width 3"]:
    """A cut-out composited on one colour."""
    alpha = rgba[..., 3:].astype(np.float64) / 255
    mixed = rgba[..., :3] * alpha + np.array(colour, dtype=float) * (1 - alpha)
    return np.rint(mixed).astype(np.uint8)


def with_matte(
    image: UInt8[np.ndarray, "height width 3"], matte: UInt8[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width 4"]:
    """An image whose background is faded to one fifth, so that the mask's outline is judged."""
    alpha = matte.astype(np.float64)
    return np.dstack([image, np.rint(51 + alpha * 0.8).astype(np.uint8)])


def error_colours(
    image: UInt8[np.ndarray, "height width 3"],
    reference: UInt8[np.ndarray, "height width 3"],
) -> UInt8[np.ndarray, "height width 3"]:
    """Mean absolute difference of the channels in false colours; black is equal."""
    if image.shape != reference.shape:
        raise DataError(f"cannot compare images of {image.shape} and {reference.shape}")
    difference = np.abs(image.astype(np.float64) - reference).mean(-1) / 255
    level = np.rint(np.clip(difference / ERROR_SCALE, 0, 1) * 255).astype(np.uint8)
    return cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)


def depth_colours(
    depth_m: Float[np.ndarray, "height width"],
) -> UInt8[np.ndarray, "height width 4"]:
    """Ray length in false colours from the nearest to the farthest; transparent where nothing."""
    there = depth_m > 0
    near, far = (depth_m[there].min(), depth_m[there].max()) if there.any() else (0.0, 1.0)
    level = np.clip((depth_m - near) / max(far - near, 1e-6), 0, 1)
    # 40..230: the ends of the map are too dark or too bright on either page colour
    coded = np.rint(230 - 190 * level).astype(np.uint8)
    colours = cv2.cvtColor(cv2.applyColorMap(coded, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    return np.dstack([colours, np.where(there, 255, 0).astype(np.uint8)])


def part_colours(
    parts: UInt8[np.ndarray, "height width"],
) -> UInt8[np.ndarray, "height width 4"]:
    """One colour per body part (golden-angle hues); transparent where nothing."""
    index = np.arange(256)
    hsv = np.stack(
        [(index * 111) % 180, 120 + (index % 3) * 45, 235 - (index % 2) * 50], -1
    ).astype(np.uint8)
    palette = cv2.cvtColor(hsv[None], cv2.COLOR_HSV2RGB)[0]
    return np.dstack([palette[parts], np.where(parts > 0, 255, 0).astype(np.uint8)])


def _premultiplied(image: np.ndarray) -> np.ndarray:
    if image.ndim == 2 or image.shape[2] == 3:
        return image.astype(np.float32)
    alpha = image[..., 3:].astype(np.float32) / 255
    return np.concatenate([image[..., :3] * alpha, image[..., 3:]], -1).astype(np.float32)


def _straight(image: np.ndarray) -> np.ndarray:
    if image.ndim == 3 and image.shape[2] == 4:
        alpha = np.maximum(image[..., 3:] / 255, 1e-6)
        image = np.concatenate([image[..., :3] / alpha, image[..., 3:]], -1)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _data_uri(image: np.ndarray) -> str:
    code = {2: cv2.COLOR_GRAY2BGR, 3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}[
        2 if image.ndim == 2 else image.shape[2]
    ]
    ordered = cv2.cvtColor(np.ascontiguousarray(image), code)
    done, data = cv2.imencode(".webp", ordered, [cv2.IMWRITE_WEBP_QUALITY, WEBP_QUALITY])
    if not done:
        raise DataError(f"cannot encode an image of {image.shape} as WebP; check OpenCV's build")
    return "data:image/webp;base64," + base64.b64encode(data.tobytes()).decode("ascii")
