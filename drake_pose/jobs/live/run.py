"""Runs the diagram of a live capture, period by period, and notes what comes out."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import Context, Diagram

from drake_pose.person.date.capture import PersonView
from drake_pose.person.views import SilhouetteView
from drake_pose.systems.person.live_capture import LiveSensors

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# A simulation that lags behind the clock by more [s] does not try to make up for it.
_LARGEST_LAG = 0.2


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """What a moment's pictures say.

    Args:
        time: the pictures' time stamp, from the first ones on [s].
        q: (nq,) estimated positions [rad or m]; nan where nobody was found.
        share: of the contours, what fits; nan where the diagram does not say.
        views: by camera that gave a picture, what it says.
        has_others: whether other persons are in the views, whom the tracker has cut out.
        deviations: (nq,) standard deviations of q [rad or m]; nan where nobody was found, or where
            the diagram does not give them.
        seconds: the work since the frame before [s].
    """

    time: float
    q: Array
    share: float
    views: Mapping[str, SilhouetteView | PersonView]
    has_others: bool
    deviations: Array
    seconds: float


def run_live(
    diagram: Diagram,
    sensors: LiveSensors,
    seconds: float | None,
    on_report: Callable[[str], None],
    until: Callable[[], bool] = lambda: False,
    monitor: Callable[[Context], None] | None = None,
    is_shown: bool = False,
) -> bool:
    """Runs a diagram until its recordings end, its time is up, or Ctrl-C.

    Args:
        diagram: with the sensors in it.
        sensors: the sensors.
        seconds: how long; None: without end.
        on_report: hears what the user should know of cameras and pictures.
        until: asked after every period whether it is enough.
        monitor: called with the diagram's context after every period.
        is_shown: whether somebody watches: then recordings, too, run no faster than the clock.

    Returns:
        Whether it was ended by Ctrl-C.
    """
    simulator = Simulator(diagram)
    if monitor is not None:
        simulator.set_monitor(monitor)
    is_paced = sensors.live or is_shown
    if is_paced:
        simulator.set_target_realtime_rate(1.0)
    context = simulator.get_context()
    begin = start = time.monotonic()

    def elapsed() -> float:
        return time.monotonic() - start if sensors.live else context.get_time()

    end = math.inf if seconds is None else seconds
    reached = SimulatorStatus.ReturnReason.kReachedTerminationCondition
    try:
        simulator.Initialize()
        begin = start = time.monotonic()
        while elapsed() < end and not until():
            status = simulator.AdvanceTo(context.get_time() + sensors.period)
            for report in sensors.take_reports():
                on_report(report)
            if status.reason() == reached:
                break
            lag = time.monotonic() - begin - context.get_time()
            if is_paced and lag > _LARGEST_LAG:
                # What was missed is gone: nobody wants to see it in fast motion.
                simulator.ResetStatistics()
                begin += lag
    except KeyboardInterrupt:
        return True
    return False


class FrameWatch:
    """Notes each new moment of a diagram from build_live_capture or build_paper_capture.

    Args:
        diagram: the diagram.
        cameras: the names of its cameras.
        on_frame: hears of each frame.
        view: before a camera's name, the output with what the camera's picture says.
    """

    def __init__(
        self,
        diagram: Diagram,
        cameras: Iterable[str],
        on_frame: Callable[[LiveFrame], None],
        view: str = "silhouette",
    ) -> None:
        self._time = diagram.GetOutputPort("time")
        self._positions = diagram.GetOutputPort("estimated_positions")
        self._share, self._others, self._deviations = (
            diagram.GetOutputPort(name) if diagram.HasOutputPort(name) else None
            for name in ("share", "others", "deviations")
        )
        self._views = {name: diagram.GetOutputPort(f"{view}_{name}") for name in cameras}
        self._on_frame = on_frame
        self._last = math.nan
        self._begin = time.perf_counter()

    def __call__(self, context: Context) -> None:
        """Looks whether there is a new moment."""
        moment = float(self._time.Eval(context)[0])
        if math.isnan(moment) or moment == self._last:
            return
        self._last = moment
        views = {name: port.Eval(context) for name, port in self._views.items()}
        seen = {name: view for name, view in views.items() if view is not None}
        q = np.array(self._positions.Eval(context))
        share = math.nan if self._share is None else float(self._share.Eval(context)[0])
        has_others = self._others is not None and bool(self._others.Eval(context)[0])
        deviations = np.full(len(q), np.nan)
        if self._deviations is not None:
            deviations = np.array(self._deviations.Eval(context))
        now = time.perf_counter()
        self._on_frame(LiveFrame(moment, q, share, seen, has_others, deviations, now - self._begin))
        self._begin = time.perf_counter()
