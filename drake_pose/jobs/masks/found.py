"""What every way to find masks gives."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class FoundMask:
    """A mask of one picture, or why there is none.

    Args:
        camera, frame: whose it is.
        where: names the picture in messages.
        mask: (H, W).
        picture: (H, W, 3) red, green, blue; None where only the mask is known.
        refusal: why the mask is not good; "" where it is.
        warnings: what its user should look at.
    """

    camera: str
    frame: str
    where: str
    mask: Mask
    picture: NDArray[np.uint8] | None = None
    refusal: str = ""
    warnings: tuple[str, ...] = ()


FoundMasks = Iterator[FoundMask]
