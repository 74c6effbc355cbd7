"""Shimada's real experiment (figures 17 and 18): a recorded hand in one view of unknown scale."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.table import Table
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array, Mask
from drake_pose.body import PlantKinematics, bundled_model
from drake_pose.camera.episode_files import JOINT_TABLE
from drake_pose.camera.models import ParallelCamera
from drake_pose.errors import SceneError
from drake_pose.files.settings import EstimateSettings
from drake_pose.filtering.hand import HandObservation
from drake_pose.filtering.hand_model import PALM, HandModel, palm_rotation, read_hand
from drake_pose.filtering.hand_silhouette import HandSilhouette
from drake_pose.filtering.inequalities import from_bounds, model_inequalities, stack
from drake_pose.filtering.motion import LinearMotion
from drake_pose.filtering.state import Belief
from drake_pose.filtering.truncated_filter import FilterSettings, TruncatedFilter
from drake_pose.input_files import read_csv
from drake_pose.jobs.estimate.inputs import EstimateInputs, read_inputs
from drake_pose.papers.shimada_sequences import (
    experiment_settings,
    run_frames,
)
from drake_pose.papers.tables import Count, figure_table, uncounted
from drake_pose.search import View
from drake_pose.systems.truncated_ekf import build_recorded_hand_estimation

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
        errors = np.abs(
            np.degrees(means[:, moved]) - np.column_stack([truth[name] for name in names])
        )
        figures["flexion_error_median"] = float(np.median(errors))
        figures["flexion_error_mean"] = float(np.mean(errors))
        figures["inside_2sigma"] = float(
            np.mean(errors < 2.0 * np.degrees(run.deviations[:, moved]))
        )
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
