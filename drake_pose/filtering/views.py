"""The same view for long teaches nothing new: what one view may tell in all, and no more.

A filter that linearises anew in every frame of a static view intersects tangents at ever other
points of one curved set, and believes itself ever surer: the flaw that Shimada et al. state in
their section 7. Here a view keeps the tangent of its first frame, and its frames together count
as their mean does: noise R / k after k frames, plus the curvature C that no averaging takes away.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_pose.filtering.fusion import lower_or_root
from drake_pose.filtering.state import Belief
from drake_pose.filtering.update import ObservationModel, difference

Array = NDArray[np.float64]

# E[(b z^2)^2] = 3 b^2 for a standard normal z.
_FOURTH_MOMENT = 3.0


@dataclass(frozen=True, eq=False)
class View:
    """Frames that show the same.

    Attributes:
        reference: (m,) the measurement of its first frame.
        count: how many frames it has had.
    """

    reference: Array
    count: int


def next_view(view: View | None, y: Array, model: ObservationModel, novelty: float) -> View:
    """The view a measurement belongs to: the one so far, or one that begins with it.

    Args:
        view: the one so far.
        y: (m,) measured, NaN where occluded.
        model: gives the noise.
        novelty: a view is new when its measurement differs from the reference by more than this,
            in root mean square of standard deviations (noise alone gives 1.4); 0: every one is.
    """
    if view is None or novelty == 0:
        return View(y, 1)
    change = difference(y, view.reference, model.wraps)
    both = np.isfinite(change)
    new_rows = np.isfinite(y) & ~np.isfinite(view.reference)
    if new_rows.any() or not both.any():
        return View(y, 1)
    size = math.sqrt(float(np.mean(change[both] ** 2 / model.variances[both])))
    return View(y, 1) if size > novelty else View(view.reference, view.count + 1)


class AnchoredObservation:
    """An observation model held at the tangent of one state.

    Args:
        model: what is observed.
        belief: the tangent is taken at its mean; its covariance says how far the truth may lie
            from there, and so how much the tangent may be off.
    """

    def __init__(self, model: ObservationModel, belief: Belief) -> None:
        self._model = model
        self._x = belief.mean
        self._h, self._H = model.predict(belief.mean)
        self._curvature = self._measure_curvature(belief)
        self.variances = model.variances
        self.names = model.names
        self.wraps = model.wraps

    def _measure_curvature(self, belief: Belief) -> Array:
        """(m,) mean square of what the tangent leaves out, by second differences."""
        used = np.flatnonzero(np.abs(self._H).sum(axis=0) > 0)
        root = lower_or_root(belief.covariance[np.ix_(used, used)])
        total = np.zeros(len(self._h))
        for column in root.T:
            step = np.zeros_like(self._x)
            step[used] = column
            ends = [self._model.predict(self._x + sign * step)[0] for sign in (1.0, -1.0)]
            bend = 0.5 * sum(difference(end, self._h, self._model.wraps) for end in ends)
            total += _FOURTH_MOMENT * np.nan_to_num(bend) ** 2
        return total

    def for_frame(self, count: int) -> "AnchoredObservation":
        """The same, with the noise of a view's frame number ``count`` (2 or more).

        Together with the frames before, it makes the view's noise R / count + C.
        """
        R, C = self._model.variances, self._curvature
        gain = 1.0 / (R / count + C) - 1.0 / (R / (count - 1) + C)
        self.variances = 1.0 / np.maximum(gain, 1e-12 / R)
        return self

    def predict(self, x: Array) -> tuple[Array, Array]:
        """The tangent's value at x (m,), and its slope (m, n)."""
        return self._h + self._H @ (x - self._x), self._H

    def mirrors(self, belief: Belief) -> list[Array]:
        """None: what else the view may be was asked when it was new."""
        return []
