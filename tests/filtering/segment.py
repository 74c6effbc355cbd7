"""A segment of unknown length that turns in the plane, and filters for it."""

import numpy as np

from drake_pose.filtering.inequalities import Inequalities, from_bounds
from drake_pose.filtering.motion import MotionModel, constant_velocity
from drake_pose.filtering.state import Belief, StateLayout
from drake_pose.filtering.truncated_filter import FilterSettings, TruncatedFilter
from drake_pose.filtering.update import FunctionObservation, ObservationModel

LAYOUT = StateLayout(("angle",), ("length",))
START = Belief(np.array([0.6, 0.1, 1.0]), np.diag([0.2, 0.3, 0.15]) ** 2)
STEP = constant_velocity(LAYOUT, {"angle": 0.5}, 0.1)
FREE = from_bounds(["angle"], [-np.inf], [np.inf])


def end_of(x):
    """Return the place (2,) of the segment's end."""
    return x[2] * np.array([np.cos(x[0]), np.sin(x[0])])


def end_slope(x):
    cosine, sine = np.cos(x[0]), np.sin(x[0])
    return np.array([[-x[2] * sine, 0, cosine], [x[2] * cosine, 0, sine]])


END = FunctionObservation(("u", "v"), 0.05, end_of, end_slope)


class Depth:
    """The distance of the segment's end along the viewing ray alone: the same at -angle."""

    names = ("u",)
    variances = np.array([0.002**2])
    wraps = np.zeros(1, dtype=bool)

    def predict(self, x):
        return end_of(x)[:1], end_slope(x)[:1]

    def mirrors(self, belief):
        return [belief.mean * [-1.0, 1.0, 1.0]]


def make_filter(
    observation: ObservationModel = END,
    rows: Inequalities = FREE,
    motion: MotionModel = STEP,
    **settings,
) -> TruncatedFilter:
    return TruncatedFilter(LAYOUT, observation, rows, motion, FilterSettings(**settings))


def follow(f: TruncatedFilter, measured, start: Belief = START) -> list[Belief]:
    """Return the best belief after each measurement; the first one has no step before it."""
    state, beliefs = f.start(start), []
    for t, y in enumerate(measured):
        state = f.update(f.predict(state) if t else state, y)
        beliefs.append(state.best)
    return beliefs


def draw(generator, observation: FunctionObservation, frames=20, start: Belief = START):
    """Return true states drawn from the start and the motion, and their measurements."""
    x = start.mean + start.root @ generator.normal(size=3)
    states, root = [], np.linalg.cholesky(STEP.noise + 1e-15 * np.eye(3))
    for t in range(frames):
        if t:
            x = STEP.transition @ x + root @ generator.normal(size=3)
        states.append(x)
    noise = np.sqrt(observation.variances) * generator.normal(size=(frames, 2))
    return np.array(states), np.array([observation.function(x) for x in states]) + noise
