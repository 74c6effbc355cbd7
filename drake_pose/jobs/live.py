"""Capture of a person, frame by frame as pictures arrive from live cameras, videos or folders.

A live scene is a folder with cameras.yaml, sources.yaml and pictures of the empty room; `run_live`
simulates the diagram that captures it.
"""

import math
import os
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, EventStatus, OutputPort

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.body import ArticulatedModel, PoseTree, bundled_model, load_model
from drake_pose.camera.camera_files import load_cameras
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.camera.sources import (
    CAMERAS,
    SOURCES,
    TIME_STAMPS,
    FrameSource,
    SourceSpecification,
    load_background_pictures,
    load_sources,
    open_source,
)
from drake_pose.errors import CameraError, OutputError, SceneError, SettingsError, UnknownNameError
from drake_pose.files.folder import write_file, writes_folder
from drake_pose.files.records import FrameRecord, SceneEstimate, describe_job, record_deviations
from drake_pose.files.settings import CaptureMethod, EstimateSettings, LiveSettings
from drake_pose.files.writer import ResultWriter
from drake_pose.input_files import csv_text
from drake_pose.jobs.estimate.inputs import bundled_person
from drake_pose.jobs.estimate.person import FOLLOWED
from drake_pose.person.capture import SHAPE_FRAMES, capture_person
from drake_pose.person.date.features import (
    RegisteredPose,
    learn_recorded_faces,
    place_registered,
    recognise,
)
from drake_pose.person.date.skeleton import FEATURES, load_skeleton
from drake_pose.person.figures import PersonRecording, keep_person
from drake_pose.person.pose_tracker import (
    PersonPoseTracker,
    PersonShape,
    shape_values,
    tracker_of_person,
)
from drake_pose.person.views import shows_somebody
from drake_pose.silhouette.pictures.masks import compare_masks
from drake_pose.silhouette.pictures.scene_checks import frame_ranges
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.silhouette.scoring import draw_mask
from drake_pose.silhouette.segmentation import Background, learn_background
from drake_pose.systems.cameras import colour_image_to_picture
from drake_pose.systems.date import (
    CaptureSetup,
    build_paper_capture,
    prepare_paper_capture,
    render_registered_pose,
)
from drake_pose.systems.person import add_silhouette_sensors, build_silhouette_capture
from drake_pose.systems.picture_capture import PictureCapture
from drake_pose.systems.ports import evaluate


@dataclass(frozen=True, eq=False)
class LiveScene:
    """Calibrated cameras, the sources of their pictures, and their background models."""

    path: Path  # The scene's folder.
    cameras: Mapping[str, Camera]  # Cameras by name.
    specifications: Mapping[str, SourceSpecification]  # Sources by camera.
    # Background models by camera, without cameras whose sources deliver masks.
    backgrounds: Mapping[str, Background]

    def open_sensors(self) -> PictureCapture:
        """Open the sources and return their sensor system.

        Raises SceneError: a source cannot be opened; sources opened before are closed.
        """
        with ExitStack() as opened:
            sensors = PictureCapture(_open_sources(self.specifications, opened), self.cameras)
            opened.pop_all()
        return sensors


def _open_sources(
    given: Mapping[str, SourceSpecification], opened: ExitStack
) -> dict[str, FrameSource]:
    """Return the opened sources by camera, which ``opened`` closes. Raises as `open_sensors`."""
    return {name: opened.enter_context(closing(open_source(one))) for name, one in given.items()}


def hush_opencv() -> None:
    """Silence OpenCV, which logs every attempt to open a camera."""
    # Read when the first camera or video is opened; -8 means silent.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


def load_live_scene(path: Path) -> LiveScene:
    """Return the live scene of a folder with cameras.yaml, sources.yaml and background pictures.

    Raises SceneError, CameraError: the message names a missing or damaged file.
    """
    specifications = load_sources(path / SOURCES)
    cameras = load_cameras(path / CAMERAS)
    if len(cameras) < 2:
        raise SceneError(f"{path}: the capture of a person needs two or more calibrated cameras")
    filmed = {name: one for name, one in specifications.items() if not one.gives_masks}
    backgrounds = {k: learn_background(load_background_pictures(one)) for k, one in filmed.items()}
    return LiveScene(path, cameras, specifications, backgrounds)


def take_empty_room(folder: Path, count: int, patience: float = 30.0) -> dict[str, Path]:
    """Write each camera's first pictures to its background folder; return the folders by camera.

    ``folder``: has cameras.yaml and sources.yaml. ``count``: number of pictures of each camera.
    ``patience``: timeout for the pictures [s]. Raises SceneError: a camera gives too few pictures,
    or no camera needs a background; OutputError: a background folder is not empty, or cannot be
    written.
    """
    specifications = {
        name: one for name, one in load_sources(folder).items() if one.background is not None
    }
    if not specifications:
        raise SceneError(f"{folder}: no source needs a background, as all deliver masks")
    places = {name: Path(str(one.background)) for name, one in specifications.items()}
    for name, place in places.items():
        if place.exists() and (not place.is_dir() or any(place.iterdir())):
            raise OutputError(
                f"{place}: the background of camera '{name}' exists already; remove it first"
            )
    pictures: dict[str, list[Picture]] = {name: [] for name in places}
    with ExitStack() as opened:
        sources = _open_sources(specifications, opened)
        end = time.monotonic() + patience
        while slow := [name for name, some in pictures.items() if len(some) < count]:
            for name in slow:
                if (taken := sources[name].read()) is not None:
                    pictures[name].append(taken.picture.astype("uint8"))
                elif sources[name].ended or time.monotonic() > end:
                    reasons = "; ".join(sources[name].problems)
                    raise SceneError(
                        f"camera '{name}' gave {len(pictures[name])} of {count} pictures"
                        f"{': ' if reasons else ''}{reasons}"
                    )
            time.sleep(0.005)
    for name, place in places.items():
        for k, picture in enumerate(pictures[name]):
            _, data = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
            write_file(place, f"{k:03d}.png", data.tobytes())
    return places


def run_live(
    diagram: Diagram,
    sensors: PictureCapture,
    seconds: float | None,
    on_report: Callable[[str], None],
    monitor: Callable[[Context], EventStatus | None],
    largest_lag: float = 0.2,
) -> bool:
    """Simulate a diagram until its recordings end, the time is over, or Ctrl-C.

    Recordings are simulated as fast as possible, live cameras by the computer's clock.

    ``sensors``: the diagram's sensor system. ``seconds``: duration [s], of the clock if the sensors
    are live, else simulated; None: unlimited. ``on_report``: gets messages about cameras and
    pictures. ``monitor``: called with the diagram's context after every step; ends the run by
    returning ReachedTermination. ``largest_lag``: delay to the clock beyond which a simulation
    skips ahead [s]. Returns whether Ctrl-C ended the run.
    """
    simulator = Simulator(diagram)
    simulator.set_monitor(monitor)
    is_live = sensors.live
    simulator.set_target_realtime_rate(float(is_live))
    context = simulator.get_context()
    end = math.inf if seconds is None else seconds
    try:
        simulator.Initialize()
        begin = start = time.monotonic()
        while (time.monotonic() - start if is_live else context.get_time()) < end:
            goal = context.get_time() + sensors.period
            status = simulator.AdvanceTo(goal if is_live else min(goal, end))
            for report in sensors.take_reports():
                on_report(report)
            if status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition:
                break
            lag = time.monotonic() - begin - context.get_time()
            if is_live and lag > largest_lag:
                simulator.ResetStatistics()
                begin += lag
    except KeyboardInterrupt:
        return True
    return False


def look_until(
    diagram: Diagram,
    sensors: PictureCapture,
    looks: Callable[[Context], bool],
    on_report: Callable[[str], None],
    patience: float = 60.0,
) -> None:
    """Simulate a diagram until ``looks`` returns True, then close the sensors.

    The simulation also ends when its recordings end, or with live cameras after ``patience``.

    ``sensors``: the diagram's sensor system. ``looks``: called with the diagram's context after
    every step. ``on_report``: gets messages about live cameras. ``patience``: timeout [s].
    Raises KeyboardInterrupt: Ctrl-C ended the run.
    """

    def look(context: Context) -> EventStatus:
        ended = EventStatus.ReachedTermination(diagram, "")
        return ended if looks(context) else EventStatus.DidNothing()

    # Recorded pictures are read again in the capture, which reports their problems.
    report = on_report if sensors.live else lambda _: None
    waited = patience if sensors.live else None
    try:
        if run_live(diagram, sensors, waited, report, look):
            raise KeyboardInterrupt
    finally:
        sensors.close()


@writes_folder
def capture_live(
    scene: LiveScene,
    out: Path,
    model_path: Path | None = None,
    settings: LiveSettings | None = None,
    method: CaptureMethod = "person",
    *,
    packages: Mapping[str, Path] | None = None,
    replay: bool = True,
    on_report: Callable[[str], None] = lambda _: None,
    on_frame: Callable[[int, bool], None] = lambda _, __: None,
) -> tuple[SceneEstimate, bool, tuple[str, ...]]:
    """Capture a person as pictures arrive, and write the result folder.

    Return the estimate of all frames, whether Ctrl-C ended the capture, and the warnings that were
    not passed to ``on_report`` during it.

    Ctrl-C ends the capture and keeps all frames. The sources are opened twice if the shape is
    fitted to the first frames or the registered pose is searched.

    Args:
        scene: cameras, sources and backgrounds.
        out: folder for the result; it must be new or empty.
        model_path: model of a person with landmarks.yaml beside it; None: the bundled person, with
            shape joints for the method "person".
        settings: settings; None: defaults.
        method: "person": fit to all silhouettes at once; "paper": the stages of Date et al. (skin,
            rays, inverse kinematics, search; see find_registered_pose).
        packages: folders of the packages in the model's ``package://`` addresses, by name.
        replay: whether replay.html is written.
        on_report: called immediately when a camera stops or returns, and for bad pictures.
        on_frame: called after each frame with the number of frames and whether a person was found.

    Raises SceneError, CameraError, ModelError, SettingsError, UnknownNameError: the inputs do not
    allow a capture; OutputError: the result cannot be written.
    """
    settings, packages = settings or LiveSettings(), packages or {}
    usual = bundled_person() if method == "person" else bundled_model("person")
    model = load_model(model_path or usual, package_paths=packages)
    tree, setup, shape = model.pose_tree(), None, None
    if method == "paper":
        setup = find_registered_pose(scene, model, settings, on_report)
    else:
        shape = _fit_first_frames(scene, tree, on_report)
    tracker = tracker_of_person(tree, shape)
    with closing(scene.open_sensors()) as sensors:
        if setup is None:
            kind, cameras = "silhouette", scene.cameras
            diagram = build_silhouette_capture(
                tracker, cameras, scene.backgrounds, sensors.period, source=sensors,
                with_deviations=True,
            ).diagram  # fmt: skip
        else:
            kind, cameras = "person_view", setup.cameras
            diagram = build_paper_capture(setup, sensors, sensors.period).diagram
        recorded = Scene(scene.path, scene.cameras, (), {}, True, 1.0 / sensors.period)
        described = EstimateSettings(method="person", packages=packages)
        writer = ResultWriter(recorded, model, describe_job(scene.path, model.path, described), out)
        writer.more["method"] = "person" if setup is None else "paper_capture"
        if shape is not None:
            writer.more |= {"lengths_m": shape.lengths, "radius_scales": shape.radius_scales}
        views = {name: diagram.GetOutputPort(f"{kind}_{name}") for name in cameras}
        frames = _FrameWriter(writer, scene, tracker, diagram, views, sensors.period, on_frame)
        reported: list[str] = []

        def report(text: str) -> None:
            reported.append(text)
            writer.warnings.append(text)
            on_report(text)

        writer.begin()
        try:
            interrupted = run_live(diagram, sensors, settings.seconds, report, frames.watch)
            frames.finish(sensors, replay)
        finally:
            writer.end()
    estimate = writer.result()
    unreported = tuple(text for text in estimate.warnings if text not in reported)
    return estimate, interrupted, unreported


def _fit_first_frames(
    scene: LiveScene, tree: PoseTree, on_report: Callable[[str], None]
) -> PersonShape | None:
    """Fit link lengths and radius scales to the first frames in which two cameras see somebody.

    The frames are fewer if recordings end before, or live cameras are read for a minute.
    ``on_report``: gets messages about live cameras. Returns the shape; None for a model without
    shape joints. Raises SettingsError: two cameras never saw a person at the same time.
    """
    if not shape_values(tree).any():
        return None
    sensors = scene.open_sensors()
    frames: list[dict[str, Mask]] = []
    builder = DiagramBuilder()
    seers = add_silhouette_sensors(builder, sensors, scene.cameras, scene.backgrounds)
    time, last = sensors.GetOutputPort("time"), np.nan

    def look(context: Context) -> bool:
        """Store the silhouettes of a new frame; return whether there are enough frames."""
        nonlocal last
        before, last = last, float(evaluate(time, context)[0])
        if last != before and not np.isnan(last):
            views = {name: evaluate(one.silhouette, context) for name, one in seers.items()}
            regions = {name: view.region for name, view in views.items() if shows_somebody(view)}
            if len(regions) >= 2:
                frames.append(regions)
        return len(frames) >= SHAPE_FRAMES

    look_until(builder.Build(), sensors, look, on_report)
    # Other people in view are removed from the masks.
    alone = PersonRecording(scene.cameras, lambda k: frames[k], len(frames), True)
    if not alone.seen:
        raise SettingsError(
            f"{scene.path}: two cameras never saw a person at the same time; stand in view of "
            "them, and compare the pictures with their backgrounds"
        )
    return capture_person(tree, scene.cameras, alone.read, alone.seen).shape


def find_registered_pose(
    scene: LiveScene,
    model: ArticulatedModel,
    settings: LiveSettings,
    on_report: Callable[[str], None],
) -> CaptureSetup:
    """Prepare a capture by the stages of Date et al. from pictures that show the registered pose.

    ``model``: of a person with the bundled person's joints; its lengths stay as they are. Without a
    face camera and faces in ``settings``, the head's direction is found by inverse kinematics only.
    ``on_report``: called when a camera stops, returns, or is left out. Returns the cameras used,
    the registered pose with its silhouettes, and all else that `build_paper_capture` needs.

    Raises SceneError, CameraError, ModelError, SettingsError, UnknownNameError: the inputs do not
    allow such a capture, or no picture shows the registered pose.
    """
    faces = None if settings.faces is None else learn_recorded_faces(settings.faces)
    path, face = scene.path, settings.face_camera
    cameras = dict[str, PinholeCamera]()
    for name, camera in scene.cameras.items():
        if scene.specifications[name].gives_masks:
            raise SceneError(
                f"{path}: camera '{name}' delivers masks, but the method paper detects skin in "
                "colour pictures; give pictures, and a background of the empty room"
            )
        if not isinstance(camera, PinholeCamera):
            raise CameraError(f"camera '{name}': the method paper needs a pinhole camera")
        cameras[name] = camera
    if face is not None and face not in cameras:
        raise UnknownNameError("camera", face, cameras, str(path))
    ring = {name: one for name, one in cameras.items() if name != face}
    blank = CaptureSetup(load_skeleton(model), ring, backgrounds=scene.backgrounds)
    best, shown = _best_registered_frame(blank, ring, scene.open_sensors(), on_report)
    if best is None or best[1] < blank.recognition:
        seen = "two cameras never saw a whole person at the same time"
        if best is not None:
            seen = f"the best similarity is {best[1]:.2f}, {blank.recognition:.2f} are needed"
        raise SettingsError(
            f"{path}: no frame shows the registered pose, upright with both arms spread: {seen}; "
            "compare the pictures with those of the empty room, show the pose once, give a model "
            "with the person's measures (urdf/person/make_person.py makes one), or use --method "
            "person"
        )
    known = {name: one for name, one in cameras.items() if name == face or name in shown}
    for name in cameras:
        if name not in known:
            on_report(f"camera '{name}' has no picture of the registered pose and is left out")
    return prepare_paper_capture(model, known, face, best[0], shown, scene.backgrounds, faces=faces)


def _best_registered_frame(
    setup: CaptureSetup,
    ring: Mapping[str, PinholeCamera],
    sensors: PictureCapture,
    on_report: Callable[[str], None],
    more_frames: int = 10,
) -> tuple[tuple[Array, float] | None, dict[str, Picture]]:
    """Find the frame most like the registered pose.

    ``setup``: without registered pose. ``ring``: cameras around the person. ``sensors``: are
    closed. ``on_report``: gets messages about cameras. ``more_frames``: number of frames after a
    good one that may still be better. Returns positions (nq,) [rad or m] and similarity (1: equal),
    None if no frame had two whole silhouettes; and the frame's pictures (H, W, 3) by camera, {} for
    None.
    """
    diagram = build_paper_capture(setup, sensors, sensors.period).diagram
    registered: RegisteredPose | None = None
    best: tuple[Array, float] | None = None
    shown: dict[str, Picture] = {}
    since = 0

    def look(context: Context) -> bool:
        """Compare a new frame with the registered pose; return whether the best one is final."""
        nonlocal registered, best, shown, since
        if not evaluate(sensors.GetOutputPort("fresh"), context)[0]:
            return False
        since += 1
        views = {n: diagram.GetOutputPort(f"person_view_{n}").Eval(context) for n in ring}
        contours = {n: one.contour for n, one in views.items() if one is not None}
        outlines = {n: one for n, one in contours.items() if one is not None}
        if len(outlines) >= 2:
            cameras, seen = [ring[name] for name in outlines], list(outlines.values())
            if registered is None:
                q = place_registered(setup.skeleton, cameras, [middle for _, middle in seen])
                registered = render_registered_pose(setup.skeleton, q, ring)
            found = recognise(setup.skeleton, registered, cameras, seen, threshold=0.0)
            if found is not None and (best is None or found[1] > best[1]):
                best, since = found, 0
                ports = {name: sensors.GetOutputPort(f"color_image_{name}") for name in contours}
                images = {name: evaluate(port, context) for name, port in ports.items()}
                shown = {k: colour_image_to_picture(one).copy() for k, one in images.items()}
        return best is not None and best[1] >= setup.recognition and since >= more_frames

    look_until(diagram, sensors, look, on_report)
    return best, shown


@dataclass(eq=False)
class _FrameWriter:
    """Writes the frames of a running capture."""

    writer: ResultWriter  # Writer of the result.
    scene: LiveScene  # The live scene.
    tracker: PersonPoseTracker  # Tracker of the person, which has the body's surfaces.
    diagram: Diagram  # Diagram of build_silhouette_capture or build_paper_capture.
    # The diagram's ports of the segmented pictures by camera; values may be None.
    views: Mapping[str, OutputPort]
    period: float  # Time between two frames [s].
    on_frame: Callable[[int, bool], None]  # As in capture_live.
    times: dict[str, float] = field(default_factory=dict)  # By name of the frame [s].
    # By camera and frame, the source of a picture.
    seen: dict[tuple[str, str], Path] = field(default_factory=dict)
    doubts: dict[str, list[str]] = field(default_factory=dict)  # Frames by text.
    index: int = -1  # Of the last frame.
    last: float = math.nan  # Time of the last pictures [s].
    begin: float = field(default_factory=time.perf_counter)  # When its work began [s].

    def watch(self, context: Context) -> None:
        """Write a frame, named by its count of periods, if the pictures of the context are new."""
        now = float(self._value(context, "time")[0])
        if np.isnan(now) or now == self.last:
            return
        self.last, self.index = now, max(self.index + 1, round(now / self.period))
        name, q = f"{self.index:06d}", self._value(context, "estimated_positions")
        views = {camera: port.Eval(context) for camera, port in self.views.items()}
        masks = {camera: view.region for camera, view in views.items() if view is not None}
        for camera in masks:
            self.seen[camera, name] = Path(self.scene.specifications[camera].location)
        inlier_ratio = float(self._value(context, "inlier_ratio")[0])
        seconds = time.perf_counter() - self.begin
        error = float("nan")
        ious: Mapping[str, float] = {}
        if np.isfinite(q).all():
            tracker, cameras = self.tracker, self.scene.cameras
            values = tracker.values(q)
            X_WN = tracker.fit.kinematics.poses(values)
            if self._value(context, "others")[0] > 0.0:
                masks, *_ = keep_person(cameras, masks, tracker.trunk_middle(values))
            bodies = {
                name: draw_mask(tracker.fit.outlines, cameras[name].X_CW @ X_WN, cameras[name])
                for name in masks
            }
            error, ious = compare_masks(masks, bodies)
        deviations = self._value(context, "deviations", len(q))
        record = FrameRecord(
            name, q, None, error if np.isfinite(error) else None, seconds, stopped_by=FOLLOWED,
            joints=record_deviations(self.writer.model, q, deviations), ious=ious,
            inlier_ratio=inlier_ratio if np.isfinite(inlier_ratio) else None,
        )  # fmt: skip
        self.writer.add(record)
        self.times[name] = now
        if self.writer.more["method"] != "person":
            self._doubt(context, record)
        self.on_frame(len(self.times), record.found)
        self.begin = time.perf_counter()

    def _doubt(self, context: Context, record: FrameRecord, min_iou: float = 0.6) -> None:
        """Record doubts about the result of the paper's stages in a frame.

        ``min_iou``: mean IoU of the cameras below which the pose is doubtful; tracked simulated
        persons have about 0.8.
        """
        doubts = []
        if not np.isfinite(record.q).all():
            doubts.append("before the registered pose")
        else:
            # In a recognised registered pose features need not be measured.
            if np.isfinite(self._value(context, "limb_points")).all():
                lost = np.array(FEATURES)[self._value(context, "last_support") == 0]
                doubts += [
                    f"{k.replace('_', ' ')} not visible; held at its last position" for k in lost
                ]
            if np.mean(list(record.ious.values()) or [0.0]) < min_iou:
                doubts.append(
                    f"body and silhouettes hardly agree (mean IoU below {min_iou}); the method "
                    "paper does not detect that it has lost the person: show the registered pose "
                    "again"
                )
        for text in doubts:
            self.doubts.setdefault(text, []).append(record.frame)

    def finish(self, sensors: PictureCapture, replay: bool) -> None:
        """Write warnings, the use of pictures by ``sensors``, and the files about all frames."""
        writer, sources, warnings = self.writer, {}, []
        for name, count in sensors.counts().items():
            given = self.scene.specifications[name]
            sources[name] = {"kind": given.kind, "location": given.location, **count}
            numbers = {"could not be used": count["dropped"], "came too late": count["late"]}
            lost = [f"{number} {text}" for text, number in numbers.items() if number]
            if lost:
                warnings.append(f"camera '{name}': of its pictures {' and '.join(lost)}")
            if count["changes"] and count["changes"][-1]["what"] == "stopped":
                warnings.append(f"camera '{name}' had stopped by the end; check its connection")
        if sensors.skipped:
            warnings.append(
                f"{sensors.skipped} frames were skipped, as this computer is too slow for the "
                "cameras; use fewer or smaller pictures"
            )
        doubts = self.doubts.items()
        writer.warnings += [
            *(f"frame {frame_ranges(own, list(self.times))}: {text}" for text, own in doubts),
            *warnings,
        ]
        # Periods without pictures, and skipped ones, are frames without a pose.
        names = tuple(f"{k:06d}" for k in range(self.index + 1))
        writer.scene = replace(writer.scene, frames=names, masks=self.seen)
        writer.more |= {"sources": sources, "skipped_frames": sensors.skipped}
        if writer.records:
            writer.finish(replay)
            times = [(frame, f"{time:.6f}") for frame, time in self.times.items()]
            writer.write(TIME_STAMPS, csv_text([("frame", "time"), *times]))

    def _value(self, context: Context, name: str, size: int = 1) -> Array:
        """Return the value (n,) of an output of the diagram; nan (size,) without such an output."""
        if not self.diagram.HasOutputPort(name):
            return np.full(size, np.nan)
        return np.array(self.diagram.GetOutputPort(name).Eval(context))
