"""How far each pixel is from the edge of a mask."""

import cv2
import numpy as np


def signed_distances(mask: np.ndarray) -> np.ndarray:
    """(H, W) float32 distance from the edge of a mask, half way between pixels; positive outside.

    Beyond the picture's edge nothing is known: it is no edge of the mask.
    """
    inside = np.asarray(mask, dtype=np.uint8)
    if inside.all():
        return np.full(mask.shape, -float(max(mask.shape)), dtype=np.float32)
    within = cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    beyond = cv2.distanceTransform(1 - inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.where(inside > 0, 0.5 - within, beyond - 0.5).astype(np.float32)
