"""Capture of a person, frame by frame as pictures arrive from live cameras, videos or folders."""

import time
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.body import ArticulatedModel, PoseTree, bundled_model, load_model
from drake_pose.camera.models import PinholeCamera
from drake_pose.camera.sources import TIME_STAMPS
from drake_pose.errors import CameraError, OutputError, SceneError, SettingsError, UnknownNameError
from drake_pose.files.folder import read_summary, writes_folder
from drake_pose.files.records import FrameRecord, SceneEstimate, describe_job, record_deviations
from drake_pose.files.settings import EstimateSettings
from drake_pose.files.writer import ResultWriter
from drake_pose.input_files import csv_text
from drake_pose.jobs.estimate.inputs import bundled_person
from drake_pose.jobs.estimate.person import FOLLOWED
from drake_pose.jobs.live.scene import LiveScene, look_until, run_live
from drake_pose.jobs.live.settings import CaptureMethod, LiveSettings
from drake_pose.person.capture import capture_person
from drake_pose.person.date.features import (
    RegisteredPose,
    learn_recorded_faces,
    place_registered,
    recognise,
)
from drake_pose.person.date.skeleton import FEATURES, load_skeleton
from drake_pose.person.figures import PersonRecording, keep_person
from drake_pose.person.pose_tracker import (
    KnownShape,
    PersonPoseTracker,
    shape_values,
    tracker_of_person,
)
from drake_pose.person.views import shows_somebody
from drake_pose.silhouette.pictures.masks import compare_masks
from drake_pose.silhouette.pictures.scene_checks import frame_ranges
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.silhouette.scoring import draw_mask
from drake_pose.systems.cameras import colour_image_to_picture
from drake_pose.systems.date import (
    CaptureSetup,
    build_paper_capture,
    prepare_paper_capture,
    render_registered_pose,
)
from drake_pose.systems.person import add_silhouette_sensors, build_silhouette_capture
from drake_pose.systems.picture_capture import CameraCount, PictureCapture
from drake_pose.systems.ports import evaluate


@writes_folder
def capture_live(
    scene: LiveScene,
    out: Path,
    model_path: Path | None = None,
    settings: LiveSettings | None = None,
    on_report: Callable[[str], None] = lambda _: None,
    on_frame: Callable[[int, bool], None] = lambda _, __: None,
    method: CaptureMethod = "person",
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
        on_report: called immediately when a camera stops or returns, and for bad pictures.
        on_frame: called after each frame with the number of frames and whether a person was found.
        method: "person": fit to all silhouettes at once; "paper": the stages of Date et al. (skin,
            rays, inverse kinematics, search; see find_registered_pose).

    Raises SceneError, CameraError, ModelError, SettingsError, UnknownNameError: the inputs do not
    allow a capture; OutputError: the result cannot be written.
    """
    settings = settings or LiveSettings()
    usual = bundled_person() if method == "person" else bundled_model("person")
    model = load_model(model_path or usual, package_paths=settings.packages)
    setup = shape = None
    if method != "person":
        setup = find_registered_pose(scene, model, settings, on_report)
    elif settings.shape is not None:
        shape = shape_of_result(settings.shape)
    elif settings.fit_shape:
        shape = _fit_first_frames(scene, settings, model.pose_tree(), on_report)
    tracker = tracker_of_person(model.pose_tree(), shape)
    with closing(scene.open_sensors(settings.tolerance)) as sensors:
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
        described = EstimateSettings(method="person", packages=settings.packages)
        job = describe_job(scene.path, model.path, described)
        writer = ResultWriter(recorded, model, job, out)
        writer.more["method"] = "person" if setup is None else f"{method}_capture"
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
            interrupted = run_live(diagram, sensors, settings.seconds, report, monitor=frames.watch)
            frames.finish(sensors, settings.replay)
        finally:
            writer.end()
    estimate = writer.result()
    unreported = tuple(text for text in estimate.warnings if text not in reported)
    return estimate, interrupted, unreported


def shape_of_result(result: Path) -> KnownShape:
    """Return the link lengths [m] and radius scales of an earlier capture.

    Raises OutputError: the result does not exist, or has none.
    """
    summary = read_summary(result)
    found = []
    for name in ("lengths_m", "radius_scales"):
        numbers = summary.get(name)
        if not isinstance(numbers, dict) or not all(
            isinstance(number, int | float) for number in numbers.values()
        ):
            raise OutputError(f"{result}: its summary has no {name}; give a result of capture")
        found.append(numbers)
    return KnownShape(*found)


def _fit_first_frames(
    scene: LiveScene,
    settings: LiveSettings,
    tree: PoseTree,
    on_report: Callable[[str], None],
    count: int = 40,
) -> KnownShape | None:
    """Fit link lengths and radius scales to the first frames in which two cameras see somebody.

    ``settings``: tolerance of synchronised pictures. ``on_report``: gets messages about live
    cameras. ``count``: number of frames; fewer if recordings end before, or live cameras are read
    for a minute. Returns both; None for a model without shape joints. Raises SettingsError: two
    cameras never saw a person at the same time.
    """
    if not shape_values(tree).any():
        return None
    sensors = scene.open_sensors(settings.tolerance)
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
        return len(frames) >= count

    look_until(builder.Build(), sensors, look, on_report)
    # Other people in view are removed from the masks.
    alone = PersonRecording(scene.cameras, lambda k: frames[k], len(frames), True)
    visible = alone.seen
    if not visible:
        raise SettingsError(
            f"{scene.path}: two cameras never saw a person at the same time; stand in view of "
            "them, and compare the pictures with their backgrounds"
        )
    found = capture_person(tree, scene.cameras, alone.read, visible)
    return None if found.shape is None else found.shape.known


def find_registered_pose(
    scene: LiveScene,
    model: ArticulatedModel,
    settings: LiveSettings,
    on_report: Callable[[str], None],
) -> CaptureSetup:
    """Prepare a capture by the stages of Date et al. from pictures that show the registered pose.

    Args:
        scene: cameras, sources and backgrounds.
        model: model of a person with the bundled person's joints; its lengths stay as they are.
        settings: settings without shape; without a face camera and faces, the head's direction is
            found by inverse kinematics only.
        on_report: called when a camera stops, returns, or is left out.

    Returns the cameras used, the registered pose with its silhouettes, and all else that
    `build_paper_capture` needs.

    Raises SceneError, CameraError, ModelError, SettingsError, UnknownNameError: the inputs do not
    allow such a capture, or no picture shows the registered pose.
    """
    if settings.shape is not None:
        raise SettingsError("the method paper uses the model's lengths; leave shape out")
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
    best, shown = _best_registered_frame(
        blank, ring, scene.open_sensors(settings.tolerance), on_report
    )
    if best is None:
        raise SettingsError(
            f"{path}: two cameras never saw a whole person at the same time; compare the pictures "
            "with those of the empty room"
        )
    (q, similarity), needed = best, blank.recognition
    if similarity < needed:
        raise SettingsError(
            f"{path}: no frame shows the registered pose, upright with both arms spread: the best "
            f"similarity is {similarity:.2f}, {needed:.2f} are needed; show the pose once, give a "
            "model with the person's measures (urdf/person/make_person.py makes one), or use "
            "--method person"
        )
    known = {name: one for name, one in cameras.items() if name == face or name in shown}
    for name in cameras:
        if name not in known:
            on_report(f"camera '{name}' has no picture of the registered pose and is left out")
    return prepare_paper_capture(model, known, face, q, shown, scene.backgrounds, faces=faces)


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
        if evaluate(sensors.GetOutputPort("fresh"), context)[0]:
            since += 1
            views = {
                name: view
                for name in ring
                if (view := diagram.GetOutputPort(f"person_view_{name}").Eval(context)) is not None
            }
            contours = {name: one.contour for name, one in views.items() if one.contour is not None}
            cameras, outlines = [ring[name] for name in contours], list(contours.values())
            if len(outlines) >= 2:
                if registered is None:
                    q = place_registered(
                        setup.skeleton, cameras, [middle for _, middle in outlines]
                    )
                    registered = render_registered_pose(setup.skeleton, q, ring)
                found = recognise(setup.skeleton, registered, cameras, outlines, threshold=0.0)
                if found is not None and (best is None or found[1] > best[1]):
                    images = {
                        name: evaluate(sensors.GetOutputPort(f"color_image_{name}"), context)
                        for name in views
                    }
                    best, since = found, 0
                    shown = {k: colour_image_to_picture(one).copy() for k, one in images.items()}
        is_sure = best is not None and best[1] >= setup.recognition
        return is_sure and since >= more_frames

    look_until(diagram, sensors, look, on_report)
    return best, shown


class _FrameWriter:
    """Writes the frames of a running capture.

    Args:
        writer: writer of the result.
        scene: the live scene.
        tracker: tracker of the person, which has the body's surfaces.
        diagram: diagram of build_silhouette_capture or build_paper_capture.
        views: by camera, the diagram's port of its segmented picture, which may be None.
        period: time between two frames [s].
        on_frame: as in capture_live.
    """

    def __init__(
        self,
        writer: ResultWriter,
        scene: LiveScene,
        tracker: PersonPoseTracker,
        diagram: Diagram,
        views: Mapping[str, OutputPort],
        period: float,
        on_frame: Callable[[int, bool], None],
    ) -> None:
        self._writer, self._scene, self._tracker = writer, scene, tracker
        self._diagram, self._views, self._period = diagram, views, period
        self._on_frame = on_frame
        self._times: dict[str, float] = {}
        self._seen: dict[tuple[str, str], Path] = {}
        self._doubts: dict[str, list[str]] = {}
        self._index, self._time, self._begin = -1, float("nan"), time.perf_counter()

    def watch(self, context: Context) -> None:
        """Write a frame, named by its count of periods, if the pictures of the context are new."""
        now = float(self._value(context, "time")[0])
        if np.isnan(now) or now == self._time:
            return
        self._time, self._index = now, max(self._index + 1, round(now / self._period))
        name, q = f"{self._index:06d}", self._value(context, "estimated_positions")
        views = {camera: port.Eval(context) for camera, port in self._views.items()}
        masks = {camera: view.region for camera, view in views.items() if view is not None}
        for camera in masks:
            self._seen[camera, name] = Path(self._scene.specifications[camera].location)
        inlier_ratio, others = (
            float(self._value(context, what)[0]) for what in ("inlier_ratio", "others")
        )
        seconds = time.perf_counter() - self._begin
        error = float("nan")
        ious: Mapping[str, float] = {}
        if np.isfinite(q).all():
            tracker, cameras = self._tracker, self._scene.cameras
            values = tracker.values(q)
            X_WN = tracker.fit.kinematics.poses(values)
            if others > 0.0:
                masks, *_ = keep_person(cameras, masks, tracker.trunk_middle(values))
            bodies = {
                name: draw_mask(tracker.fit.outlines, cameras[name].X_CW @ X_WN, cameras[name])
                for name in masks
            }
            error, ious = compare_masks(masks, bodies)
        deviations = self._value(context, "deviations", len(q))
        record = FrameRecord(
            name,
            q,
            None,
            error if np.isfinite(error) else None,
            seconds,
            stopped_by=FOLLOWED,
            joints=record_deviations(self._writer.model, q, deviations),
            ious=ious,
            inlier_ratio=inlier_ratio if np.isfinite(inlier_ratio) else None,
        )
        self._writer.add(record)
        self._times[name] = now
        if self._writer.more["method"] != "person":
            self._doubt(context, name, q, ious)
        self._on_frame(len(self._times), record.found)
        self._begin = time.perf_counter()

    def _doubt(
        self,
        context: Context,
        frame: str,
        q: Array,
        ious: Mapping[str, float],
        min_iou: float = 0.6,
    ) -> None:
        """Record doubts about the result of the paper's stages in a frame.

        ``q``: (nq,) positions; nan before the registered pose. ``min_iou``: mean of ``ious`` by
        camera below which the pose is doubtful; tracked simulated persons have about 0.8.
        """
        doubts = []
        if not np.isfinite(q).all():
            doubts.append("before the registered pose")
        else:
            # In a recognised registered pose features need not be measured.
            if np.isfinite(self._value(context, "limb_points")).all():
                lost = np.array(FEATURES)[self._value(context, "last_support") == 0]
                doubts += [
                    f"{k.replace('_', ' ')} not visible; held at its last position" for k in lost
                ]
            if np.mean(list(ious.values()) or [0.0]) < min_iou:
                doubts.append(
                    f"body and silhouettes hardly agree (mean IoU below {min_iou}); the method "
                    "paper does not detect that it has lost the person: show the registered pose "
                    "again"
                )
        for text in doubts:
            self._doubts.setdefault(text, []).append(frame)

    def finish(self, sensors: PictureCapture, replay: bool) -> None:
        """Write warnings, the use of pictures by ``sensors``, and the files about all frames."""
        writer = self._writer
        writer.warnings += [
            f"frame {frame_ranges(frames, list(self._times))}: {text}"
            for text, frames in self._doubts.items()
        ]
        # Periods without pictures, and skipped ones, are frames without a pose.
        names = tuple(f"{k:06d}" for k in range(self._index + 1))
        writer.scene = replace(writer.scene, frames=names, masks=self._seen)
        counts, sources = sensors.counts(), {}
        for name, count in counts.items():
            given = self._scene.specifications[name]
            changes = [
                {"time": one.time, "what": "stopped" if one.stopped else "returned"}
                for one in count.changes
            ]
            known = {"kind": given.kind, "location": given.location, **asdict(count)}
            sources[name] = known | {"changes": changes}
        writer.more |= {"sources": sources, "skipped_frames": sensors.skipped}
        writer.warnings += capture_warnings(counts, sensors.skipped)
        if writer.records:
            writer.finish(replay)
            times = [(frame, f"{time:.6f}") for frame, time in self._times.items()]
            writer.write(TIME_STAMPS, csv_text([("frame", "time"), *times]))

    def _value(self, context: Context, name: str, size: int = 1) -> Array:
        """Return the value (n,) of an output of the diagram; nan (size,) without such an output."""
        if not self._diagram.HasOutputPort(name):
            return np.full(size, np.nan)
        return np.array(self._diagram.GetOutputPort(name).Eval(context))


def capture_warnings(counts: Mapping[str, CameraCount], skipped: int) -> list[str]:
    """Return warnings of lost pictures and stopped cameras at the end of a capture.

    Args:
        counts: use of pictures by camera.
        skipped: number of skipped sets of synchronised pictures.
    """
    warnings = []
    for name, count in counts.items():
        numbers = {"could not be used": count.dropped, "came too late": count.late}
        lost = [f"{number} {what}" for what, number in numbers.items() if number]
        if lost:
            warnings.append(f"camera '{name}': of its pictures {' and '.join(lost)}")
        if count.changes and count.changes[-1].stopped:
            warnings.append(f"camera '{name}' had stopped by the end; check its connection")
    if skipped:
        warnings.append(
            f"{skipped} frames were skipped, as this computer is too slow for the cameras; use "
            "fewer or smaller pictures"
        )
    return warnings
