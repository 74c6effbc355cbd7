"""Benchmark of registration from images only: simulated episodes of arms in rooms, by Drake.

Run as ``python -m tests.benchmarks.episodes DATA [--rooms N] [--first K] [--only TEXT]``; DATA is a
folder with the arms ``arm_two_views/med7``, ``franka_one_view/panda``, ``droid_episodes/robot`` and
``so101``, N the number of rooms per arm and set. In sets with wrong rows, frames near the start and
end of these rows are not evaluated. ``--spoilt``: instead, episodes that must be refused.
"""

import argparse
import re
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drake_pose.body import ArticulatedModel, load_model
from drake_pose.camera.camera_files import save_cameras
from drake_pose.errors import DrakePoseError
from drake_pose.files.settings import RegistrationSettings
from drake_pose.jobs.registration.register import SceneRegistration, register_scene
from tests.benchmarks.registration import CameraError
from tests.benchmarks.rooms import LOG_HZ, SimulatedEpisode, simulate
from tests.benchmarks.tables import print_table
from tests.camera.recordings import write_pictures
from tests.jobs.scenes import edit_camera
from tests.registration.recordings import write_images, write_log


class Arm(NamedTuple):
    """A model file, and bounds of a camera's distance from the point that it looks at [m]."""

    file: str
    distance: tuple[float, float] = (1.1, 1.7)
    middle: tuple[float, float, float] = (0.0, 0.0, 0.4)


ARMS = {
    "LBR Med 7": Arm("arm_two_views/med7/med7.urdf"),
    "Franka Panda": Arm("franka_one_view/panda/panda.urdf"),
    "Panda with Robotiq": Arm("droid_episodes/robot/panda_robotiq.urdf"),
    "SO-101": Arm("so101/so101_new_calib.urdf", (0.6, 0.9), (0.05, 0.0, 0.12)),
}
# Prefixes of arm joints, without those of grippers of several joints.
_JOINTS = ("A", "panda_joint", "lbr_", "shoulder_", "elbow_", "wrist_", "gripper")
# Every fifth room has little contrast (grey on grey).
GREY = 5
# Maximum time offset [s], joint offset [deg], and duration of wrong rows [s].
_LATE, _ZERO, _WRONG = 0.3, 2.0, 2.0
# Probability of a larger error by its covariance, at least, of a camera that is right.
LEAST = 0.001
# Frames this close to the start or end of wrong rows are not evaluated [s].
_BETWEEN = 0.15


class EpisodeSet(NamedTuple):
    """Episodes with one kind of error."""

    name: str
    late: bool = False  # A time offset.
    log_hz: float = LOG_HZ
    zeros: bool = False  # Offsets of three joints.
    wrong: bool = False  # Wrong rows.
    off: float = 0.0  # Bound of the offsets of all joints [deg].
    codec: str = ""  # Encoder of the pictures' video, with its option `crf`; "": PNG files.
    crf: int = 23
    small: bool = False  # As of ``simulate``.
    cause: str = ""  # Pattern of words that name what is wrong, if no pose explains the episode.


SETS = (
    EpisodeSet("as recorded"),
    EpisodeSet("in a video (H.264)", codec="libx264"),
    EpisodeSet("in a video (H.264, crf 32)", codec="libx264", crf=32),
    EpisodeSet("the arm 50 pixels tall, crf 32", codec="libx264", crf=32, small=True),
    EpisodeSet("in a video (AV1, as LeRobot's)", codec="libsvtav1", crf=30),
    EpisodeSet("clock off by up to .3 s, log at 33 Hz", late=True, log_hz=33.0),
    EpisodeSet("three zeros off by 2 degrees", zeros=True),
    EpisodeSet("all zeros off by up to 10 degrees", off=10.0),
    EpisodeSet("all zeros off by up to 20 degrees", off=20.0),
    EpisodeSet("a third of the rows wrong", wrong=True),
)
_ROWS = "another (episode|time)|not (those|theirs)|in reverse|too (late|early)|clock (is|runs)"
SPOILT = tuple(
    EpisodeSet(name, codec="libx264", cause=cause)
    for name, cause in (
        ("joints of another episode", _ROWS),
        ("rows in reverse", _ROWS),
        ("rows 2 to 10 s late or early", _ROWS),
        ("mirrored pictures", "mirrored"),
        ("model of another arm", "(other|another) (robot|arm)"),
        ("picture frozen", "frozen|same picture|do(es)? not change"),
        ("sign of a joint", "(other|wrong) sign"),
    )
)


class Outcome(NamedTuple):
    """Result of an episode; the last five are set by episodes with these errors only."""

    refusal: str  # Message of the error; "": the registration was accepted.
    seconds: float  # CPU time.
    error: CameraError = CameraError()
    cause: bool = False  # Whether an error or warning states what is wrong with the episode.
    clock: float = np.nan  # Error of the time offset [s].
    zeros: tuple[float, ...] = ()  # Errors of the wrong offsets [deg]; without the first joint's.
    first: float = np.nan  # Error of that [deg]; NaN: it is right, or not determined.
    false: int = 0  # Number of correct joint offsets reported as wrong.
    named: tuple[float, float] = (np.nan, np.nan)  # Parts of wrong, right frames that are outliers.


def measure_episode(data: Path, name: str, folder: Path, seed: int, kind: EpisodeSet) -> Outcome:
    """Simulate an episode with errors, and find its camera.

    data: folder of the models. name: of the arm, a key of ARMS. folder: for the files.
    """
    rng = np.random.default_rng([10, seed])
    arm, path = ARMS[name], data / ARMS[name].file
    model = load_model(path, check=False)
    late = float(rng.uniform(-_LATE, _LATE)) if kind.late else 0.0
    if "s late" in kind.name:
        late = float(rng.choice([-1.0, 1.0]) * rng.uniform(2.0, 10.0))
    grey = seed % GREY == GREY - 1
    room = partial(simulate, model, folder, grey=grey, distance=arm.distance, middle=arm.middle)
    episode = room(seed, late=late, small=kind.small)
    moving = [
        name
        for name, low, high in zip(model.position_names, model.lower, model.upper, strict=True)
        if np.isfinite(low) and high - low > 0.5 and name.startswith(_JOINTS)
    ]
    turned = {}
    if kind.zeros:
        # Offsets of the first joint are absorbed by the camera, those of the last are invisible.
        three = rng.choice(moving[1:-1], 3, replace=False).tolist()
        turned = dict(zip(three, rng.choice([-_ZERO, _ZERO], 3).tolist(), strict=True))
    if kind.off:
        turned = dict(zip(moving, rng.uniform(-kind.off, kind.off, len(moving)), strict=True))
    wrong = (0.0, 0.0)
    if kind.wrong:
        begin = float(rng.uniform(0.5, episode.times[-1] - _WRONG - 0.5))
        wrong = (begin, begin + _WRONG)
    positions, pictures = episode.positions.copy(), episode.pictures.copy()
    if "another episode" in kind.name:
        episode = replace(episode, positions=room(seed + 1000).positions)
    elif "reverse" in kind.name:
        episode = replace(episode, positions=positions[::-1])
    elif "mirrored" in kind.name:
        episode = replace(episode, pictures=pictures[:, :, ::-1])
    elif "another arm" in kind.name:
        # A Panda with another gripper is the same arm.
        others = [k for k in ARMS if k != name and not ("Panda" in k and "Panda" in name)]
        path = data / ARMS[str(rng.choice(others))].file
        model, episode = of_another_arm(model, episode, path)
    elif "frozen" in kind.name:
        first = int(rng.uniform(0.0, 0.6) * len(pictures))
        pictures[first:] = pictures[first]
        episode = replace(episode, pictures=pictures)
    elif "sign" in kind.name:
        # The sign of the last joint is hardly visible.
        positions[:, model.position_index(str(rng.choice(moving[:-1])))] *= -1.0
        episode = replace(episode, positions=positions)
    write_episode(folder, model, episode, kind.log_hz, turned, wrong, kind.codec, kind.crf)
    settings = RegistrationSettings(zeros=("all",) if turned else ())
    start = time.process_time()
    try:
        found = register_scene(folder, path, settings=settings)
    except DrakePoseError as error:
        texts = [str(error), *getattr(error, "__notes__", [])]
        outcome = Outcome(texts[0], time.process_time() - start)
    else:
        seconds, texts = time.process_time() - start, [*found.warnings]
        outcome = _outcome(found, episode, late, turned, wrong, seconds)
    return outcome._replace(cause=names_cause(kind, texts))


def names_cause(kind: EpisodeSet, texts: Sequence[str]) -> bool:
    """Return whether texts name what is wrong with an episode, beside the list of all causes."""
    said = re.sub(r"Does the camera stand still[^?]*\?", "", " ".join(texts))
    return bool(kind.cause) and re.search(kind.cause, said) is not None


def of_another_arm(
    model: ArticulatedModel, episode: SimulatedEpisode, path: Path
) -> tuple[ArticulatedModel, SimulatedEpisode]:
    """Return the arm of another file, and the episode's log as its, joint by joint in order."""
    other = load_model(path, check=False)
    moving = [
        np.flatnonzero(np.isfinite(one.lower) & (one.upper - one.lower > 0.1))
        for one in (model, other)
    ]
    count = min(len(one) for one in moving)
    positions = np.tile(other.default_positions, (len(episode.positions), 1))
    positions[:, moving[1][:count]] = episode.positions[:, moving[0][:count]]
    return other, replace(episode, positions=np.clip(positions, other.lower, other.upper))


def write_episode(
    folder: Path,
    model: ArticulatedModel,
    episode: SimulatedEpisode,
    log_hz: float,
    turned: dict[str, float],
    wrong: tuple[float, float],
    codec: str = "",
    crf: int = 23,
) -> None:
    """Write an episode's files: images, a joint log at some rate, and a camera without pose.

    codec, crf: as of EpisodeSet.
    """
    if codec:
        video = folder / "videos" / f"{episode.camera.name}.mp4"
        write_pictures(video, episode.pictures, episode.times, codec, crf=str(crf))
    else:
        images = folder / "images" / episode.camera.name
        write_images(images, episode.pictures, episode.times)
    save_cameras(folder / "cameras.yaml", [episode.camera])
    edit_camera(folder / "cameras.yaml", episode.camera.name, X_WC=None)
    times = np.arange(episode.log_times[0], episode.log_times[-1], 1.0 / log_hz)
    logged = [np.interp(times, episode.log_times, column) for column in episode.positions.T]
    positions = np.column_stack(logged)
    for name, degrees in turned.items():
        positions[:, model.position_index(name)] += np.radians(degrees)
    spoilt = np.flatnonzero((times >= wrong[0]) & (times < wrong[1]))
    positions[spoilt] = np.roll(positions, len(times) // 2, axis=0)[spoilt]
    moving = np.flatnonzero(np.isfinite(model.lower) & (model.lower < model.upper))
    names = [model.position_names[k] for k in moving]
    write_log(folder / "joint_angles.csv", times, positions[:, moving], names)


def _outcome(
    found: SceneRegistration, episode: SimulatedEpisode, late: float, turned: dict[str, float],
    wrong: tuple[float, float], seconds: float,
) -> Outcome:  # fmt: skip
    """Return the errors of an episode's camera, clock, joint offsets and outliers."""
    one, summary = found.registered["camera"], found.summary
    offset, false, off = summary["time_offset_s"], 0, dict[str, float]()
    for name, estimate in summary["zeros"].items():
        if name not in turned:
            false += bool(estimate["significant"])
        elif estimate["determined"]:
            # The estimated offset is added to readings, so it should cancel the error.
            value = estimate["value_deg"] if estimate["significant"] else 0.0
            off[name] = abs(value + turned[name])
    first = off.pop(next(iter(summary["zeros"]), ""), np.nan)
    outliers = {int(name) for name in one.outliers}
    is_wrong = (episode.times >= wrong[0]) & (episode.times < wrong[1])
    between = np.abs(episode.times[:, None] - np.array(wrong)).min(axis=1) < _BETWEEN
    named = np.array([k in outliers for k in range(len(episode.times))])
    fractions = [
        float(named[own].mean()) if own.any() else np.nan
        for own in (is_wrong & ~between, ~is_wrong & ~between)
    ]
    clock = np.nan if offset is None else offset - late
    error = CameraError.of(one, episode.camera.X_WC)
    more = clock, tuple(off.values()), first, false, (fractions[0], fractions[1])
    return Outcome("", seconds, error, False, *more)


def _row(name: str, outcomes: Sequence[Outcome]) -> list[str]:
    """Return a row of the table."""
    found = [one for one in outcomes if not one.refusal]
    right = [one for one in found if one.error.probable >= LEAST]
    off = np.array([one.error[:2] for one in found]).reshape(-1, 2)
    clocks = np.abs([one.clock for one in found if np.isfinite(one.clock)])
    zeros = [off for one in found for off in one.zeros]
    first = [one.first for one in found if np.isfinite(one.first)]
    named = np.array([one.named for one in found]).reshape(-1, 2)
    return [
        name,
        f"{len(right)} of {len(outcomes)}",
        f"{len(outcomes) - len(found)}",
        f"{len(found) - len(right)}",
        f"{sum(one.cause for one in outcomes)}",
        *(f"{one:.2g}" for one in (np.median(off, axis=0) if len(off) else (np.nan, np.nan))),
        f"{100.0 * sum(one.error.inside for one in found) / max(6 * len(found), 1):.0f}%",
        f"{1e3 * float(np.median(clocks)):.2g} ({1e3 * float(clocks.max()):.2g})"
        if len(clocks)
        else "-",
        f"{np.median(zeros):.2f} ({max(zeros):.2f}), {sum(one.false for one in found)}"
        if zeros
        else "-",
        f"{np.median(first):.2f} ({max(first):.2f}), {len(first)}" if first else "-",
        " / ".join(
            f"{100.0 * float(np.mean(own)):.0f}%" if np.isfinite(own).all() and len(own) else "-"
            for own in named.T
        ),
        f"{np.median([one.seconds for one in outcomes]):.0f}",
    ]


def _rows(data: Path, sets: Sequence[EpisodeSet], rooms: range, only: str) -> Iterator[list[str]]:
    for kind in sets:
        for name, arm in ARMS.items():
            text = f"{kind.name}, {name}"
            if only in text and (data / arm.file).is_file():
                outcomes = []
                for seed in rooms:
                    with tempfile.TemporaryDirectory() as folder:
                        outcomes.append(measure_episode(data, name, Path(folder), seed, kind))
                        print(text, seed, outcomes[-1], flush=True)
                yield _row(text, outcomes)


def main() -> None:
    """Print a row for each set and arm."""
    parser = argparse.ArgumentParser(description="Cameras, clocks, zeros of recorded episodes.")
    parser.add_argument("data", type=Path)
    parser.add_argument("--rooms", type=int, default=10)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", default="")
    parser.add_argument("--spoilt", action="store_true", help="episodes that must be refused")
    given = parser.parse_args()
    rooms = range(given.first, given.first + given.rooms)
    headings = (
        "set, arm", "found", "refused", "wrong", "cause named", "mm", "degrees", "inside 95 %",
        "clock [ms] (worst)", "zeros [degrees] (worst), sound ones named",
        "first joint's zero (worst), determined",
        "frames named: wrong / right", "CPU s",
    )  # fmt: skip
    rows = _rows(given.data, SPOILT if given.spoilt else SETS, rooms, given.only)
    print_table("Cameras from pictures alone", headings, rows)


if __name__ == "__main__":
    main()
