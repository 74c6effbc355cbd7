"""The paper's pose estimator (Date et al., 4 and 5), and its capture as a diagram (figure 1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    InputPort,
    InputPortIndex,
    OutputPort,
    System,
)

from drake_pose.arrays import Array
from drake_pose.errors import SettingsError
from drake_pose.person.date.body_pose import estimate_pose, uncross_feet, waist_of
from drake_pose.person.date.faces import head_angles
from drake_pose.person.date.features import expect_features
from drake_pose.person.date.skeleton import FEATURES, LIMBS
from drake_pose.systems.bodies import add_avatar
from drake_pose.systems.date.preparation import CaptureSetup
from drake_pose.systems.date.stages import (
    FaceDirectionFinder,
    FeatureFinder,
    HorizontalImage,
    PoseRecogniser,
    add_views,
)
from drake_pose.systems.pictures.person_region import connect_images
from drake_pose.systems.ports import (
    MemorySystem,
    StagedDiagram,
    connect_same,
    export_outputs,
    require_period,
)


class PaperPoseEstimator(MemorySystem):
    """Estimates the person's positions, and keeps all that one frame hands to the next.

    .. pydrake_system::

        name: PaperPoseEstimator
        input_ports: [person_view_<camera>, features, support, face_direction (optional),
          recognised_positions (optional), fresh (optional)]
        output_ports: [estimated_positions, last_features, last_support, limb_points,
          expected_features]

    Stepwise inverse kinematics of the upper body, waist and legs, and the search for elbows and
    knees. ``recognised_positions`` that are not nan overwrite all without a reset. A camera that is
    unconnected or gives None is left out. While ``fresh`` is 0 nothing is done.

    Outputs, all of them state, nan until the person is known: ``estimated_positions`` (nq) [rad or
    m]; ``last_features`` (15), where head, hands and feet were [m], and ``last_support`` (5), from
    how many 3-D points (``FeatureFinder`` needs them in the next frame); and ``limb_points`` (36),
    root, middle joint and end of left arm, right arm, left leg and right leg as found [m], nan
    where the pose was recognised: no limb was searched then; ``expected_features`` (15), where
    head, hands and feet are expected in the next frame [m], for ``FeatureFinder``, too. The time
    between two frames is ``period`` [s].

    Raises:
        SettingsError: a period that is not positive.
    """

    def __init__(self, setup: CaptureSetup, period: float) -> None:
        super().__init__()
        require_period("estimator", period)
        self.setup = setup
        self._waist = setup.settings.waist or waist_of(setup.skeleton)
        nq, places = len(setup.skeleton.lower), 3 * len(FEATURES)
        self._seen = add_views(self, list(setup.cameras.values()))
        inputs = {
            "features": places, "support": len(FEATURES), "face_direction": 2,
            "recognised_positions": nq, "fresh": 1,
        }  # fmt: skip
        for name, size in inputs.items():
            self.add_input(name, size)
        states = {
            "estimated_positions": nq, "last_features": places, "last_support": len(FEATURES),
            "limb_points": 9 * len(LIMBS), "expected_features": places,
        }  # fmt: skip
        unknown = {name: np.full(size, np.nan) for name, size in states.items()}
        self.keep_vectors(unknown, unknown, period)

    def set_person(self, context: Context, q: Array, features: Array | None = None) -> None:
        """Say where the person is.

        Args:
            q: (nq,) positions [rad or m].
            features: (5, 3) head, hands and feet [m]; those at q where not given.

        Raises:
            SettingsError: another number of positions or features, or one that is not finite.
        """
        _require_finite(q, (len(self.setup.skeleton.lower),), "positions")
        if features is not None:
            _require_finite(features, (len(FEATURES), 3), "features")
        self.set_vectors(context.get_mutable_discrete_state(), self._anew(q, features))

    def next_vectors(self, context: Context, known: dict[str, Array]) -> Mapping[str, Array]:
        """The pose in the pictures of one moment more."""
        fresh = self._known(context, "fresh")
        if fresh is not None and not fresh[0]:
            return {}
        recognised, features = (
            self._known(context, name) for name in ("recognised_positions", "features")
        )
        if recognised is not None:
            return self._anew(recognised, None)
        if features is None or not np.isfinite(known["estimated_positions"]).all():
            return {}
        features = features.reshape(-1, 3)
        support = self.GetInputPort("support").Eval(context).astype(np.int64)
        if self.setup.settings.track_feet:
            order = uncross_feet(self.setup.skeleton, known["estimated_positions"], features)
            features, support = features[order], support[order]
        cameras, views = self._seen(context)
        pose = estimate_pose(
            self.setup.skeleton,
            known["estimated_positions"],
            features,
            self._head_angles(context, features[0]),
            cameras,
            [view.region for view in views],
            search=self.setup.settings.search,
            waist=self._waist,
        )
        before = known["last_features"].reshape(-1, 3)
        support_before = known["last_support"].astype(np.int64)
        return {
            "estimated_positions": pose.q,
            "last_features": features,
            "last_support": support,
            "limb_points": np.array([pose.limbs[name] for name in LIMBS]),
            "expected_features": expect_features(features, support, before, support_before),
        }

    def _anew(self, q: Array, features: Array | None) -> dict[str, Array]:
        """What is known where nothing before counts."""
        places = self.setup.skeleton.features(q) if features is None else features
        return {
            "estimated_positions": q,
            "last_features": places,
            "last_support": np.zeros(len(FEATURES)),
            "limb_points": np.full(9 * len(LIMBS), np.nan),
            "expected_features": places,
        }

    def _known(self, context: Context, name: str) -> Array | None:
        """The value of an input port; None: unconnected, or unknown (nan)."""
        value: Array | None = self.given(context, name)
        return value if value is not None and np.isfinite(value).all() else None

    def _head_angles(self, context: Context, head: Array) -> Array | None:
        """The head's angles in the world (2,) [rad] where the face is seen."""
        camera, direction = self.setup.face_camera, self._known(context, "face_direction")
        if camera is None or direction is None:
            return None
        return head_angles(direction, head, camera)


def _require_finite(values: Array, shape: tuple[int, ...], what: str) -> None:
    if np.shape(values) != shape or not np.isfinite(values).all():
        raise SettingsError(f"the person's {what} must be {shape} finite numbers, not {values}")


@dataclass(frozen=True, eq=False)
class PaperCapture(StagedDiagram):
    """A diagram of the paper's capture; its estimator keeps what one frame hands to the next."""

    estimator: PaperPoseEstimator


def build_paper_capture(
    setup: CaptureSetup,
    source: System | None = None,
    period: float = 1.0 / 30.0,
    meshcat: Meshcat | None = None,
) -> PaperCapture:
    """Wire images to the paper's stages, these to the pose, and that to the avatar.

    The diagram's outputs are those of ``PaperPoseEstimator``, ``person_view_<camera>``, where
    the setup has what they need ``face_direction``, ``recognised_positions`` and ``similarity``,
    and where the source has it ``time``. The source's inputs are the diagram's, by their names.

    Args:
        setup: without a registered pose nobody is found by itself: see
            ``PaperPoseEstimator.set_person``.
        source: what has the output ``color_image_<camera>`` of each camera: a rig's diagram
            (``build_camera_rig``), recorded pictures, live cameras. A camera without a background
            in the setup needs ``label_image_<camera>``, too. A source that is not new in every
            period has the output ``fresh``. None: the images are the diagram's inputs.
        period: time between two frames [s].

    Raises:
        SettingsError: the source lacks an output, or the period is not positive.
    """
    builder = DiagramBuilder()
    if source is not None:
        builder.AddNamedSystem("source", source)
        for index in range(source.num_input_ports()):
            port = source.get_input_port(InputPortIndex(index))
            builder.ExportInput(port, port.get_name())
    images, wanted = _add_images(builder, setup)
    views = {name: image.GetOutputPort("person_view") for name, image in images.items()}
    stages: dict[str, tuple[OutputPort, ...]] = {
        "region": tuple(image.region for image in images.values()),
        "skin": tuple(views.values()),
    }
    estimator = PaperPoseEstimator(setup, period)
    builder.AddNamedSystem("pose", estimator)
    _connect_views(builder, views, estimator)
    for stage, (system, results) in _parts(setup).items():
        builder.AddNamedSystem(stage, system)
        stages[stage] = (system.GetOutputPort(results[0]),)
        if isinstance(system, FaceDirectionFinder):
            builder.Connect(views[system.camera], system.GetInputPort("person_view"))
            wanted[f"color_image_{system.camera}"].append(system.GetInputPort("color_image"))
        _connect_views(builder, views, system)
        connect_same(builder, system, estimator)
        connect_same(builder, estimator, system)
        for name in results if stage != "features" else ():
            builder.ExportOutput(system.GetOutputPort(name), name)
    connect_images(builder, source, wanted)
    if source is not None:
        connect_same(builder, source, estimator)
        if source.HasOutputPort("time"):
            builder.ExportOutput(source.GetOutputPort("time"), "time")
    export_outputs(builder, estimator)
    if meshcat is not None:
        positions = estimator.GetOutputPort("estimated_positions")
        add_avatar(builder, setup.skeleton.model, positions, meshcat, "avatar", period)
    return PaperCapture(builder.Build(), stages, estimator)


def _parts(setup: CaptureSetup) -> dict[str, tuple[System, tuple[str, ...]]]:
    """By stage what comes between images and pose, and its outputs, the estimator's first."""
    parts: dict[str, tuple[System, tuple[str, ...]]] = {}
    cameras, settings = list(setup.cameras.values()), setup.settings
    if setup.registered is not None:
        recogniser = PoseRecogniser(setup.skeleton, setup.registered, cameras, settings.recognition)
        parts["recognition"] = recogniser, ("recognised_positions", "similarity")
    parts["features"] = FeatureFinder(cameras, settings.track_feet), ("features",)
    if setup.face_camera is not None and setup.faces is not None:
        face = FaceDirectionFinder(setup.face_camera, setup.faces, settings.farthest_face)
        parts["face"] = face, ("face_direction",)
    return parts


def _connect_views(
    builder: DiagramBuilder, views: Mapping[str, OutputPort], system: System
) -> None:
    """Connects what the cameras on the circle saw."""
    for name, port in views.items():
        if system.HasInputPort(f"person_view_{name}"):
            builder.Connect(port, system.GetInputPort(f"person_view_{name}"))


def _add_images(
    builder: DiagramBuilder, setup: CaptureSetup
) -> tuple[dict[str, HorizontalImage], dict[str, list[InputPort]]]:
    """One HorizontalImage a camera, the face camera's last, and the images that they want."""
    images: dict[str, HorizontalImage] = {}
    wanted: dict[str, list[InputPort]] = {}
    face = setup.face_camera
    for camera in [*setup.cameras.values(), *([] if face is None else [face])]:
        name = camera.name
        image = HorizontalImage(camera, setup.backgrounds.get(name), setup.settings.skin)
        images[name] = builder.AddNamedSystem(f"horizontal_image_{name}", image)
        builder.ExportOutput(image.GetOutputPort("person_view"), f"person_view_{name}")
        wanted |= {f"{kind}_{name}": [image.GetInputPort(kind)] for kind in image.wanted}
    return images, wanted
