"""From premultiplied to straight colours, with a margin of colour around what is seen."""

import cv2
import numpy as np
from jaxtyping import Float

SEEN_ALPHA = 0.02  # a pixel less covered has hardly a colour of its own
MARGIN_PX = 8  # survives a resampling to an eighth


def straight_colours(
    premultiplied: Float[np.ndarray, "height width 3"], alpha: Float[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width 3"]:
    """Colours not multiplied by alpha, in [0, 1]; 0 farther than `MARGIN_PX` from what is seen.

    What is hardly seen has the colour of the nearest pixel that is. A picture with straight alpha
    that is black beyond the outline gets a dark rim from every tool that resamples or blurs its
    colours without regard to alpha; so textures are padded, and so are these.
    """
    unseen = alpha < SEEN_ALPHA
    colours = np.clip(premultiplied / np.maximum(alpha, 1e-6)[..., None], 0, 1)
    if unseen.all():
        return np.zeros_like(colours)
    distance_px, nearest = cv2.distanceTransformWithLabels(
        unseen.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.empty(nearest.max() + 1, np.int64)
    of_label[nearest[~unseen]] = np.flatnonzero(~unseen)
    padded = colours.reshape(-1, 3)[of_label[nearest]]
    padded[distance_px > MARGIN_PX] = 0
    return padded
