"""Benchmark of whole estimates: CPU time a frame, as label images of the same process, and errors.

Run as ``python -m tests.benchmarks.estimates [DATA]``; DATA is a folder with the scenes
``arm_two_views``, ``human_four_views``, ``hand_photos`` and ``hand_sequences``. Rows whose scene is
not there are left out; the demonstration's always is.
"""

from __future__ import annotations

import csv
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.files.records import PoseRow
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.demo import demo_scene, demo_settings
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.papers.kameda import continuous_search, run_experiment
from drake_pose.papers.kameda_figures import continuous_figures
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.pictures.masks import write_mask
from drake_pose.silhouette.pictures.scenes import load_scene
from tests.benchmarks.scenes import print_table
from tests.benchmarks.speed import measure_kernel

_SEQUENCE_FRAMES = 24
_RATE_HZ = 30.0
_IMAGES = 20
_ARM_JOINTS = ("A1", "A2", "A3", "A4")


class Work(NamedTuple):
    """One row: an estimate of a scene with a model. So many frames are not counted, as the search
    is asked in them; the errors of some joints are told, by joint_angles.csv beside the scene.
    """

    name: str
    scene: Path
    model: Path
    settings: EstimateSettings = EstimateSettings()
    uncounted: int = 0
    joints: tuple[str, ...] = ()


def works(data: Path | None, folder: Path) -> Iterator[Work]:
    """The rows whose scenes are there; what is drawn goes to a folder."""
    yield Work(
        "demo: man, one view", demo_scene(), bundled_model("man"), demo_settings(demo_scene())
    )
    if data is None:
        return
    arm, human = data / "arm_two_views", data / "human_four_views"
    if arm.is_dir():
        model = arm / "med7" / "med7.urdf"
        yield Work("arm, two views, one pose", arm, model, joints=_ARM_JOINTS)
        drawn = draw_arm_sequence(arm, folder / "arm_sequence")
        yield Work("arm, two views, sequence", drawn, model, uncounted=2, joints=_ARM_JOINTS)
    if human.is_dir():
        settings = EstimateSettings(
            frames=("0010", "0011"),
            root="right_foot",
            root_position=(human / "joint_centres.csv", "right_ankle"),
            root_rotation={"y": (-180.0, 180.0), "x": (-20.0, 20.0), "z": (-20.0, 20.0)},
            track=False,
        )
        yield Work("man, four views, one frame", human, bundled_model("man"), settings)
    if (data / "hand_photos").is_dir():
        yield Work("hand photograph", data / "hand_photos", bundled_model("hand"))
    sequence = data / "hand_sequences" / "count"
    if sequence.is_dir():
        right = bundled_model("hand").with_name("right_hand.urdf")
        frames = EstimateSettings(frames=(f"0000:{_SEQUENCE_FRAMES - 1:04d}",))
        yield Work("hand, sequence, no camera known", sequence, right, frames, uncounted=1)


def draw_arm_sequence(arm: Path, out: Path, frames: int = _SEQUENCE_FRAMES) -> Path:
    """A scene of the recorded arm on its way from its first pose to its second, drawn by Drake."""
    model, scene = load_model(arm / "med7" / "med7.urdf", check=False), load_scene(arm)
    with (arm / "joint_angles.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.reader(file))
    names, poses = rows[0][1:], np.array(rows[1:3], dtype=np.float64)[:, 1:]
    share = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, frames))
    path = poses[0] + share[:, None] * (poses[1] - poses[0])
    out.mkdir()
    (out / "cameras.yaml").write_bytes((arm / "cameras.yaml").read_bytes())
    (out / "scene.yaml").write_text(f"sequence: true\nframe_rate_hz: {_RATE_HZ:.0f}\n")
    index = [model.position_index(name) for name in names]
    renderers = {name: LabelRenderer(model, camera) for name, camera in scene.cameras.items()}
    with (out / "joint_angles.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["frame", *names])
        for k, values in enumerate(path):
            writer.writerow([k, *values])
            q = np.array(model.default_positions)
            q[index] = values
            for name, renderer in renderers.items():
                (out / "masks" / name).mkdir(parents=True, exist_ok=True)
                write_mask(out / "masks" / name / f"{k:04d}.png", renderer.mask(q))
    return out


def measure(work: Work) -> tuple[float, float, str]:
    """CPU seconds a frame, E_total in the mean, and the error in words; the first run warms up."""
    ends: list[float] = []

    def note(*_: object) -> None:
        ends.append(time.process_time())

    for _ in range(2 if work.uncounted == 0 else 1):
        ends.clear()
        found = estimate_scene(work.scene, work.model, None, work.settings, on_frame=note)
    seconds = np.diff(ends)[work.uncounted :]
    rows = found.rows[work.uncounted :]
    E_total = float(np.mean([row.error for row in rows]))
    return float(np.median(seconds)), E_total, _error(work, rows, found.position_names)


def _error(work: Work, rows: tuple[PoseRow, ...], names: tuple[str, ...]) -> str:
    """The joints' errors where they are known."""
    if not work.joints:
        return ""
    with (work.scene / "joint_angles.csv").open(encoding="utf-8", newline="") as file:
        truth = {int(row["frame"]): row for row in csv.DictReader(file)}
    off = [
        abs(row.q[names.index(joint)] - float(truth[int(row.frame)][joint]))
        for row in rows
        for joint in work.joints
    ]
    # A flip of the chain looks the same: what is off by more is one.
    near = np.degrees([one for one in off if one < 0.5])
    return f"{work.joints[0]} to {work.joints[-1]}: {np.median(near):.2f} deg in the median"


def _rows(data: Path | None, folder: Path) -> Iterator[tuple[str, ...]]:
    label_image = measure_kernel().label_image_microseconds * 1e-6
    for work in works(data, folder):
        seconds, E_total, error = measure(work)
        yield work.name, f"{seconds:.3f} s", f"{seconds / label_image:.0f}", f"{E_total:.2%}", error
    plain = continuous_figures(run_experiment(continuous_search(), _IMAGES, seed=1))
    seconds = plain["median_seconds"] + plain["mean_interval_seconds"]
    yield (
        "continuous angles, one view, exact masks",
        f"{seconds:.3f} s",
        f"{seconds / label_image:.0f}",
        f"{plain['median_e_total']:.2%}",
        f"intervals hold {plain['interval_coverage']:.0%}, {plain['determined']:.0%} determined",
    )


def main() -> None:
    """Print what estimates cost and reach here."""
    data = Path(sys.argv[1]) if len(sys.argv) > 1 else None
    with tempfile.TemporaryDirectory() as folder:
        headings = ("work", "a frame", "label images", "E_total", "error")
        title = "Estimates: CPU time a frame, one core"
        print_table(title, headings, _rows(data, Path(folder)))


if __name__ == "__main__":
    main()
