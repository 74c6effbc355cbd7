"""The regular grid on which a node's values are sampled (Kameda, section 5.1, step 3)."""

import itertools
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from drake_pose.errors import SettingsError

MAXIMUM_GRID_SIZE = 5_000_000
# A multiple that misses a limit by rounding alone still counts as inside.
_ROUNDING = 1e-9


def axis_samples(lower: float, upper: float, interval: float, *, is_angle: bool) -> list[float]:
    """The multiples of the interval inside the limits, by size, the negative of two equals first.

    The middle of the finite limits [rad or m] where no multiple lies inside. A full turn of an
    angle gives each direction once. Raises SettingsError where memory would not hold the samples.
    """
    first = math.ceil(lower / interval - _ROUNDING)
    last = math.floor(upper / interval + _ROUNDING)
    if is_angle and (last - first) * interval >= 2.0 * math.pi - _ROUNDING:
        first = last - math.ceil(2.0 * math.pi / interval - _ROUNDING) + 1
    if last < first:
        return [0.5 * (lower + upper)]
    if last - first >= MAXIMUM_GRID_SIZE:
        raise SettingsError(
            f"a sampling interval of {interval:g} makes {last - first + 1} samples of one joint, "
            f"at most {MAXIMUM_GRID_SIZE} are allowed: use a larger interval"
        )
    multiples = sorted(range(first, last + 1), key=lambda multiple: (abs(multiple), multiple))
    return [min(max(multiple * interval, lower), upper) for multiple in multiples]


def product_grid(axes: Sequence[Sequence[float]], node: str) -> NDArray[np.float64]:
    """All combinations (n, k) of the axes' samples, the last axis changing fastest.

    Raises SettingsError, which names the node, where memory would not hold them.
    """
    size = math.prod(len(axis) for axis in axes)
    if size > MAXIMUM_GRID_SIZE:
        raise SettingsError(
            f"node '{node}' would have {size} samples, at most {MAXIMUM_GRID_SIZE} are allowed: "
            "use a larger sampling interval or hold some of its joints"
        )
    return np.array(list(itertools.product(*axes)), dtype=np.float64).reshape(size, len(axes))
