"""The truncated filter as a Drake system, and a sensor that measures a hand's silhouette for it.

The hand follows section 6 of Shimada, Shirai, Kuno and Miura.
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
from drake_pose.fit.judge import LEVEL
from drake_pose.silhouette.pictures.label_renderer import label_image_to_mask
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.systems.cameras import MaskPlayer
from drake_pose.systems.diagrams import add_simulated_cameras
from drake_pose.systems.ports import (
    BeliefSystem,
    ImmutableValue,
    PortedSystem,
    connect_matching_ports,
    require_period,
    require_time_forward,
)

STATISTICS = ("step", "hypotheses", "distance", "count", "lost")
"""Names of the elements of the output port ``statistics``."""


@dataclass(frozen=True, eq=False)
class _EkfState(ImmutableValue):
    """The state of a TruncatedEkf."""

    state: FilterState  # State of the filter.
    step: int = 0  # Number of updates.
    unlikely: int = 0  # Number of consecutive unlikely measurements.
    lost: bool = False  # Whether these are too many.
    time: float = -math.inf  # Time of the last update [s].

    def statistics(self) -> list[float]:
        """Return the elements of STATISTICS."""
        state = self.state
        return [self.step, len(state.hypotheses), state.distance, state.count, self.lost]


class TruncatedEkf(BeliefSystem[_EkfState]):
    """Estimates a state from measurements, inside linear inequalities.

    .. pydrake_system::

        name: TruncatedEkf
        input_ports: [measurement (optional), measurement_covariance (optional), reset_state
          (optional), restart (optional)]
        output_ports: [estimated_state, covariance, overall_state, overall_covariance,
          hypothesis_weights, hypothesis_states, hypothesis_covariances, active_limits, statistics]

    A periodic update predicts the state and uses the measurement; output ports read the result. At
    the first update, while the track is lost, and whenever ``restart`` is not 0, the filter
    restarts from ``reset_state``, if this is finite, with the covariance of ``start``.

    Input ports:
        measurement (m): NaN where nothing is measured; if all are NaN, or the port is not
            connected, the update only predicts.
        measurement_covariance (m x m, row by row): noise covariance of this measurement, NaN where
            nothing is measured; the observation model's if not connected.
        reset_state (n): state to restart from, for example a matcher's.
        restart (1): not 0: restart.

    Output ports:
        estimated_state (n): mean of the heaviest hypothesis.
        covariance (n x n, row by row): of this state's error, over all hypotheses.
        overall_state (n): mean of the mixture of all hypotheses.
        overall_covariance (n x n): of this mixture.
        hypothesis_weights (cap): sorted, descending; 0 where there are fewer hypotheses.
        hypothesis_states (cap x n, row by row): in the same order; NaN where there are fewer.
        hypothesis_covariances (cap x n x n): in the same order; NaN where there are fewer.
        active_limits (K): 1 if this row of ``filter.inequalities`` changed the heaviest hypothesis.
        statistics (5): see ``STATISTICS``. ``lost`` is 1 after ``patience`` consecutive unlikely
            measurements.

    Parameters of the context: abstract parameter 0 is the ``FilterSettings``, numeric parameter 0
    is (patience, loss_probability).

    Args:
        belief_filter: the filter, with its models of measurement and motion.
        start: belief before the first measurement.
        period: time between two updates, one step of the motion [s]; required if the motion's rates
            are per step. None: the motion's.
        patience: number of consecutive unlikely measurements after which the track is lost.
        loss_probability: p-value below which a measurement is unlikely.
        offset: time of the first update [s]. Drake updates all systems with a state at once, so
            that a measurement by one of them, for example a ``SilhouetteTracker``, is a period old
            unless the filter is updated shortly after it.

    Raises:
        SettingsError: an argument has the wrong type, the start does not fit the filter, the period
            is not the motion's, or the patience is below 1. In a simulation: time runs backwards,
            or parameters do not fit.
    """

    def __init__(
        self,
        belief_filter: TruncatedFilter,
        start: Belief,
        period: float | None = None,
        patience: int = 3,
        loss_probability: float = LEVEL,
        offset: float = 0.0,
    ) -> None:
        super().__init__()
        if not isinstance(belief_filter, TruncatedFilter):
            raise SettingsError(
                f"TruncatedEkf takes a TruncatedFilter, not {type(belief_filter).__name__}"
            )
        if not isinstance(start, Belief):
            raise SettingsError(
                "start must be a Belief, made by make_belief(mean, covariance), not a "
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
        self.declare_belief(_EkfState(belief_filter.start(self._start)), period, offset)
        rows = belief_filter.inequalities.rows

        def filled(size: int, read: Callable[[Hypothesis], Any], empty: float) -> Any:
            """Return a function of the belief that gives rows (cap * size,) of all hypotheses.

            A row is ``read`` of a hypothesis, or ``empty`` where there are fewer hypotheses.
            """

            def read_all(known: _EkfState) -> Array:
                found = np.full((cap, size), empty)
                for k, one in enumerate(known.state.hypotheses):
                    found[k] = np.ravel(read(one))
                return found.ravel()

            return read_all

        def active(known: _EkfState) -> Array:
            cut = np.zeros(max(len(rows), 1))
            if known.step and rows:
                cut[:] = np.isin(rows, known.state.hypotheses[0].active)
            return cut

        self.add_belief_output("estimated_state", n, lambda known: known.state.best.mean)
        self.add_belief_output(
            "covariance", n * n, lambda known: known.state.estimate.covariance.ravel()
        )
        self.add_belief_output("overall_state", n, lambda known: known.state.overall.mean)
        self.add_belief_output(
            "overall_covariance", n * n, lambda known: known.state.overall.covariance.ravel()
        )
        self.add_belief_output("hypothesis_weights", cap, filled(1, lambda one: one.weight, 0.0))
        self.add_belief_output(
            "hypothesis_states", cap * n, filled(n, lambda one: one.belief.mean, math.nan)
        )
        covariances = filled(n * n, lambda one: one.belief.covariance, math.nan)
        self.add_belief_output("hypothesis_covariances", cap * n * n, covariances)
        self.add_belief_output("active_limits", max(len(rows), 1), active)
        self.add_belief_output("statistics", len(STATISTICS), _EkfState.statistics)

    def filter_state(self, context: Context) -> FilterState:
        """Return the filter's state in a context."""
        return self.belief(context).state

    def next_belief(self, context: Context, last: _EkfState) -> _EkfState:
        """Return the state after one step of the filter with the context's inputs.

        Raises:
            SettingsError: time runs backwards, or the context's parameters do not fit.
        """
        require_time_forward(self, context, last.time)
        settings = self._settings(context)
        belief_filter = self.filter.with_settings(settings)
        if settings.hypothesis_cap > self.filter.settings.hypothesis_cap:
            raise SettingsError(
                f"{self.get_name()}: its ports hold {self.filter.settings.hypothesis_cap} "
                f"hypotheses; the context's hypothesis_cap is {settings.hypothesis_cap}"
            )
        patience, loss_probability = context.get_numeric_parameter(int(self._loss)).value()
        _require_loss(patience, loss_probability)
        now, unlikely, skips_prediction = last.state, last.unlikely, last.step == 0
        restart = self.eval_input(context, "restart")
        if skips_prediction or last.lost or (restart is not None and restart[0] != 0):
            mean = self.eval_input(context, "reset_state")
            if mean is not None and np.isfinite(mean).all():
                now = belief_filter.start(Belief(mean, self._start.covariance))
                skips_prediction, unlikely = True, 0
        if not skips_prediction:
            now = belief_filter.predict(now)
        y, noise = self.eval_input(context, "measurement"), None
        if y is None:
            y = np.full(self._measured, np.nan)
        else:
            noise = self.eval_input(context, "measurement_covariance")
        if noise is not None:
            noise = noise.reshape(self._measured, self._measured)
        now = belief_filter.update(now, y, variances=noise)
        if now.count:
            is_unlikely = now.distance > chdtri(now.count, loss_probability)
            unlikely = unlikely + 1 if is_unlikely else 0
        lost = bool(unlikely >= patience)
        return _EkfState(now, last.step + 1, unlikely, lost, context.get_time())


def plant_motion(
    plant: MultibodyPlant,
    layout: StateLayout,
    noise: Array,
    period: float,
    context: Context | None = None,
) -> FunctionMotion:
    """Return a plant's dynamics as a filter's motion model, with a numerical Jacobian.

    Args:
        plant: finalized. Each joint that moves has one position and the name of a moving element of
            the state.
        layout: the elements of the state; its constants do not change.
        noise: (n, n) process noise covariance of a step.
        period: duration of a step [s], a multiple of a discrete plant's time step.
        context: the plant's, with fixed inputs and parameters; None: the default.

    Raises:
        SettingsError: the plant's joints are not the state's moving elements, or the period is not
            a multiple of the plant's time step.
    """
    every = map(plant.get_joint, plant.GetJointIndices())
    joints = {joint.name(): joint for joint in every if joint.num_velocities()}
    single = all(one.num_positions() == one.num_velocities() == 1 for one in joints.values())
    if not single or set(joints) != set(layout.moving):
        raise SettingsError(
            f"the plant's moving joints are {listed(list(joints))}; the state's moving elements "
            f"are {listed(layout.moving)}: they must be the same, with one position each"
        )
    require_period("motion", period)
    step = plant.time_step()
    if step and abs(period / step - round(period / step)) > 1e-6:
        raise SettingsError(f"a period of {period:g} s is no multiple of the plant's {step:g} s")
    simulator = Simulator(plant, context.Clone() if context else plant.CreateDefaultContext())
    if not step:
        # Error control would choose different steps for neighbouring states, and so perturb the
        # numerical Jacobian.
        ResetIntegratorFromFlags(simulator, "runge_kutta3", min(period / 4, 1e-2))
        simulator.get_mutable_integrator().set_fixed_step_mode(True)
    m, own = len(layout.moving), simulator.get_mutable_context()
    order = [joints[name] for name in layout.moving]
    places = np.array([one.position_start() for one in order])
    rates = np.array([plant.num_positions() + one.velocity_start() for one in order])

    def after(x: Array) -> Array:
        """Return the state (n,) one step after x (n,)."""
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
    """Raise SettingsError unless the patience is 1 or more and the probability in [0, 1)."""
    if not (patience >= 1 and 0.0 <= probability < 1.0):
        raise SettingsError(
            "patience must be 1 or more and loss_probability in [0, 1), not "
            f"{patience:g} and {probability:g}"
        )


def _period_of(motion: MotionModel, period: float | None) -> float:
    """Return the time between two updates [s]: ``period``, or the motion's if that is None.

    Raises SettingsError: no period is known, or the given one differs from the motion's.
    """
    step_period = period if motion.period is None else motion.period
    if step_period is None:
        raise SettingsError("the motion's rates are per step: give TruncatedEkf a period")
    require_period("filter", step_period)
    if period is not None and period != step_period:
        raise SettingsError(f"the motion's period is {step_period:g} s, not {period:g} s")
    return step_period


class HandSensor(PortedSystem):
    """Measures a hand's lines and fingertips in a silhouette, lengths unknown: figure 17.

    .. pydrake_system::

        name: HandSensor
        input_ports: [label_image, estimated_state, covariance, statistics]
        output_ports: [measurement, measurement_covariance, rough_state, difference]

    The system has no state. It is connected in a loop with the ``TruncatedEkf`` that uses its
    measurements.

    Input ports:
        label_image (ImageLabel16I): only the silhouette is used; a blank or unconnected image
            measures nothing.
        estimated_state, covariance, statistics: of the ``TruncatedEkf``.

    Output ports:
        measurement, measurement_covariance: for the ``TruncatedEkf``.
        rough_state (n): see ``HandMeasurement``.
        difference (1): see ``HandMeasurement``.

    ``silhouette``: makes the measurements; its filter is the ``TruncatedEkf``'s.
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

        def add_measured(name: str, size: int, read: Callable[[HandMeasurement], Array]) -> None:
            self.add_output(name, size, lambda context: read(measured.Eval(context)))

        add_measured("measurement", m, lambda one: one.y)
        add_measured("measurement_covariance", m * m, lambda one: one.covariance.ravel())
        add_measured("rough_state", n, lambda one: one.rough)
        add_measured("difference", 1, lambda one: np.array([one.difference]))

    def _measure(self, context: Context) -> HandMeasurement:
        """Measure the hand in the context's image, near the filter's prediction."""
        image, mean = (self.eval_input(context, k) for k in ("label_image", "estimated_state"))
        covariance = self.eval_input(context, "covariance").reshape(len(mean), len(mean))
        has_started = self.eval_input(context, "statistics")[STATISTICS.index("step")] > 0
        belief = Belief(mean, covariance)
        silhouette = self._silhouette
        mask = np.zeros((silhouette.height, silhouette.width), dtype=np.bool_)
        if image is not None:
            mask = label_image_to_mask(image)
        if has_started:
            return silhouette.measure(mask, silhouette.belief_filter.predict_belief(belief))
        # Table 2 of Shimada et al. gives the scale of the first frame.
        return silhouette.measure(mask, belief, 1.0)


def build_hand_estimation(
    model: ParsedModel,
    camera: Camera,
    silhouette: HandSilhouette,
    start: Belief,
    true_positions: Trajectory,
    period: float,
) -> tuple[Diagram, TruncatedEkf, HandSensor]:
    """Build a diagram that estimates a simulated hand's angles and lengths from rendered images.

    It contains a posed plant, Drake's renderer, a ``HandSensor`` and a ``TruncatedEkf``.

    Args:
        model: the true hand.
        camera: the camera that sees it.
        silhouette: makes the measurements, and has the filter.
        start: belief before the first image.
        true_positions: the true hand's positions (nq,) [rad or m] over time.
        period: time between two images [s].

    Returns the diagram, the filter and the sensor.
    """
    builder = DiagramBuilder()
    scene_graph = builder.AddNamedSystem("scene_graph", SceneGraph())
    _, images = add_simulated_cameras(builder, scene_graph, model, [camera], true_positions)
    return _add_hand_filter(builder, images[0], silhouette, start, period)


def build_recorded_hand_estimation(
    scene: Scene, silhouette: HandSilhouette, start: Belief
) -> tuple[Diagram, TruncatedEkf, HandSensor]:
    """Build the diagram of ``build_hand_estimation`` for recorded silhouettes, with a MaskPlayer.

    ``scene``: recorded masks of one camera. ``silhouette``: makes the measurements, and has the
    filter. ``start``: belief before the first image. Returns the diagram, the filter and the
    sensor.
    """
    builder, player = DiagramBuilder(), MaskPlayer(scene, scene.cameras)
    builder.AddNamedSystem("mask_player", player)
    image = player.GetOutputPort("label_image")
    return _add_hand_filter(builder, image, silhouette, start, player.period)


def _add_hand_filter(
    builder: DiagramBuilder, image: OutputPort, silhouette: HandSilhouette, start: Belief,
    period: float,
) -> tuple[Diagram, TruncatedEkf, HandSensor]:  # fmt: skip
    """Add filter and sensor for the label images at the port ``image``; build and return all."""
    ekf = TruncatedEkf(silhouette.belief_filter, start, period)
    builder.AddNamedSystem("truncated_ekf", ekf)
    sensor = builder.AddNamedSystem("hand_sensor", HandSensor(silhouette))
    builder.Connect(image, sensor.GetInputPort("label_image"))
    connect_matching_ports(builder, sensor, ekf)
    connect_matching_ports(builder, ekf, sensor)
    return builder.Build(), ekf, sensor
