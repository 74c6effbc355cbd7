"""Date's capture of a person as Drake systems: preparation, stages, pose, and diagram (figure 1).

Section numbers are those of Date's paper.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    InputPort,
    InputPortIndex,
    OutputPort,
    System,
)
from pydrake.systems.sensors import ImageRgba8U

from drake_pose.arrays import Array, Mask, Picture
from drake_pose.body import ArticulatedModel
from drake_pose.camera.models import Camera, PinholeCamera, circle_of_cameras
from drake_pose.errors import SettingsError, UnknownNameError
from drake_pose.person.date.features import (
    FaceTemplates,
    Features,
    PersonView,
    RegisteredPose,
    cut_face,
    find_face,
    find_features,
    head_angles,
    learn_faces,
    recognise,
    register_pose,
    see_person,
)
from drake_pose.person.date.pose import estimate_pose
from drake_pose.person.date.skeleton import FEATURES, LIMBS, Skeleton, load_skeleton
from drake_pose.silhouette.segmentation import Background, person_region
from drake_pose.systems.cameras import build_camera_rig, colour_image_to_picture
from drake_pose.systems.picture_capture import PersonRegion, connect_images
from drake_pose.systems.ports import (
    MemorySystem,
    PortedSystem,
    StagedDiagram,
    connect_matching_ports,
    export_outputs,
    require_distinct_cameras,
    require_period,
)

FARTHEST_FACE = 30.0
"""Largest distance of a face from the eigenspace [grey levels]."""


@dataclass(frozen=True, eq=False)
class CaptureSetup:
    """The constants of a capture.

    Raises:
        SettingsError: there are fewer than two cameras, or the face camera has the name of another.
    """

    skeleton: Skeleton  # The person's model.
    cameras: Mapping[str, Camera]  # Cameras on the circle around the person, by name.
    face_camera: Camera | None = None  # Camera that sees the face; None: there is none.
    # Templates of the person's face; None: the face's direction is not measured.
    faces: FaceTemplates | None = None
    # Pose that is recognised without earlier frames; None: there is none.
    registered: RegisteredPose | None = None
    # Background model of each camera that gives no masks, by name of the camera.
    backgrounds: Mapping[str, Background] = field(default_factory=dict)
    # Whether elbows and knees are searched on their circles; see estimate_pose.
    search: bool = True
    # Smallest similarity at which the registered pose replaces the state.
    recognition: float = 0.93

    def __post_init__(self) -> None:
        if len(self.cameras) < 2:
            raise SettingsError("3-D points need two cameras or more besides the face camera")
        if self.face_camera is not None and self.face_camera.name in self.cameras:
            raise SettingsError(
                f"the face camera '{self.face_camera.name}' is also one of the cameras on the "
                "circle; it must be another one"
            )


def prepare_paper_capture(
    model: ArticulatedModel,
    cameras: Mapping[str, PinholeCamera],
    face_camera: str | None,
    q: Array,
    pictures: Mapping[str, Picture],
    backgrounds: Mapping[str, Background],
    faces: FaceTemplates | None = None,
) -> CaptureSetup:
    """Prepare a capture while the person, ``model``, shows the registered pose.

    The pictures show where the person's skin is visible; the registered pose is rendered.

    Args:
        cameras: all cameras, by name.
        face_camera: name of the face camera; None: there is none.
        q: (nq,) the person's positions in the registered pose [rad or m].
        pictures: (H, W, 3), red, green, blue, by name of the camera, of the cameras on the circle.
        backgrounds: background models by camera; that of the face camera may be missing.
        faces: templates of the person's face; None: rendered ones if there is a face camera.

    Raises:
        UnknownNameError: there is no such face camera.
        SettingsError: there are fewer than two other cameras.
        ModelError: the model's structure is not that of the bundled person.
    """
    if face_camera is not None and face_camera not in cameras:
        raise UnknownNameError("camera", face_camera, cameras, "the rig")
    ring = {name: camera for name, camera in cameras.items() if name != face_camera}
    own = load_skeleton(model)
    views = [see_person(pictures[n], person_region(pictures[n], backgrounds[n])) for n in ring]
    seen = find_features(list(ring.values()), views, own.features(q))
    places = np.where(seen.support[:, None] > 0, seen.positions, np.nan)
    skeleton = own.with_features(q, places)
    registered = render_registered_pose(skeleton, q, ring)
    if face_camera is not None and faces is None:
        faces = learn_rendered_faces(model, own, q)
    face = None if face_camera is None else cameras[face_camera]
    return CaptureSetup(skeleton, ring, face, faces, registered, backgrounds)


def render_registered_pose(
    skeleton: Skeleton, q: Array, cameras: Mapping[str, PinholeCamera]
) -> RegisteredPose:
    """Return the pose q (nq,) with its silhouettes rendered in ``cameras``, for recognition."""
    rig = build_camera_rig(skeleton.model, cameras)
    context = rig.diagram.CreateDefaultContext()

    def draw(camera: Camera, positions: Array) -> Mask:
        rig.set_positions(context, positions)
        return rig.mask(context, camera.name)

    return register_pose(skeleton, q, list(cameras.values()), draw)


def learn_rendered_faces(model: ArticulatedModel, skeleton: Skeleton, q: Array) -> FaceTemplates:
    """Return face templates from 300 rendered pictures at q (nq,); ``skeleton`` is of ``model``."""
    head = skeleton.features(q)[0]
    view, size = math.radians(11.0), (200, 200)
    placed = circle_of_cameras(1, height=float(head[2]), target=head, field_of_view=view, size=size)
    name, camera = next(iter(placed.items()))
    azimuth = math.atan2(camera.X_WC[1, 3] - head[1], camera.X_WC[0, 3] - head[0])
    rig = build_camera_rig(model, placed)
    context = rig.diagram.CreateDefaultContext()
    faces, directions = [], []
    for turn in np.radians(np.linspace(-80.0, 80.0, 20)):
        for nod in np.radians(np.linspace(-35.0, 50.0, 15)):
            posed = np.array(q)
            posed[skeleton.head_angles] = azimuth + turn, nod
            posed[skeleton.head_positions] += head - skeleton.features(posed)[0]
            rig.set_positions(context, posed)
            picture = rig.picture(context, name)
            seen = see_person(picture, rig.mask(context, name))
            face = cut_face(picture, seen.blobs)
            if face is not None:
                faces.append(face)
                directions.append((turn, nod))
    return learn_faces(faces, np.array(directions))


def _add_views(
    system: PortedSystem, cameras: Sequence[Camera]
) -> Callable[[Context], tuple[list[Camera], list[PersonView]]]:
    """Add input ports ``person_view_<camera>``; return a function of a context: cameras, views.

    Raises SettingsError: there are fewer than two cameras, or two have the same name.
    """
    require_distinct_cameras(cameras, 2, "two or more different cameras are needed, not")
    given = system.add_camera_inputs({one.name: f"person_view_{one.name}" for one in cameras})

    def seen(context: Context) -> tuple[list[Camera], list[PersonView]]:
        views = given(context)
        return [one for one in cameras if one.name in views], list(views.values())

    return seen


class HorizontalImage(PersonRegion):
    """Finds the person in one camera's picture: region, skin-coloured blobs in it, contour.

    .. pydrake_system::

        name: HorizontalImage
        input_ports: [color_image, label_image (optional)]
        output_ports: [region, person_view]

    The paper's horizontal image processing module (3.1.1). The system has no state. Inputs,
    arguments and errors are those of ``PersonRegion``, and:

    Output ports:
        region: see ``PersonRegion``.
        person_view: a ``person.date.features.PersonView``; None if an image is missing.
    """

    def __init__(self, camera: Camera, background: Background | None = None) -> None:
        super().__init__(camera, background)
        self.wanted = ("color_image",) if background is not None else ("color_image", "label_image")

        def see(context: Context) -> PersonView | None:
            picture, region = self.picture.Eval(context), self.region.Eval(context)
            if picture is None or region is None:
                return None
            return see_person(picture, region)

        self.add_output("person_view", None, see)


class FeatureFinder(PortedSystem):
    """Finds head, hands and feet in space where the rays of skin-coloured blobs meet.

    .. pydrake_system::

        name: FeatureFinder
        input_ports: [person_view_<camera>, last_features]
        output_ports: [found, features, support]

    The first part of the paper's 3-D module (3.1.2). The system has no state.

    Input ports:
        person_view_<camera>: a PersonView; a camera that is not connected or gives None is ignored.
        last_features (15): positions in the last frame of head, left hand, right hand, left foot
            and right foot [m]; nothing is found while they are NaN.

    Output ports:
        found: a ``person.date.features.Features`` with all 3-D points, or None.
        features (15): as ``last_features``, and equal to them where nothing was measured [m].
        support (5): number of 3-D points that gave each feature; 0: not measured.

    ``cameras``: in the order of the input ports.

    Raises SettingsError: there are fewer than two cameras, or two have the same name.
    """

    def __init__(self, cameras: Sequence[Camera]) -> None:
        super().__init__()
        size = 3 * len(FEATURES)
        seen = _add_views(self, cameras)
        self.add_input("last_features", size)

        def find(context: Context) -> Features | None:
            last = self.GetInputPort("last_features").Eval(context).reshape(-1, 3)
            if not np.isfinite(last).all():
                return None
            cameras, views = seen(context)
            return find_features(cameras, views, last)

        found = self.add_output("found", None, find)
        self.add_reading("features", size, found, np.nan, lambda one: one.positions.ravel())
        self.add_reading("support", len(FEATURES), found, 0.0, lambda one: one.support)


class FaceDirectionFinder(PortedSystem):
    """Finds the direction of the face in the face camera's picture by eigenspace templates.

    .. pydrake_system::

        name: FaceDirectionFinder
        input_ports: [color_image, person_view]
        output_ports: [face_direction]

    The paper's face processing module (3.2). The system has no state.

    Input ports:
        color_image (ImageRgba8U): of the face camera.
        person_view: of the same picture, from a ``HorizontalImage``.

    Output ports:
        face_direction (2): turn to the person's left and nod downwards, relative to facing the
            camera [rad]; NaN if no face is visible or an input is missing.

    ``templates``: templates of the person's face.
    """

    def __init__(self, camera: Camera, templates: FaceTemplates) -> None:
        super().__init__()
        self.add_input("color_image", ImageRgba8U(camera.width, camera.height))
        self.add_input("person_view", None)

        def find(context: Context) -> Array:
            image, view = (self.eval_input(context, k) for k in ("color_image", "person_view"))
            if image is None or not image.size() or view is None:
                return np.full(2, np.nan)
            return find_face(colour_image_to_picture(image), view.blobs, templates, FARTHEST_FACE)

        self.add_output("face_direction", 2, find)


class PoseRecogniser(PortedSystem):
    """Recognises the registered pose in the current views, without earlier frames (section 5).

    .. pydrake_system::

        name: PoseRecogniser
        input_ports: [person_view_<camera>]
        output_ports: [recognition, recognised_positions, similarity]

    The system has no state.

    Input ports:
        person_view_<camera>: a PersonView; a camera that is not connected or gives None is ignored.

    Output ports:
        recognition: the tuple (positions, similarity), or None if the pose is not recognised.
        recognised_positions (nq): of the person in the registered pose [rad or m]; NaN if not
            recognised.
        similarity (1): of the contours; 0 if not recognised.

    ``registered``: the registered pose of the person of ``skeleton``. ``cameras``: in the order of
    the input ports, as in the registered pose. ``threshold``: smallest similarity at which the pose
    is recognised.
    """

    def __init__(
        self,
        skeleton: Skeleton,
        registered: RegisteredPose,
        cameras: Sequence[Camera],
        threshold: float,
    ) -> None:
        super().__init__()
        seen_by = _add_views(self, cameras)

        def see(context: Context) -> tuple[Array, float] | None:
            going, seen = seen_by(context)
            contours = [view.contour for view in seen]
            return recognise(skeleton, registered, going, contours, threshold)

        recognition, nq = self.add_output("recognition", None, see), len(registered.q)
        self.add_reading("recognised_positions", nq, recognition, np.nan, lambda one: one[0])
        self.add_reading("similarity", 1, recognition, 0.0, lambda one: [one[1]])


class PaperPoseEstimator(MemorySystem):
    """Estimates the person's positions, and keeps the state that one frame passes to the next.

    .. pydrake_system::

        name: PaperPoseEstimator
        input_ports: [person_view_<camera>, features, support, face_direction (optional),
          recognised_positions (optional), fresh (optional)]
        output_ports: [estimated_positions, last_features, last_support, limb_points]

    A periodic update computes stepwise inverse kinematics of upper body, waist and legs, and
    searches elbows and knees; output ports read the result, NaN until the person is known.
    ``recognised_positions`` that are finite replace the state.

    Input ports:
        person_view_<camera>: a PersonView; a camera that is not connected or gives None is ignored.
        features, support: from a ``FeatureFinder``.
        face_direction (2): from a ``FaceDirectionFinder``.
        recognised_positions (nq): from a ``PoseRecogniser``.
        fresh (1): 0: the update does nothing.

    Output ports:
        estimated_positions (nq): [rad or m].
        last_features (15): features of this frame [m], which ``FeatureFinder`` needs in the next.
        last_support (5): their support.
        limb_points (36): root, middle joint and end of left arm, right arm, left leg and right leg
            [m]; NaN if the pose was recognised, because no limb was searched.

    ``period``: time between two frames [s].

    Raises SettingsError: the period is not positive.
    """

    def __init__(self, setup: CaptureSetup, period: float) -> None:
        super().__init__()
        require_period("estimator", period)
        self.setup = setup
        nq, places = len(setup.skeleton.lower), 3 * len(FEATURES)
        self._seen = _add_views(self, list(setup.cameras.values()))
        inputs = {
            "features": places, "support": len(FEATURES), "face_direction": 2,
            "recognised_positions": nq, "fresh": 1,
        }  # fmt: skip
        for name, size in inputs.items():
            self.add_input(name, size)
        states = {
            "estimated_positions": nq, "last_features": places, "last_support": len(FEATURES),
            "limb_points": 9 * len(LIMBS),
        }  # fmt: skip
        unknown = {name: np.full(size, np.nan) for name, size in states.items()}
        self.declare_vectors(unknown, unknown, period)

    def next_vectors(self, context: Context, known: dict[str, Array]) -> Mapping[str, Array]:
        """Return the state vectors, by name, that the context's inputs change; ``known``: all."""
        fresh = self._finite_input(context, "fresh")
        if fresh is not None and not fresh[0]:
            return {}
        recognised, features = (
            self._finite_input(context, name) for name in ("recognised_positions", "features")
        )
        if recognised is not None:
            return {
                "estimated_positions": recognised,
                "last_features": self.setup.skeleton.features(recognised),
                "last_support": np.zeros(len(FEATURES)),
                "limb_points": np.full(9 * len(LIMBS), np.nan),
            }
        if features is None or not np.isfinite(known["estimated_positions"]).all():
            return {}
        features = features.reshape(-1, 3)
        support = self.GetInputPort("support").Eval(context).astype(np.int64)
        face_camera, angles = self.setup.face_camera, None
        direction = self._finite_input(context, "face_direction")
        if face_camera is not None and direction is not None:
            angles = head_angles(direction, features[0], face_camera)
        cameras, views = self._seen(context)
        q, limbs = estimate_pose(
            self.setup.skeleton, known["estimated_positions"], features, angles, cameras,
            [view.region for view in views], search=self.setup.search,
        )  # fmt: skip
        return {
            "estimated_positions": q,
            "last_features": features,
            "last_support": support,
            "limb_points": np.array([limbs[name] for name in LIMBS]),
        }

    def _finite_input(self, context: Context, name: str) -> Array | None:
        """Return the vector at the input port ``name``; None if not connected or not finite."""
        value: Array | None = self.eval_input(context, name)
        return value if value is not None and np.isfinite(value).all() else None


def build_paper_capture(
    setup: CaptureSetup, source: System | None = None, period: float = 1.0 / 30.0
) -> StagedDiagram[PaperPoseEstimator]:
    """Build a diagram that captures a person: images, the paper's stages, and the pose.

    Its output ports are those of ``PaperPoseEstimator``, ``person_view_<camera>``, if the setup
    allows them ``face_direction``, ``recognised_positions`` and ``similarity``, and if the source
    has it ``time``. The source's input ports are exported under their names.

    ``setup``: constants of the capture. Without a registered pose, the person is never found.
    ``source``: has an output port ``color_image_<camera>`` for each camera, for example a rig's
    diagram (``build_camera_rig``), recorded pictures or live cameras. A camera without a background
    in the setup also needs ``label_image_<camera>``. A source without new pictures in each period
    has the output port ``fresh``. None: the images are inputs of the diagram. ``period``: time
    between two frames [s].

    Raises SettingsError: the source lacks an output port, or the period is not positive.
    """
    builder = DiagramBuilder()
    if source is not None:
        builder.AddNamedSystem("source", source)
        for index in range(source.num_input_ports()):
            port = source.get_input_port(InputPortIndex(index))
            builder.ExportInput(port, port.get_name())
    face, cameras = setup.face_camera, list(setup.cameras.values())
    views: dict[str, OutputPort] = {}
    wanted: dict[str, list[InputPort]] = {}
    regions = []
    for camera in [*cameras, *([] if face is None else [face])]:
        name = camera.name
        image = HorizontalImage(camera, setup.backgrounds.get(name))
        builder.AddNamedSystem(f"horizontal_image_{name}", image)
        regions.append(image.region)
        views[name] = image.GetOutputPort("person_view")
        builder.ExportOutput(views[name], f"person_view_{name}")
        wanted |= {f"{kind}_{name}": [image.GetInputPort(kind)] for kind in image.wanted}
    stages = {"region": tuple(regions), "skin": tuple(views.values())}
    # By stage, the system between images and pose, and its outputs, that for the estimator first.
    parts: dict[str, tuple[System, tuple[str, ...]]] = {}
    if setup.registered is not None:
        recogniser = PoseRecogniser(setup.skeleton, setup.registered, cameras, setup.recognition)
        parts["recognition"] = recogniser, ("recognised_positions", "similarity")
    parts["features"] = FeatureFinder(cameras), ("features",)
    if face is not None and setup.faces is not None:
        finder = FaceDirectionFinder(face, setup.faces)
        parts["face"] = finder, ("face_direction",)
    estimator = PaperPoseEstimator(setup, period)
    for stage, (system, results) in {**parts, "pose": (estimator, ())}.items():
        builder.AddNamedSystem(stage, system)
        for camera in cameras:
            if system.HasInputPort(f"person_view_{camera.name}"):
                port = system.GetInputPort(f"person_view_{camera.name}")
                builder.Connect(views[camera.name], port)
        if system is not estimator:
            stages[stage] = (system.GetOutputPort(results[0]),)
        for name in results if stage != "features" else ():
            builder.ExportOutput(system.GetOutputPort(name), name)
    if face is not None and "face" in parts:
        finder = parts["face"][0]
        builder.Connect(views[face.name], finder.GetInputPort("person_view"))
        wanted[f"color_image_{face.name}"].append(finder.GetInputPort("color_image"))
    for system, _ in parts.values():
        connect_matching_ports(builder, system, estimator)
        connect_matching_ports(builder, estimator, system)
    connect_images(builder, source, wanted)
    if source is not None:
        connect_matching_ports(builder, source, estimator)
        if source.HasOutputPort("time"):
            builder.ExportOutput(source.GetOutputPort("time"), "time")
    export_outputs(builder, estimator)
    return StagedDiagram(builder.Build(), stages, estimator)
