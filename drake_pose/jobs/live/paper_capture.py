"""The pictures with which capture by the stages of Date et al. begins: the registered pose.

It is upright with both arms spread, begins the capture, and sets it right.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from pydrake.systems.framework import Context

from drake_pose.arrays import Picture
from drake_pose.body.model import ArticulatedModel
from drake_pose.camera.models import PinholeCamera
from drake_pose.errors import CameraError, SceneError, SettingsError, UnknownNameError
from drake_pose.jobs.live.run import look_until
from drake_pose.jobs.live.scene import LiveScene
from drake_pose.jobs.live.settings import LiveSettings
from drake_pose.person.date.faces import learn_recorded_faces
from drake_pose.person.date.recognition import (
    Recognition,
    RegisteredPose,
    recognise,
    stand_registered,
)
from drake_pose.person.date.skeleton import load_skeleton
from drake_pose.systems.colour_images import colour_image_to_picture
from drake_pose.systems.date.capture import build_paper_capture
from drake_pose.systems.date.preparation import (
    CaptureSetup,
    prepare_paper_capture,
    render_registered_pose,
)
from drake_pose.systems.person.live_capture import LiveSensors
from drake_pose.systems.ports import evaluate

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
        raise SettingsError("the paper's method takes the model's measures: give no shape")
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
    needed = blank.settings.recognition
    if best.similarity < needed:
        raise SettingsError(
            f"{path}: nobody showed the registered pose, upright with both arms spread: the "
            f"likest silhouettes agree with it by {best.similarity:.2f}, {needed:.2f} are needed; "
            "show it once, give a model of the person's measures (urdf/person/make_person.py "
            "makes one), or capture by all silhouettes (--method person)"
        )
    known = {name: one for name, one in cameras.items() if name == face or name in shown}
    for name in cameras:
        if name not in known:
            on_report(f"camera '{name}' gave no picture of the registered pose: left out")
    return prepare_paper_capture(
        model, known, face, best.q, shown, scene.backgrounds, blank.settings, faces
    )


def _best_moment(
    setup: CaptureSetup,
    ring: Mapping[str, PinholeCamera],
    sensors: LiveSensors,
    on_report: Callable[[str], None],
) -> tuple[Recognition | None, dict[str, Picture]]:
    """The moment that is most like the registered pose, and its pictures."""
    diagram = build_paper_capture(setup, sensors, sensors.period).diagram
    registered: RegisteredPose | None = None
    best: Recognition | None = None
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
                    q = stand_registered(setup.skeleton, cameras, [one.middle for one in seen])
                    registered = render_registered_pose(setup.skeleton, q, ring)
                found = recognise(setup.skeleton, registered, cameras, seen, threshold=0.0)
                if found is not None and (best is None or found.similarity > best.similarity):
                    images = {
                        name: evaluate(sensors.GetOutputPort(f"color_image_{name}"), context)
                        for name in views
                    }
                    best, since = found, 0
                    shown = {k: colour_image_to_picture(one).copy() for k, one in images.items()}
        is_sure = best is not None and best.similarity >= setup.settings.recognition
        return is_sure and since >= _MORE_MOMENTS

    look_until(diagram, sensors, look, on_report)
    return best, shown


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
