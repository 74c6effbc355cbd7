"""Shimada's experiments: the moving hand of the synthetic one, and recorded silhouettes.

`make_sequence` draws true states, measurements and table 2's first guess; `run_sequence` filters a
recorded hand (figures 17 and 18).
"""

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple, cast

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
OBSERVED = ("full", "lines", "lines_wrist")
"""What is measured: all; axes and tips of the fingers and the palm's outline; the wrist, too."""

ACCELERATIONS = {
    **dict.fromkeys(WRIST, 0.8),
    **dict.fromkeys(QUATERNION, 0.004),
    **dict.fromkeys((*SPREADS, *FLEXIONS), math.radians(0.8)),
}
"""Standard deviations of the accelerations [pixel, 1, rad per frame^2]: theta's part of U (6)."""


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

    put("wrist_x", -50 + 30 * np.sin(turn + phase[0]))
    put("wrist_y", 20 * np.sin(1.3 * turn + phase[1]))
    # Seen from the back, fingers to the right; roll is about the fingers' axis.
    roll = math.radians(65) + math.radians(40) * np.sin(1.1 * turn + phase[2])
    yaw = yaw_middle + math.radians(25) * np.sin(0.9 * turn + phase[3])
    pitch = math.radians(20) * np.sin(1.2 * turn + phase[4])
    scale = 1.0 + 0.15 * np.sin(turn)
    quaternions = _product(_about("z", pitch), _product(_about("y", yaw), _about("x", roll)))
    for k, name in enumerate(QUATERNION):
        put(name, np.sqrt(scale) * quaternions[:, k])
    put("spread_1", np.radians(-10 + 5 * np.sin(turn + phase[5])))
    put("spread_2", np.radians(10 + 5 * np.sin(1.4 * turn + phase[5])))
    for i, shift in ((1, 0.0), (2, 0.5)):
        wave = np.sin(1.2 * turn + phase[5] + shift)
        put(f"flexion_{i}1", np.radians(40 + 28 * np.sin(turn + phase[4] + shift)))
        put(f"flexion_{i}2", np.radians(38 + 28 * wave))
        put(f"flexion_{i}3", np.radians(36 + 25 * np.sin(1.2 * turn + phase[5] + shift - 0.1)))
    # These lengths satisfy table 1 for r_13 = 35 and 40.
    for name, length in zip(LENGTHS, (62.0, 41.0, r_13, 60.0, 40.0, 38.0), strict=True):
        put(name, length / 1000.0)
    for name, size in zip(PALM, (0.070, 0.080, 0.022), strict=True):
        put(name, size)
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
        hidden += [] if observed == "lines_wrist" else WRIST
        measurements[:, [MEASURED.index(name) for name in hidden]] = np.nan
    return SyntheticSequence(states, measurements, first_guess(states[0], generator))


def first_guess(x: Array, generator: np.random.Generator) -> Belief:
    """Draw table 2's belief about a true state.

    Table 2 does not list the palm's rotation, which gets the joint angles' error and variance.

    Args:
        x: (n,) the true state in the order of `HAND_STATE`: wrist [pixel], quaternion, its squared
            norm being the scale, angles [rad] and lengths, then their rates.
        generator: draws the errors, which are uniform up to table 2's values.

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


# A frame is well matched if silhouette and matched pose differ by less than the first fraction; the
# track is lost if they differ by more than the second. The model is not the recorded hand's own.
_WELL_MATCHED, _UNMATCHED = 0.12, 0.4


class HandTrack(NamedTuple):
    """Beliefs of a filter after each frame.

    Attributes:
        means, deviations: (frames, n) of the best hypothesis.
        covariance: (n, n) of the last one.
        milliseconds: (frames,) processor time of prediction, update and, with pictures, of the
            measurement, but not of rendering; nan after a failure.
        mirrored, rejected: number of hypotheses made by mirroring, and rejected by an inequality.
        differences: (frames,) fraction by which silhouette and matched pose differ; () without
            pictures.
        kept: mask, measurement (m,) and rough pose (n,) of some frames, by index.
    """

    means: Array
    deviations: Array
    covariance: Array
    milliseconds: Array
    mirrored: int
    rejected: int
    differences: Array = np.zeros(0)
    kept: Mapping[int, tuple[Mask, Array, Array]] = MappingProxyType({})


def track_of(states: Sequence[FilterState], milliseconds: Sequence[float]) -> HandTrack:
    """Return the track of a filter from its state after each frame, and each frame's time [ms]."""
    best = [state.best for state in states]
    ends = [end.reason for state in states for end in state.rejections]
    return HandTrack(
        np.array([one.mean for one in best]),
        np.array([one.deviations() for one in best]),
        best[-1].covariance,
        np.array(milliseconds),
        mirrored=len(ends) + len(states[-1].hypotheses) - 1,
        rejected=ends.count("constraint"),
    )


def follow_pictures(
    parts: tuple[Diagram, TruncatedEkf, HandSensor],
    period: float,
    frames: int,
    kept_frames: Sequence[int],
    advance: Advance = lambda _done: None,
) -> HandTrack:
    """Run a diagram of ``build_hand_estimation`` or of recorded pictures frame by frame.

    Args:
        parts: the diagram, with the filter and the sensor in it.
        period: between frames [s].
        frames: number of frames.
        kept_frames: indices of the frames whose mask, measurement and rough pose are kept.
        advance: called with the number of frames done.
    """
    diagram, ekf, sensor = parts
    simulator = Simulator(diagram)
    sensor_context, ekf_context = (
        one.GetMyContextFromRoot(simulator.get_context()) for one in (sensor, ekf)
    )
    states, milliseconds, differences, kept = [], [], [], {}
    for t in range(frames):
        mask = label_image_to_mask(sensor.GetInputPort("label_image").Eval(sensor_context))
        begin = time.thread_time()
        y, difference, rough = (
            np.array(sensor.GetOutputPort(name).Eval(sensor_context))
            for name in ("measurement", "difference", "rough_state")
        )
        differences.append(float(difference[0]))
        if t in kept_frames:
            kept[t] = (mask.copy(), y, rough)
        simulator.AdvanceTo((t + 1) * period)
        states.append(ekf.filter_state(ekf_context))
        milliseconds.append(1e3 * (time.thread_time() - begin))
        advance(t + 1)
    track = track_of(states, milliseconds)
    return track._replace(differences=np.array(differences), kept=kept)


@dataclass(frozen=True, eq=False)
class SequenceResult:
    """A filtered recorded sequence."""

    name: str  # Of the sequence's folder.
    observation: HandObservation  # Predicts measurements, and has the hand.
    guess: Belief  # Belief about the rough pose of the first frame.
    track: HandTrack  # Beliefs after each frame.
    # (frames,) true values by name of the angle [deg]; {} if they are unknown.
    truth: Mapping[str, Array]

    def warning(self) -> str:
        """Return a warning about badly matched frames, and about the deviations."""
        bad, lost = self._frames_beyond(_WELL_MATCHED), self._frames_beyond(_UNMATCHED)
        return (
            f"{self.name}: the hand was not measured, so deviations are too small: in four such "
            "sequences 14 to 50 % of the flexions were within 2 sigma. Pose and silhouette differ "
            f"by more than {_WELL_MATCHED:.0%} in {bad} of {len(self.track.means)} frames: fingers "
            "may be exchanged, or bent where they are straight. They differ by more than "
            f"{_UNMATCHED:.0%} in {lost} frames: the track is lost, and the pose is a prediction"
        )

    def _frames_beyond(self, difference: float) -> int:
        """Return the number of frames in which silhouette and matched pose differ by more."""
        return int(np.count_nonzero(self.track.differences > difference))

    def as_json(self) -> dict[str, object]:
        """Return the figures: errors [deg] where the truth is known, lengths at the end [m]."""
        layout, track = self.observation.hand.layout, self.track
        figures: dict[str, object] = {
            "frames": len(track.means),
            "silhouette_difference": float(np.median(track.differences)),
            "badly_matched": self._frames_beyond(_WELL_MATCHED),
            "lost": self._frames_beyond(_UNMATCHED),
            "mirrored": track.mirrored,
            "rejected_by_an_inequality": track.rejected,
            "ms_per_update": float(np.median(track.milliseconds)),
        }
        lengths = track.means[-1][layout.indices(layout.constant)].tolist()
        figures["lengths"] = dict(zip(layout.constant, lengths, strict=True))
        if names := [name for name in self.observation.hand.flexions if name in self.truth]:
            means, deviations = (
                np.degrees(one[:, layout.indices(names)]) for one in (track.means, track.deviations)
            )
            errors = np.abs(means - np.column_stack([self.truth[name] for name in names]))
            figures["flexion_error_median"] = float(np.median(errors))
            figures["flexion_error_mean"] = float(np.mean(errors))
            figures["inside_2sigma"] = float(np.mean(errors < 2.0 * deviations))
        return figures


def sequence_table(results: Sequence[SequenceResult]) -> Table:
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
    figures = {one.name: one.as_json() for one in results}
    return figure_table("Shimada, figure 17: a recorded hand, camera unknown", rows, figures)


def experiment_settings(truncation: str, iterations: int | None = None) -> FilterSettings:
    """Return the hand filter's settings with iterated tangents; ``iterations`` None: 20.

    ``truncation``: "joint", "sequential", "clip" or "none". Raises SettingsError: another.
    """
    return FilterSettings(
        truncation=cast(Truncation, truncation),
        linearisation="tangent",
        iterations=20 if iterations is None else iterations,
        novelty=1e-9,
    )


def run_sequence(
    folder: Path,
    settings: FilterSettings | None = None,
    acceleration: float = 1.0,
    count: Count = uncounted,
) -> SequenceResult:
    """Filter angles and lengths of a hand in silhouettes of one parallel camera of unknown scale.

    The default search matches the first frame; the filter follows the others.

    Args:
        folder: a scene whose frames follow one another. If it has a ``joint_angles.csv``, the true
            angles are in it: [rad], or [deg] if it has columns that the bundled hand lacks.
        settings: None: ``experiment_settings("joint")``.
        acceleration: factor on the accelerations that the filter expects.
        count: reports progress.

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
    # The first frame's rough pose.
    frame, model, search = inputs.frames[0], inputs.model, inputs.search
    assert search is not None
    found = search.match([View(camera, scene.read(camera.name, frame))])
    if not found.found:
        raise SceneError(f"{scene.path}: no pose explains the first frame, '{frame}'")
    scale = camera.pixels_per_metre * found.scale
    X_WP = found.X_WB @ PlantKinematics(model).pose_at(model.link_index("palm"), found.q)
    X_CP = camera.X_CW @ X_WP
    quaternion = Rotation.from_matrix(palm_rotation(X_CP[:3, :3])).as_quat(scalar_first=True)
    angles = found.q[[model.position_index(name) for name in hand.angles]]
    moving, layout = np.r_[scale * X_CP[:2, 3], quaternion, angles], hand.layout
    sizes = np.array([hand.sizes[name] for name in layout.constant])
    period = 1.0 / (scene.frame_rate_hz or 30.0)

    def of_kinds(wrist: float, turn: float, angle: float) -> Array:
        """Return standard deviations (moving,) of the state's moving elements, in their units.

        `wrist` is that of the wrist [pixel], `turn` of the quaternion, `angle` of joints [deg].
        """
        return np.repeat((wrist, turn, math.radians(angle)), (2, 4, len(hand.angles)))

    # Standard deviations of the rough pose, of its rates per frame, and of the relative sizes.
    start, rates = of_kinds(10.0, 0.5 * math.radians(20.0), 25.0), of_kinds(5.0, 0.03, 4.0)
    shares = [0.15 if name in PALM else 0.2 for name in layout.constant]
    deviations = np.r_[start, rates, shares * sizes]
    guess = Belief(np.r_[moving, np.zeros(len(moving)), sizes], np.diag(deviations**2))
    # Sizes are between 0.5 and 1.5 times the model's.
    limits = from_bounds(layout.constant, 0.5 * sizes, 1.5 * sizes, layout.names)
    rows = stack([model_inequalities(model).restricted_to(layout.names), limits], layout.names)
    # Accelerations per frame^2 at 30 Hz; an unobserved rate fades with a time constant of 0.15 s.
    noise = acceleration * (30.0 * period) ** 2 * of_kinds(2.0, 0.008, 1.5)
    U = layout.process_noise(dict(zip(layout.moving, noise.tolist(), strict=True)))
    A = layout.transition(math.exp(-period / 0.15))
    # The prior of usual flexions counts once per second.
    observation = HandObservation(scale, prior_frames=1.0 / period, hand=hand)
    motion, settings = LinearMotion(A, U, None), settings or experiment_settings("joint")
    hand_filter = TruncatedFilter(layout, observation, rows, motion, settings)
    center, frames = (camera.center_x, camera.center_y), len(inputs.frames)
    silhouette = HandSilhouette(
        hand_filter, camera.width, camera.height, center, _WELL_MATCHED, _UNMATCHED
    )
    shown = np.linspace(0, frames, 4, endpoint=False).astype(int).tolist()
    parts = build_recorded_hand_estimation(scene, silhouette, guess)
    advance = count(f"frames of {folder.name}", frames)
    track = follow_pictures(parts, period, frames, shown, advance)
    return SequenceResult(folder.name, observation, guess, track, _truth(folder, inputs, hand))


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
    unit = 1.0 if inputs.truth is None else 180.0 / math.pi
    return {
        name: np.array([unit * float(rows[int(k)][header.index(name)]) for k in inputs.frames])
        for name in hand.angles
        if name in header
    }
