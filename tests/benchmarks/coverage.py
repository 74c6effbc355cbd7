"""Benchmark of intervals: the fraction that covers the truth, and their widths.

Run as ``python -m tests.benchmarks.coverage DATA [--draws N] [--only TEXT]``; DATA is a folder
with ``franka_one_view/panda`` (Drake renders sequences of this arm) and ``arm_two_views``. A frame
is wrong without warning if a true joint position lies more than 10 degrees, or 5 cm, outside its
interval.
"""

import argparse
import csv
import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from drake_pose.arrays import Array, Mask
from drake_pose.body import ArticulatedModel, bundled_model, load_model
from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.models import PinholeCamera, circle_of_cameras
from drake_pose.files.settings import EstimateSettings
from drake_pose.input_files import csv_text
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.benchmarks.tables import print_table
from tests.registration.arm_pictures import with_holes
from tests.written_files import write_mask

Damage = Callable[[Mask, np.random.Generator, int], Mask]
"""Function of a mask, random numbers and the frame's number."""

_FRAMES, _RATE_HZ, _FASTEST = 24, 30.0, 2.0
_WRONG_DEGREES, _WRONG_METRES = 10.0, 0.05
_PANDA, _LBR = "franka_one_view/panda/panda.urdf", "arm_two_views"
# Image shift caused by the orientation error of cameras [pixel].
_CAMERAS_OFF = 1.4


class CoverageSet(NamedTuple):
    """Scenes of one kind."""

    name: str
    model: Path
    make: Callable[[Path, int], Path]  # Renders the n-th scene, or returns an existing one.
    joints: tuple[str, ...]  # Prefixes of the names of evaluated joints.
    settings: EstimateSettings = EstimateSettings()
    draws: int | None = None  # Maximum number of scenes; None: as given on the command line.


class Evaluation(NamedTuple):
    """Per joint and frame: inside, determined, width [deg or m]; and the number of wrong frames."""

    inside: Array
    determined: Array
    width: Array
    angles: NDArray[np.bool_]
    wrong: int


def coverage_sets(data: Path) -> Iterator[CoverageSet]:
    """Yield the sets of scenes."""
    person = bundled_model("person")
    for name, damage in _damages():
        yield CoverageSet(
            f"person, sequence, four views, {name}", person, _draw_person(damage), ("",), draws=1
        )
    panda, moving = data / _PANDA, EstimateSettings()
    stills = EstimateSettings(track=False, frames=("0000:0005",))
    arms = [(f"sequence, {name}", _draw_arm(panda, one), "panda_joint", moving)
            for name, one in _damages()]  # fmt: skip
    off = f"sequence, cameras {_CAMERAS_OFF} px off"
    arms += [
        (off, _draw_arm(panda, cameras_off=_CAMERAS_OFF), "panda_", moving),
        ("sequence by colour", _draw_arm(panda, colours=True), "panda_joint", moving),
        ("sequence, half hidden for 8 frames", _draw_arm(panda, _half_hidden), "panda_", moving),
        ("stills, edges 1.5 px off", _draw_arm(panda, _with_ragged_edges), "panda_", stills),
        ("stills, one view, exact masks", _draw_arm(panda, views=1), "panda_", stills),
    ]
    for name, make, joints, settings in arms:
        yield CoverageSet(f"arm, {name}", panda, make, (joints,), settings)
    arm = data / _LBR
    model = arm / "med7" / "med7.urdf"
    yield CoverageSet("real arm, stills", model, lambda _, k: arm, ("A",), draws=1)


def _damages() -> Iterator[tuple[str, Damage]]:
    yield "exact masks", lambda mask, rng, k: mask
    yield "edges 1.5 px off", _with_ragged_edges
    yield "masks a pixel too wide", lambda mask, rng, k: _dilated(mask)
    yield "holes", lambda mask, rng, k: with_holes(mask, rng)


def _with_ragged_edges(mask: Mask, rng: np.random.Generator, k: int) -> Mask:
    """Return a mask with an edge noise of 1.5 pixels, correlated over eight pixels."""
    noise = cv2.GaussianBlur(rng.normal(size=mask.shape), (0, 0), 8.0)
    inside = cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5)
    outside = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    return inside - outside + 1.5 * noise / noise.std() > 0.0


def _dilated(mask: Mask) -> Mask:
    return cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(np.bool_)


def swinging(
    lower: Array, upper: Array, frames: int, rng: np.random.Generator, fastest: float = _FASTEST
) -> Array:
    """Return (frames, n) positions that oscillate inside limits, at full speed from the start.

    fastest: maximum velocity of a joint [rad/s or m/s].
    """
    middle, reach = 0.5 * (lower + upper), 0.4 * (upper - lower)
    amplitude = reach * rng.uniform(0.3, 1.0, len(lower))
    rate = fastest * rng.uniform(0.3, 1.0, len(lower)) / amplitude
    phase = rng.uniform(-0.5, 0.5, len(lower))
    t = np.arange(frames)[:, None] / _RATE_HZ
    centre = middle + (reach - amplitude) * rng.uniform(-1.0, 1.0, len(lower))
    return np.asarray(centre + amplitude * np.sin(phase + rate * t))


def _half_hidden(mask: Mask, rng: np.random.Generator, k: int) -> Mask:
    """Return a mask without its left half in frames 8 to 15."""
    rest = mask.copy()
    if 8 <= k < 16:
        rest[:, : int(np.median(np.nonzero(mask)[1])) + 1] = False
    return rest


def _draw_arm(
    path: Path,
    damage: Damage | None = None,
    cameras_off: float = 0.0,
    colours: bool = False,
    views: int = 2,
) -> Callable[[Path, int], Path]:
    """Return a function that renders an oscillating arm for one camera, or two 75 degrees apart."""

    def make(folder: Path, draw: int) -> Path:
        rng = np.random.default_rng([5, draw])
        model = load_model(path, check=False)
        around = circle_of_cameras(
            5, radius=1.7, height=0.8, target=(0.0, 0.0, 0.4), face_camera=False
        )
        cameras = dict(list(around.items())[:views])
        moving = np.array([name.startswith("panda_joint") for name in model.position_names])
        moving &= model.upper - model.lower > 0.1
        q = np.tile(model.default_positions, (_FRAMES, 1))
        limits = model.lower[moving], model.upper[moving]
        q[:, moving] = swinging(*limits, _FRAMES, rng)
        return draw_scene(folder, model, cameras, q, rng, damage, cameras_off, colours)

    return make


def _draw_person(damage: Damage) -> Callable[[Path, int], Path]:
    """Return a function that renders a person swinging arms and legs, for four cameras."""

    def make(folder: Path, draw: int) -> Path:
        rng = np.random.default_rng([6, draw])
        model = load_model(bundled_model("person"), check=False)
        cameras = circle_of_cameras(4, size=(480, 360), face_camera=False)
        names = model.position_names
        lower, upper = np.maximum(model.lower, -0.5), np.minimum(model.upper, 0.5)
        placed = np.array([name.startswith("position_") for name in names])
        swung = ~placed & (lower < upper)
        q = np.tile(model.default_positions, (_FRAMES, 1))
        q[:, swung] = swinging(lower[swung], upper[swung], _FRAMES, rng, 1.5)
        q[:, model.position_index("position_z")] = 1.55
        return draw_scene(folder, model, cameras, q, rng, damage)

    return make


def draw_scene(
    folder: Path, model: ArticulatedModel, cameras: Mapping[str, PinholeCamera], q: Array,
    rng: np.random.Generator, damage: Damage | None = None, cameras_off: float = 0.0,
    colours: bool = False,
) -> Path:  # fmt: skip
    """Write a scene of masks by Drake's renderer, optionally of images, and joint_angles.csv."""
    folder.mkdir(parents=True)
    saved_cameras = {
        name: _with_orientation_error(camera, cameras_off, rng) for name, camera in cameras.items()
    }
    save_cameras(folder / "cameras.yaml", saved_cameras)
    (folder / "scene.yaml").write_text(f"sequence: true\nframe_rate_hz: {_RATE_HZ:.0f}\n")
    rows = [["frame", *model.position_names], *([k, *row] for k, row in enumerate(q))]
    (folder / "joint_angles.csv").write_text(csv_text(rows))
    for name, camera in cameras.items():
        renderer = LabelRenderer(model, camera)
        room = cv2.resize(
            rng.integers(0, 255, (24, 32, 3), np.uint8), (camera.width, camera.height)
        )
        paint = rng.integers(0, 255, (len(renderer.link_names) + 1, 3))
        for kind in ("masks", *(["images"] if colours else [])):
            (folder / kind / name).mkdir(parents=True)
        for k, positions in enumerate(q):
            segments = renderer.segments(positions)
            mask = segments >= 0
            if not colours or k == 0:
                seen = mask if damage is None else damage(mask, rng, k)
                write_mask(folder / "masks" / name / f"{k:04d}.png", seen)
            if colours:
                picture = np.where(mask[..., None], paint[segments], room)
                picture = picture + rng.normal(0.0, 5.0, picture.shape)
                file = folder / "images" / name / f"{k:04d}.png"
                cv2.imwrite(str(file), np.clip(picture, 0, 255).astype(np.uint8))
    return folder


def _with_orientation_error(
    camera: PinholeCamera, pixels: float, rng: np.random.Generator
) -> PinholeCamera:
    """Return a camera with an orientation error that shifts its image by about ``pixels``."""
    if pixels == 0.0:
        return camera
    by = rng.normal(size=3) * pixels / camera.focal_x
    X_WC = camera.X_WC.copy()
    X_WC[:3, :3] = X_WC[:3, :3] @ cv2.Rodrigues(by)[0]
    return replace(camera, X_WC=X_WC)


def evaluate_result(out: Path, scene: Path, joints: Sequence[str]) -> Evaluation:
    """Return the intervals in a result's files, compared with the scene's truth."""
    truth = true_positions(scene)
    frames = json.loads((out / "summary.json").read_text())["frames"]
    lost = {name for name, one in frames.items() if not one["found"]}
    inside, determined, width, angles, wrong = [], [], [], [], set()
    for row in _rows(out / "joints.csv"):
        true = truth[int(row["frame"])].get(row["joint"])
        if true is None or not row["joint"].startswith(tuple(joints)) or row["frame"] in lost:
            continue
        is_angle = "position_" not in row["joint"] and "finger" not in row["joint"][:12]
        value = np.degrees(true) if is_angle else true
        low, high = float(row["low"]), float(row["high"])
        inside.append(low <= value <= high)
        determined.append(row["determined"] == "yes")
        width.append(high - low)
        angles.append(is_angle)
        off = max(low - value, value - high)
        if off > (_WRONG_DEGREES if is_angle else _WRONG_METRES):
            wrong.add(row["frame"])
    arrays = (np.array(one) for one in (inside, determined, width, angles))
    return Evaluation(*arrays, len(wrong))


def true_positions(scene: Path) -> dict[int, dict[str, float]]:
    """Return the true joint positions of a scene by frame number."""
    rows = [{k: float(v) for k, v in row.items()} for row in _rows(scene / "joint_angles.csv")]
    return {int(row.pop("frame")): row for row in rows}


def _rows(path: Path) -> Iterator[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        yield from csv.DictReader(file)


def measure(one: CoverageSet, draws: int, folder: Path) -> list[Evaluation]:
    """Return the evaluation of each scene of a set."""
    results = []
    for draw in range(one.draws or draws):
        place = folder / f"{one.name} {draw}".replace("/", " ")
        scene, out = one.make(place / "scene", draw), place / "out"
        estimate_scene(scene, one.model, out, one.settings, replay=False, overlay=False)
        results.append(evaluate_result(out, scene, one.joints))
    return results


def _table(sets: Iterator[CoverageSet], draws: int, folder: Path) -> Iterator[tuple[str, ...]]:
    for one in sets:
        results = measure(one, draws, folder)
        inside, determined, width, angles = (
            np.concatenate([getattr(part, name) for part in results])
            for name in Evaluation._fields[:4]
        )
        half = 0.5 * np.median(width[angles]) if angles.any() else np.nan
        sure = 0.5 * np.median(width[angles & determined]) if (angles & determined).any() else 0.0
        yield (
            one.name,
            str(len(inside)),
            f"{inside.mean():.1%}",
            f"{determined.mean():.0%}",
            f"{inside[determined].mean():.1%}" if determined.any() else "",
            f"{half:.2f} ({sure:.2f})",
            str(sum(part.wrong for part in results)),
        )


def main() -> None:
    """Print the coverage of intervals."""
    parser = argparse.ArgumentParser(description="Whether intervals hold, and how wide they are.")
    parser.add_argument("data", type=Path, help="a folder of recorded scenes")
    parser.add_argument("--draws", type=int, default=2, help="scenes drawn for each set")
    parser.add_argument("--only", default="", help="sets whose name holds this text")
    asked = parser.parse_args()
    headings = (
        *("set", "truths", "inside 95 %", "determined", "of these inside"),
        *("half width, median (determined) [deg]", "wrong frames, not said"),
    )
    sets = (one for one in coverage_sets(asked.data) if asked.only in one.name)
    with tempfile.TemporaryDirectory() as folder:
        rows = _table(sets, asked.draws, Path(folder))
        print_table("Intervals that a user reads", headings, rows)


if __name__ == "__main__":
    main()
