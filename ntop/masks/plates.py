"""The empty scene behind a moving person, pieced together from the frames that show it.

The cameras of a recording stand still. Wherever the person moves away, some frames show what is
behind him, and a pixel that looks like that is scene: it decides gaps between arm and trunk, and
dark things beside dark shorts, which the pose network's coarse mask cannot. Where no frame shows
the scene (he always stands before it) there is no evidence, and the network decides alone.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8

from ntop.masks.edges import disc

SHOWS_SCENE = 0.02  # probability of the person below which a pixel counts as scene
MIN_FRAMES = 5  # that must show a pixel's scene
CAMERA_NOISE = 4.0  # of 255: compression and sensor, per channel
DIMMEST = 0.65  # a shadow may dim the scene to this share of its brightness...
DIMMING_COST = 2.0  # ...at this cost in log odds; whatever is darker is no shadow
PERSON_LOG_DENSITY = 4.0  # log odds of a colour that the scene cannot explain, before its distance
MAX_LOG_ODDS = 3.0  # so that the network, where it is sure, is not overruled


@dataclass(frozen=True)
class Plate:
    """Mean colour of the scene (0..255), its spread in time, and how many frames showed it."""

    colour: Float32[np.ndarray, "height width 3"]
    spread: Float32[np.ndarray, "height width"]
    frames: Float32[np.ndarray, "height width"]


class PlateBuilder:
    """Sums over the frames of one fixed view; order does not matter beyond rounding."""

    def __init__(self, shape: tuple[int, int]) -> None:
        """Start without a frame; `shape` is (height, width)."""
        self._sum = np.zeros((*shape, 3), np.float32)
        self._squares = np.zeros((*shape, 3), np.float32)
        self._frames = np.zeros(shape, np.float32)

    def add(
        self,
        image: UInt8[np.ndarray, "height width 3"],
        person: UInt8[np.ndarray, "height width"],
        *,
        radius_px: int,
    ) -> None:
        """Take in the scene of one frame: all further than `radius_px` from the person.

        `person` is the probability of the person in 1/255.
        """
        scene = (cv2.dilate(person, disc(radius_px)) <= round(255 * SHOWS_SCENE)).astype(np.uint8)
        cv2.accumulate(image, self._sum, mask=scene)
        cv2.accumulateSquare(image, self._squares, mask=scene)
        self._frames += scene

    def finish(self) -> Plate:
        """The plate of the frames taken in so far."""
        count = np.maximum(self._frames, 1)[..., None]
        mean = self._sum / count
        variance = np.maximum(self._squares / count - mean**2, 0)
        return Plate(mean, np.sqrt(variance.max(-1)), self._frames)


def person_log_odds(
    image: UInt8[np.ndarray, "height width 3"], plate: Plate, *, box: tuple[slice, slice]
) -> Float32[np.ndarray, "rows columns"]:
    """How much a pixel's colour speaks for the person (> 0) or for the scene (< 0), inside a box.

    The scene explains a colour by its plate, a Gaussian of the camera's noise and the pixel's own
    spread, possibly dimmed by a shadow; the person by any colour.
    """
    colour, scene = image[box].astype(np.float32), plate.colour[box]
    brightness = (scene**2).sum(-1) + 1
    dimming = np.clip((colour * scene).sum(-1) / brightness, DIMMEST, 1)
    residual = colour - dimming[..., None] * scene
    noise = np.sqrt(CAMERA_NOISE**2 + plate.spread[box] ** 2)
    cost = DIMMING_COST * ((1 - dimming) / (1 - DIMMEST)) ** 2
    # a wider Gaussian is lower: in a flickering place an unexpected colour says less
    density = np.maximum(PERSON_LOG_DENSITY - 3 * np.log(noise / CAMERA_NOISE), 0)
    odds = ((residual**2).sum(-1) / noise**2 + cost) / 2 - density
    known = plate.frames[box] >= MIN_FRAMES
    return np.where(known, np.clip(odds, -MAX_LOG_ODDS, MAX_LOG_ODDS), 0).astype(np.float32)


def with_evidence(
    person: Float32[np.ndarray, "rows columns"], log_odds: Float32[np.ndarray, "rows columns"]
) -> Float32[np.ndarray, "rows columns"]:
    """The network's probability after the evidence of colour (Bayes); zero stays zero."""
    sure = np.clip(person, 0.005, 0.995)
    posterior = 1 / (1 + np.exp(-(np.log(sure / (1 - sure)) + log_odds)))
    return np.where(person > SHOWS_SCENE, posterior, 0).astype(np.float32)
