"""Conversion between masks and Drake's label images."""

from collections.abc import Collection

import numpy as np
from pydrake.geometry import RenderLabel
from pydrake.systems.sensors import ImageLabel16I

EMPTY = int(RenderLabel.kEmpty)
"""Label of a pixel without an object."""

OBJECT = 1
"""The label that mask_to_label_image gives the object."""


def mask_to_label_image(mask: np.ndarray) -> ImageLabel16I:
    """Return a mask (H, W) as a label image: OBJECT on the object, EMPTY elsewhere."""
    height, width = mask.shape
    image = ImageLabel16I(width, height)
    fill_label_image(image, mask)
    return image


def fill_label_image(image: ImageLabel16I, mask: np.ndarray) -> None:
    """Write a mask (H, W) into an existing label image, which is resized."""
    height, width = mask.shape
    image.resize(width, height)
    labels = image.mutable_data[:, :, 0]
    # Ten times as fast as numpy.where.
    np.multiply(mask, np.int16(OBJECT - EMPTY), out=labels, dtype=np.int16)
    labels += np.int16(EMPTY)


def label_image_to_mask(
    image: ImageLabel16I | np.ndarray, labels: Collection[int] | None = None
) -> np.ndarray:
    """Return the mask (H, W) of a label image or of its data (H, W) or (H, W, 1).

    ``labels``: the labels of the object; None: all labels that Drake does not reserve (kEmpty,
    kDontCare, kDoNotRender and kUnspecified).
    """
    data = label_data(image)
    if labels is None:
        return data <= int(RenderLabel.kMaxUnreserved)
    return np.isin(data, list(labels))


def label_data(image: ImageLabel16I | np.ndarray) -> np.ndarray:
    """Return the labels (H, W) int16 of a label image or of its data, without a copy."""
    data = image.data if isinstance(image, ImageLabel16I) else np.asarray(image)
    return data[:, :, 0] if data.ndim == 3 else data
