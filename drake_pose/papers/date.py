"""Date's experiment: a simulated person with known motion, captured by many cameras."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from rich.table import Table

from drake_pose.arrays import Array, Picture
from drake_pose.body import landmarks_of_nodes, load_landmarks
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.papers.date_capture import PaperTrack, SilhouetteTrack, Studio, one_core
from drake_pose.papers.tables import Count, figure_table, require_choice, uncounted
from drake_pose.person.date.features import (
    Features,
    PersonView,
)
from drake_pose.person.date.skeleton import LIMBS
from drake_pose.person.date.walking import REGISTERED, UPRIGHT, Motion, make_motion
from drake_pose.systems.images import picture_to_colour_image

SHOWN_CAMERA = "camera_0"
TITLES = {
    "ik_only": "the paper's IK alone",
    "paper": "the paper's search",
    "silhouette": "all silhouettes",
}
"""What the ways of capturing are called."""

# How long a destroyed track is watched [frames].
_WATCHED = 30


class Moment(NamedTuple):
    """The middle frame of a motion: pictures (H, W, 3), `compared` side by side with all estimates.

    What the paper's stages saw: the person by camera, the features in space, and `faces`
    (130, 80, 3), the seen face, nearest template, and the model's head, or none.
    """

    compared: Picture
    picture: Picture
    views: Mapping[str, PersonView]
    found: Features
    faces: tuple[Picture, ...]


class DateResult:
    """What the experiment measures, frame by frame; see run_experiment.

    Attributes:
        names: (n,) motion of each frame.
        errors: by way of capturing, of the joint centres in each frame (k,) [mm].
        found_errors: of the paper's stages, elbows and knees as found, before the model with its
            stiff trunk is laid through them, in each frame (4,) in the order of LIMBS [mm]; nan
            where the registered pose was recognised instead.
        face_errors: angle between true and estimated direction of the head in each frame [deg].
        destroyed: tracks on their way back: way of capturing, the motion at the destruction, or
            REGISTERED, the track, and the mean error of each frame since [mm].
        moments: by motion, what pictures show.
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
        self._destroyed_at = frames_of_destruction(motion)
        landmarks, tree = load_landmarks(studio.model.path), studio.model.pose_tree()
        del landmarks["head_top"]
        self._kinematics = TreeKinematics(tree)
        self._landmarks = landmarks_of_nodes(tree, landmarks)
        self.errors: dict[str, list[Array]] = {way: [] for way in self._tracks}
        self.found_errors: dict[str, list[Array]] = {"ik_only": [], "paper": []}
        self.face_errors: list[float] = []
        self.destroyed: list[tuple[str, str, PaperTrack | SilhouetteTrack, list[float]]] = []
        self.moments: dict[str, Moment] = {}

    def step(self, k: int) -> None:
        """One more frame."""
        studio, q = self.studio, self._motion.q[k]
        shots = studio.pictures(q)
        images = {name: picture_to_colour_image(shot) for name, shot in shots.items()}
        if k in self._destroyed_at:
            for way in dict.fromkeys((self._method, "paper")):
                lost = self._tracks[way].destroyed(self._motion.q[k - 1], self._generator)
                self.destroyed.append((way, self._destroyed_at[k], lost, []))
        estimates = {}
        for way, track in self._tracks.items():
            estimates[way] = track.step(images)
            self.errors[way].append(self._joint_errors(estimates[way], q))
            if isinstance(track, PaperTrack):
                true = [studio.skeleton.limb_points(q, name)[1] for name in LIMBS]
                off = 1e3 * np.linalg.norm(track.middle_joints() - true, axis=1)
                self.found_errors[way].append(off)
        heads = [studio.skeleton.head_rotation(one)[:, 2] for one in (estimates[self._method], q)]
        cosine = float(np.clip(heads[0] @ heads[1], -1.0, 1.0))
        self.face_errors.append(math.degrees(math.acos(cosine)))
        for _, _, lost, errors in self.destroyed:
            if len(errors) < _WATCHED:
                errors.append(_mean(self._joint_errors(lost.step(images), q)))
        if _is_middle(self._motion, k):
            paper = self._tracks["paper"]
            assert isinstance(paper, PaperTrack)
            views, found, faces = paper.seen()
            shown = [studio.shown_at(one, SHOWN_CAMERA) for one in (q, *estimates.values())]
            head = studio.face_at(estimates["paper"]) if faces else None
            self.moments[self.names[k]] = Moment(
                np.hstack(shown), shots[SHOWN_CAMERA], views, found,
                () if head is None else (*faces, head),
            )  # fmt: skip

    def _joint_errors(self, found: Array, q: Array) -> Array:
        """(k,) how far the joint centres at found positions (nq,) are off those at q (nq,) [mm]."""
        order = self.studio.skeleton.order
        places = [
            self._landmarks.positions(self._kinematics.poses(one[order])) for one in (found, q)
        ]
        return np.asarray(1e3 * np.linalg.norm(places[0] - places[1], axis=1))

    @property
    def motions(self) -> tuple[str, ...]:
        """Those that were shown."""
        return tuple(name for name in dict.fromkeys(self.names) if name != REGISTERED)

    def recoveries(self, way: str) -> dict[str, int | None]:
        """Frames until a destroyed track was right again, by motion; None: not while watched.

        It is right within twice its usual error, or 25 mm.
        """
        right = max(25.0, 2.0 * _mean(self.errors[way]))
        return {
            motion: next((k for k, off in enumerate(errors, 1) if off <= right), None)
            for own, motion, _, errors in self.destroyed
            if own == way
        }

    @property
    def slowest_recovery(self) -> float:
        """The longest that a frame's pose took on the way back [ms]."""
        own = [track for way, _, track, _ in self.destroyed if way == self._method]
        return max((lap["pose"] for track in own for lap in track.milliseconds), default=0.0)

    def milliseconds(self, way: str) -> dict[str, float]:
        """Processor time by stage, a frame, all cameras together; "all": of all stages."""
        laps = self._tracks[way].milliseconds
        names = dict.fromkeys(name for lap in laps for name in lap)
        stages = {name: float(np.median([lap.get(name, 0.0) for lap in laps])) for name in names}
        return {**stages, "all": sum(stages.values())}

    def as_json(self) -> dict[str, object]:
        """The figures; the registered pose's frames do not count."""
        own = np.array(self.errors[self._method])[np.isin(self.names, self.motions)]
        all_motions = self._of_motions(self.motions)
        recoveries, spent = self.recoveries(self._method), self.milliseconds(self._method)
        cameras = len(self.studio.cameras)
        anywhere = [n for motion, n in recoveries.items() if motion != REGISTERED]
        soon = anywhere or list(recoveries.values())
        known = [n for n in soon if n is not None]
        return {
            "joint_error_mm": _mean(own),
            "joint_error_p95_mm": float(np.percentile(own, 95)),
            "ik_only_mm": all_motions["ik_only_mm"],
            "paper_mm": all_motions["paper_mm"],
            "elbows_and_knees": self._of_joints(("elbow", "knee")),
            "elbows": self._of_joints(("elbow",)),
            "knees": self._of_joints(("knee",)),
            **self._as_found(UPRIGHT),
            "as_found": {motion: self._as_found((motion,)) for motion in self.motions},
            "face_error_deg": all_motions["face_error_deg"],
            "frames_to_recover": max(known) if known and len(known) == len(soon) else None,
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
        """Mean errors of elbows and knees as found, with the search and without [mm]."""
        chosen = np.isin(self.names, motions)
        figures = {}
        for way, ending in (("ik_only", "ik_mm"), ("paper", "mm")):
            errors = np.array(self.found_errors[way])[chosen]
            errors = errors[np.isfinite(errors).all(axis=1)]
            for joint, limbs in (("elbow", errors[:, :2]), ("knee", errors[:, 2:])):
                figures[f"{joint}_{ending}"] = _mean(limbs) if len(limbs) else math.nan
        return figures

    def _of_motions(self, motions: Sequence[str]) -> dict[str, float]:
        """Mean errors in the frames of some motions."""
        chosen = np.isin(self.names, motions)
        errors = {f"{way}_mm": _mean(np.array(one)[chosen]) for way, one in self.errors.items()}
        return {**errors, "face_error_deg": _mean(np.array(self.face_errors)[chosen])}

    def _of_joints(self, ends: tuple[str, ...]) -> dict[str, float]:
        """Mean errors in all motions of the joints whose names end so, by way of capturing."""
        moving = np.isin(self.names, self.motions)
        chosen = [i for i, name in enumerate(self._landmarks.names) if name.endswith(ends)]
        return {
            f"{way}_mm": _mean(np.array(one)[moving][:, chosen]) for way, one in self.errors.items()
        }

    def tables(self) -> tuple[Table, Table]:
        """The errors in each motion; and elbows and knees as found, with the search and without."""
        rows = {motion: self._of_motions((motion,)) for motion in self.motions}
        found = {motion: self._as_found((motion,)) for motion in self.motions}
        headings = {f"{way}_mm": f"{TITLES[way]} [mm]" for way in self.errors}
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
        """What a frame costs, and how soon a destroyed track is right again."""
        *stages, (_, whole) = self.milliseconds(self._method).items()
        parts = ", ".join(f"{name} {spent:.1f}" for name, spent in stages)
        soon = ", ".join(
            f"{motion} {'not' if n is None else n}"
            for motion, n in self.recoveries(self._method).items()
        )
        return (
            f"One core, {TITLES[self._method]}: {whole:.1f} ms a frame ({parts}), "
            f"{1e3 / whole:.0f} frames a second.\n"
            f"Frames until a destroyed track was right again: {soon}; "
            f"the slowest of them took {self.slowest_recovery:.0f} ms."
        )


def run_experiment(
    cameras: int = 9,
    frames: int = 240,
    seed: int = 0,
    method: str = "silhouette",
    count: Count = uncounted,
    size: tuple[int, int] = (640, 480),
) -> DateResult:
    """Captures a simulated person, by one core.

    Args:
        cameras: how many, the face camera included.
        seed: another one draws other motions.
        method: whose figures lead: "paper", all as it prints it, alone; "silhouette", all
            silhouettes at once, beside it.
        size: width and height of the pictures [pixel].

    Raises:
        SettingsError: an argument is out of its range.
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
    """A row a motion, a column a figure."""
    columns = {
        heading: {motion: figures[key] for motion, figures in rows.items()}
        for key, heading in headings.items()
    }
    return figure_table(title, {motion: (motion, form) for motion in rows}, columns, "motion")


def frames_of_destruction(motion: Motion) -> dict[int, str]:
    """Where tracks are destroyed: amid each whole motion, and at the registered pose's return.

    None is destroyed in the last ten frames.
    """
    count = len(motion.names)
    found = {k: motion.names[k] for k in range(count - 10) if _is_middle(motion, k)}
    again = 1 + max(k for k, name in enumerate(motion.names) if name != REGISTERED)
    return found if again == count else {**found, again: REGISTERED}


def _is_middle(motion: Motion, k: int) -> bool:
    """Whether frame k is the middle one of its motion."""
    same = [i for i, name in enumerate(motion.names) if name == motion.names[k]]
    return motion.names[k] != REGISTERED and k == same[len(same) // 2]


def _mean(values: Array | Sequence[Array]) -> float:
    return float(np.mean(values))
