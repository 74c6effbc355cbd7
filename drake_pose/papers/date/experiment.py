"""Date's experiment: a simulated person with known motion, captured by many cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from drake_pose.body.landmarks import landmarks_of_nodes
from drake_pose.body.tree.tree_kinematics import TreeKinematics
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import SettingsError
from drake_pose.papers.date.stages import FaceTriple, StagesShown
from drake_pose.papers.date.studio import Studio
from drake_pose.papers.date.tracks import Images, PaperTrack, SilhouetteTrack, see
from drake_pose.person.date.body_pose import Waist
from drake_pose.person.date.limb_search import Search
from drake_pose.person.date.skeleton import LIMBS
from drake_pose.person.date.walking_motion import REGISTERED, UPRIGHT, Motion, make_motion
from drake_pose.systems.colour_images import colour_image_to_picture

Array = NDArray[np.float64]

METHODS = ("silhouette", "paper")
WAISTS = ("reach", "person", "paper")
SEARCHES: tuple[Search, ...] = ("surfaces", "rectangles")
FEWEST_CAMERAS = 3
SHOWN_CAMERA = "camera_0"
FRAMES = 240

# A track is right again within twice its usual error, or within this [mm].
_RIGHT_AGAIN, _RIGHT_MM = 2.0, 25.0
# How long a destroyed track is watched [frames].
_WATCHED = 30
_FEWEST_WATCHED = 10


TITLES = {
    "ik_only": "inverse kinematics alone",
    "paper": "with the search",
    "silhouette": "all silhouettes",
}
"""What the ways of capturing are called."""


@dataclass(frozen=True, eq=False)
class DateResult:
    """What the experiment measured.

    Args:
        method: of METHODS, whose figures lead.
        names: (n,) motion of each frame.
        joint_names: (k,) the joint centres.
        errors: by way of capturing ("silhouette", "paper", "ik_only"): (n, k) [mm].
        found_errors: of "paper" and "ik_only", elbows and knees as found, before the model with its
            stiff trunk is laid through them: (n, 4) in the order of LIMBS [mm]; nan where the
            registered pose was recognised instead.
        waist: of WAISTS, how the waist was found.
        search: of SEARCHES, how elbows and knees were searched.
        face_errors: (n,) angle between true and estimated direction of the head [deg].
        recoveries: frames until a destroyed track was right again, by the motion during which it
            was destroyed; REGISTERED: the registered pose was shown; None: not within _WATCHED.
        search_ms: the longest that a frame's pose took on the way back [ms].
        milliseconds: processor time by stage, a frame, all cameras together.
        cameras: how many, the face camera included.
        seed: what the motion was drawn with.
        pictures: by motion: input and all estimates, side by side.
        stages: by motion: what the paper's stages saw in the same frame.
        rig: the cameras, by name.
    """

    method: str
    names: tuple[str, ...]
    joint_names: tuple[str, ...]
    errors: Mapping[str, Array]
    found_errors: Mapping[str, Array]
    waist: str
    search: str
    face_errors: Array
    recoveries: Mapping[str, int | None]
    search_ms: float
    milliseconds: Mapping[str, float]
    cameras: int
    seed: int
    pictures: Mapping[str, NDArray[np.uint8]]
    stages: Mapping[str, StagesShown]
    rig: Mapping[str, PinholeCamera]

    @property
    def motions(self) -> tuple[str, ...]:
        """Those that were shown."""
        return tuple(name for name in dict.fromkeys(self.names) if name != REGISTERED)

    def as_json(self) -> dict[str, object]:
        """The figures; the registered pose's frames do not count."""
        chosen = np.array([name != REGISTERED for name in self.names])
        errors = {way: values[chosen] for way, values in self.errors.items()}
        whole = sum(self.milliseconds.values())
        anywhere = [n for motion, n in self.recoveries.items() if motion != REGISTERED]
        return {
            "joint_error_mm": _mean(errors[self.method]),
            "joint_error_p95_mm": float(np.percentile(errors[self.method], 95)),
            "ik_only_mm": _mean(errors["ik_only"]),
            "paper_mm": _mean(errors["paper"]),
            "elbows_and_knees": self._of_joints(errors, ("elbow", "knee")),
            "elbows": self._of_joints(errors, ("elbow",)),
            "knees": self._of_joints(errors, ("knee",)),
            **self._as_found(UPRIGHT),
            "as_found": {motion: self._as_found((motion,)) for motion in self.motions},
            "face_error_deg": _mean(self.face_errors[chosen]),
            "frames_to_recover": _slowest(anywhere or list(self.recoveries.values())),
            "frames_to_recover_registered": self.recoveries.get(REGISTERED),
            "ms_of_slowest_recovering_frame": self.search_ms,
            "ms_per_frame": {**self.milliseconds, "all": whole},
            "fps": 1e3 / whole,
            "camera_frames_per_second": 1e3 * self.cameras / whole,
            "motions": {motion: self._of_motion(motion) for motion in self.motions},
            "frames": len(self.names),
            "cameras": self.cameras,
            "seed": self.seed,
            "method": self.method,
            "waist": self.waist,
            "search": self.search,
        }

    def _as_found(self, motions: Sequence[str]) -> dict[str, float]:
        """Mean errors of elbows and knees as found, with the search and without [mm]."""
        chosen = np.isin(self.names, motions)
        figures = {}
        for way, ending in (("paper", "mm"), ("ik_only", "ik_mm")):
            errors = self.found_errors[way][chosen]
            errors = errors[np.isfinite(errors).all(axis=1)]
            for joint, limbs in (("elbow", errors[:, :2]), ("knee", errors[:, 2:])):
                figures[f"{joint}_{ending}"] = _mean(limbs) if len(limbs) else math.nan
        return figures

    def _of_motion(self, motion: str) -> dict[str, float]:
        """The figures of one motion."""
        chosen = np.array(self.names) == motion
        figures = {f"{way}_mm": _mean(errors[chosen]) for way, errors in self.errors.items()}
        return {**figures, "face_error_deg": _mean(self.face_errors[chosen])}

    def _of_joints(self, errors: Mapping[str, Array], ends: tuple[str, ...]) -> Mapping[str, float]:
        """Mean errors of the joints whose names end so, by way of capturing.

        Elbows and knees are what the search on circles is for.
        """
        chosen = [i for i, name in enumerate(self.joint_names) if name.endswith(ends)]
        return {f"{way}_mm": _mean(values[:, chosen]) for way, values in errors.items()}

    def table(self) -> Table:
        """The figures of each motion."""
        ways = [way for way in TITLES if way in self.errors]
        table = Table(
            "motion",
            *(f"{TITLES[way]} [mm]" for way in ways),
            "face [deg]",
            title=f"Date: {self.cameras} cameras, {len(self.names)} frames",
        )
        moving = np.array([name != REGISTERED for name in self.names])
        rows = {name: np.array(self.names) == name for name in self.motions} | {"all": moving}
        for motion, chosen in rows.items():
            table.add_row(
                motion,
                *(f"{_mean(self.errors[way][chosen]):.1f}" for way in ways),
                f"{_mean(self.face_errors[chosen]):.1f}",
            )
        return table

    def found_table(self) -> Table:
        """Elbows and knees as found, with the search and without."""
        table = Table(
            "motion", "elbows [mm]", "by IK alone", "knees [mm]", "by IK alone",
            title=f"Elbows and knees as found, --waist {self.waist} --search {self.search}",
        )  # fmt: skip
        rows = {motion: (motion,) for motion in self.motions} | {"upright": UPRIGHT}
        for label, motions in rows.items():
            found = self._as_found(motions)
            keys = ("elbow_mm", "elbow_ik_mm", "knee_mm", "knee_ik_mm")
            table.add_row(label, *(f"{found[key]:.0f}" for key in keys))
        return table

    def costs(self) -> str:
        """What a frame costs, and how soon a destroyed track is right again."""
        whole = sum(self.milliseconds.values())
        stages = ", ".join(f"{name} {spent:.1f}" for name, spent in self.milliseconds.items())
        soon = ", ".join(
            f"{motion} {'not' if n is None else n}" for motion, n in self.recoveries.items()
        )
        return (
            f"One core, {TITLES[self.method]}: {whole:.1f} ms a frame ({stages}), "
            f"{1e3 / whole:.0f} frames a second.\n"
            f"Frames until a destroyed track was right again: {soon}; "
            f"the slowest of them took {self.search_ms:.0f} ms."
        )


def run_experiment(
    cameras: int = 9,
    frames: int = FRAMES,
    seed: int = 0,
    method: str = "silhouette",
    progress: Callable[[int], None] | None = None,
    size: tuple[int, int] = (640, 480),
    waist: str = "reach",
    search: str = "surfaces",
) -> DateResult:
    """Captures a simulated person.

    Args:
        cameras: how many, the face camera included.
        frames: how many.
        seed: another one draws other motions.
        method: "silhouette" for all silhouettes at once, "paper" for the paper's way alone.
        progress: called with the number of frames done after each.
        size: width and height of the pictures [pixel].
        waist: of the paper's formula: "person" with this person's constants, "paper" with 0.55,
            0.225, 0.225; "reach" as "person", then lowered until both feet are in reach.
        search: of elbows and knees: "rectangles" as in the paper, or "surfaces".

    Raises:
        SettingsError: an argument is out of its range.
    """
    if method not in METHODS:
        raise SettingsError(f"method must be one of {', '.join(METHODS)}, not '{method}'")
    if waist not in WAISTS:
        raise SettingsError(f"waist must be one of {', '.join(WAISTS)}, not '{waist}'")
    way = next((one for one in SEARCHES if one == search), None)
    if way is None:
        raise SettingsError(f"search must be one of {', '.join(SEARCHES)}, not '{search}'")
    if cameras < FEWEST_CAMERAS:
        raise SettingsError(f"cameras must be {FEWEST_CAMERAS} or more, not {cameras}")
    # What is measured is one core's work.
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        return _Experiment(cameras, frames, seed, method, size, waist, way).run(progress)
    finally:
        cv2.setNumThreads(threads)


class _Experiment:
    """One run; see run_experiment."""

    def __init__(
        self,
        cameras: int,
        frames: int,
        seed: int,
        method: str,
        size: tuple[int, int],
        waist: str,
        search: Search,
    ) -> None:
        self.cameras, self.seed, self.method = cameras, seed, method
        self.waist, self.search = waist, search
        self.studio = Studio.build(cameras, size, np.random.default_rng([seed, 1]))
        self.motion = make_motion(self.studio.skeleton, frames, seed)
        setup = self.studio.prepare(self.motion.q[0])
        setup = replace(setup, settings=replace(setup.settings, search=search))
        if waist != "reach":
            own = replace(setup.settings.waist, in_reach=False)
            formula = Waist() if waist == "paper" else own
            setup = replace(setup, settings=replace(setup.settings, waist=formula))
        model = self.studio.model
        tree = model.pose_tree()
        self.kinematics = TreeKinematics(tree)
        self.landmarks = landmarks_of_nodes(tree, self.studio.landmarks)
        self.order = np.array([model.position_index(name) for name in self.kinematics.names])
        alone = replace(setup, settings=replace(setup.settings, search="none"))
        self.tracks: dict[str, PaperTrack | SilhouetteTrack] = {
            "ik_only": PaperTrack.build(alone),
            "paper": PaperTrack.build(setup),
        }
        if method == "silhouette":
            self.tracks[method] = SilhouetteTrack.build(
                model, self.studio.cameras, self.studio.backgrounds
            )
        self.generator = np.random.default_rng([seed, 2])

    def run(self, progress: Callable[[int], None] | None) -> DateResult:
        """All frames."""
        studio, motion = self.studio, self.motion
        estimates: dict[str, list[Array]] = {way: [] for way in self.tracks}
        found: dict[str, list[Array]] = {way: [] for way in ("paper", "ik_only")}
        watched: list[_Watched] = []
        pictures, stages = {}, {}
        destroyed_at = frames_of_destruction(motion)
        for k, q in enumerate(motion.q):
            images = see(studio.pictures(q))
            if k in destroyed_at:
                track = self.tracks[self.method].destroyed(motion.q[k - 1], self.generator)
                watched.append(_Watched(destroyed_at[k], track, []))
            for way, track in self.tracks.items():
                estimates[way].append(track.step(images))
                if isinstance(track, PaperTrack):
                    found[way].append(self._middle_joints_off(track, q))
            for one in watched:
                if len(one.errors) < _WATCHED:
                    one.errors.append(float(np.mean(self._off(one.track.step(images), q))))
            if _is_middle(motion, k):
                shown = [estimates[way][-1] for way in self.tracks]
                pictures[motion.names[k]] = studio.side_by_side(q, shown, SHOWN_CAMERA)
                stages[motion.names[k]] = self._stages(images, estimates["paper"][-1])
            if progress is not None:
                progress(k + 1)
        errors = {
            way: np.array([self._off(one, q) for one, q in zip(path, motion.q, strict=True)])
            for way, path in estimates.items()
        }
        right = max(_RIGHT_MM, _RIGHT_AGAIN * _mean(errors[self.method]))
        rotation = studio.skeleton.head_rotation
        return DateResult(
            method=self.method,
            names=motion.names,
            joint_names=self.landmarks.names,
            errors=errors,
            found_errors={way: np.array(values) for way, values in found.items()},
            waist=self.waist,
            search=self.search,
            face_errors=np.array(
                [
                    _angle_between(rotation(estimate), rotation(q))
                    for estimate, q in zip(estimates[self.method], motion.q, strict=True)
                ]
            ),
            recoveries={one.motion: one.frames_until(right) for one in watched},
            search_ms=max(max(one.spent()) for one in watched),
            milliseconds=self._medians(),
            cameras=self.cameras,
            seed=self.seed,
            pictures=pictures,
            stages=stages,
            rig=studio.cameras,
        )

    def _stages(self, images: Images, estimate: Array) -> StagesShown:
        """What the paper's stages saw in the frame whose estimate (nq,) this is."""
        track = self.tracks["paper"]
        assert isinstance(track, PaperTrack)
        views, found, face = track.seen()
        picture = colour_image_to_picture(images[SHOWN_CAMERA]).copy()
        avatar = None if face is None else self.studio.face_at(estimate)
        triple = None if face is None or avatar is None else FaceTriple(*face, avatar)
        return StagesShown(picture, SHOWN_CAMERA, views, found, triple)

    def _off(self, found: Array, q: Array) -> Array:
        """(k,) how far the joint centres at found positions (nq,) are off those at q (nq,) [mm]."""
        places = [
            self.landmarks.positions(self.kinematics.poses(positions[self.order]))
            for positions in (found, q)
        ]
        return np.asarray(1e3 * np.linalg.norm(places[0] - places[1], axis=1))

    def _middle_joints_off(self, track: PaperTrack, q: Array) -> Array:
        """(4,) how far elbows and knees as found are off those at q (nq,) [mm]."""
        true = [self.studio.skeleton.limb_points(q, name)[1] for name in LIMBS]
        return np.asarray(1e3 * np.linalg.norm(track.middle_joints() - true, axis=1))

    def _medians(self) -> dict[str, float]:
        """Milliseconds a frame, by stage."""
        laps = self.tracks[self.method].milliseconds
        names = dict.fromkeys(name for lap in laps for name in lap)
        return {name: float(np.median([lap.get(name, 0.0) for lap in laps])) for name in names}


class _Watched(NamedTuple):
    """A destroyed track. errors: mean error of each frame since [mm]."""

    motion: str
    track: PaperTrack | SilhouetteTrack
    errors: list[float]

    def spent(self) -> list[float]:
        """What the pose of each frame took [ms]."""
        return [lap["pose"] for lap in self.track.milliseconds] or [0.0]

    def frames_until(self, right: float) -> int | None:
        """How many frames it took until the error was small enough; None: too many."""
        good = [k for k, error in enumerate(self.errors) if error <= right]
        return good[0] + 1 if good else None


def frames_of_destruction(motion: Motion) -> dict[int, str]:
    """Where tracks are destroyed: amid each motion, and when the registered pose is shown again.

    Not in the last frames of a motion cut short, where recovery could not be seen.
    """
    count = len(motion.names)
    found = {k: motion.names[k] for k in range(count - _FEWEST_WATCHED) if _is_middle(motion, k)}
    again = 1 + max(k for k, name in enumerate(motion.names) if name != REGISTERED)
    return found if again == count else {**found, again: REGISTERED}


def _is_middle(motion: Motion, k: int) -> bool:
    """Whether frame k is the middle one of its motion."""
    same = [i for i, name in enumerate(motion.names) if name == motion.names[k]]
    return motion.names[k] != REGISTERED and k == same[len(same) // 2]


def _angle_between(R_a: Array, R_b: Array) -> float:
    """Between the directions in which two heads look [deg]."""
    return math.degrees(math.acos(min(1.0, max(-1.0, float(R_a[:, 2] @ R_b[:, 2])))))


def _slowest(frames: Sequence[int | None]) -> int | None:
    """The largest; None where one is."""
    known = [n for n in frames if n is not None]
    return max(known) if known and len(known) == len(frames) else None


def _mean(values: Array) -> float:
    return float(np.mean(values))
