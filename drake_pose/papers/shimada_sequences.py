"""Sequences of Shimada's hands, and the track of a filter over their frames.

`make_sequence` draws true states, measurements and table 2's first guess; `run_sequence` follows a
recorded hand in one view of unknown scale (figures 17 and 18).
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import cast

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram
from rich.table import Table
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array, Mask
from drake_pose.body import PlantKinematics, bundled_model
from drake_pose.camera.episode_files import JOINT_TABLE
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import SceneError
from drake_pose.files.settings import EstimateSettings
from drake_pose.filtering.hand import (
    FLEXIONS,
    HAND_STATE,
    LENGTHS,
    MEASURED,
    SPREADS,
    HandObservation,
)
from drake_pose.filtering.hand_model import (
    PALM,
    QUATERNION,
    WRIST,
    HandModel,
    palm_rotation,
    read_hand,
)
from drake_pose.filtering.hand_silhouette import HandSilhouette
from drake_pose.filtering.inequalities import from_bounds, model_inequalities, stack
from drake_pose.filtering.motion import LinearMotion
from drake_pose.filtering.state import Belief
from drake_pose.filtering.truncated_filter import (
    FilterSettings,
    FilterState,
    TruncatedFilter,
    Truncation,
)
from drake_pose.input_files import read_csv
from drake_pose.jobs.estimate.inputs import EstimateInputs, read_inputs
from drake_pose.papers.tables import Advance, Count, figure_table, uncounted
from drake_pose.search import View
from drake_pose.silhouette.pictures.label_renderer import label_image_to_mask
from drake_pose.systems.truncated_ekf import (
    HandSensor,
    TruncatedEkf,
    build_recorded_hand_estimation,
)

FRAMES = 55
OBSERVED = ("full", "lines")
"""What is measured: all; axes and tips of the fingers and the palm's outline."""

ACCELERATIONS = {
    **dict.fromkeys(WRIST, 0.8),
    **dict.fromkeys(QUATERNION, 0.004),
    **dict.fromkeys((*SPREADS, *FLEXIONS), math.radians(0.8)),
}
"""Standard deviations of the accelerations [pixel, 1, rad per frame^2]: theta's part of U (6)."""


# Motion of an element [pixel, deg]: middle, reach, swings in the sequence, its phase, the lead of
# finger 2, and the lag of the last joints [rad].
_SWINGS = {
    "wrist_x": (-50, 30, 1.0, 0, 0.0, 0.0),
    "wrist_y": (0, 20, 1.3, 1, 0.0, 0.0),
    "spread_1": (-10, 5, 1.0, 5, 0.0, 0.0),
    "spread_2": (10, 5, 1.4, 5, 0.0, 0.0),
    "flexion_11": (40, 28, 1.0, 4, 0.0, 0.0),
    "flexion_12": (38, 28, 1.2, 5, 0.0, 0.0),
    "flexion_13": (36, 25, 1.2, 5, 0.0, 0.1),
    "flexion_21": (40, 28, 1.0, 4, 0.5, 0.0),
    "flexion_22": (38, 28, 1.2, 5, 0.5, 0.0),
    "flexion_23": (36, 25, 1.2, 5, 0.5, 0.1),
}
# Sizes [mm]; with them, lengths r_13 of 35 and 40 satisfy table 1.
_SIZES = dict(zip((*LENGTHS, *PALM), (62, 41, 0, 60, 40, 38, 70, 80, 22), strict=True))


@dataclass(frozen=True, eq=False)
class SyntheticSequence:
    """A synthetic sequence of 55 frames."""

    states: Array  # (55, n) true states, elements as of HAND_STATE.
    measurements: Array  # (55, m) noisy measurements, elements as of MEASURED; nan: not measured.
    guess: Belief  # Table 2's belief about the first state.


def true_states(r_13: float, phase: Array, yaw_middle: float = 0.0) -> Array:
    """Return the states (55, n) of a hand that moves, turns, flexes, and changes its distance.

    ``r_13``: length of finger 1's last segment [mm]. ``phase``: (6,) phase shifts of wrist x, wrist
    y, roll, yaw, pitch with the first flexions, and spreads with the other flexions [rad].
    ``yaw_middle``: mean yaw of the fingers away from the camera [rad]; negative: towards it.
    """
    frames = np.arange(FRAMES)
    turn = 2 * np.pi * frames / FRAMES
    states = np.zeros((FRAMES, len(HAND_STATE)))

    def put(name: str, values: Array | float) -> None:
        states[:, HAND_STATE.index(name)] = values

    for name, (middle, reach, speed, shift, late, lag) in _SWINGS.items():
        swing = middle + reach * np.sin(speed * turn + phase[shift] + late - lag)
        put(name, swing if name in WRIST else np.radians(swing))
    # Seen from the back, fingers to the right; roll is about the fingers' axis.
    roll = math.radians(65) + math.radians(40) * np.sin(1.1 * turn + phase[2])
    yaw = yaw_middle + math.radians(25) * np.sin(0.9 * turn + phase[3])
    pitch = math.radians(20) * np.sin(1.2 * turn + phase[4])
    scale = 1.0 + 0.15 * np.sin(turn)
    quaternions = _product(_about("z", pitch), _product(_about("y", yaw), _about("x", roll)))
    for k, name in enumerate(QUATERNION):
        put(name, np.sqrt(scale) * quaternions[:, k])
    for name, size in {**_SIZES, "length_13": r_13}.items():
        put(name, size / 1000.0)
    moving = len(HAND_STATE.moving)
    states[:, moving : 2 * moving] = np.gradient(states[:, :moving], axis=0)
    return states


def make_sequence(
    r_13: float,
    observed: str,
    observation: HandObservation,
    generator: np.random.Generator,
    yaw_middle: float = 0.0,
) -> SyntheticSequence:
    """Draw a sequence: phases of the motion, noise, and table 2's first guess.

    Args:
        r_13, yaw_middle: as of ``true_states``.
        observed: one of ``OBSERVED``.
        observation: predicts the measurements of a state, and has their variances.
        generator: draws the sequence.
    """
    states = true_states(r_13, generator.uniform(-0.6, 0.6, 6), yaw_middle)
    deviations = np.sqrt(observation.variances)
    measurements = np.array([observation.predict(x)[0] for x in states])
    measurements += deviations * generator.normal(size=measurements.shape)
    # Table 2 gives the scale in the first frame only.
    measurements[1:, MEASURED.index("scale")] = np.nan
    measurements[0, MEASURED.index("scale")] = 1.0
    if observed != "full":
        hidden = [f"point_{i}{j}_{axis}" for i in (1, 2) for j in (0, 1, 2) for axis in "xy"]
        measurements[:, [MEASURED.index(name) for name in (*hidden, *WRIST)]] = np.nan
    return SyntheticSequence(states, measurements, first_guess(states[0], generator))


def first_guess(x: Array, generator: np.random.Generator) -> Belief:
    """Draw table 2's belief about a true state.

    Table 2 does not list the palm's rotation, which gets the joint angles' error and variance.

    ``x``: (n,) the true state in the order of `HAND_STATE`: wrist [pixel], quaternion, its squared
    norm being the scale, angles [rad] and lengths, then their rates. ``generator``: draws the
    errors, which are uniform up to table 2's values.

    Returns the mean, with scale 1 and rates 0, and a diagonal covariance.
    """
    mean = x.copy()
    moving = len(HAND_STATE.moving)

    def shift(names: tuple[str, ...], reach: float) -> None:
        mean[HAND_STATE.indices(names)] += generator.uniform(-reach, reach, len(names))

    shift(WRIST, 5.0)
    shift((*SPREADS, *FLEXIONS), math.radians(15))
    shift((*LENGTHS, *PALM), 0.010)
    axis = generator.normal(size=3)
    axis *= math.radians(generator.uniform(-15, 15)) / np.linalg.norm(axis)
    start = HAND_STATE.indices(QUATERNION)
    half = 0.5 * np.linalg.norm(axis)
    turn = np.r_[math.cos(half), 0.5 * axis * np.sinc(half / np.pi)]
    mean[start] = _product(turn[None], x[start][None])[0] / np.linalg.norm(x[start])
    mean[moving : 2 * moving] = 0.0
    variances = np.zeros(len(mean))
    variances[HAND_STATE.indices(WRIST)] = 50.0
    variances[start] = (0.5 * math.radians(40)) ** 2
    variances[HAND_STATE.indices((*SPREADS, *FLEXIONS))] = math.radians(40) ** 2
    variances[HAND_STATE.indices((*LENGTHS, *PALM))] = 800e-6
    rates = {**dict.fromkeys(WRIST, 5.0), **dict.fromkeys(QUATERNION, 0.06)}
    for k, name in enumerate(HAND_STATE.moving):
        variances[moving + k] = rates.get(name, math.radians(5)) ** 2
    return Belief(mean, np.diag(variances))


def _about(axis: str, angles: Array) -> Array:
    """Return the quaternions (n, 4), w first, of rotations about "x", "y" or "z" by angles (n,)."""
    quaternions = np.zeros((len(angles), 4))
    quaternions[:, 0] = np.cos(0.5 * angles)
    quaternions[:, 1 + "xyz".index(axis)] = np.sin(0.5 * angles)
    return quaternions


def _product(a: Array, b: Array) -> Array:
    """Return the products (n, 4) of quaternions a and b (n, 4), w first, row by row."""
    w, v, s, u = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    vector = w * u + s * v + np.cross(v, u)
    return np.hstack([w * s - np.sum(v * u, axis=1, keepdims=True), vector])


@dataclass(frozen=True, eq=False)
class HandTrack:
    """Beliefs of a filter after each frame of a sequence."""

    states: Sequence[FilterState]  # After each frame.
    # (frames,) processor time of prediction, update and, with pictures, of the measurement, but not
    # of rendering; nan after a failure.
    milliseconds: Array
    # (frames, n) true states; () for a recorded sequence.
    truths: Array = field(default_factory=lambda: np.zeros(0))
    # (n,) final mean of a filter that linearises at the truth and has no limits; () with pictures.
    bound: Array = field(default_factory=lambda: np.zeros(0))
    # (frames,) fraction by which silhouette and matched pose differ; () without pictures.
    differences: Array = field(default_factory=lambda: np.zeros(0))
    kept: Mapping[int, Mask] = field(default_factory=dict)  # Masks (H, W) of some frames, by index.

    @cached_property
    def means(self) -> Array:
        """Means (frames, n) of the best hypothesis."""
        return np.array([state.best.mean for state in self.states])

    @cached_property
    def deviations(self) -> Array:
        """Standard deviations (frames, n) of the best hypothesis."""
        return np.array([state.best.deviations() for state in self.states])

    @property
    def rejected(self) -> int:
        """Number of hypotheses rejected by an inequality."""
        reasons = [end.reason for state in self.states for end in state.rejections]
        return reasons.count("constraint")

    @property
    def mirrored(self) -> int:
        """Number of hypotheses made by mirroring."""
        ends = sum(len(state.rejections) for state in self.states)
        return ends + len(self.states[-1].hypotheses) - 1


def run_frames(
    parts: tuple[Diagram, TruncatedEkf, HandSensor],
    period: float,
    frames: int,
    kept_frames: Sequence[int],
    advance: Advance,
) -> HandTrack:
    """Run a diagram of ``build_hand_estimation`` or of recorded masks frame by frame.

    Args:
        parts: the diagram, with the filter and the sensor in it.
        period: between frames [s].
        frames: number of frames.
        kept_frames: indices of the frames whose masks are kept.
        advance: reports progress.
    """
    diagram, ekf, sensor = parts
    simulator = Simulator(diagram)
    sensor_context, ekf_context = (
        one.GetMyContextFromRoot(simulator.get_context()) for one in (sensor, ekf)
    )
    states, milliseconds, differences, kept = [], [], [], {}
    for t in range(frames):
        mask = label_image_to_mask(sensor.GetInputPort("label_image").Eval(sensor_context))
        if t in kept_frames:
            kept[t] = mask.copy()
        begin = time.thread_time()
        differences.append(float(sensor.GetOutputPort("difference").Eval(sensor_context)[0]))
        simulator.AdvanceTo((t + 1) * period)
        states.append(ekf.filter_state(ekf_context))
        milliseconds.append(1e3 * (time.thread_time() - begin))
        advance(t + 1)
    return HandTrack(states, np.array(milliseconds), differences=np.array(differences), kept=kept)


def experiment_settings(truncation: str = "joint", iterations: int = 20) -> FilterSettings:
    """Return the hand filter's settings with at most some iterated tangents; 1 in the paper.

    ``truncation``: "joint", "sequential" or "none". Raises SettingsError: another.
    """
    return FilterSettings(
        truncation=cast(Truncation, truncation),
        linearisation="tangent",
        iterations=iterations,
        novelty=1e-9,
    )


# Pose and silhouette of a well matched frame differ by less than the first fraction, and the track
# is lost if they differ by more than the second. The model is not the recorded hand's own.
_WELL_MATCHED, _UNMATCHED = 0.12, 0.4


@dataclass(frozen=True, eq=False)
class RecordedHand:
    """A filtered recorded sequence."""

    name: str  # Of the sequence's folder.
    figures: Mapping[str, object]  # Errors [deg] where the truth is known, lengths at the end [m].
    observation: HandObservation  # Predicts measurements, and has the hand.
    means: Array  # (frames, n) states of the best hypothesis after each frame.
    kept: Mapping[int, Mask]  # Masks (H, W) of some frames, by index.

    def warning(self) -> str:
        """Return a warning about badly matched frames, and about the deviations."""
        return (
            f"{self.name}: the hand was not measured, so deviations are too small: in four such "
            "sequences 14 to 50 % of the flexions were within 2 sigma. Pose and silhouette differ "
            f"by more than {_WELL_MATCHED:.0%} in {self.figures['badly_matched']} of "
            f"{len(self.means)} frames: fingers may be exchanged, or bent where they are straight. "
            f"They differ by more than {_UNMATCHED:.0%} in {self.figures['lost']} frames: the "
            "track is lost, and the pose is a prediction"
        )


def recorded_table(results: Sequence[RecordedHand]) -> Table:
    """Tabulate the figures of sequences side by side."""
    rows = {
        "frames": ("frames", "{}"),
        "flexion_error_median": ("error of the four fingers' flexions, median [deg]", "{:.1f}"),
        "flexion_error_mean": ("  mean", "{:.1f}"),
        "inside_2sigma": ("  within 2 sigma", "{:.0%}"),
        "silhouette_difference": ("difference of silhouette and matched pose, median", "{:.1%}"),
        "badly_matched": ("  frames with more than 12 %", "{}"),
        "lost": ("  frames with more than 40 %: lost", "{}"),
        "mirrored": ("hypotheses made by mirroring", "{}"),
        "rejected_by_an_inequality": ("  rejected by an inequality", "{}"),
        "ms_per_update": ("milliseconds a frame, median", "{:.0f}"),
    }
    figures = {one.name: one.figures for one in results}
    return figure_table("Shimada, figure 17: a recorded hand, camera unknown", rows, figures)


def run_sequence(
    folder: Path, settings: FilterSettings | None = None, count: Count = uncounted
) -> RecordedHand:
    """Filter angles and lengths of a hand in silhouettes of one parallel camera of unknown scale.

    The default search matches the first frame; the filter follows the others.

    ``folder``: a scene whose frames follow one another. If it has a ``joint_angles.csv``, the true
    angles are in it: [rad], or [deg] if it has columns that the bundled hand lacks. ``settings``:
    None: ``experiment_settings()``. ``count``: reports progress.

    Raises DrakePoseError: the scene has several cameras, or no hand in it can be matched.
    """
    file = bundled_model("hand").with_name("right_hand.urdf")
    inputs = read_inputs(folder, file, EstimateSettings(unseen=("forearm",)), None)
    scene, hand = inputs.scene, read_hand(inputs.model)
    (camera, *others) = scene.cameras.values()
    if others or not isinstance(camera, ParallelCamera) or not scene.sequence:
        raise SceneError(
            f"{folder}: a hand is filtered in successive frames of one parallel camera: the scene "
            "needs sequence: true in scene.yaml, and the masks of one camera, which is no pinhole"
        )
    scale, guess = _rough_belief(inputs, camera, hand)
    layout, sizes = hand.layout, np.array([hand.sizes[name] for name in hand.layout.constant])
    # Sizes are between 0.5 and 1.5 times the model's.
    limits = from_bounds(layout.constant, 0.5 * sizes, 1.5 * sizes, layout.names)
    limited = model_inequalities(inputs.model).restricted_to(layout.names)
    rows = stack([limited, limits], layout.names)
    period = 1.0 / (scene.frame_rate_hz or 30.0)
    # Accelerations per frame^2 at 30 Hz; an unobserved rate fades with a time constant of 0.15 s.
    noise = (30.0 * period) ** 2 * _of_kinds(hand, 2.0, 0.008, 1.5)
    U = layout.process_noise(dict(zip(layout.moving, noise.tolist(), strict=True)))
    A = layout.transition(math.exp(-period / 0.15))
    # The prior of usual flexions counts once per second.
    observation = HandObservation(scale, prior_frames=1.0 / period, hand=hand)
    motion, settings = LinearMotion(A, U, None), settings or experiment_settings()
    hand_filter = TruncatedFilter(layout, observation, rows, motion, settings)
    center, frames = (camera.center_x, camera.center_y), len(inputs.frames)
    silhouette = HandSilhouette(
        hand_filter, camera.width, camera.height, center, _WELL_MATCHED, _UNMATCHED
    )
    parts = build_recorded_hand_estimation(scene, silhouette, guess)
    shown = np.linspace(0, frames, 3, endpoint=False).astype(int).tolist()
    advance = count(f"frames of {folder.name}", frames)
    run = run_frames(parts, period, frames, shown, advance)
    means = run.means
    lengths = means[-1][layout.indices(layout.constant)].tolist()
    figures: dict[str, object] = {
        "frames": frames,
        "silhouette_difference": float(np.median(run.differences)),
        "badly_matched": int(np.count_nonzero(run.differences > _WELL_MATCHED)),
        "lost": int(np.count_nonzero(run.differences > _UNMATCHED)),
        "mirrored": run.mirrored,
        "rejected_by_an_inequality": run.rejected,
        "ms_per_update": float(np.median(run.milliseconds)),
        "lengths": dict(zip(layout.constant, lengths, strict=True)),
    }
    truth = _truth(folder, inputs, hand)
    if names := [name for name in hand.flexions if name in truth]:
        moved = layout.indices(names)
        true = np.column_stack([truth[name] for name in names])
        errors = np.abs(np.degrees(means[:, moved]) - true)
        figures["flexion_error_median"] = float(np.median(errors))
        figures["flexion_error_mean"] = float(np.mean(errors))
        inside = errors < 2.0 * np.degrees(run.deviations[:, moved])
        figures["inside_2sigma"] = float(np.mean(inside))
    return RecordedHand(folder.name, figures, observation, means, run.kept)


def _of_kinds(hand: HandModel, wrist: float, turn: float, angle: float) -> Array:
    """Return standard deviations of the state's moving elements, in their units.

    ``wrist``: of the wrist [pixel]. ``turn``: of the quaternion. ``angle``: of joints [deg].
    """
    return np.repeat((wrist, turn, math.radians(angle)), (2, 4, len(hand.angles)))


def _rough_belief(
    inputs: EstimateInputs, camera: ParallelCamera, hand: HandModel
) -> tuple[float, Belief]:
    """Return the scale [pixel/m] and the belief that the first frame's best pose gives."""
    frame, model, search = inputs.frames[0], inputs.model, inputs.search
    assert search is not None
    found = search.match([View(camera, inputs.scene.read(camera.name, frame))])
    if not found.found:
        raise SceneError(f"{inputs.scene.path}: no pose explains the first frame, '{frame}'")
    scale = camera.pixels_per_metre * found.scale
    X_WP = found.X_WB @ PlantKinematics(model).pose_at(model.link_index("palm"), found.q)
    X_CP = camera.X_CW @ X_WP
    quaternion = Rotation.from_matrix(palm_rotation(X_CP[:3, :3])).as_quat(scalar_first=True)
    angles = found.q[[model.position_index(name) for name in hand.angles]]
    moving = np.r_[scale * X_CP[:2, 3], quaternion, angles]
    sizes = np.array([hand.sizes[name] for name in hand.layout.constant])
    # Standard deviations of the rough pose, of its rates per frame, and of the relative sizes.
    start = _of_kinds(hand, 10.0, 0.5 * math.radians(20.0), 25.0)
    rates = _of_kinds(hand, 5.0, 0.03, 4.0)
    fractions = [0.15 if name in PALM else 0.2 for name in hand.layout.constant]
    deviations = np.r_[start, rates, fractions * sizes]
    return scale, Belief(np.r_[moving, np.zeros(len(moving)), sizes], np.diag(deviations**2))


def _truth(folder: Path, inputs: EstimateInputs, hand: HandModel) -> dict[str, Array]:
    """Return the true angles (frames,) [deg] by name of `hand.angles`, from the sequence's file.

    {} if the folder has no ``joint_angles.csv``; angles that have no column are left out.
    """
    file = folder / JOINT_TABLE
    if not file.is_file():
        return {}
    header, lines = read_csv(file, SceneError)
    rows = {int(row[0]): row for _, row in lines}
    # A file with the model's positions only is in radians, as joint_angles.csv is elsewhere.
    unit = 1.0 if inputs.truth is None else math.degrees(1.0)
    return {
        name: np.array([unit * float(rows[int(k)][header.index(name)]) for k in inputs.frames])
        for name in hand.angles
        if name in header
    }
