"""A filter's state as plain vectors, for a Drake context."""

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context, LeafSystem

from drake_pose.errors import SettingsError
from drake_pose.filtering.kalman.hypotheses import Hypothesis
from drake_pose.filtering.kalman.repeated_views import RepeatedView, View
from drake_pose.filtering.kalman.truncated_filter import FilterState, TruncatedFilter
from drake_pose.filtering.state import Belief

Array = NDArray[np.float64]

HEAD = 5
"""So many numbers stand before the mean in a belief's row."""


def require_time_forward(system: LeafSystem, context: Context, last: float) -> None:
    """Refuse an update that is earlier than the last one, after which a filter knows the future.

    Raises:
        SettingsError: time ran backwards.
    """
    now = context.get_time()
    if now < last:
        raise SettingsError(
            f"{system.get_name()}: time ran backwards, from {last:g} s to {now:g} s; to begin "
            "anew, set the context to its defaults (SetDefaultContext)"
        )


class FilterPacking:
    """Turns the states of one filter into three vectors, and back.

    Rejections and the names of active rows are left out: they do not decide what comes next.

    Args:
        belief_filter: its layout and settings decide the sizes.
        measured: (m) how many numbers a measurement has.
    """

    def __init__(self, belief_filter: TruncatedFilter, measured: int) -> None:
        self._filter = belief_filter
        self.n, self.m = len(belief_filter.layout), measured
        self.cap = belief_filter.settings.hypothesis_cap
        self._sites = belief_filter.site_count
        n, z = self.n, self.n + measured
        self.belief_width = HEAD + 2 * (n + n * n) + 2 * self._sites + n
        self._repeated_width = 1 + z + z * z if belief_filter.novelty > 0 else 0

    def pack(self, state: FilterState) -> tuple[Array, Array, Array]:
        """Beliefs (cap x belief_width), repeated_views (cap x width), view (1 + m), each flat.

        A belief's row begins with: alive, log weight, log evidence, step of birth and place, mean.
        """
        beliefs = np.zeros((self.cap, self.belief_width))
        repeated_views = np.zeros((self.cap, self._repeated_width))
        for row, repeated_row, h in zip(beliefs, repeated_views, state.hypotheses, strict=False):
            sites = np.zeros((self._sites, 2))
            sites[: len(h.sites)] = h.sites
            row[:] = np.concatenate(
                [
                    [1.0, h.log_weight, h.log_evidence, h.born, h.place],
                    h.belief.mean,
                    h.belief.covariance.ravel(),
                    h.free.mean,
                    h.free.covariance.ravel(),
                    sites.ravel(),
                    h.tangent,
                ]
            )
            if h.repeated is not None:
                belief = h.repeated.belief
                repeated_row[:] = np.concatenate([[1.0], belief.mean, belief.covariance.ravel()])
        view = np.zeros(1 + self.m)
        if state.view is not None and self._filter.novelty > 0:
            view[0], view[1:] = state.view.count, state.view.reference
        return beliefs.ravel(), repeated_views.ravel(), view

    def unpack(
        self,
        beliefs: Array,
        repeated_views: Array,
        view: Array,
        step: int,
        distance: float,
        count: int,
    ) -> FilterState:
        """The state that was packed."""
        n, z = self.n, self.n + self.m
        ends = np.cumsum([HEAD, n, n * n, n, n * n, 2 * self._sites])
        hypotheses = []
        rows = beliefs.reshape(self.cap, -1)
        for row, repeated_row in zip(rows, repeated_views.reshape(self.cap, -1), strict=True):
            if row[0] == 0:
                continue
            head, mean, P, free_mean, free_P, sites, tangent = np.split(row.copy(), ends)
            repeated = None
            if repeated_row.size and repeated_row[0] > 0:
                joint = Belief(
                    repeated_row[1 : 1 + z].copy(), repeated_row[1 + z :].reshape(z, z).copy()
                )
                repeated = RepeatedView(tangent, joint)
            hypotheses.append(
                Hypothesis(
                    belief=Belief(mean, P.reshape(n, n)),
                    free=Belief(free_mean, free_P.reshape(n, n)),
                    log_weight=float(head[1]),
                    log_evidence=float(head[2]),
                    born=int(head[3]),
                    place=int(head[4]),
                    sites=sites.reshape(-1, 2),
                    tangent=tangent,
                    repeated=repeated,
                )
            )
        seen = View(view[1:].copy(), int(view[0])) if view[0] > 0 else None
        return FilterState(step, tuple(hypotheses), (), distance, count, seen)
