"""The truncated filter as a Drake system: measurements in, a belief within limits out.

And the hand's sensor of section 6, which measures a silhouette for it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
from pydrake.systems.framework import BasicVector, Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.sensors import ImageLabel16I
from pydrake.trajectories import Trajectory
from scipy.special import chdtri

from drake_pose.arrays import Array
from drake_pose.body import ParsedModel
from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError, listed
from drake_pose.filtering.hand_silhouette import HandMeasurement, HandSilhouette
from drake_pose.filtering.motion import FunctionMotion, MotionModel
from drake_pose.filtering.state import Belief, StateLayout, make_belief
from drake_pose.filtering.truncated_filter import FilterState, Hypothesis, TruncatedFilter
from drake_pose.silhouette.pictures.label_images import label_image_to_mask
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.systems.diagrams import add_simulated_cameras
from drake_pose.systems.images import MaskPlayer
from drake_pose.systems.ports import (
    BeliefSystem,
    PortedSystem,
    SharedValue,
    connect_same,
    require_period,
    require_time_forward,
)

STATISTICS = ("step", "hypotheses", "distance", "count", "lost")
"""What the elements of the output ``statistics`` are."""


@dataclass(frozen=True, eq=False)
class _Known(SharedValue):
    """What is known after an update: how many there were, and unlikely ones in a row; time [s]."""

    state: FilterState
    step: int = 0
    unlikely: int = 0
    lost: bool = False
    time: float = -math.inf

    def statistics(self) -> list[float]:
        """STATISTICS."""
        state = self.state
        return [self.step, len(state.hypotheses), state.distance, state.count, self.lost]


class TruncatedEkf(BeliefSystem[_Known]):
    """Estimates a state from measurements, inside linear inequalities.

    .. pydrake_system::

        name: TruncatedEkf
        input_ports: [measurement (optional), measurement_covariance (optional), reset_state
          (optional), restart (optional)]
        output_ports: [estimated_state, covariance, overall_state, overall_covariance,
          hypothesis_weights, hypothesis_states, hypothesis_covariances, active_limits, statistics]

    A periodic update predicts and uses the measurement: NaN where something is occluded; all NaN,
    or an unconnected port, where a camera is late or missing, which leaves the prediction.
    ``measurement_covariance`` (m x m, row by row) is that of this one's noise, finite where it is;
    the observation model's own where the port is not connected.

    - ``estimated_state`` (n), ``covariance`` (n x n, row by row): of the heaviest hypothesis.
    - ``overall_state`` (n), ``overall_covariance`` (n x n): of all hypotheses together, wide where
      they disagree.
    - ``hypothesis_weights`` (cap), ``hypothesis_states`` (cap x n, row by row): the heaviest first,
      weights 0 and states NaN where there are fewer; ``hypothesis_covariances`` (cap x n x n).
    - ``active_limits`` (K): 1 where that row of ``filter.inequalities`` cut the best belief.
    - ``statistics``: see ``STATISTICS``. ``lost`` is 1 while measurements have been as unlikely as
      one in a million for several steps.

    At the first update, while the track is lost, and whenever ``restart`` (1) is not 0, the filter
    starts again from ``reset_state`` (n), for example from a matcher, if all its elements are
    finite; with the covariance of the belief given here.

    A context holds how the filter works: abstract parameter 0 is its ``FilterSettings``, numeric
    parameter 0 is (patience, loss_probability).

    Args:
        start: the belief before the first measurement.
        period: time between two updates, one step of the prediction [s]; needed where the motion's
            rates are per step. None: the motion's.
        patience: how many unlikely measurements in a row make a loss.
        loss_probability: p-value below which a measurement is unlikely.

    Raises:
        SettingsError: a filter of another class, a start that does not fit, a period that is not
            the motion's, a patience below 1; and, in a simulation, time that runs backwards, or
            parameters that do not fit.
    """

    def __init__(
        self,
        belief_filter: TruncatedFilter,
        start: Belief,
        period: float | None = None,
        patience: int = 3,
        loss_probability: float = 1e-6,
    ) -> None:
        super().__init__()
        if not isinstance(belief_filter, TruncatedFilter):
            raise SettingsError(
                f"TruncatedEkf takes a TruncatedFilter, not {type(belief_filter).__name__}"
            )
        if not isinstance(start, Belief):
            raise SettingsError(
                "start must be a Belief, as make_belief(mean, covariance) gives it, not a "
                f"{type(start).__name__}"
            )
        period = _period_of(belief_filter.motion, period)
        self.filter = belief_filter
        self._start = make_belief(start.mean, start.covariance, belief_filter.layout, "the start")
        self._settings = self.add_parameter(belief_filter.settings)
        self._loss = self.DeclareNumericParameter(BasicVector([patience, loss_probability]))
        _require_loss(patience, loss_probability)
        n, cap = len(belief_filter.layout), belief_filter.settings.hypothesis_cap
        self._measured = len(belief_filter.observation.names)
        self.add_input("measurement", self._measured)
        self.add_input("measurement_covariance", self._measured**2)
        self.add_input("reset_state", n)
        self.add_input("restart", 1)
        self.keep_belief(_Known(belief_filter.start(self._start)), period)
        rows = belief_filter.inequalities.rows

        def filled(size: int, read: Callable[[Hypothesis], Any], empty: float) -> Any:
            def show(known: _Known) -> Array:
                found = np.full((cap, size), empty)
                for k, one in enumerate(known.state.hypotheses):
                    found[k] = np.ravel(read(one))
                return found.ravel()

            return show

        def active(known: _Known) -> Array:
            cut = np.zeros(max(len(rows), 1))
            if known.step and rows:
                cut[:] = np.isin(rows, known.state.hypotheses[0].active)
            return cut

        self.show("estimated_state", n, lambda known: known.state.best.mean)
        self.show("covariance", n * n, lambda known: known.state.best.covariance.ravel())
        self.show("overall_state", n, lambda known: known.state.overall.mean)
        self.show("overall_covariance", n * n, lambda known: known.state.overall.covariance.ravel())
        self.show("hypothesis_weights", cap, filled(1, lambda one: one.weight, 0.0))
        self.show("hypothesis_states", cap * n, filled(n, lambda one: one.belief.mean, math.nan))
        covariances = filled(n * n, lambda one: one.belief.covariance, math.nan)
        self.show("hypothesis_covariances", cap * n * n, covariances)
        self.show("active_limits", max(len(rows), 1), active)
        self.show("statistics", len(STATISTICS), _Known.statistics)

    def filter_state(self, context: Context) -> FilterState:
        """The filter's state in a context."""
        return self.belief(context).state

    def next_belief(self, context: Context, last: _Known) -> _Known:
        """A step of the filter."""
        require_time_forward(self, context, last.time)
        settings = self._settings(context)
        belief_filter = self.filter.with_settings(settings)
        if settings.hypothesis_cap > self.filter.settings.hypothesis_cap:
            raise SettingsError(
                f"{self.get_name()}: its ports are of {self.filter.settings.hypothesis_cap} "
                f"hypotheses at most; the context's hypothesis_cap is {settings.hypothesis_cap}"
            )
        patience, loss_probability = context.get_numeric_parameter(int(self._loss)).value()
        _require_loss(patience, loss_probability)
        now, unlikely, is_fresh = last.state, last.unlikely, last.step == 0
        restart = self.given(context, "restart")
        if is_fresh or last.lost or (restart is not None and restart[0] != 0):
            mean = self.given(context, "reset_state")
            if mean is not None and np.isfinite(mean).all():
                now = belief_filter.start(Belief(mean, self._start.covariance))
                is_fresh, unlikely = True, 0
        if not is_fresh:
            now = belief_filter.predict(now)
        y, noise = self.given(context, "measurement"), None
        if y is None:
            y = np.full(self._measured, np.nan)
        else:
            noise = self.given(context, "measurement_covariance")
        if noise is not None:
            noise = noise.reshape(self._measured, self._measured)
        now = belief_filter.update(now, y, variances=noise)
        if now.count:
            is_unlikely = now.distance > chdtri(now.count, loss_probability)
            unlikely = unlikely + 1 if is_unlikely else 0
        lost = bool(unlikely >= patience)
        return _Known(now, last.step + 1, unlikely, lost, context.get_time())


def plant_motion(
    plant: MultibodyPlant,
    layout: StateLayout,
    noise: Array,
    period: float,
    context: Context | None = None,
) -> FunctionMotion:
    """A plant's own dynamics as a filter's motion, Jacobian by differences.

    Args:
        plant: finalized; each of its joints that moves has one position, and the joint's name is a
            moving element of the state. Its constants stay as they are.
        noise: (n, n) the covariance of what a step adds.
        period: the time of a step [s], a multiple of a discrete plant's time step.
        context: the plant's, with inputs and parameters that are fixed; None: the default.

    Raises:
        SettingsError: joints that are not the state's moving elements, or a period that does not
            fit the plant's time step.
    """
    joints = {
        joint.name(): joint
        for joint in map(plant.get_joint, plant.GetJointIndices())
        if joint.num_velocities()
    }
    single = all(one.num_positions() == one.num_velocities() == 1 for one in joints.values())
    if not single or set(joints) != set(layout.moving):
        raise SettingsError(
            f"the plant's joints that move are {listed(list(joints))}; the state's moving elements "
            f"are {listed(layout.moving)}: they must be the same, with one position each"
        )
    require_period("motion", period)
    step = plant.time_step()
    if step and abs(period / step - round(period / step)) > 1e-6:
        raise SettingsError(f"a period of {period:g} s is no multiple of the plant's {step:g} s")
    simulator = Simulator(plant, context.Clone() if context else plant.CreateDefaultContext())
    if not step:
        # Steps that a required accuracy chose would differ between neighbouring states.
        ResetIntegratorFromFlags(simulator, "runge_kutta3", min(period / 4, 1e-2))
        simulator.get_mutable_integrator().set_fixed_step_mode(True)
    m, own = len(layout.moving), simulator.get_mutable_context()
    order = [joints[name] for name in layout.moving]
    places = np.array([one.position_start() for one in order])
    rates = np.array([plant.num_positions() + one.velocity_start() for one in order])

    def after(x: Array) -> Array:
        state = plant.GetPositionsAndVelocities(own)
        state[places], state[rates] = x[:m], x[m : 2 * m]
        own.SetTime(0.0)
        plant.SetPositionsAndVelocities(own, state)
        simulator.Initialize()
        simulator.AdvanceTo(period)
        state = plant.GetPositionsAndVelocities(own)
        return np.r_[state[places], state[rates], x[2 * m :]]

    return FunctionMotion(after, noise, period)


def _require_loss(patience: float, probability: float) -> None:
    if not (patience >= 1 and 0.0 <= probability < 1.0):
        raise SettingsError(
            "patience must be 1 or more and loss_probability in [0, 1), not "
            f"{patience:g} and {probability:g}"
        )


def _period_of(motion: MotionModel, period: float | None) -> float:
    """The time between two updates [s]; SettingsError where it is not that of a step."""
    if period is None and motion.period is None:
        raise SettingsError("the motion's rates are per step: give TruncatedEkf a period")
    given = period if motion.period is None else motion.period
    assert given is not None
    require_period("filter", given)
    if period is not None and period != given:
        raise SettingsError(f"a step of the motion takes {given:g} s: its period is not {period:g}")
    return given


class HandSensor(PortedSystem):
    """Measures a hand's axes and tips in a silhouette, lengths unknown: figure 17.

    .. pydrake_system::

        name: HandSensor
        input_ports: [label_image, estimated_state, covariance, statistics]
        output_ports: [measurement, measurement_covariance, rough_state, difference]

    The inputs but the image come from the ``TruncatedEkf`` that takes the first two outputs. Of the
    label image only the silhouette is used; an image that is not connected, or blank, shows
    nothing. ``rough_state`` (n) and ``difference`` (1) are as of ``HandMeasurement``.

    Args:
        silhouette: measures; its filter is the ``TruncatedEkf``'s.
    """

    def __init__(self, silhouette: HandSilhouette) -> None:
        super().__init__()
        self._silhouette = silhouette
        n = len(silhouette.belief_filter.layout)
        m = len(silhouette.belief_filter.observation.names)
        self.add_input("label_image", ImageLabel16I(silhouette.width, silhouette.height))
        self.add_input("estimated_state", n)
        self.add_input("covariance", n * n)
        self.add_input("statistics", len(STATISTICS))
        measured = self.add_cache("measured", self._measure)

        def show(name: str, size: int, read: Callable[[HandMeasurement], Array]) -> None:
            self.add_output(name, size, lambda context: read(measured.Eval(context)))

        show("measurement", m, lambda one: one.y)
        show("measurement_covariance", m * m, lambda one: one.covariance.ravel())
        show("rough_state", n, lambda one: one.rough)
        show("difference", 1, lambda one: np.array([one.difference]))

    def _measure(self, context: Context) -> HandMeasurement:
        image, mean = self.given(context, "label_image"), self.given(context, "estimated_state")
        covariance = self.given(context, "covariance").reshape(len(mean), len(mean))
        begun = self.given(context, "statistics")[STATISTICS.index("step")] > 0
        belief = Belief(mean, covariance)
        silhouette = self._silhouette
        if image is None:
            mask = np.zeros((silhouette.height, silhouette.width), dtype=np.bool_)
        else:
            mask = label_image_to_mask(image)
        if begun:
            return silhouette.measure(mask, silhouette.belief_filter.predicted(belief))
        # Table 2 gives the scale of the first frame.
        return silhouette.measure(mask, belief, 1.0)


def build_hand_estimation(
    model: ParsedModel,
    camera: Camera,
    silhouette: HandSilhouette,
    start: Belief,
    true_positions: Trajectory,
    period: float,
) -> tuple[Diagram, TruncatedEkf, HandSensor]:
    """Plant, Drake's renderer, ``HandSensor``, ``TruncatedEkf``: angles, lengths from pictures.

    Args:
        model: the hand that is seen, in the plant's positions over time.
        start: the belief before the first picture.
        period: time between two pictures [s].
    """
    builder = DiagramBuilder()
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    _, images = add_simulated_cameras(builder, scene_graph, model, [camera], true_positions)
    return _add_hand_filter(builder, images[0], silhouette, start, period)


def build_recorded_hand_estimation(
    scene: Scene, silhouette: HandSilhouette, start: Belief
) -> tuple[Diagram, TruncatedEkf, HandSensor]:
    """The same of a scene's recorded silhouettes: ``MaskPlayer``, ``HandSensor``, ``TruncatedEkf``.

    Args:
        scene: of one camera.
        start: the belief before the first picture.
    """
    builder, player = DiagramBuilder(), MaskPlayer(scene, scene.cameras)
    builder.AddNamedSystem("mask_player", player)
    image = player.GetOutputPort("label_image")
    return _add_hand_filter(builder, image, silhouette, start, player.period)


def _add_hand_filter(
    builder: DiagramBuilder, image: OutputPort, silhouette: HandSilhouette, start: Belief,
    period: float,
) -> tuple[Diagram, TruncatedEkf, HandSensor]:  # fmt: skip
    ekf = TruncatedEkf(silhouette.belief_filter, start, period)
    builder.AddNamedSystem("truncated_ekf", ekf)
    sensor = builder.AddNamedSystem("hand_sensor", HandSensor(silhouette))
    builder.Connect(image, sensor.GetInputPort("label_image"))
    connect_same(builder, sensor, ekf)
    connect_same(builder, ekf, sensor)
    return builder.Build(), ekf, sensor
