"""Benchmark of the workers: ratios of one run, and what more cameras or frames would need.

Run as ``python -m tests.benchmarks.cluster``. A batch of stills and a live capture of a
simulated person are done by this process, one worker and two; bytes are counted, milliseconds are
the processor's own, so that a busy machine changes little but the frames a second.
"""

from __future__ import annotations

import math
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
import yaml
from pydrake.systems.framework import Context

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.models import FACE_CAMERA
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.batch.batch import run_batch
from drake_pose.jobs.batch.job import SceneJob
from drake_pose.jobs.cluster.remote_views import ClusterSensors
from drake_pose.jobs.cluster.scheduler import open_cluster
from drake_pose.jobs.live.scene import LiveScene, load_live_scene, run_live
from drake_pose.papers.date_capture import Studio
from drake_pose.papers.kameda import experiment_camera
from drake_pose.person.date.walking import make_motion
from drake_pose.person.shape import tracker_of_person
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.pictures.masks import write_mask
from drake_pose.systems.person.live_capture import LiveSensors, build_live_capture
from tests.benchmarks.tables import print_table

if TYPE_CHECKING:
    from distributed import Client

_STILLS, _CHUNK = 8, 2
_CAMERAS, _SIZE, _RATE_HZ = 8, (640, 480), 30.0
# How many frames of Date's motions, which take twelve seconds in all.
_FRAMES, _MOTION_FRAMES = 60, 360
_FAR_AWAY = -9.0


class BatchFigures(NamedTuple):
    """Of a batch, the wall's and the processor's seconds, and bytes a frame on disk."""

    frames: int
    seconds: float
    processor_seconds: float
    bytes_a_frame: float


class LiveFigures(NamedTuple):
    """Of a live capture of a recording, as fast as can be.

    The wall's seconds, the processor's in this process, a frame in the median, those of the
    workers' processors for one view, and its bytes on its way; nan where there are no workers.
    """

    frames: int
    seconds: float
    centre_seconds: float
    view_seconds: float = float("nan")
    view_bytes: float = float("nan")


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


def write_studio(folder: Path) -> LiveScene:
    """Videos of a simulated person before eight cameras, and pictures of the empty room."""
    studio = Studio.build(_CAMERAS + 1, _SIZE, np.random.default_rng(0))
    poses = make_motion(studio.skeleton, _MOTION_FRAMES, 0).q[:_FRAMES]
    cameras = {name: one for name, one in studio.cameras.items() if name != FACE_CAMERA}
    save_cameras(folder / "cameras.yaml", list(cameras.values()))
    away = poses[0].copy()
    away[studio.model.position_index("position_z")] = _FAR_AWAY

    def seen(q: np.ndarray, name: str) -> np.ndarray:
        return cv2.cvtColor(studio.side_by_side([q], name), cv2.COLOR_RGB2BGR)

    entries = {}
    for name in cameras:
        (folder / "empty" / name).mkdir(parents=True)
        cv2.imwrite(str(folder / "empty" / name / "0.png"), seen(away, name))
        entries[name] = {
            "kind": "video", "location": f"{name}.avi", "background": f"empty/{name}",
        }  # fmt: skip
        code = cv2.VideoWriter.fourcc(*"MJPG")
        writer = cv2.VideoWriter(str(folder / f"{name}.avi"), code, _RATE_HZ, _SIZE)
        for q in poses:
            writer.write(seen(q, name))
        writer.release()
    (folder / "sources.yaml").write_text(yaml.safe_dump(entries), encoding="utf-8")
    return load_live_scene(folder)


def measure_batch(job: SceneJob, out: Path, client: Client | None) -> BatchFigures:
    """Times a batch; what is loaded or compiled once, or what workers need to start, is not."""
    settings = replace(job.settings, frames=("0000",))
    warm_up = [replace(job, name=f"warm_up_{k}", settings=settings) for k in range(2)]
    run_batch(warm_up, out / "warm_up", client)
    begin, processor = time.perf_counter(), time.process_time()
    result = run_batch([job], out / "out", client)
    seconds, processor = time.perf_counter() - begin, time.process_time() - processor
    frames = result.scenes[job.name].frame_count
    size = sum(path.stat().st_size for path in (out / "out").rglob("*") if path.is_file())
    return BatchFigures(frames, seconds, processor, size / frames)


def measure_live(scene: LiveScene, client: Client | None) -> LiveFigures:
    """Captures a recording as fast as can be."""
    sensors: LiveSensors = scene.open_sensors() if client is None else ClusterSensors(client, scene)
    tracker = tracker_of_person(load_model(bundled_model("person"), check=False).pose_tree(), None)
    diagram = build_live_capture(tracker, scene.cameras, sensors)
    moments, times = [math.nan], []

    def note(context: Context) -> None:
        moment = float(diagram.GetOutputPort("time").Eval(context)[0])
        if not math.isnan(moment) and moment != moments[-1]:
            diagram.GetOutputPort("estimated_positions").Eval(context)
            moments.append(moment)
            times.append((time.perf_counter(), time.process_time()))

    try:
        run_live(diagram, sensors, None, monitor=note)
    finally:
        sensors.close()
    # In the first frame the person is searched, not followed.
    walls, processors = np.diff(times, axis=0).T
    figures = LiveFigures(len(walls), float(walls.sum()), float(np.median(processors)))
    if not isinstance(sensors, ClusterSensors):
        return figures
    groups = sensors.groups
    views = sum(group.views for group in groups)
    return figures._replace(
        view_seconds=sum(group.seconds for group in groups) / views,
        view_bytes=sum(group.view_bytes for group in groups) / views,
    )


def print_needs(batch: BatchFigures, live: LiveFigures) -> None:
    """What 100 cameras at 30 Hz and ten million stills would need, by figures of two workers."""
    views, picture = 100 * _RATE_HZ, 3 * _SIZE[0] * _SIZE[1]
    hours = 1e7 * batch.processor_seconds / batch.frames / 3600
    one = f"{1e3 * live.view_seconds:.2f} ms, {live.view_bytes:.0f} bytes (its picture: {picture})"
    megabits = [f"{8e-6 * views * size:.0f}" for size in (live.view_bytes, picture)]
    rows = (
        ("one view", one),
        ("100 cameras at 30 Hz: workers", f"{views * live.view_seconds:.1f} cores"),
        ("its network", f"{megabits[0]} Mbit/s of views (pictures: {megabits[1]})"),
        ("ten million stills", f"{hours:.0f} core hours, {1e-2 * batch.bytes_a_frame:.0f} GB"),
    )
    print_table("What more would need", ("for", "needs"), rows)


def main() -> None:
    """Print what workers bring on this machine."""
    with tempfile.TemporaryDirectory() as name, open_cluster(1) as one, open_cluster(2) as two:
        folder, who = Path(name), {"this process": None, "1 worker": one, "2 workers": two}
        for part in ("stills", "studio"):
            (folder / part).mkdir()
        job, scene = write_stills(folder / "stills"), write_studio(folder / "studio")
        batches = [measure_batch(job, folder / f"batch_{k}", who[k]) for k in who]
        measure_live(scene, None)
        lives = [measure_live(scene, client) for client in who.values()]
    rows = [
        (k, f"{b.frames / b.seconds:.2f}", f"{batches[0].seconds / b.seconds:.2f}")
        for k, b in zip(who, batches, strict=True)
    ]
    title = f"Batch: {_STILLS} stills in chunks of {_CHUNK}"
    print_table(title, ("who", "frames a second", "ratio"), rows)
    rates = [_CAMERAS * one.frames / one.seconds for one in lives]
    shown = [
        (k, f"{rate:.0f}", f"{rate / rates[0]:.2f}", f"{1e3 * one.centre_seconds:.1f} ms")
        for k, rate, one in zip(who, rates, lives, strict=True)
    ]
    headings = ("who", "cameras x frames a second", "ratio", "main process, a frame")
    print_table(f"Live: {_CAMERAS} cameras of {_SIZE[0]} x {_SIZE[1]}", headings, shown)
    print_needs(batches[0], lives[2])


if __name__ == "__main__":
    main()
