"""Solid textures: the colour of a surface point as a function of its place on the rest body.

The rest body stands in T-pose, y up, facing +z, its left at +x. Because the colour depends on the
rest place only, it follows the body through every pose. Garments are painted over skin, one after
another. Colours are sRGB albedo in 0..1.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from ntop.body.skeletons import COCO17_NAMES, SMPL24_NAMES
from ntop.captures.studio.patterns import (
    EDGE_M,
    Colour,
    box,
    dots,
    inside,
    paint,
    ripple,
    stripes,
    strokes,
)

Points = Float[ndarray, "point 3"]
Channel = Float[ndarray, " point"]

TORSO_RADIUS_M = 0.15  # turns an angle around the body into a length on the cloth
NTOP_LETTERS = {  # strokes in units of the letter height
    "N": (0.72, [[(0, 0), (0, 1), (0.72, 0), (0.72, 1)]]),
    "T": (0.76, [[(0, 1), (0.76, 1)], [(0.38, 1), (0.38, 0)]]),
    "o": (0.6, [[(0.3 + 0.3 * math.cos(a * math.pi / 6), 0.3 + 0.3 * math.sin(a * math.pi / 6))
                 for a in range(13)]]),
    "P": (0.62, [[(0, 0), (0, 1), (0.36, 1), (0.58, 0.9), (0.62, 0.74), (0.58, 0.58), (0.36, 0.48),
                  (0, 0.48)]]),
}  # fmt: skip


COLLAR_FROM_NECK_M = np.array([0.0, 0.018, 0.032])  # centre of the neckline's ellipsoid
CREAM, NAVY = (0.96, 0.94, 0.88), (0.06, 0.23, 0.45)


@dataclass(frozen=True)
class Landmarks:
    """Joints and keypoints of the shaped rest body (body frame, metres), by name."""

    joints: Float[ndarray, "24 3"]
    coco17: Float[ndarray, "17 3"]

    def joint(self, name: str) -> Float[ndarray, " 3"]:
        """A SMPL joint."""
        return self.joints[SMPL24_NAMES.index(name)]

    def keypoint(self, name: str) -> Float[ndarray, " 3"]:
        """A COCO keypoint."""
        return self.coco17[COCO17_NAMES.index(name)]


@dataclass(frozen=True)
class Cut:
    """Where the garments end on the rest body, in metres (body frame)."""

    sleeve_x: float
    hem_y: float
    trouser_end_y: float
    shoe_top_y: float


def layer(
    colours: Float[ndarray, "point 3"],
    points: Points,
    *,
    weight: Channel,
    pattern: Callable[[Points], Float[ndarray, "point 3"]],
) -> None:
    """Paint a garment's pattern where its weight is positive, in place."""
    chosen = np.flatnonzero(weight > 0)
    if len(chosen):
        below = colours[chosen]
        colours[chosen] = below + weight[chosen, None] * (pattern(points[chosen]) - below)


def plain_colour(points: Points, on_body: Points) -> Points:
    """An array of one colour, `on_body` giving it."""
    return np.tile(np.asarray(on_body, dtype=points.dtype), (len(points), 1))


def cloth_coordinates(points: Points, marks: Landmarks) -> tuple[Channel, Channel]:
    """Lengths on the upper body's cloth: around the trunk, and up it and out along the arms."""
    centre_z = marks.joint("spine2")[2]
    around = TORSO_RADIUS_M * np.arctan2(points[:, 0], points[:, 2] - centre_z)
    along = points[:, 1] - np.maximum(np.abs(points[:, 0]) - 0.12, 0)
    return around, along


# --- where garments are: 1 inside, 0 outside, a smooth edge between -------------------------------


def shirt_weight(points: Points, marks: Landmarks, cut: Cut) -> Channel:
    """The shirt: above the hem, outside a round neck that is lower in front, up to the cuffs."""
    neck = marks.joint("neck")
    radii = np.array([0.088, 0.078, 0.098], dtype=points.dtype)
    from_neck = (points - (neck + COLLAR_FROM_NECK_M).astype(points.dtype)) / radii
    collar = (np.sqrt((from_neck * from_neck).sum(-1)) - 1) * 0.085
    collar = np.minimum(collar, neck[1] + 0.04 - points[:, 1])
    length = np.minimum(points[:, 1] - cut.hem_y, cut.sleeve_x - np.abs(points[:, 0]))
    return inside(np.minimum(collar, length))


def trouser_weight(points: Points, marks: Landmarks, cut: Cut) -> Channel:
    """The trousers: from the waist down to the ankles, not the hands."""
    waist_y = marks.joint("pelvis")[1] + 0.12
    return inside(np.minimum(waist_y - points[:, 1], points[:, 1] - cut.trouser_end_y))


def shoe_weight(points: Points, cut: Cut) -> Channel:
    """The shoes."""
    return inside(cut.shoe_top_y - points[:, 1])


def hair_weight(points: Points, marks: Landmarks, edge_m: float = EDGE_M) -> Channel:
    """The hair: above a line from the forehead over the temples to the nape, free of the ears."""
    eyes_y = 0.5 * (marks.keypoint("left_eye") + marks.keypoint("right_eye"))[1]
    ear = marks.keypoint("left_ear")
    forward = points[:, 2] - ear[2]
    # height of the hairline over the eyes: front 6 cm, ears 0, nape -8 cm
    line = np.interp(forward, [-0.10, -0.03, 0.01, 0.05, 0.075], [-0.085, -0.06, 0.0, 0.045, 0.060])
    above = points[:, 1] - (eyes_y + line.astype(points.dtype))
    beside = np.abs(points[:, 0]) - ear[0]
    from_ear = np.sqrt(beside**2 + (points[:, 1] - ear[1] + 0.005) ** 2 + (forward + 0.008) ** 2)
    return inside(np.minimum(above, from_ear - 0.034), edge_m)


# --- patterns -------------------------------------------------------------------------------------


def skin(points: Points, marks: Landmarks, tone: Colour) -> Points:
    """Skin with mild variation, and a face."""
    colours = plain_colour(points, tone)
    colours *= (1 + 0.05 * ripple(points, wavelength_m=0.07, seed=11))[:, None]
    for side in ("left", "right"):
        wrist_x = abs(marks.joint(f"{side}_wrist")[0])
        knuckles = inside(np.abs(points[:, 0]) - wrist_x - 0.09, 0.06)
        paint(colours, 0.15 * knuckles, (0.78, 0.42, 0.34))
    face = np.flatnonzero(points[:, 1] > marks.joint("neck")[1])
    if len(face):
        colours[face] = _face(points[face], colours[face], marks)
    return colours


def _face(points: Points, colours: Points, marks: Landmarks) -> Points:
    nose = marks.keypoint("nose")
    x, y = points[:, 0], points[:, 1]
    front = inside(points[:, 2] - (marks.keypoint("left_ear")[2] + 0.03), 0.03)
    for side, sign in (("left", 1), ("right", -1)):
        eye = marks.keypoint(f"{side}_eye")
        du, dv = x - eye[0], y - eye[1]
        cheek = inside(0.024 - np.hypot(x - sign * 0.04, y - (nose[1] - 0.012)), 0.03)
        paint(colours, 0.35 * front * cheek, (0.85, 0.40, 0.36))
        socket = inside(1 - np.hypot(du / 0.026, dv / 0.016), 0.7)
        paint(colours, 0.35 * front * socket, (0.45, 0.28, 0.22))
        white = inside(1 - np.hypot(du / 0.0155, dv / 0.0075), 0.5)
        paint(colours, front * white, (0.93, 0.92, 0.90))
        iris = inside(0.0068 - np.hypot(du, dv), 0.005)
        paint(colours, front * white * iris, (0.10, 0.08, 0.07))
        arch = dv - 0.024 + 9.0 * (du - sign * 0.003) ** 2
        brow = inside(np.minimum(0.0042 - np.abs(arch), 0.020 - np.abs(du)), 0.006)
        paint(colours, front * brow, (0.16, 0.10, 0.07))
    dv = y - (nose[1] - 0.036)
    mouth = inside(1 - np.hypot(x / 0.024, (dv - 5 * x * x) / 0.0085), 0.45)
    paint(colours, front * mouth, (0.70, 0.27, 0.26))
    return colours


def hair(points: Points, marks: Landmarks, *, dark: Colour, light: Colour) -> Points:
    """Strands that run from a parting over the crown, with lighter locks."""
    ear = 0.5 * (marks.keypoint("left_ear") + marks.keypoint("right_ear"))
    x, forward = points[:, 0] - 0.022, points[:, 2] - ear[2]
    # strands run off the parting to both sides, in waves that slow noise bends and thins out
    bend = 0.014 * ripple(points, wavelength_m=0.10, seed=5)
    phase = (forward + bend + 0.15 * x) * (2 * np.pi / 0.034)
    locks = 0.5 + 0.28 * np.sin(phase) + 0.22 * np.sin(1.62 * phase + 9 * x / 0.1)
    slow = np.clip(0.65 + 0.5 * ripple(points, wavelength_m=0.09, seed=6), 0, 1)
    colours = plain_colour(points, dark)
    paint(colours, locks * slow, light)
    top = inside(points[:, 1] - marks.keypoint("left_eye")[1] - 0.07, 0.03)
    parting = inside(0.006 - np.abs(x), 0.009) * inside(forward + 0.05, 0.04) * top
    paint(colours, 0.75 * parting, (0.80, 0.62, 0.52))
    return colours


def flannel(points: Points, marks: Landmarks) -> Points:
    """A red plaid with dark bands and cream lines, a badge on the chest and letters on the back."""
    around, along = cloth_coordinates(points, marks)
    period = TORSO_RADIUS_M * 2 * np.pi / 10  # ten repeats close around the trunk
    colours = plain_colour(points, (0.78, 0.13, 0.12))
    for coordinate in (around, along):
        paint(
            colours, 0.72 * stripes(coordinate, period_m=period, width_m=0.036), (0.07, 0.09, 0.17)
        )
    for coordinate in (around, along):
        line = stripes(coordinate + period / 2, period_m=period, width_m=0.021)
        paint(colours, 0.92 * line, (0.98, 0.91, 0.72))
    chest_y = marks.joint("spine3")[1] + 0.07
    near = np.flatnonzero((np.abs(points[:, 1] - chest_y) < 0.09) & (np.abs(points[:, 0]) < 0.15))
    u, v, z = points[near, 0], points[near, 1] - chest_y, points[near, 2]
    front = inside(z - marks.joint("spine2")[2], 0.02)
    printed = colours[near]
    _badge(printed, u, v, front)
    _letters(printed, -u, v, 1 - front)
    colours[near] = printed
    return colours


def _badge(colours: Points, u: Channel, v: Channel, weight: Channel) -> None:
    """A cream disc with the rig from above: a dot in the centre and eight around."""
    radius = np.hypot(u, v)
    paint(colours, weight * inside(0.078 - radius), CREAM)
    paint(colours, weight * inside(0.006 - np.abs(radius - 0.070)), NAVY)
    nearest = np.round(np.arctan2(v, u) / (np.pi / 4)) * (np.pi / 4)
    ring = np.hypot(u - 0.045 * np.cos(nearest), v - 0.045 * np.sin(nearest))
    paint(colours, weight * inside(0.0105 - ring), NAVY)
    paint(colours, weight * inside(0.0145 - radius), (0.93, 0.42, 0.05))


def _letters(colours: Points, u: Channel, v: Channel, weight: Channel) -> None:
    """A cream label with the letters NToP."""
    label = box(u, v, half_size_m=(0.135, 0.062), radius_m=0.02)
    paint(colours, weight * inside(label), CREAM)
    height, gap = 0.075, 0.24
    left = -0.5 * (sum(letter[0] for letter in NTOP_LETTERS.values()) + 3 * gap)
    for letter_width, lines in NTOP_LETTERS.values():
        distance = strokes(u / height - left, v / height + 0.5, lines) * height
        paint(colours, weight * inside(0.0075 - distance), NAVY)
        left += letter_width + gap


def denim(points: Points, marks: Landmarks) -> Points:
    """Blue jeans: faded fronts, dark seams, a white stripe down the outer side, back pockets."""
    x, y, z = np.abs(points[:, 0]), points[:, 1], points[:, 2]
    hip, knee = marks.joint("left_hip"), marks.joint("left_knee")
    axis_x = np.interp(y, [knee[1], hip[1]], [knee[0], hip[0]]).astype(points.dtype)
    angle = np.arctan2(z - hip[2], x - axis_x)
    colours = plain_colour(points, (0.15, 0.26, 0.47))
    colours *= (1 + 0.12 * ripple(points, wavelength_m=0.06, seed=21))[:, None]
    fade = inside(0.75 - np.abs(angle - np.pi / 2), 0.9) * inside(y - knee[1] + 0.12, 0.2)
    paint(colours, 0.45 * fade, (0.55, 0.68, 0.82))
    paint(
        colours, inside(0.011 - np.abs(angle) * 0.07) * inside(hip[1] + 0.1 - y), (0.92, 0.90, 0.84)
    )
    pocket = box(x - hip[0], y - hip[1] + 0.02, half_size_m=(0.055, 0.06), radius_m=0.02)
    behind = inside(hip[2] - 0.03 - z, 0.02)
    paint(colours, 0.8 * behind * inside(0.006 - np.abs(pocket), 0.007), (0.85, 0.60, 0.25))
    cuff = inside(marks.joint("left_ankle")[1] + 0.075 - y)
    paint(colours, 0.55 * cuff, (0.60, 0.70, 0.82))
    return colours


def trainers(points: Points, marks: Landmarks, main: Colour) -> Points:
    """Shoes with a white sole and three stripes."""
    colours = plain_colour(points, main)
    ankle = marks.joint("left_ankle")
    line = points[:, 2] + 0.6 * points[:, 1]
    place = inside(0.045 - np.abs(points[:, 2] - ankle[2] - 0.07))
    paint(colours, place * stripes(line, period_m=0.032, width_m=0.014), (0.96, 0.96, 0.94))
    sole_y = marks.joint("left_foot")[1] - 0.008
    paint(colours, inside(sole_y - points[:, 1], 0.006), (0.95, 0.94, 0.90))
    return colours


def blouse(points: Points, marks: Landmarks) -> Points:
    """A white blouse with large blue dots and dark cuffs."""
    around, along = cloth_coordinates(points, marks)
    colours = plain_colour(points, (0.94, 0.92, 0.86))
    period = TORSO_RADIUS_M * 2 * np.pi / 12
    dotted = dots(around, along, period_m=(period, 0.09), radius_m=0.019)
    paint(colours, dotted, (0.05, 0.22, 0.42))
    wrist_x = abs(marks.joint("left_wrist")[0])
    cuff = inside(np.abs(points[:, 0]) - (wrist_x - 0.09))
    paint(colours, cuff, (0.05, 0.22, 0.42))
    buttons = inside(0.008 - np.hypot(points[:, 0], (along / 0.06 % 1.0 - 0.5) * 0.06), 0.006)
    front = inside(points[:, 2] - marks.joint("spine2")[2], 0.02)
    paint(colours, front * inside(0.016 - np.abs(points[:, 0])), (0.90, 0.86, 0.76))
    paint(colours, front * buttons, (0.75, 0.35, 0.10))
    return colours


def skirt(points: Points, *, centre_z: float, top_y: float, hem_y: float) -> Points:
    """A long skirt: panels of two colours that widen downwards, a belt, two bands at the hem."""
    angle = np.arctan2(points[:, 0], points[:, 2] - centre_z)
    radius = np.hypot(points[:, 0], points[:, 2] - centre_z)
    # panels are cut by angle, so that they widen with the radius
    offset = np.abs((angle / (2 * np.pi / 14) + 0.5) % 1.0 - 0.5) * (2 * np.pi / 14)
    colours = plain_colour(points, (0.05, 0.36, 0.36))
    paint(colours, inside((np.pi / 28 - offset) * radius), (0.93, 0.70, 0.20))
    from_hem = points[:, 1] - hem_y
    paint(colours, inside(0.075 - from_hem), (0.55, 0.08, 0.16))
    paint(colours, inside(0.010 - np.abs(from_hem - 0.045)), (0.96, 0.92, 0.82))
    paint(colours, inside(points[:, 1] - (top_y - 0.045)), (0.28, 0.13, 0.07))
    return colours
