"""The one loop of what happens live: a diagram's periods, and their end."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import Context, Diagram, EventStatus

from drake_pose.systems.person.live_capture import LiveSensors

# Between two looks whether a walk without cameras has ended [s].
_LOOK = 0.5
# How long it is waited for the person before live cameras [s].
_PATIENCE = 60.0
# A simulation that lags behind the clock by more [s] does not try to make up for it.
_LARGEST_LAG = 0.2


def run_live(
    diagram: Diagram,
    sensors: LiveSensors | None,
    seconds: float | None,
    on_report: Callable[[str], None] = lambda _: None,
    monitor: Callable[[Context], EventStatus | None] | None = None,
    speed: float = 0.0,
) -> bool:
    """Runs a diagram until its recordings end or its time is up; True: until Ctrl-C instead.

    Args:
        sensors: those in the diagram; None: it has none.
        seconds: how long; None: without end.
        on_report: called with what the user should know of cameras and pictures.
        monitor: called with the diagram's context after every step; may end the run.
        speed: simulated seconds a second where no camera is live; 0: as fast as it can.
    """
    simulator = Simulator(diagram)
    if monitor is not None:
        simulator.set_monitor(monitor)
    is_live = sensors is not None and sensors.live
    speed = 1.0 if is_live else speed
    simulator.set_target_realtime_rate(speed)
    context = simulator.get_context()
    period = _LOOK if sensors is None else sensors.period
    end = math.inf if seconds is None else seconds
    try:
        simulator.Initialize()
        begin = start = time.monotonic()
        while (time.monotonic() - start if is_live else context.get_time()) < end:
            goal = context.get_time() + period
            status = simulator.AdvanceTo(goal if is_live else min(goal, end))
            for report in [] if sensors is None else sensors.take_reports():
                on_report(report)
            if status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition:
                break
            lag = time.monotonic() - begin - context.get_time() / speed if speed else 0.0
            if lag > _LARGEST_LAG:
                # What was missed is gone: nobody wants to see it in fast motion.
                simulator.ResetStatistics()
                begin += lag
    except KeyboardInterrupt:
        return True
    return False


def look_until(
    diagram: Diagram,
    sensors: LiveSensors,
    looks: Callable[[Context], bool],
    on_report: Callable[[str], None],
) -> None:
    """Runs a diagram until what looks at it has seen enough; uses the sensors up.

    Raises:
        KeyboardInterrupt: the user gave up.
    """

    def look(context: Context) -> EventStatus:
        is_enough = looks(context)
        return (
            EventStatus.ReachedTermination(diagram, "") if is_enough else EventStatus.DidNothing()
        )

    # What is wrong with recorded pictures is said when they are captured.
    report = on_report if sensors.live else lambda _: None
    waited = _PATIENCE if sensors.live else None
    try:
        if run_live(diagram, sensors, waited, report, look):
            raise KeyboardInterrupt
    finally:
        sensors.close()
