"""Capture by the stages of Date et al., as pictures come: skin, rays, inverse kinematics, search.

The registered pose, upright with both arms spread, begins it and sets it right.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import ArticulatedModel, load_model
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.errors import CameraError, SceneError, SettingsError, UnknownNameError
from drake_pose.files.folder import require_empty
from drake_pose.jobs.live.capture import record_frames
from drake_pose.jobs.live.frame_results import LiveResult, LiveWriter
from drake_pose.jobs.live.run import FrameWatch, LiveFrame, look_until
from drake_pose.jobs.live.scene import LiveScene
from drake_pose.jobs.live.settings import LiveSettings
from drake_pose.person.date.capture import CaptureSettings, CaptureSetup, PersonView
from drake_pose.person.date.faces import FaceTemplates, learn_recorded_faces
from drake_pose.person.date.recognition import (
    Recognition,
    RegisteredPose,
    recognise,
    register_pose,
    stand_registered,
)
from drake_pose.person.date.skeleton import FEATURES, load_skeleton
from drake_pose.person.shape import tracker_of_person
from drake_pose.silhouette.pictures.scene_checks import frame_ranges
from drake_pose.systems.colour_images import colour_image_to_picture
from drake_pose.systems.date.capture import build_paper_capture
from drake_pose.systems.date.preparation import prepare_paper_capture
from drake_pose.systems.date.stages import HorizontalImage
from drake_pose.systems.person.live_capture import LiveSensors
from drake_pose.systems.pictures.camera_rig import build_camera_rig
from drake_pose.systems.ports import evaluate

Array = NDArray[np.float64]
Picture = NDArray[np.uint8]

METHOD = "paper_capture"
"""What summary.json calls it."""

# A choice: of simulated persons who are followed the mean IoU is about 0.8 and more.
_LEAST_IOU = 0.6
# The arms may still be on their way up: so many more moments are looked at for a better one.
_MORE_MOMENTS = 10


def capture_paper(
    scene: LiveScene,
    out: Path,
    model_path: Path | None = None,
    settings: LiveSettings | None = None,
    open_sensors: Callable[[], LiveSensors] | None = None,
    on_report: Callable[[str], None] = lambda _: None,
    on_frame: Callable[[int, bool], None] = lambda _, __: None,
) -> LiveResult:
    """Captures a person the paper's way, and writes the result's folder.

    Recorded pictures are read twice: for the registered pose, and then to follow the person. Ctrl-C
    ends the capture, and keeps everything.

    Args:
        out: the result's folder, empty or not there.
        model_path: a person of the same build as the bundled one, which is taken where not given;
            its measures are taken as they are.
        settings: no shape can be given or fitted; without a camera before the face, and templates
            as of learn_recorded_faces, its direction is found by inverse kinematics alone.
        open_sensors: opens the sensors; where not given the scene's. Called twice.
        on_report: called at once when cameras stop and return, and with bad pictures.
        on_frame: called with each frame: how many there are, and whether a person was found.

    Raises:
        SceneError, CameraError, ModelError, SettingsError, UnknownNameError: what was given cannot
            be captured so, or nobody showed the registered pose.
        OutputError: the result cannot be written.
    """
    settings, opener = settings or LiveSettings(), open_sensors or scene.open_sensors
    if settings.shape is not None:
        raise SettingsError("the paper's method takes the model's measures: give no shape")
    model = load_model(model_path or bundled_model("person"), package_paths=settings.packages)
    require_empty(out)
    faces = None if settings.faces is None else learn_recorded_faces(settings.faces)
    search = _RegisteredPoseSearch(scene, model, settings.face_camera, faces)
    setup = search.run(opener(), on_report)
    sensors = opener()
    try:
        tracker = tracker_of_person(model.pose_tree(), None)
        writer = LiveWriter(
            scene, model, tracker, out, sensors.period, settings.packages, on_report, on_frame
        )
        diagram = build_paper_capture(setup, sensors, sensors.period).diagram
        watch = _PaperWatch(diagram, setup.cameras, writer)
        return record_frames(METHOD, diagram, sensors, watch, writer, settings)
    finally:
        sensors.close()


class _RegisteredPoseSearch:
    """Looks for the registered pose in a scene's pictures: upright, both arms spread."""

    def __init__(
        self,
        scene: LiveScene,
        model: ArticulatedModel,
        face_camera: str | None = None,
        faces: FaceTemplates | None = None,
    ) -> None:
        self._cameras = _require_colour(scene)
        if face_camera is not None and face_camera not in scene.cameras:
            raise UnknownNameError("camera", face_camera, scene.cameras, str(scene.path))
        self._scene, self._model = scene, model
        self._face_camera, self._faces = face_camera, faces
        ring = {name: one for name, one in self._cameras.items() if name != face_camera}
        self._settings = CaptureSettings()
        self._setup = CaptureSetup(load_skeleton(model), ring, settings=self._settings)
        self._rig = build_camera_rig(model, ring)
        self._context = self._rig.diagram.CreateDefaultContext()
        self._registered: RegisteredPose | None = None
        self._best: Recognition | None = None
        self._shown: dict[str, Picture] = {}
        self._since = 0

    def run(self, sensors: LiveSensors, on_report: Callable[[str], None]) -> CaptureSetup:
        """What the capture needs, from the pictures of the registered pose; uses the sensors up."""
        builder = DiagramBuilder()
        builder.AddNamedSystem("picture_capture", sensors)
        images = {name: sensors.GetOutputPort(f"color_image_{name}") for name in self._cameras}
        seers = {}
        for name, camera in self._setup.cameras.items():
            seer = HorizontalImage(camera, self._scene.backgrounds[name], self._settings.skin)
            builder.AddNamedSystem(f"horizontal_image_{name}", seer)
            builder.Connect(images[name], seer.GetInputPort("color_image"))
            seers[name] = seer.GetOutputPort("person_view")

        def look(context: Context) -> bool:
            if evaluate(sensors.GetOutputPort("fresh"), context)[0]:
                views = {name: evaluate(port, context) for name, port in seers.items()}
                seen = {name: view for name, view in views.items() if view is not None}
                if self._is_best(seen):
                    self._shown = {
                        name: colour_image_to_picture(evaluate(images[name], context)).copy()
                        for name in seen
                    }
            return self._similarity >= self._settings.recognition and self._since >= _MORE_MOMENTS

        look_until(builder.Build(), sensors, look, on_report)
        return self._prepared(on_report)

    @property
    def _similarity(self) -> float:
        return -1.0 if self._best is None else self._best.similarity

    def _is_best(self, views: Mapping[str, PersonView]) -> bool:
        """Whether a moment's views are the most like the registered pose."""
        contours = {name: view.contour for name, view in views.items() if view.contour is not None}
        skeleton, cameras = self._setup.skeleton, [self._setup.cameras[name] for name in contours]
        self._since += 1
        if len(contours) < 2:
            return False
        if self._registered is None:
            q = stand_registered(skeleton, cameras, [one.middle for one in contours.values()])
            ring = list(self._setup.cameras.values())
            self._registered = register_pose(skeleton, q, ring, self._draw)
        seen = list(contours.values())
        found = recognise(skeleton, self._registered, cameras, seen, threshold=0.0)
        if found is None or found.similarity <= self._similarity:
            return False
        self._best, self._since = found, 0
        return True

    def _draw(self, camera: Camera, q: Array) -> NDArray[np.bool_]:
        self._rig.set_positions(self._context, q)
        return self._rig.mask(self._context, camera.name)

    def _prepared(self, on_report: Callable[[str], None]) -> CaptureSetup:
        path, needed = self._scene.path, self._settings.recognition
        if self._best is None:
            raise SettingsError(
                f"{path}: two cameras never saw a person whole at the same time: compare the "
                "pictures with those of the empty room"
            )
        if self._similarity < needed:
            raise SettingsError(
                f"{path}: nobody showed the registered pose, upright with both arms spread: the "
                f"likest silhouettes agree with it by {self._similarity:.2f}, "
                f"{needed:.2f} are needed; show it once, give a model of the person's measures "
                "(urdf/person/make_person.py makes one), or capture by all silhouettes "
                "(--method person)"
            )
        known = {
            name: one
            for name, one in self._cameras.items()
            if name == self._face_camera or name in self._shown
        }
        for name in self._cameras:
            if name not in known:
                on_report(f"camera '{name}' gave no picture of the registered pose: left out")
        return prepare_paper_capture(
            self._model, known, self._face_camera, self._best.q, self._shown,
            self._scene.backgrounds, self._settings, self._faces,
        )  # fmt: skip


def _require_colour(scene: LiveScene) -> dict[str, PinholeCamera]:
    """The cameras of a scene, whose colour pictures show skin."""
    cameras = {}
    for name, camera in scene.cameras.items():
        if scene.specifications[name].gives_masks:
            raise SceneError(
                f"{scene.path}: camera '{name}' delivers masks; the paper's method looks for skin "
                "in colour pictures: give these, and a background of the empty room"
            )
        if not isinstance(camera, PinholeCamera):
            raise CameraError(f"camera '{name}': the paper's method needs a pinhole camera")
        cameras[name] = camera
    return cameras


class _PaperWatch(FrameWatch):
    """Also notes frames whose pose the paper's method gives, but that one should not trust."""

    def __init__(self, diagram: Diagram, cameras: Iterable[str], result: LiveWriter) -> None:
        super().__init__(diagram, cameras, self._note, "person_view")
        self._result = result
        self._unmeasured: Sequence[str] = ()
        self._nobody: list[str] = []
        self._differs: list[str] = []
        self._held: dict[str, list[str]] = {name: [] for name in FEATURES}

    def __call__(self, context: Context) -> None:
        """Notes which features were not measured; where a pose was recognised none need be."""
        support = self._value(context, "last_support")
        is_followed = np.isfinite(self._value(context, "limb_points")).all()
        pairs = zip(FEATURES, support, strict=True)
        self._unmeasured = [name for name, count in pairs if is_followed and not count]
        super().__call__(context)

    def _note(self, frame: LiveFrame) -> None:
        self._result.add(frame)
        name, record = next(reversed(self._result.writer.records.items()))
        if not record.found:
            self._nobody.append(name)
            return
        for feature in self._unmeasured:
            self._held[feature].append(name)
        if np.mean(list(record.ious.values()) or [0.0]) < _LEAST_IOU:
            self._differs.append(name)

    def doubts(self) -> list[str]:
        """What the user should know."""
        said = {"before the registered pose; no pose": self._nobody}
        for name, frames in self._held.items():
            said[f"{name.replace('_', ' ')} not seen; held where it was last"] = frames
        said[
            f"the body and the silhouettes hardly agree (mean IoU below {_LEAST_IOU}); the paper's "
            "method does not notice when it has lost the person, until the registered pose is "
            "shown again"
        ] = self._differs
        known = list(self._result.writer.records)
        return [
            f"frame {frame_ranges(frames, known)}: {text}"
            for text, frames in said.items()
            if frames
        ]
