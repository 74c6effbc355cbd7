"""Benchmarks of ratios measured in one process (`make bench`)."""

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from drake_pose.body import TriangleMesh, bundled_model, load_model
from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.models import ParallelCamera, PinholeCamera
from drake_pose.papers.date import SilhouetteTrack, Studio, one_core
from drake_pose.papers.kameda import experiment_camera
from drake_pose.person.date.walking import FEWEST_FRAMES, make_motion
from drake_pose.registration.picture_registration import register_pictures
from drake_pose.registration.recording import Recording
from drake_pose.silhouette.outline import outline_from_mesh
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.scoring import prefix_sums, score_bodies
from drake_pose.silhouette.segmentation import person_region
from drake_pose.systems.cameras import picture_to_colour_image
from drake_pose.workers import use_workers
from tests.benchmarks.tables import print_table
from tests.registration.episodes import painted_episode
from tests.silhouette.agreement import measure_agreement
from tests.written_files import write_mask

# Kameda's scale of 2.26 pixels per centimetre, and a limb of his body.
_SIDE, _SCALE = 700, 226.0
_RADIUS, _LENGTH = 0.088, 0.44
_CANDIDATES, _IMAGES = 1000, 30
_CAMERAS, _FRAMES = (4, 8, 16), 12


class KernelFigures(NamedTuple):
    """Times for one segment."""

    triangles: int
    kernel_microseconds: float  # To score one candidate against two sets.
    label_image_microseconds: float  # Of one Drake label image.


def measure_kernel(columns: int = 14, rows: int = 16, seed: int = 0) -> KernelFigures:
    """Time the span kernel against Drake label images of the same limb in the same poses.

    The limb measures 44 cm by 17.6 cm, in an image of 700 x 700 pixels at Kameda's scale (100 x 40
    pixels); 14 x 16 give 420 triangles, 72 x 71 give 10,080.
    """
    limb = limb_mesh(columns, rows)
    camera = ParallelCamera("benchmark", _SIDE, _SIDE, _SCALE, 0.5 * _SIDE, 0.5 * _SIDE, np.eye(4))
    rng = np.random.default_rng(seed)
    X_CN = np.tile(np.eye(4), (_CANDIDATES, 1, 1))
    X_CN[:, :3, :3] = Rotation.random(_CANDIDATES, random_state=rng).as_matrix()
    X_CN[:, :3, 3] = rng.uniform(-1.0, 1.0, (_CANDIDATES, 3))
    prefixes = np.array([prefix_sums(rng.random((_SIDE, _SIDE)) < 0.5) for _ in range(2)])
    outline = outline_from_mesh(TriangleMesh(limb.vertices, limb.faces.astype(np.int32)))
    kernel = fastest(lambda: score_bodies([outline], X_CN[:, None], camera, prefixes), 20)
    with tempfile.TemporaryDirectory() as folder:
        path = write_limb(Path(folder), limb).with_name("limb.urdf")
        path.write_text(
            '<robot name="limb"><link name="limb"><visual><geometry><mesh filename="limb.obj"/>'
            "</geometry></visual></link></robot>"
        )
        renderer = LabelRenderer(load_model(path, check=False), camera)
    q = np.array([1.0, *[0.0] * 6])
    images = fastest(lambda: [renderer.mask(q, X) for X in X_CN[:_IMAGES]], 3)
    return KernelFigures(len(limb.faces), kernel / _CANDIDATES * 1e6, images / _IMAGES * 1e6)


def limb_mesh(columns: int, rows: int) -> trimesh.Trimesh:
    """Return a closed ellipsoid of 2 columns (rows - 1) triangles."""
    polar = np.pi * np.arange(rows + 1) / rows
    profile = np.column_stack([_RADIUS * np.sin(polar), -0.5 * _LENGTH * np.cos(polar)])
    return trimesh.creation.revolve(profile, sections=columns)


def write_limb(folder: Path, limb: trimesh.Trimesh) -> Path:
    """Write a limb as an OBJ file with normals, which Drake's VTK engine requires."""
    path = folder / "limb.obj"
    limb.export(path, include_normals=True)
    return path


def fastest(function: Callable[[], object], repeats: int) -> float:
    """Return the minimum CPU time of a call [s], after one call to warm up."""
    function()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return min(times)


def measure_cost(cameras: int, size: tuple[int, int] = (640, 480), seed: int = 0) -> np.ndarray:
    """Return the median CPU times (2,) of region and edge, and of the pose, per frame [ms].

    A person walks in front of the cameras (including the face camera), from a known initial pose.
    """
    studio = Studio.build(cameras, size, np.random.default_rng([seed, 1]))
    motion = make_motion(studio.skeleton, 4 * FEWEST_FRAMES, seed)
    begin = motion.names.index("walk")
    track = SilhouetteTrack(studio)
    track.place(motion.q[begin])
    with one_core():
        for q in motion.q[begin : begin + _FRAMES]:
            shots = studio.pictures(q)
            track.step({name: picture_to_colour_image(one) for name, one in shots.items()})
    laps = [(lap["region"] + lap["edge"], lap["pose"]) for lap in track.milliseconds]
    return np.asarray(np.median(laps, axis=0))


def measure_pictures(size: tuple[int, int] = (640, 480), frames: int = 30) -> tuple[float, ...]:
    """Return CPU times of a registration from pictures and of a Drake label image [s].

    Returns:
        the registration on one core; the label image, of the same arm with the same camera; and
        the duration on two idle cores, if both share all work of threads other than the main one.
    """
    with tempfile.TemporaryDirectory() as folder:
        episode = painted_episode(Path(folder), frames, size, every=0.2)
    recording = Recording(
        tuple(f"{k:04d}" for k in range(frames)),
        lambda offset: episode.values_at(episode.times + offset),
        episode.pictures.__getitem__,
        episode.times,
    )
    body, camera = episode.body, episode.camera.with_pose(np.eye(4))

    def register(workers: int) -> None:
        with use_workers(workers):
            register_pictures(body, camera, recording)

    alone = fastest(lambda: register(1), 1)
    start, own = time.process_time(), time.thread_time()
    register(2)
    seconds, own = time.process_time() - start, time.thread_time() - own
    renderer = LabelRenderer(episode.model, episode.camera)
    positions = body.tree.positions_from(body.kinematics.split(episode.values[0]))
    image = fastest(lambda: renderer.segments(*positions), 10)
    return alone, image, own + 0.5 * (seconds - own)


def record_person(folder: Path, frames: int, cameras: int) -> None:
    """Write a person's motion as a scene of masks in a new folder."""
    studio = Studio.build(cameras, (640, 480), np.random.default_rng([5, 1]))
    folder.mkdir()
    save_cameras(folder / "cameras.yaml", studio.cameras)
    (folder / "scene.yaml").write_text("sequence: true")
    motion = make_motion(studio.skeleton, 4 * FEWEST_FRAMES, 5)
    for k, q in enumerate(motion.q[:frames]):
        for name, picture in studio.pictures(q).items():
            path = folder / "masks" / name / f"{k:04d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            write_mask(path, person_region(picture, studio.backgrounds[name]))


def measure_capture(scene: Path, overlay: bool, frames: int) -> tuple[float, float]:
    """Return the CPU time of capturing a recording [s], and that of a further frame of it.

    They are those of whole processes, start-up, search and report included. The second is from the
    recording and one of twice as many frames.

    scene: the recording of 2 x `frames` frames.
    """

    def capture(count: int) -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        with tempfile.TemporaryDirectory() as folder:
            subprocess.run(
                [sys.executable, "-m", "drake_pose.commands.main", "capture", str(scene),
                 "--out", f"{folder}/out", "--frame", f"0000:{count - 1:04d}",
                 "--overlay" if overlay else "--no-overlay"],
                check=True, stdout=subprocess.DEVNULL,
                env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
            )  # fmt: skip
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    capture(2)
    once, twice = capture(frames), capture(2 * frames)
    return once, (twice - once) / frames


def _kernel_rows() -> Iterator[tuple[str, ...]]:
    for columns, rows in ((14, 16), (72, 71)):
        triangles, kernel, image = measure_kernel(columns, rows)
        yield str(triangles), f"{kernel:.1f} us", f"{image:.0f} us", f"{image / kernel:.0f}"


def _agreement_rows() -> Iterator[tuple[str, ...]]:
    """Compare the span kernel with label images, in 200 random poses of each bundled body."""
    parallel = experiment_camera()
    centre = parallel.center_x, parallel.center_y
    pinhole = PinholeCamera("front", _SIDE, _SIDE, 1130.0, 1130.0, *centre, parallel.X_WC)
    held = dict.fromkeys(("position_x", "position_y", "position_z"), 0.0)
    for name in ("woman", "man"):
        model = load_model(bundled_model(name))
        for projection, camera in (("parallel", parallel), ("pinhole", pinhole)):
            worst, mean, _ = measure_agreement(model, camera, held=held)
            yield name, projection, f"{worst:.3%}", f"{mean:.4%}"


def _cost_rows() -> Iterator[tuple[str, ...]]:
    for cameras in _CAMERAS:
        seen, pose = measure_cost(cameras)
        costs = (seen, pose, seen + pose, (seen + pose) / cameras)
        yield str(cameras), *(f"{cost:.1f}" for cost in costs)


def _picture_rows() -> Iterator[tuple[str, ...]]:
    alone, image, shared = measure_pictures()
    yield f"{alone:.1f} s", f"{1e3 * image:.1f} ms", f"{alone / image:.0f}", f"{shared / alone:.2f}"


def _capture_rows(frames: int = 60, cameras: int = 9) -> Iterator[tuple[str, ...]]:
    with tempfile.TemporaryDirectory() as folder:
        record_person(Path(folder) / "scene", 2 * frames, cameras)
        for overlay in (False, True):
            whole, further = measure_capture(Path(folder) / "scene", overlay, frames)
            name = "masks, overlays" if overlay else "masks"
            numbers = 1e3 * whole / frames, 1e3 * further
            yield name, *(f"{one:.0f}" for one in numbers), f"{whole - frames * further:.1f} s"


def main() -> None:
    """Print times of the kernel, of registration and capture, and the agreement with Drake."""
    headings: tuple[str, ...] = ("triangles", "kernel, a candidate", "Drake label image", "ratio")
    print_table("One segment, 700 x 700 pixels, one core", headings, _kernel_rows())
    title = "XOR of the kernel's masks and Drake's, 200 random poses"
    print_table(title, ("body", "projection", "worst", "mean"), _agreement_rows())
    headings = ("one core", "Drake label image", "ratio", "two idle cores over one")
    title = "Registration from 30 pictures of a simulated arm, 640 x 480"
    print_table(title, headings, _picture_rows())
    headings = ("cameras", "region and edge", "pose", "all", "a camera")
    title = "Date, all silhouettes, 640 x 480, one core: milliseconds a frame"
    print_table(title, headings, _cost_rows())
    title = "Capture of 60 recorded frames, nine views, 640 x 480: CPU time of the process"
    headings = ("recorded", "milliseconds a frame", "a further frame", "start, search and report")
    print_table(title, headings, _capture_rows())


if __name__ == "__main__":
    main()
