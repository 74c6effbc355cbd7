"""Benchmark of the workers: ratios of one run, and what more cameras or frames would need.

Run as ``python -m tests.benchmarks.cluster``. A batch of stills and a live capture of a
simulated person are done by this process, one worker and two; bytes are counted, milliseconds are
the processor's own, so that a busy machine changes little but the frames a second.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import yaml
from rich.console import Console
from rich.table import Table

from drake_pose.body.files.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.camera.files import save_cameras
from drake_pose.camera.rigs import circle_of_cameras
from drake_pose.jobs.batch.batch import run_batch
from drake_pose.jobs.batch.job import SceneJob
from drake_pose.jobs.batch.workers import ClusterPool
from drake_pose.jobs.cluster.remote_views import ClusterSensors
from drake_pose.jobs.cluster.scheduler import open_cluster
from drake_pose.jobs.live.run import FrameWatch, LiveFrame, run_live
from drake_pose.jobs.live.scene import LiveScene, load_live_scene
from drake_pose.papers.kameda import experiment_camera
from drake_pose.person.date.skeleton import load_skeleton
from drake_pose.person.date.walking_motion import make_motion
from drake_pose.person.shape import tracker_of_person
from drake_pose.results.settings import EstimateSettings
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.pictures.masks import write_mask
from drake_pose.systems.person.live_capture import LiveSensors, build_live_capture
from drake_pose.systems.pictures.camera_rig import build_camera_rig

if TYPE_CHECKING:
    from distributed import Client

_STILLS, _CHUNK = 8, 2
_CAMERAS, _SIZE, _RATE_HZ = 8, (640, 480), 30.0
# How many frames of Date's motions, which take twelve seconds in all.
_FRAMES, _MOTION_FRAMES = 60, 360
_FAR_AWAY = -9.0
_GIGA = 1e9


@dataclass(frozen=True)
class BatchFigures:
    """A batch. workers: how many, 0: this process; seconds: the wall's; bytes_a_frame: on disk."""

    workers: int
    frames: int
    seconds: float
    processor_seconds: float
    bytes_a_frame: float


@dataclass(frozen=True)
class LiveFigures:
    """A live capture of a recording, as fast as can be.

    Args:
        workers: how many; 0: this process.
        cameras: how many.
        frames: how many.
        seconds: the wall's [s].
        centre_seconds: of the processor in this process, a frame in the median [s].
        view_seconds: of the workers' processors for one view [s]; nan where there are none.
        view_bytes: of one view on its way; nan where there is none.
    """

    workers: int
    cameras: int
    frames: int
    seconds: float
    centre_seconds: float
    view_seconds: float = float("nan")
    view_bytes: float = float("nan")

    @property
    def throughput(self) -> float:
        """Cameras x frames a second."""
        return self.cameras * self.frames / self.seconds


def write_stills(folder: Path, count: int = _STILLS) -> SceneJob:
    """Kameda's woman, who moves her arms before the paper's camera, and the job for that scene."""
    model_path = bundled_model("woman")
    model = load_model(model_path, check=False)
    camera = experiment_camera()
    save_cameras(folder / "cameras.yaml", [camera])
    renderer = LabelRenderer(model, camera)
    (folder / "masks" / camera.name).mkdir(parents=True)
    generator = np.random.default_rng(0)
    moves = np.array(["arm" in name for name in model.position_names])
    rest = np.where(np.array(model.position_kinds) == "angle", model.default_positions, 0.0)
    for k in range(count):
        drawn = 0.4 * generator.uniform(model.lower, model.upper)
        q = np.where(moves, np.clip(drawn, model.lower, model.upper), rest)
        write_mask(folder / "masks" / camera.name / f"{k:04d}.png", renderer.mask(q))
    hold = {
        name: float(np.degrees(value))
        for name, value, free in zip(model.position_names, rest, moves, strict=True)
        if not free
    }
    settings = EstimateSettings(interval=20.0, hold=hold, method="beam", angles="grid")
    return SceneJob("stills", folder, model_path, settings, replay=False, chunk=_CHUNK)


def write_studio(folder: Path, frames: int = _FRAMES) -> LiveScene:
    """Videos of a simulated person before eight cameras, and pictures of the empty room."""
    model = load_model(bundled_model("person"), check=False)
    poses = make_motion(load_skeleton(model), _MOTION_FRAMES, 0).q[:frames]
    cameras = circle_of_cameras(_CAMERAS, size=_SIZE, face_camera=False)
    save_cameras(folder / "cameras.yaml", list(cameras.values()))
    rig = build_camera_rig(model, cameras)
    context = rig.diagram.CreateDefaultContext()
    away = poses[0].copy()
    away[model.position_index("position_z")] = _FAR_AWAY
    rig.set_positions(context, away)
    entries = {}
    for name in cameras:
        (folder / "empty" / name).mkdir(parents=True)
        empty = cv2.cvtColor(rig.picture(context, name), cv2.COLOR_RGB2BGR)
        cv2.imwrite(str(folder / "empty" / name / "0.png"), empty)
        entries[name] = {
            "kind": "video", "location": f"{name}.avi", "background": f"empty/{name}",
        }  # fmt: skip
    (folder / "sources.yaml").write_text(yaml.safe_dump(entries), encoding="utf-8")
    code = cv2.VideoWriter.fourcc(*"MJPG")
    writers = {
        name: cv2.VideoWriter(str(folder / f"{name}.avi"), code, _RATE_HZ, _SIZE)
        for name in cameras
    }
    for q in poses:
        rig.set_positions(context, q)
        for name, writer in writers.items():
            writer.write(cv2.cvtColor(rig.picture(context, name), cv2.COLOR_RGB2BGR))
    for writer in writers.values():
        writer.release()
    return load_live_scene(folder)


def measure_batch(job: SceneJob, out: Path, workers: int, client: Client | None) -> BatchFigures:
    """Times a batch; what the workers need to start is not counted."""
    if client is not None:
        run_batch(warm_up_jobs(job, workers), out / "warm_up", ClusterPool(client))
    begin, processor = time.perf_counter(), time.process_time()
    result = run_batch([job], out / "out", None if client is None else ClusterPool(client))
    seconds, processor = time.perf_counter() - begin, time.process_time() - processor
    frames = result.scenes[job.name].frame_count
    size = sum(path.stat().st_size for path in (out / "out").rglob("*") if path.is_file())
    return BatchFigures(workers, frames, seconds, processor, size / frames)


def warm_up_jobs(job: SceneJob, count: int) -> list[SceneJob]:
    """This many jobs of one frame each: whatever is loaded or compiled once is not timed."""
    settings = replace(job.settings, frames=("0000",))
    return [replace(job, name=f"warm_up_{k}", settings=settings) for k in range(count)]


def measure_live(scene: LiveScene, workers: int, client: Client | None) -> LiveFigures:
    """Captures a recording as fast as can be."""
    sensors: LiveSensors = scene.open_sensors() if client is None else ClusterSensors(client, scene)
    tracker = tracker_of_person(load_model(bundled_model("person"), check=False).pose_tree(), None)
    diagram = build_live_capture(tracker, scene.cameras, sensors)
    times: list[tuple[float, float]] = []

    def note(_: LiveFrame) -> None:
        times.append((time.perf_counter(), time.process_time()))

    try:
        run_live(
            diagram, sensors, None, lambda _: None, monitor=FrameWatch(diagram, scene.cameras, note)
        )
    finally:
        sensors.close()
    # In the first frame the person is searched, not followed.
    walls, processors = np.diff(times, axis=0).T
    seconds, centre = float(walls.sum()), float(np.median(processors))
    figures = LiveFigures(workers, len(scene.cameras), len(walls), seconds, centre)
    if not isinstance(sensors, ClusterSensors):
        return figures
    groups = sensors.watchers.groups
    views = sum(group.views for group in groups)
    return replace(
        figures,
        view_seconds=sum(group.seconds for group in groups) / views,
        view_bytes=sum(group.view_bytes for group in groups) / views,
    )


def fewer_cameras(scene: LiveScene, count: int) -> LiveScene:
    """The first cameras of a scene."""
    names = list(scene.cameras)[:count]
    return replace(
        scene,
        cameras={name: scene.cameras[name] for name in names},
        specifications={name: scene.specifications[name] for name in names},
    )


def batch_table(found: list[BatchFigures]) -> Table:
    """Frames a second, and those of this process as the unit."""
    table = Table(title=f"Batch: {found[0].frames} stills in chunks of {_CHUNK}")
    for heading in ("who", "frames a second", "ratio"):
        table.add_column(heading, justify="right")
    for one in found:
        ratio = found[0].seconds / one.seconds
        table.add_row(_who(one.workers), f"{one.frames / one.seconds:.2f}", f"{ratio:.2f}")
    return table


def live_table(found: list[LiveFigures]) -> Table:
    """Cameras x frames a second, and those of this process as the unit."""
    table = Table(title=f"Live: {found[0].cameras} cameras of {_SIZE[0]} x {_SIZE[1]}")
    for heading in ("who", "cameras x frames a second", "ratio", "centre, a frame"):
        table.add_column(heading, justify="right")
    for one in found:
        table.add_row(
            _who(one.workers),
            f"{one.throughput:.0f}",
            f"{one.throughput / found[0].throughput:.2f}",
            f"{1e3 * one.centre_seconds:.1f} ms",
        )
    return table


def needs_table(batch: BatchFigures, live: LiveFigures) -> Table:
    """What 100 cameras at 30 Hz and ten million frames would need.

    Args:
        batch: this process's.
        live: a capture by two workers.
    """
    per_second = 100 * _RATE_HZ
    table = Table(title="What more would need")
    table.add_column("for")
    table.add_column("needs")
    picture = 3 * _SIZE[0] * _SIZE[1]
    rows = (
        ("one view", f"{1e3 * live.view_seconds:.2f} ms, {live.view_bytes:.0f} bytes "
                     f"(its picture: {picture})"),
        ("100 cameras at 30 Hz: workers", f"{per_second * live.view_seconds:.1f} cores"),
        ("100 cameras at 30 Hz: network",
         f"{8e-6 * per_second * live.view_bytes:.0f} Mbit/s of views "
         f"(pictures: {8e-6 * per_second * picture:.0f})"),
        ("ten million stills", f"{1e7 * batch.processor_seconds / batch.frames / 3600:.0f} core "
                               f"hours, {1e7 * batch.bytes_a_frame / _GIGA:.0f} GB"),
    )  # fmt: skip
    for row in rows:
        table.add_row(*row)
    return table


@contextmanager
def _clients() -> Iterator[dict[int, Client | None]]:
    """Nobody, one worker, two workers."""
    with open_cluster(1) as one, open_cluster(2) as two:
        yield {0: None, 1: one, 2: two}


def _who(workers: int) -> str:
    return "this process" if not workers else f"{workers} worker{'s' if workers > 1 else ''}"


def main() -> None:
    """Print what workers bring on this machine."""
    console = Console()
    with tempfile.TemporaryDirectory() as name, _clients() as clients:
        folder = Path(name)
        for part in ("stills", "studio"):
            (folder / part).mkdir()
        job, scene = write_stills(folder / "stills"), write_studio(folder / "studio")
        run_batch(warm_up_jobs(job, 1), folder / "warm_up")
        measure_live(fewer_cameras(scene, 2), 0, None)
        batch = [
            measure_batch(job, folder / f"batch_{workers}", workers, client)
            for workers, client in clients.items()
        ]
        console.print(batch_table(batch))
        live = [measure_live(scene, workers, client) for workers, client in clients.items()]
        console.print(live_table(live))
    console.print(needs_table(batch[0], live[2]))


if __name__ == "__main__":
    main()
