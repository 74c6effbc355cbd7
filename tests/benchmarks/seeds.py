"""Benchmark of what judge, registration, search, tracker and filter claim: scatter over seeds.

Run as ``python -m tests.benchmarks.seeds [NUMBER of seeds [FIRST]]``. Each sample draws its bodies,
poses, cameras and noise from a seed; ``test_seeds.py`` takes one of each.
"""

import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from drake_pose.arrays import Array
from drake_pose.body import load_model
from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.models import PinholeCamera, look_at
from drake_pose.errors import RegistrationError
from drake_pose.filtering.contour_tracker import Tracker, TrackerState
from drake_pose.filtering.truncated_filter import FilterSettings
from drake_pose.fit.judge import paired_evidence
from drake_pose.jobs.registration.register import register_scene
from drake_pose.papers.kameda import continuous_figures, experiment_tree, run_experiment
from drake_pose.search import MultiStartSearch, View
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.benchmarks import filters
from tests.benchmarks.coverage import swinging
from tests.benchmarks.episodes import LEAST
from tests.benchmarks.registration import CameraError, draw_arm, load_arm, write_box_arm
from tests.benchmarks.tables import print_table
from tests.jobs.scenes import edit_camera, write_joints
from tests.written_files import write_mask

Figures = dict[str, float]
Sample = Callable[[int], Figures]


def judge(seed: int) -> Figures:
    """60 times 60 frames and rows, correlated in time: unrelated, or the same with noise."""
    rng, passed = np.random.default_rng([21, seed]), []

    def process(correlation: float) -> Array:
        rows = rng.normal(size=(60, 5))
        for k in range(1, 60):
            rows[k] = correlation * rows[k - 1] + np.sqrt(1.0 - correlation**2) * rows[k]
        return rows

    for k in range(60):
        rows, frames = (process((0.0, 0.8, 0.95)[k % 3]) for _ in range(2))
        noisy = rows + 0.7 * rng.normal(size=rows.shape)
        gains = (30.0 - ((one[:, None] - rows) ** 2).sum(axis=2) for one in (frames, noisy))
        passed.append([paired_evidence(one, rows, draws=1000).holds for one in gains])
    unrelated, own = np.mean(passed, axis=0)
    return {"unrelated accepted": unrelated, "own refused": 1.0 - own}


def registration(seed: int) -> Figures:
    """`register` with 8 masks of an arm by 3 cameras: as they are, mirrored, wrong rows."""
    wrong, refused = 0, 0
    with tempfile.TemporaryDirectory() as text:
        arm = load_arm(model := write_box_arm(Path(text) / "arm.urdf"))
        for k, fault in enumerate(("mirrored", "next row", "other rows")):
            rng = np.random.default_rng([22, seed, k])
            camera, frames = draw_arm(arm, 8, rng)
            for name in ("", fault):
                scene = Path(text) / f"{k} {name}"
                (masks := scene / "masks" / camera.name).mkdir(parents=True)
                save_cameras(scene / "cameras.yaml", [camera])
                edit_camera(scene / "cameras.yaml", camera.name, X_WC=None)
                rows = draw_arm(arm, 8, rng)[1] if name == "other rows" else frames
                values = np.roll([one.values for one in rows], name == "next row", axis=0)
                table = dict(zip((one.name for one in frames), values, strict=True))
                write_joints(scene / "joint_angles.csv", arm.kinematics.names, table)
                for one in frames:
                    step = -1 if name == "mirrored" else 1
                    write_mask(masks / f"{one.name}.png", one.mask[:, ::step])
                try:
                    found = register_scene(scene, model).registered[camera.name]
                except RegistrationError:
                    refused += not name
                else:
                    wrong += CameraError.of(found, camera.X_WC).probable < LEAST
    return {"accepted and wrong": wrong / 6, "right refused": refused / 3}


def search(seed: int) -> Figures:
    """Kameda's woman at 4 random poses, one exact silhouette each."""
    whole = MultiStartSearch(experiment_tree(), exact_masks=True)
    found = continuous_figures(run_experiment(whole, 4, seed))
    held, E_total = found["interval_coverage"], found["median_e_total"]
    return {"determined, outside": 1.0 - held, "E_total, median": E_total}


def tracker(seed: int) -> Figures:
    """Four arms before one camera, in 12 frames, of which 5 hide a half: left or right."""
    late, beyond = list[bool](), list[bool]()
    with tempfile.TemporaryDirectory() as text:
        model = load_model(write_box_arm(Path(text) / "arm.urdf"), check=False)
    tree, lower, upper = model.pose_tree(), 0.6 * model.lower, 0.6 * model.upper
    finder, moving = MultiStartSearch(tree), np.arange(len(lower))
    for k in range(4):
        rng = np.random.default_rng([24, seed, k])
        turn, rise = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.1, 0.6)
        eye = 2.2 * np.array([np.cos(turn), np.sin(turn), rise]) + [0.0, 0.0, 0.4]
        X_WC = look_at(eye, [0.0, 0.0, 0.45])
        camera = PinholeCamera("camera", 320, 240, 260.0, 260.0, 159.5, 119.5, X_WC)
        renderer, state = LabelRenderer(model, camera), TrackerState()
        follower = Tracker(tree, [camera], 1.0 / 30.0, search=finder)
        left = rng.random() < 0.5
        for frame, q in enumerate(swinging(lower, upper, 12, rng)):
            mask = renderer.mask(q).copy()
            if frame < 5:
                middle = int(np.median(np.nonzero(mask)[1]))
                mask[:, slice(None, middle) if left else slice(middle, None)] = False
            state, _ = follower.update(state, [View(camera, mask)])
            if (belief := state.belief) is not None:
                off = np.abs(belief.mean - follower.observation.state(q))[moving]
                beyond += [*(off > 3.0 * belief.deviations()[moving])]
            if frame == 6:  # The second in which it is whole.
                late.append(belief is None or bool(np.median(off) > np.radians(5.0)))
    return {"not found again": float(np.mean(late)), "beyond 3 sd": float(np.mean(beyond))}


def own_filter(seed: int) -> Figures:
    """The filter's defaults on 8 arms of `tests.benchmarks.filters`, elbow and tip seen."""
    arms, seen = range(8 * seed, 8 * seed + 8), filters.OBSERVED["elbow, tip"]
    return {"NEES": filters.measure(filters.ours(FilterSettings()), seen, arms)[2]}


SAMPLES: tuple[Sample, ...] = (judge, registration, search, tracker, own_filter)


def rows(seeds: range) -> Iterator[tuple[str, ...]]:
    """Yield for each figure its mean, standard deviation and extremes over seeds."""
    for sample in SAMPLES:
        begin = time.process_time()
        found = [sample(seed) for seed in seeds]
        seconds = (time.process_time() - begin) / len(seeds)
        for figure in found[0]:
            one = np.array([each[figure] for each in found])
            numbers = (one.mean(), one.std(ddof=1), one.min(), one.max())
            name = f"{sample.__name__}: {figure}"
            yield name, *(f"{number:.4f}" for number in numbers), f"{seconds:.0f}"


if __name__ == "__main__":
    count, first = (int(word) for word in [*sys.argv[1:], *["2", "0"][len(sys.argv) - 1 :]])
    headings = ("figure", "mean", "sd of a sample", "least", "most", "CPU s a sample")
    print_table(
        f"Seeds {first} to {first + count - 1}", headings, rows(range(first, first + count))
    )
