"""Capture frame by frame, as the pictures come from live cameras, videos or folders."""

import time
from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.body import ArticulatedModel, PoseTree, bundled_model, load_model
from drake_pose.camera.models import PinholeCamera
from drake_pose.camera.sources import TIME_STAMPS
from drake_pose.csv_files import csv_text
from drake_pose.errors import CameraError, OutputError, SceneError, SettingsError, UnknownNameError
from drake_pose.files.folder import read_summary, writes_folder
from drake_pose.files.records import (
    FrameRecord,
    SceneEstimate,
    describe_job,
    record_deviations,
)
from drake_pose.files.settings import EstimateSettings
from drake_pose.files.writer import ResultWriter
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
from drake_pose.person.pose_tracker import PersonPoseTracker
from drake_pose.person.shape import KnownShape, shape_values, tracker_of_person
from drake_pose.person.views import shows_somebody
from drake_pose.silhouette.pictures.masks import compare_masks
from drake_pose.silhouette.pictures.scene_checks import frame_ranges
from drake_pose.silhouette.pictures.scenes import Scene
from drake_pose.silhouette.scoring import draw_mask
from drake_pose.systems.date import (
    CaptureSetup,
    build_paper_capture,
    prepare_paper_capture,
    render_registered_pose,
)
from drake_pose.systems.images import colour_image_to_picture
from drake_pose.systems.person import add_silhouette_sensors, build_silhouette_capture
from drake_pose.systems.picture_capture import CameraCount, PictureCapture
from drake_pose.systems.ports import evaluate


class LiveResult(NamedTuple):
    """What came out of a live capture; troubles: what the user was not told while it ran."""

    estimate: SceneEstimate
    interrupted: bool
    troubles: tuple[str, ...]


@writes_folder
def capture_live(
    scene: LiveScene,
    out: Path,
    model_path: Path | None = None,
    settings: LiveSettings | None = None,
    on_report: Callable[[str], None] = lambda _: None,
    on_frame: Callable[[int, bool], None] = lambda _, __: None,
    method: CaptureMethod = "person",
) -> LiveResult:
    """Captures a person as the pictures come, and writes the result's folder.

    Ctrl-C ends the capture, and keeps everything. The sources are opened twice if the first frames
    give the person's shape or show the registered pose.

    Args:
        out: the result's folder, empty or not there.
        model_path: a person with landmarks.yaml beside it; the bundled one, with shape joints
            for the method "person", where not given.
        on_report: called at once when cameras stop and return, and with bad pictures.
        on_frame: called with each frame: how many there are, and whether a person was found.
        method: "person" by all silhouettes at once; "paper" by the stages of Date et al. (skin,
            rays, inverse kinematics, search; see find_registered_pose).

    Raises:
        SceneError, CameraError, ModelError, SettingsError, UnknownNameError: what was given cannot
            be captured so.
        OutputError: the result cannot be written.
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
    with closing(scene.open_sensors(tolerance=settings.tolerance)) as sensors:
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
        told: list[str] = []

        def tell(text: str) -> None:
            told.append(text)
            writer.warnings.append(text)
            on_report(text)

        writer.begin()
        try:
            interrupted = run_live(diagram, sensors, settings.seconds, tell, monitor=frames.watch)
            frames.finish(sensors, settings.replay)
        finally:
            writer.write_summary()
    estimate = writer.result()
    troubles = tuple(text for text in estimate.warnings if text not in told)
    return LiveResult(estimate, interrupted, troubles)


def shape_of_result(result: Path) -> KnownShape:
    """The lengths and radius scales that an earlier capture found.

    Raises:
        OutputError: there is no such result, or it has none.
    """
    summary = read_summary(result)
    found = []
    for name in ("lengths_m", "radius_scales"):
        numbers = summary.get(name)
        if not isinstance(numbers, dict) or not all(
            isinstance(number, int | float) for number in numbers.values()
        ):
            raise OutputError(f"{result}: its summary has no {name}; name a result of capture")
        found.append(numbers)
    return KnownShape(*found)


def _fit_first_frames(
    scene: LiveScene,
    settings: LiveSettings,
    tree: PoseTree,
    on_report: Callable[[str], None],
    count: int = 40,
) -> KnownShape | None:
    """Fit lengths and radius scales to the first frames; None without shape joints."""
    if not shape_values(tree).any():
        return None
    sensors = scene.open_sensors(tolerance=settings.tolerance)
    frames: list[dict[str, Mask]] = []
    builder = DiagramBuilder()
    seers = add_silhouette_sensors(builder, sensors, scene.cameras, scene.backgrounds)
    time, last = sensors.GetOutputPort("time"), np.nan

    def look(context: Context) -> bool:
        nonlocal last
        before, last = last, float(evaluate(time, context)[0])
        if last != before and not np.isnan(last):
            views = {name: evaluate(one.silhouette, context) for name, one in seers.items()}
            seen = {name: view.region for name, view in views.items() if shows_somebody(view)}
            if len(seen) >= 2:
                frames.append(seen)
        return len(frames) >= count

    look_until(builder.Build(), sensors, look, on_report)
    # Whoever else is in view is cut out.
    alone = PersonRecording(scene.cameras, lambda k: frames[k], len(frames), True)
    seen = alone.seen
    if not seen:
        raise SettingsError(
            f"{scene.path}: two cameras never saw a person at the same time: stand before them, "
            "and compare the pictures with their backgrounds"
        )
    found = capture_person(tree, scene.cameras, alone.read, seen)
    return None if found.shape is None else found.shape.known


def find_registered_pose(
    scene: LiveScene,
    model: ArticulatedModel,
    settings: LiveSettings,
    on_report: Callable[[str], None],
) -> CaptureSetup:
    """What capture needs, from the pictures in which a person shows the registered pose.

    Args:
        model: a person of the same build as the bundled one; its measures are taken as they are.
        settings: no shape can be given; without a camera before the face, and templates as of
            learn_recorded_faces, its direction is found by inverse kinematics alone.

    Raises:
        SceneError, CameraError, ModelError, SettingsError, UnknownNameError: what was given cannot
            be captured so, or no picture shows the registered pose.
    """
    if settings.shape is not None:
        raise SettingsError("the paper's stages take the model's measures: give no shape")
    faces = None if settings.faces is None else learn_recorded_faces(settings.faces)
    path, face = scene.path, settings.face_camera
    cameras = dict[str, PinholeCamera]()
    for name, camera in scene.cameras.items():
        if scene.specifications[name].gives_masks:
            raise SceneError(
                f"{path}: camera '{name}' delivers masks; the paper's stages look for skin in "
                "colour pictures: give these, and a background of the empty room"
            )
        if not isinstance(camera, PinholeCamera):
            raise CameraError(f"camera '{name}': the paper's stages need a pinhole camera")
        cameras[name] = camera
    if face is not None and face not in cameras:
        raise UnknownNameError("camera", face, cameras, str(path))
    ring = {name: one for name, one in cameras.items() if name != face}
    blank = CaptureSetup(load_skeleton(model), ring, backgrounds=scene.backgrounds)
    best, shown = _best_moment(
        blank, ring, scene.open_sensors(tolerance=settings.tolerance), on_report
    )
    if best is None:
        raise SettingsError(
            f"{path}: two cameras never saw a person whole at the same time: compare the "
            "pictures with those of the empty room"
        )
    (q, similarity), needed = best, blank.recognition
    if similarity < needed:
        raise SettingsError(
            f"{path}: nobody showed the registered pose, upright with both arms spread: the "
            f"likest silhouettes agree with it by {similarity:.2f}, {needed:.2f} are needed; "
            "show it once, give a model of the person's measures (urdf/person/make_person.py "
            "makes one), or capture by all silhouettes (--method person)"
        )
    known = {name: one for name, one in cameras.items() if name == face or name in shown}
    for name in cameras:
        if name not in known:
            on_report(f"camera '{name}' gave no picture of the registered pose: left out")
    return prepare_paper_capture(model, known, face, q, shown, scene.backgrounds, faces=faces)


def _best_moment(
    setup: CaptureSetup,
    ring: Mapping[str, PinholeCamera],
    sensors: PictureCapture,
    on_report: Callable[[str], None],
    more_moments: int = 10,
) -> tuple[tuple[Array, float] | None, dict[str, Picture]]:
    """Positions and similarity of the moment most like the registered pose; its pictures.

    more_moments: number of moments after a good one that may be better: arms may still be rising.
    """
    diagram = build_paper_capture(setup, sensors, sensors.period).diagram
    registered: RegisteredPose | None = None
    best: tuple[Array, float] | None = None
    shown: dict[str, Picture] = {}
    since = 0

    def look(context: Context) -> bool:
        nonlocal registered, best, shown, since
        if evaluate(sensors.GetOutputPort("fresh"), context)[0]:
            since += 1
            views = {
                name: view
                for name in ring
                if (view := diagram.GetOutputPort(f"person_view_{name}").Eval(context)) is not None
            }
            contours = {name: one.contour for name, one in views.items() if one.contour is not None}
            cameras, seen = [ring[name] for name in contours], list(contours.values())
            if len(seen) >= 2:
                if registered is None:
                    q = place_registered(setup.skeleton, cameras, [middle for _, middle in seen])
                    registered = render_registered_pose(setup.skeleton, q, ring)
                found = recognise(setup.skeleton, registered, cameras, seen, threshold=0.0)
                if found is not None and (best is None or found[1] > best[1]):
                    images = {
                        name: evaluate(sensors.GetOutputPort(f"color_image_{name}"), context)
                        for name in views
                    }
                    best, since = found, 0
                    shown = {k: colour_image_to_picture(one).copy() for k, one in images.items()}
        is_sure = best is not None and best[1] >= setup.recognition
        return is_sure and since >= more_moments

    look_until(diagram, sensors, look, on_report)
    return best, shown


class _FrameWriter:
    """Writes the frames of a capture under way.

    Args:
        tracker: made for the person's pose tree; gives its surfaces.
        diagram: of build_silhouette_capture, or of build_paper_capture.
        views: by camera, the diagram's port of what its picture says, None where there is none.
        period: time between two frames [s].
        on_frame: as of capture_live.
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
        self._index, self._moment, self._begin = -1, float("nan"), time.perf_counter()

    def watch(self, context: Context) -> None:
        """Writes a frame where there is a new moment; its name counts periods from the first."""
        moment = float(self._value(context, "time")[0])
        if np.isnan(moment) or moment == self._moment:
            return
        self._moment, self._index = moment, max(self._index + 1, round(moment / self._period))
        name, q = f"{self._index:06d}", self._value(context, "estimated_positions")
        seen = {camera: port.Eval(context) for camera, port in self._views.items()}
        masks = {camera: view.region for camera, view in seen.items() if view is not None}
        for camera in masks:
            self._seen[camera, name] = Path(self._scene.specifications[camera].location)
        share, others = (
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
            agreement = compare_masks(masks, bodies)
            error, ious = agreement.E_total, agreement.ious
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
            share=share if np.isfinite(share) else None,
        )
        self._writer.add(record)
        self._times[name] = moment
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
        """Notes why one should not trust the paper's stages in a frame.

        min_iou: of a frame in the mean; of simulated persons who are followed it is about 0.8.
        """
        doubts = []
        if not np.isfinite(q).all():
            doubts.append("before the registered pose")
        else:
            # Where a pose was recognised no feature need be measured.
            if np.isfinite(self._value(context, "limb_points")).all():
                lost = np.array(FEATURES)[self._value(context, "last_support") == 0]
                doubts += [f"{k.replace('_', ' ')} not seen; held where it was last" for k in lost]
            if np.mean(list(ious.values()) or [0.0]) < min_iou:
                doubts.append(
                    f"the body and the silhouettes hardly agree (mean IoU below {min_iou}); the "
                    "paper's stages do not notice when they have lost the person, until the "
                    "registered pose is shown again"
                )
        for text in doubts:
            self._doubts.setdefault(text, []).append(frame)

    def finish(self, sensors: PictureCapture, replay: bool) -> None:
        """Writes what is made of all frames."""
        writer = self._writer
        writer.warnings += [
            f"frame {frame_ranges(frames, list(self._times))}: {text}"
            for text, frames in self._doubts.items()
        ]
        # A moment that no camera saw, or that was skipped, is a frame without a pose.
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
        writer.more |= {"sources": sources, "skipped_moments": sensors.skipped}
        writer.warnings += camera_troubles(counts, sensors.skipped)
        if writer.records:
            writer.finish(replay)
            times = [(frame, f"{time:.6f}") for frame, time in self._times.items()]
            writer.write(TIME_STAMPS, csv_text([("frame", "time"), *times]))

    def _value(self, context: Context, name: str, size: int = 1) -> Array:
        """An output's value; nan where the diagram has no such output."""
        if not self._diagram.HasOutputPort(name):
            return np.full(size, np.nan)
        return np.array(self._diagram.GetOutputPort(name).Eval(context))


def camera_troubles(counts: Mapping[str, CameraCount], skipped: int) -> list[str]:
    """What the user should know at the end of a capture: pictures lost, by camera."""
    troubles = []
    for name, count in counts.items():
        numbers = {"could not be used": count.dropped, "came after their moment": count.late}
        lost = [f"{number} {what}" for what, number in numbers.items() if number]
        if lost:
            troubles.append(f"camera '{name}': of its pictures {' and '.join(lost)}")
        if count.changes and count.changes[-1].stopped:
            troubles.append(f"camera '{name}' had stopped by the end")
    if skipped:
        troubles.append(
            f"{skipped} moments were skipped: this computer could not follow the cameras"
        )
    return troubles
