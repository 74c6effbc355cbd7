"""Which parameters of the frames are unknown: in each frame by itself, or in all of them alike.

An unknown is added to one parameter of a frame. So a joint's position is an unknown of each frame
that is added to the joint's value, its zero one of all frames that is added to the same value where
an encoder's readings are held; a segment's length is an unknown of all frames, added to a shape
joint's value.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Mask
from drake_pose.errors import UnknownNameError


@dataclass(frozen=True, eq=False)
class Unknowns:
    """Unknowns of frames, those of each frame by itself first.

    Attributes:
        names: of the u unknowns.
        entries: (u,) the parameter of a frame that each is added to.
        shared: (u,) whether it is the same in all frames.
        lower, upper: (u,) limits [rad, m or a logarithm].
        information: (u,) what is known without pictures, one over the variance about where the fit
            starts; 0: nothing.
    """

    names: tuple[str, ...]
    entries: NDArray[np.intp]
    shared: Mask
    lower: Array
    upper: Array
    information: Array

    @property
    def own_count(self) -> int:
        """How many are of each frame by itself."""
        return int(np.count_nonzero(~self.shared))

    def parameters(self, held: Array, own: Array, shared: Array) -> Array:
        """(n,) the parameters of a frame.

        Args:
            held: (n,) the frame's parameters where all unknowns are 0.
            own, shared: the values of the frame's own and of the shared unknowns.
        """
        theta = held.copy()
        np.add.at(theta, self.entries, np.concatenate([own, shared]))
        return theta


def choose(
    all_names: Sequence[str],
    names: Sequence[str],
    *,
    shared: bool = False,
    lower: float | Array = -np.inf,
    upper: float | Array = np.inf,
    deviation: float | Array = np.inf,
) -> Unknowns:
    """Some parameters as unknowns.

    Args:
        all_names: of all parameters of a frame.
        names: which are unknown.
        shared: whether they are the same in all frames.
        lower, upper: limits of all, or (u,) of each.
        deviation: how far they may be off where the fit starts.

    Raises:
        UnknownNameError: a name that is no parameter's.
    """
    for name in names:
        if name not in all_names:
            raise UnknownNameError("parameter", name, list(all_names), "the fit")
    count = len(names)
    return Unknowns(
        names=tuple(names),
        entries=np.array([list(all_names).index(name) for name in names], dtype=np.intp),
        shared=np.full(count, shared),
        lower=np.broadcast_to(np.asarray(lower, dtype=np.float64), count),
        upper=np.broadcast_to(np.asarray(upper, dtype=np.float64), count),
        information=np.broadcast_to(1.0 / np.square(np.asarray(deviation, np.float64)), count),
    )


def join(*parts: Unknowns) -> Unknowns:
    """All of some unknowns, those of each frame by itself first."""
    order = np.argsort(np.concatenate([part.shared for part in parts]), kind="stable")
    names = [name for part in parts for name in part.names]
    stacked = (
        np.concatenate([getattr(part, field) for part in parts])[order]
        for field in ("entries", "shared", "lower", "upper", "information")
    )
    return Unknowns(tuple(names[k] for k in order), *stacked)
