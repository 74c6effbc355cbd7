"""Experiments of Date et al.: a simulated person with known motion, many cameras.

Section 6.1 compares the paper's inverse kinematics alone, with the search, and one fit to all
silhouettes. Section 6.2 (figure 8) is a walk through a virtual place by gestures. `save_pictures`
draws the pictures of both, as the paper's figures 2 to 4, 7 and 8.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from matplotlib.figure import Figure
from pydrake.geometry import RenderEngineVtkParams
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput, TrajectorySource
from rich.table import Table

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.body import ArticulatedModel, landmarks_of_nodes, load_landmarks
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import PinholeCamera, look_at
from drake_pose.errors import require_choice
from drake_pose.papers.date_capture import PERIOD, PaperTrack, SilhouetteTrack, Studio, one_core
from drake_pose.papers.tables import (
    Count,
    draw_panels,
    figure_table,
    save_figure,
    save_picture,
    uncounted,
)
from drake_pose.person.date.features import Features, PersonView
from drake_pose.person.date.skeleton import FEATURES, LIMBS
from drake_pose.person.date.walking import (
    COMMANDS,
    REGISTERED,
    UPRIGHT,
    Motion,
    make_gestures,
    make_motion,
)
from drake_pose.person.views import viewing_rays
from drake_pose.systems.bodies import add_posed_plant, held_positions
from drake_pose.systems.cameras import add_sensors, colour_image_to_picture, picture_to_colour_image
from drake_pose.systems.walk import Walker, add_garden, view_from_behind, walker_transform

SHOWN_CAMERA = "camera_0"
TITLES = {
    "ik_only": "the paper's IK alone",
    "paper": "the paper's search",
    "silhouette": "all silhouettes",
}
"""Names of the methods in tables."""

# Number of frames in which a perturbed track is observed.
_OBSERVED_FRAMES = 30


class MotionSample(NamedTuple):
    """The middle frame of a motion, for pictures."""

    compared: Picture  # (H, W, 3) true pose and all estimates, side by side.
    picture: Picture  # (H, W, 3) input of the shown camera.
    views: Mapping[str, PersonView]  # The person as each camera sees it, for the paper's method.
    found: Features  # Features in space.
    # (130, 80, 3) input face, nearest template and the model's face at the estimate; () if no face
    # was seen.
    faces: tuple[Picture, ...]


class DateResult:
    """Measurements of the experiment, frame by frame; see run_experiment.

    Args:
        studio: simulated person and cameras.
        motion: true positions and motion of each frame.
        method: leading method, "paper" or "silhouette".
        seed: of the perturbed tracks.

    Attributes:
        names: (n,) motion of each frame.
        errors: by method: (k,) errors of the joint centres in each frame [mm].
        found_errors: by paper's method: (4,) errors of elbows and knees in each frame, in the order
            of LIMBS, before the model with its rigid trunk is fitted to them [mm]; nan where the
            registered pose was recognised instead.
        face_errors: angle between true and estimated direction of the head in each frame [deg].
        perturbed: tracks that were set to a wrong pose: method, motion at that time or REGISTERED,
            track, and mean error of each frame since then [mm].
        samples: by motion, the frame for pictures.
    """

    def __init__(self, studio: Studio, motion: Motion, method: str, seed: int) -> None:
        self.studio, self.names = studio, motion.names
        self._motion, self._method = motion, method
        self._settings = {"seed": seed, "method": method}
        setup = studio.prepare(motion.q[0])
        alone = replace(setup, search=False)
        self._tracks: dict[str, PaperTrack | SilhouetteTrack] = {
            "ik_only": PaperTrack.build(alone),
            "paper": PaperTrack.build(setup),
        }
        if method == "silhouette":
            self._tracks[method] = SilhouetteTrack.build(studio)
        self._generator = np.random.default_rng([seed, 2])
        self._perturbed_at = perturbed_frames(motion)
        landmarks, tree = load_landmarks(studio.model.path), studio.model.pose_tree()
        del landmarks["head_top"]
        self._kinematics = TreeKinematics(tree)
        self._landmarks = landmarks_of_nodes(tree, landmarks)
        self.errors: dict[str, list[Array]] = {method: [] for method in self._tracks}
        self.found_errors: dict[str, list[Array]] = {"ik_only": [], "paper": []}
        self.face_errors: list[float] = []
        self.perturbed: list[tuple[str, str, PaperTrack | SilhouetteTrack, list[float]]] = []
        self.samples: dict[str, MotionSample] = {}

    def step(self, k: int) -> None:
        """Process frame k of the motion; frames must come in order."""
        studio, q = self.studio, self._motion.q[k]
        pictures = studio.pictures(q)
        images = {name: picture_to_colour_image(shot) for name, shot in pictures.items()}
        if k in self._perturbed_at:
            for method in dict.fromkeys((self._method, "paper")):
                perturbed_track = self._tracks[method].perturbed(
                    self._motion.q[k - 1], self._generator
                )
                self.perturbed.append((method, self._perturbed_at[k], perturbed_track, []))
        estimates = {}
        for method, track in self._tracks.items():
            estimates[method] = track.step(images)
            self.errors[method].append(self._joint_errors(estimates[method], q))
            if isinstance(track, PaperTrack):
                true = [studio.skeleton.limb_points(q, name)[1] for name in LIMBS]
                error = 1e3 * np.linalg.norm(track.middle_joints() - true, axis=1)
                self.found_errors[method].append(error)
        heads = [studio.skeleton.head_rotation(one)[:, 2] for one in (estimates[self._method], q)]
        cosine = float(np.clip(heads[0] @ heads[1], -1.0, 1.0))
        self.face_errors.append(math.degrees(math.acos(cosine)))
        for _, _, perturbed_track, errors in self.perturbed:
            if len(errors) < _OBSERVED_FRAMES:
                errors.append(_mean(self._joint_errors(perturbed_track.step(images), q)))
        if _is_middle(self._motion, k):
            paper = self._tracks["paper"]
            assert isinstance(paper, PaperTrack)
            views, found, faces = paper.seen()
            shown = [studio.shown_at(one, SHOWN_CAMERA) for one in (q, *estimates.values())]
            head = studio.face_at(estimates["paper"]) if faces else None
            self.samples[self.names[k]] = MotionSample(
                np.hstack(shown), pictures[SHOWN_CAMERA], views, found,
                () if head is None else (*faces, head),
            )  # fmt: skip

    def _joint_errors(self, found: Array, q: Array) -> Array:
        """Return the errors (k,) [mm] of k joint centres, at found and true positions q (nq,)."""
        order = self.studio.skeleton.order
        places = [
            self._landmarks.positions(self._kinematics.poses(one[order])) for one in (found, q)
        ]
        return np.asarray(1e3 * np.linalg.norm(places[0] - places[1], axis=1))

    @property
    def motions(self) -> tuple[str, ...]:
        """Motions that were shown."""
        return tuple(name for name in dict.fromkeys(self.names) if name != REGISTERED)

    def recoveries(self, method: str) -> dict[str, int | None]:
        """Return the number of frames until a perturbed track recovered, by motion.

        A track has recovered when its mean error is at most 25 mm, or twice that of the unperturbed
        track in all frames. None: not in the 30 frames observed.
        """
        right = max(25.0, 2.0 * _mean(self.errors[method]))
        return {
            motion: next((k for k, off in enumerate(errors, 1) if off <= right), None)
            for own, motion, _, errors in self.perturbed
            if own == method
        }

    @property
    def slowest_recovery(self) -> float:
        """Longest time of a frame's pose in a perturbed track [ms]."""
        own = [track for method, _, track, _ in self.perturbed if method == self._method]
        return max((lap["pose"] for track in own for lap in track.milliseconds), default=0.0)

    def milliseconds(self, method: str) -> dict[str, float]:
        """Return a frame's median processor times [ms], of all cameras, by stage and as "all"."""
        laps = self._tracks[method].milliseconds
        names = dict.fromkeys(name for lap in laps for name in lap)
        stages = {name: float(np.median([lap.get(name, 0.0) for lap in laps])) for name in names}
        return {**stages, "all": sum(stages.values())}

    def as_json(self) -> dict[str, object]:
        """Return the figures by key, over all frames but those of the registered pose."""
        leading = np.array(self.errors[self._method])[np.isin(self.names, self.motions)]
        all_motions = self._of_motions(self.motions)
        recoveries, spent = self.recoveries(self._method), self.milliseconds(self._method)
        cameras = len(self.studio.cameras)
        anywhere = [n for motion, n in recoveries.items() if motion != REGISTERED]
        counts = anywhere or list(recoveries.values())
        known = [n for n in counts if n is not None]
        return {
            "joint_error_mm": _mean(leading),
            "joint_error_p95_mm": float(np.percentile(leading, 95)),
            "ik_only_mm": all_motions["ik_only_mm"],
            "paper_mm": all_motions["paper_mm"],
            "elbows_and_knees": self._of_joints(("elbow", "knee")),
            "elbows": self._of_joints(("elbow",)),
            "knees": self._of_joints(("knee",)),
            **self._as_found(UPRIGHT),
            "as_found": {motion: self._as_found((motion,)) for motion in self.motions},
            "face_error_deg": all_motions["face_error_deg"],
            "frames_to_recover": max(known) if known and len(known) == len(counts) else None,
            "frames_to_recover_registered": recoveries.get(REGISTERED),
            "ms_of_slowest_recovering_frame": self.slowest_recovery,
            "ms_per_frame": spent,
            "fps": 1e3 / spent["all"],
            "camera_frames_per_second": 1e3 * cameras / spent["all"],
            "motions": {motion: self._of_motions((motion,)) for motion in self.motions},
            "frames": len(self.names),
            "cameras": cameras,
            **self._settings,
        }

    def _as_found(self, motions: Sequence[str]) -> dict[str, float]:
        """Return mean errors [mm] of elbows and knees as found, in the frames of some motions.

        Keys are elbow_mm and knee_mm with the search, elbow_ik_mm and knee_ik_mm without; or nan.
        """
        chosen = np.isin(self.names, motions)
        figures = {}
        for method, ending in (("ik_only", "ik_mm"), ("paper", "mm")):
            errors = np.array(self.found_errors[method])[chosen]
            errors = errors[np.isfinite(errors).all(axis=1)]
            for joint, limbs in (("elbow", errors[:, :2]), ("knee", errors[:, 2:])):
                figures[f"{joint}_{ending}"] = _mean(limbs) if len(limbs) else math.nan
        return figures

    def _of_motions(self, motions: Sequence[str]) -> dict[str, float]:
        """Return mean errors in some motions' frames: by method [mm], and the face's [deg]."""
        chosen = np.isin(self.names, motions)
        errors = {
            f"{method}_mm": _mean(np.array(one)[chosen]) for method, one in self.errors.items()
        }
        return {**errors, "face_error_deg": _mean(np.array(self.face_errors)[chosen])}

    def _of_joints(self, ends: tuple[str, ...]) -> dict[str, float]:
        """Return mean errors [mm] by method, in all motions, of joints with these endings."""
        moving = np.isin(self.names, self.motions)
        chosen = [i for i, name in enumerate(self._landmarks.names) if name.endswith(ends)]
        return {
            f"{method}_mm": _mean(np.array(one)[moving][:, chosen])
            for method, one in self.errors.items()
        }

    def tables(self) -> tuple[Table, Table]:
        """Tabulate each motion's mean errors by method, and those of elbows and knees as found."""
        rows = {motion: self._of_motions((motion,)) for motion in self.motions}
        found = {motion: self._as_found((motion,)) for motion in self.motions}
        headings = {f"{method}_mm": f"{TITLES[method]} [mm]" for method in self.errors}
        found_headings = {
            f"{joint}_{ending}": f"{joint}s, {how}"
            for joint in ("elbow", "knee")
            for ending, how in (("ik_mm", "IK alone"), ("mm", "search"))
        }
        return (
            _table_of_motions(
                f"Date: {len(self.studio.cameras)} cameras, {len(self.names)} frames",
                {**rows, "all": self._of_motions(self.motions)},
                {**headings, "face_error_deg": "face [deg]"},
                "{:.1f}",
            ),
            _table_of_motions(
                "Elbows and knees as found, in mm",
                {**found, "upright": self._as_found(UPRIGHT)},
                found_headings,
                "{:.0f}",
            ),
        )

    def costs(self) -> str:
        """Describe in words the times of a frame [ms], and the recovery of perturbed tracks."""
        *stages, (_, whole) = self.milliseconds(self._method).items()
        parts = ", ".join(f"{name} {spent:.1f}" for name, spent in stages)
        soon = ", ".join(
            f"{motion} {'not' if n is None else n}"
            for motion, n in self.recoveries(self._method).items()
        )
        return (
            f"One core, {TITLES[self._method]}: {whole:.1f} ms a frame ({parts}), "
            f"{1e3 / whole:.0f} frames a second.\n"
            f"Frames until a perturbed track recovered: {soon}; the slowest of these frames took "
            f"{self.slowest_recovery:.0f} ms."
        )


def run_experiment(
    cameras: int = 9,
    frames: int = 240,
    seed: int = 0,
    method: str = "silhouette",
    count: Count = uncounted,
    size: tuple[int, int] = (640, 480),
) -> DateResult:
    """Capture a simulated person on one core.

    Args:
        cameras: number of cameras, including the face camera.
        frames: number of frames, 40 or more.
        seed: of the motions and the noise.
        method: "paper": the paper's methods only; "silhouette": the fit to all silhouettes, too,
            whose figures lead.
        count: reports progress.
        size: width and height of the pictures [pixel].

    Raises SettingsError: an argument is out of range.
    """
    require_choice("method", method, ("silhouette", "paper"))
    with one_core():
        studio = Studio.build(cameras, size, np.random.default_rng([seed, 1]))
        motion = make_motion(studio.skeleton, frames, seed)
        result = DateResult(studio, motion, method, seed)
        advance = count("frames", frames)
        for k in range(len(motion.q)):
            result.step(k)
            advance(k + 1)
    return result


def _table_of_motions(
    title: str, rows: Mapping[str, Mapping[str, float]], headings: Mapping[str, str], form: str
) -> Table:
    """Tabulate figures: a row per motion, a column per figure with its heading, in a ``form``."""
    columns = {
        heading: {motion: figures[key] for motion, figures in rows.items()}
        for key, heading in headings.items()
    }
    return figure_table(title, {motion: (motion, form) for motion in rows}, columns, "motion")


def perturbed_frames(motion: Motion) -> dict[int, str]:
    """Return the indices of the frames in which tracks are perturbed, with their motions.

    These are the middle of each motion, except in the last ten frames, and the first frame of the
    registered pose's return.
    """
    count = len(motion.names)
    found = {k: motion.names[k] for k in range(count - 10) if _is_middle(motion, k)}
    again = 1 + max(k for k, name in enumerate(motion.names) if name != REGISTERED)
    return found if again == count else {**found, again: REGISTERED}


def _is_middle(motion: Motion, k: int) -> bool:
    """Return whether frame k is the middle one of its motion; never in the registered pose."""
    same = [i for i, name in enumerate(motion.names) if name == motion.names[k]]
    return motion.names[k] != REGISTERED and k == same[len(same) // 2]


def _mean(values: Array | Sequence[Array]) -> float:
    return float(np.mean(values))


def walk_table(figures: Mapping[str, Any]) -> Table:
    """Tabulate the time for which each command of a walk was active."""
    columns = {
        key: {name: one[f"{key}_s"] for name, one in figures["commands"].items()}
        for key in ("true", "captured", "wrongly")
    }
    end = "{same_command:.1%} of frames equal, final error {place_error_m:.2f} m"
    title = f"Walking through [s]: {end.format(**figures)}"
    return figure_table(title, {k: (k, "{:.2f}") for k in COMMANDS}, columns, "command")


def save_walk(pictures: Mapping[str, tuple[Picture, Picture]], folder: Path) -> Path:
    """Draw figure 8 from the pictures of a walk: the input, and the walk through the place."""
    figure = draw_panels(list(pictures.values()), list(pictures), ("input", "virtual walk"))
    return save_figure(figure, folder / "figure_08.png")


def run_walk_through(
    cameras: int = 9, seed: int = 0, count: Count = uncounted, size: tuple[int, int] = (640, 480)
) -> tuple[dict[str, Any], dict[str, tuple[Picture, Picture]]]:
    """Capture table 1's gestures by the paper's method, and walk by them.

    Args:
        cameras: number of cameras, including the face camera.
        seed: of the pictures' noise.
        count: reports progress.
        size: width and height of the pictures [pixel].
    """
    with one_core():
        studio = Studio.build(cameras, size, np.random.default_rng([seed, 1]))
        motion = make_gestures(studio.skeleton)
        names, model = np.array(motion.names), studio.model
        track = PaperTrack.build(studio.prepare(motion.q[0]))
        advance, q, pictures_shown = count("frames", len(names)), np.empty_like(motion.q), []
        for k, true_q in enumerate(motion.q):
            seen = studio.pictures(true_q)
            q[k] = track.step({name: picture_to_colour_image(one) for name, one in seen.items()})
            pictures_shown.append(seen[SHOWN_CAMERA])
            advance(k + 1)
    commands, poses, _ = walk_by(model, motion.q)
    found_commands, found_poses, rests = walk_by(model, q)
    seconds = {}
    for name, true_frames in active_frames(commands).items():
        captured = active_frames(found_commands)[name]
        counts = {
            "true": true_frames.sum(),
            "captured": captured.sum(),
            "wrongly": captured[~true_frames].sum(),
        }
        seconds[name] = {f"{key}_s": PERIOD * float(number) for key, number in counts.items()}
    error = found_poses[-1] - poses[-1]
    figures = {
        "same_command": float((commands == found_commands).all(axis=1).mean()),
        "commands": seconds,
        "place_error_m": float(np.linalg.norm(error[:2])),
        "heading_error_deg": abs(math.degrees(math.remainder(error[2], 2.0 * math.pi))),
        "frames": len(names), "cameras": cameras, "seed": seed, "method": "paper",
    }  # fmt: skip
    middles = {name: int(np.median(np.flatnonzero(names == name))) for name in COMMANDS}
    pictures = {
        name: (pictures_shown[k], draw_walk(model, q[k], found_poses[k], rests[k]))
        for name, k in middles.items()
    }
    return figures, pictures


def active_frames(commands: Array) -> dict[str, Mask]:
    """Return by name of COMMANDS in which rows (n, 2) of `recognise_command` it is active."""
    turn, walk = commands.T
    return dict(zip(COMMANDS, (turn > 0, turn < 0, walk > 0, walk < 0), strict=True))


def walk_by(model: ArticulatedModel, q: Array) -> tuple[Array, Array, Array]:
    """Simulate a Walker on positions q (n, nq), one frame per PERIOD, walking on the spot.

    Returns (n, 2) commands, as of `recognise_command`; (n, 3) the walker's poses, x, y [m] and
    heading [rad]; and (n, 5) rest stances, as of `stance_of`.
    """
    builder = DiagramBuilder()
    source = builder.AddSystem(TrajectorySource(held_positions(q, PERIOD)))
    walker = builder.AddSystem(Walker(model, PERIOD, on_spot=True))
    builder.Connect(source.get_output_port(), walker.GetInputPort("positions"))
    ports = [walker.GetOutputPort(name) for name in ("command", "walker_pose", "rest")]
    logs = [LogVectorOutput(port, builder, PERIOD) for port in ports]
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(PERIOD * len(q))
    # A value logged at a time is the one before the update at that time.
    commands, poses, rests = (log.FindLog(simulator.get_context()).data()[:, 1:].T for log in logs)
    return commands, poses, rests


def draw_walk(model: ArticulatedModel, q: Array, pose: Array, rest: Array) -> Picture:
    """Render the virtual place from behind the avatar; return the picture (360, 480, 3).

    ``model``: of the avatar. ``q``: (nq,) its positions [rad, m]. ``pose``, ``rest``: (3,) pose of
    the walker and (5,) rest stance, as of `walk_by`.
    """
    X_RP = walker_transform(pose, rest).inverse()
    builder = DiagramBuilder()
    scene_graph = add_garden(builder, X_RP)
    positions = builder.AddSystem(ConstantVectorSource(q)).get_output_port()
    add_posed_plant(builder, scene_graph, model, positions, "geometry_pose")
    X_RC = X_RP.GetAsMatrix4() @ look_at(*view_from_behind(pose))
    camera = PinholeCamera("view", 480, 360, 384.0, 384.0, 240.0, 180.0, X_RC)
    sky = RenderEngineVtkParams(default_clear_color=np.array([0.65, 0.78, 0.94]))
    sensor = add_sensors(builder, scene_graph, {"view": camera}, {"view": (0.1, 60.0)}, sky)["view"]
    context = builder.Build().CreateDefaultContext()
    image = sensor.color_image_output_port().Eval(sensor.GetMyContextFromRoot(context))
    return colour_image_to_picture(image)


def save_pictures(result: DateResult, folder: Path) -> list[Path]:
    """Write PNG files of each motion's figures 2, 3, 4, 7 and of all errors; return the paths."""
    files = []
    for motion, sample in result.samples.items():
        files.append(save_picture(sample.compared, folder / f"figure_07_{motion}.png"))
    for motion, sample in result.samples.items():
        files.append(save_picture(_draw_skin(sample), folder / f"figure_02_{motion}.png"))
        files.append(save_figure(_draw_points(result, sample), folder / f"figure_03_{motion}.png"))
    faces = {name: one.faces for name, one in result.samples.items() if one.faces}
    if faces:
        columns = list(zip(*faces.values(), strict=True))
        figure = draw_panels(columns, ("input", "template", "avatar"), list(faces))
        files.append(save_figure(figure, folder / "figure_04.png"))
    return [*files, save_figure(_draw_errors(result), folder / "errors.png")]


def _draw_skin(sample: MotionSample) -> Picture:
    """Draw figure 2: the input with outlines and centroids of its skin-coloured blobs."""
    picture, pink = np.ascontiguousarray(sample.picture), (255, 0, 160)
    blobs = sample.views[SHOWN_CAMERA].blobs
    outlines, _ = cv2.findContours(
        blobs.mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE
    )
    cv2.drawContours(picture, outlines, -1, pink, 1)
    for u, v in np.rint(blobs.centroids).astype(int):
        cv2.drawMarker(picture, (int(u), int(v)), pink, cv2.MARKER_CROSS, 9, 1)
    return picture


def _draw_points(result: DateResult, sample: MotionSample) -> Figure:
    """Draw figure 3: 3-D points of skin by the feature they belong to, features, and blobs' rays.

    Args:
        result: experiment that the sample is from, for its cameras.
        sample: middle frame of a motion.
    """
    found = sample.found
    figure = Figure(figsize=(6.0, 6.0))
    axes = figure.add_subplot(projection="3d")
    for name, view in sample.views.items():
        origins, directions = viewing_rays(result.studio.cameras[name], view.blobs.centroids)
        for origin, direction in zip(origins, directions, strict=True):
            # Draw rays from 0.1 m before the features to 0.1 m behind them.
            along = (found.positions - origin) @ direction
            ends = origin + np.outer([along.min() - 0.1, along.max() + 0.1], direction)
            axes.plot(*ends.T, color="0.85", linewidth=0.5, zorder=0)
    colours = ("tab:red", "tab:blue", "tab:green", "tab:orange", "tab:purple")
    for k, (name, colour) in enumerate(zip(FEATURES, colours, strict=True)):
        points = found.points[found.owners == k]
        axes.plot(*points.T, ".", color=colour, markersize=3)
        label = f"{name.replace('_', ' ')}: {found.support[k]} of {len(points)}"
        axes.plot(*found.positions[k : k + 1].T, "x", color=colour, markersize=9, label=label)
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]", aspect="equal")
    axes.legend(title="points in the dense part, of all", fontsize="small")
    return figure


def _draw_errors(result: DateResult) -> Figure:
    """Draw the joint centres' mean errors over time, by method."""
    figure = Figure(figsize=(9.0, 3.5))
    axes = figure.add_subplot()
    for method, errors in result.errors.items():
        axes.semilogy(np.mean(errors, axis=1), label=TITLES[method])
    for k, name in enumerate(result.names):
        if k == 0 or name != result.names[k - 1]:
            axes.axvline(k, color="0.8", zorder=0)
            axes.text(k, 1.0, f" {name}", transform=axes.get_xaxis_transform(), va="bottom")
    axes.set(xlabel="frame", ylabel="joint centres' mean error [mm]")
    axes.legend()
    return figure
