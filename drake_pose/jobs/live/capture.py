"""Capture frame by frame, as the pictures come from live cameras, videos or folders."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.body.tree.pose_tree import PoseTree
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import CameraError, OutputError, SceneError, SettingsError, UnknownNameError
from drake_pose.files.folder import read_summary, writes_folder
from drake_pose.jobs.estimate.inputs import bundled_person
from drake_pose.jobs.live.frame_results import LiveResult, LiveWriter
from drake_pose.jobs.live.scene import LiveScene, look_until
from drake_pose.jobs.live.settings import CaptureMethod, LiveSettings
from drake_pose.person.date.features import (
    RegisteredPose,
    learn_recorded_faces,
    recognise,
    stand_registered,
)
from drake_pose.person.date.skeleton import load_skeleton
from drake_pose.person.person_capture import capture_person
from drake_pose.person.persons_in_view import PersonRecording
from drake_pose.person.shape import KnownShape, shape_values, tracker_of_person
from drake_pose.person.views import shows_somebody
from drake_pose.systems.date import (
    CaptureSetup,
    build_paper_capture,
    prepare_paper_capture,
    render_registered_pose,
)
from drake_pose.systems.images import colour_image_to_picture
from drake_pose.systems.person.live_capture import LiveSensors, build_live_capture
from drake_pose.systems.ports import evaluate

# How many frames give a person's shape.
_FRAMES = 40


@writes_folder
def capture_live(
    scene: LiveScene,
    out: Path,
    model_path: Path | None = None,
    settings: LiveSettings | None = None,
    open_sensors: Callable[[], LiveSensors] | None = None,
    on_report: Callable[[str], None] = lambda _: None,
    on_frame: Callable[[int, bool], None] = lambda _, __: None,
    method: CaptureMethod = "person",
) -> LiveResult:
    """Captures a person as the pictures come, and writes the result's folder.

    Ctrl-C ends the capture, and keeps everything.

    Args:
        out: the result's folder, empty or not there.
        model_path: a person with landmarks.yaml beside it; the bundled one, with shape joints
            for the method "person", where not given.
        open_sensors: opens the sensors; where not given the scene's, in this process. Called once
            more for the frames that give the person's shape, or show the registered pose.
        on_report: called at once when cameras stop and return, and with bad pictures.
        on_frame: called with each frame: how many there are, and whether a person was found.
        method: "person" by all silhouettes at once; "paper" by the stages of Date et al. (skin,
            rays, inverse kinematics, search; see find_registered_pose).

    Raises:
        SceneError, CameraError, ModelError, SettingsError, UnknownNameError: what was given cannot
            be captured so.
        OutputError: the result cannot be written.
    """
    settings, opener = settings or LiveSettings(), open_sensors or scene.open_sensors
    usual = bundled_person() if method == "person" else bundled_model("person")
    model = load_model(model_path or usual, package_paths=settings.packages)
    setup = shape = None
    if method != "person":
        setup = find_registered_pose(scene, model, settings, opener, on_report)
    elif settings.shape is not None:
        shape = shape_of_result(settings.shape)
    elif settings.fit_shape:
        shape = _fit_first_frames(scene, opener(), model.pose_tree(), on_report)
    tracker = tracker_of_person(model.pose_tree(), shape)
    found = {} if shape is None else {"lengths_m": shape.lengths, "girths": shape.girths}
    more = {"method": "person" if setup is None else f"{method}_capture", **found}
    with closing(opener()) as sensors:
        if setup is None:
            kind, cameras = "silhouette", scene.cameras
            diagram = build_live_capture(tracker, cameras, sensors, with_deviations=True)
        else:
            kind, cameras = "person_view", setup.cameras
            diagram = build_paper_capture(setup, sensors, sensors.period).diagram
        views = {name: diagram.GetOutputPort(f"{kind}_{name}") for name in cameras}
        result = LiveWriter(
            scene, model, tracker, diagram, views, out, sensors.period, more, settings, on_report,
            on_frame,
        )  # fmt: skip
        return result.run(sensors)


def shape_of_result(result: Path) -> KnownShape:
    """The lengths and girths that an earlier capture found.

    Raises:
        OutputError: there is no such result, or it has none.
    """
    summary = read_summary(result)
    found = []
    for name in ("lengths_m", "girths"):
        numbers = summary.get(name)
        if not isinstance(numbers, dict) or not all(
            isinstance(number, int | float) for number in numbers.values()
        ):
            raise OutputError(f"{result}: its summary has no {name}; name a result of capture")
        found.append(numbers)
    return KnownShape(*found)


def _fit_first_frames(
    scene: LiveScene,
    sensors: LiveSensors,
    tree: PoseTree,
    on_report: Callable[[str], None],
) -> KnownShape | None:
    """Lengths and girths by the first frames that two cameras see; None without shape joints."""
    if not shape_values(tree).any():
        sensors.close()
        return None
    frames: list[dict[str, Mask]] = []
    builder = DiagramBuilder()
    ports, time, last = sensors.add(builder), sensors.GetOutputPort("time"), np.nan

    def look(context: Context) -> bool:
        nonlocal last
        before, last = last, float(evaluate(time, context)[0])
        if last != before and not np.isnan(last):
            views = {name: evaluate(port, context) for name, port in ports.items()}
            seen = {name: view.region for name, view in views.items() if shows_somebody(view)}
            if len(seen) >= 2:
                frames.append(seen)
        return len(frames) >= _FRAMES

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


# The arms may still be on their way up: so many more moments are looked at for a better one.
_MORE_MOMENTS = 10


def find_registered_pose(
    scene: LiveScene,
    model: ArticulatedModel,
    settings: LiveSettings,
    open_sensors: Callable[[], LiveSensors],
    on_report: Callable[[str], None],
) -> CaptureSetup:
    """What capture needs, from the pictures in which a person shows the registered pose.

    Args:
        model: a person of the same build as the bundled one; its measures are taken as they are.
        settings: no shape can be given; without a camera before the face, and templates as of
            learn_recorded_faces, its direction is found by inverse kinematics alone.
        open_sensors: opens the sensors, which are used up.

    Raises:
        SceneError, CameraError, ModelError, SettingsError, UnknownNameError: what was given cannot
            be captured so, or nobody showed the registered pose.
    """
    if settings.shape is not None:
        raise SettingsError("the paper's stages take the model's measures: give no shape")
    faces = None if settings.faces is None else learn_recorded_faces(settings.faces)
    cameras, path, face = _require_colour(scene), scene.path, settings.face_camera
    if face is not None and face not in cameras:
        raise UnknownNameError("camera", face, cameras, str(path))
    ring = {name: one for name, one in cameras.items() if name != face}
    blank = CaptureSetup(load_skeleton(model), ring, backgrounds=scene.backgrounds)
    best, shown = _best_moment(blank, ring, open_sensors(), on_report)
    if best is None:
        raise SettingsError(
            f"{path}: two cameras never saw a person whole at the same time: compare the "
            "pictures with those of the empty room"
        )
    (q, similarity), needed = best, blank.settings.recognition
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
    sensors: LiveSensors,
    on_report: Callable[[str], None],
) -> tuple[tuple[Array, float] | None, dict[str, Picture]]:
    """Positions and similarity of the moment most like the registered pose; its pictures."""
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
                    q = stand_registered(setup.skeleton, cameras, [middle for _, middle in seen])
                    registered = render_registered_pose(setup.skeleton, q, ring)
                found = recognise(setup.skeleton, registered, cameras, seen, threshold=0.0)
                if found is not None and (best is None or found[1] > best[1]):
                    images = {
                        name: evaluate(sensors.GetOutputPort(f"color_image_{name}"), context)
                        for name in views
                    }
                    best, since = found, 0
                    shown = {k: colour_image_to_picture(one).copy() for k, one in images.items()}
        is_sure = best is not None and best[1] >= setup.settings.recognition
        return is_sure and since >= _MORE_MOMENTS

    look_until(diagram, sensors, look, on_report)
    return best, shown


def _require_colour(scene: LiveScene) -> dict[str, PinholeCamera]:
    """The cameras of a scene, whose colour pictures show skin."""
    cameras = {}
    for name, camera in scene.cameras.items():
        if scene.specifications[name].gives_masks:
            raise SceneError(
                f"{scene.path}: camera '{name}' delivers masks; the paper's stages look for skin "
                "in colour pictures: give these, and a background of the empty room"
            )
        if not isinstance(camera, PinholeCamera):
            raise CameraError(f"camera '{name}': the paper's stages need a pinhole camera")
        cameras[name] = camera
    return cameras
