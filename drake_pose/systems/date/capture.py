"""The paper's pose estimator (Date et al., 4 and 5), and its capture as a diagram (figure 1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Meshcat
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    DiscreteValues,
    EventStatus,
    InputPortIndex,
    LeafSystem,
    OutputPort,
    System,
)

from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError
from drake_pose.person.date.body_pose import estimate_pose
from drake_pose.person.date.capture import CaptureSetup
from drake_pose.person.date.faces import head_angles
from drake_pose.person.date.features import expect_features
from drake_pose.person.date.skeleton import FEATURES, LIMBS
from drake_pose.systems.bodies.posed_geometry import add_avatar
from drake_pose.systems.date.stages import (
    FaceDirectionFinder,
    FeatureFinder,
    HorizontalImage,
    PoseRecogniser,
    ViewPorts,
)
from drake_pose.systems.staged_diagram import StagedDiagram

Array = NDArray[np.float64]


class PaperPoseEstimator(LeafSystem):
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
        if not period > 0:
            raise SettingsError(f"the estimator's period must be positive, not {period}")
        self.setup = setup
        positions = len(setup.skeleton.lower)
        self._views = ViewPorts(self, list(setup.cameras.values()))
        sizes = {
            "features": 3 * len(FEATURES),
            "support": len(FEATURES),
            "face_direction": 2,
            "recognised_positions": positions,
            "fresh": 1,
        }
        self._ports = {
            name: self.DeclareVectorInputPort(name, size) for name, size in sizes.items()
        }
        unknown = {
            "estimated_positions": positions,
            "last_features": 3 * len(FEATURES),
            "last_support": len(FEATURES),
            "limb_points": 9 * len(LIMBS),
            "expected_features": 3 * len(FEATURES),
        }
        self._states = {
            name: self.DeclareDiscreteState(np.full(size, np.nan)) for name, size in unknown.items()
        }
        for name, state in self._states.items():
            self.DeclareStateOutputPort(name, state)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._estimate)

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
        self._overwrite(context.get_mutable_discrete_state(), q, features)

    def _overwrite(self, state: DiscreteValues, q: Array, features: Array | None) -> None:
        places = self.setup.skeleton.features(q) if features is None else features
        limbs = np.full(9 * len(LIMBS), np.nan)
        self._write(state, q, places, np.zeros(len(FEATURES)), limbs, places)

    def _write(self, state: DiscreteValues, *values: Array) -> None:
        for index, value in zip(self._states.values(), values, strict=True):
            state.set_value(index, np.ravel(value))

    def _value(self, context: Context, name: str) -> Array | None:
        """The value of an input port; None: unconnected, or unknown (nan)."""
        port = self._ports[name]
        value = port.Eval(context) if port.HasValue(context) else None
        return value if value is not None and np.isfinite(value).all() else None

    def _estimate(self, context: Context, state: DiscreteValues) -> EventStatus:
        fresh = self._value(context, "fresh")
        if fresh is not None and not fresh[0]:
            return EventStatus.DidNothing()
        recognised = self._value(context, "recognised_positions")
        if recognised is not None:
            self._overwrite(state, recognised, None)
            return EventStatus.Succeeded()
        features = self._value(context, "features")
        last = context.get_discrete_state(self._states["estimated_positions"]).value()
        if features is None or not np.isfinite(last).all():
            return EventStatus.DidNothing()
        features = features.reshape(-1, 3)
        cameras, views = self._views.evaluate(context)
        pose = estimate_pose(
            self.setup.skeleton,
            last,
            features,
            self._head_angles(context, features[0]),
            cameras,
            [view.region for view in views],
            search=self.setup.settings.search,
            waist=self.setup.settings.waist,
        )
        support = self._ports["support"].Eval(context)
        limbs = np.array([pose.limbs[name] for name in LIMBS])
        before, support_before = (
            context.get_discrete_state(self._states[name]).value()
            for name in ("last_features", "last_support")
        )
        expected = expect_features(features, support, before.reshape(-1, 3), support_before)
        self._write(state, pose.q, features, support, limbs, expected)
        return EventStatus.Succeeded()

    def _head_angles(self, context: Context, head: Array) -> Array | None:
        """The head's angles in the world (2,) [rad] where the face is seen."""
        camera, direction = self.setup.face_camera, self._value(context, "face_direction")
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
    wiring = _Wiring(setup, source)
    estimator = wiring.add("pose", PaperPoseEstimator(setup, period))
    wiring.add_images()
    wiring.watch(estimator)
    cameras, settings = list(setup.cameras.values()), setup.settings
    if setup.registered is not None:
        recogniser = PoseRecogniser(setup.skeleton, setup.registered, cameras, settings.recognition)
        wiring.watch(wiring.add("recognition", recogniser))
        wiring.finish("recognition", recogniser, "recognised_positions", estimator)
        wiring.export(recogniser.GetOutputPort("similarity"))
    features = FeatureFinder(cameras, settings.features)
    wiring.watch(wiring.add("features", features))
    for name in ("last_features", "expected_features"):
        wiring.connect(estimator, features, name)
    wiring.finish("features", features, "features", estimator, exported=False)
    wiring.connect(features, estimator, "support")
    if setup.face_camera is not None and setup.faces is not None:
        face = FaceDirectionFinder(setup.face_camera, setup.faces, settings.farthest_face)
        wiring.add_face(face, setup.face_camera.name)
        wiring.finish("face", face, "face_direction", estimator)
    if source is not None and source.HasOutputPort("fresh"):
        wiring.connect(source, estimator, "fresh")
    if source is not None and source.HasOutputPort("time"):
        wiring.export(source.GetOutputPort("time"))
    for port in range(estimator.num_output_ports()):
        wiring.export(estimator.get_output_port(port))
    if meshcat is not None:
        positions = estimator.GetOutputPort("estimated_positions")
        model = setup.skeleton.model
        add_avatar(wiring.builder, model, positions, meshcat, "avatar", period)
    return PaperCapture(wiring.builder.Build(), wiring.stages, estimator)


class _Wiring:
    """The diagram under construction; see build_paper_capture."""

    def __init__(self, setup: CaptureSetup, source: System | None) -> None:
        self.setup, self.source = setup, source
        self.builder = DiagramBuilder()
        self.stages: dict[str, tuple[OutputPort, ...]] = {}
        self._images: dict[str, HorizontalImage] = {}
        self._inputs: set[str] = set()
        if source is not None:
            self.builder.AddNamedSystem("source", source)
            for index in range(source.num_input_ports()):
                port = source.get_input_port(InputPortIndex(index))
                self.builder.ExportInput(port, port.get_name())

    def add(self, name: str, system: LeafSystem) -> LeafSystem:
        return self.builder.AddNamedSystem(name, system)

    def export(self, port: OutputPort, name: str | None = None) -> None:
        self.builder.ExportOutput(port, name or port.get_name())

    def add_images(self) -> None:
        """One HorizontalImage a camera, the face camera's last."""
        face = self.setup.face_camera
        for camera in [*self.setup.cameras.values(), *([] if face is None else [face])]:
            self._images[camera.name] = self._add_image(camera)
        for stage, name in (("region", "region"), ("skin", "person_view")):
            self.stages[stage] = tuple(image.GetOutputPort(name) for image in self._images.values())
        for name, image in self._images.items():
            self.export(image.GetOutputPort("person_view"), f"person_view_{name}")

    def _add_image(self, camera: Camera) -> HorizontalImage:
        name, background = camera.name, self.setup.backgrounds.get(camera.name)
        image = HorizontalImage(camera, background, self.setup.settings.skin)
        self.add(f"horizontal_image_{name}", image)
        self._connect_image("color_image", name, image)
        if background is None:
            self._connect_image("label_image", name, image)
        return image

    def _connect_image(self, kind: str, camera: str, system: LeafSystem) -> None:
        """Connects a camera's image of a kind to a system's input of that name."""
        name, port = f"{kind}_{camera}", system.GetInputPort(kind)
        if self.source is None:
            if name in self._inputs:
                self.builder.ConnectInput(name, port)
            else:
                self.builder.ExportInput(port, name)
                self._inputs.add(name)
            return
        if not self.source.HasOutputPort(name):
            background = " (or a background in the setup)" if kind == "label_image" else ""
            raise SettingsError(
                f"camera '{camera}': the source needs an output port {name}{background}; it has: "
                + ", ".join(
                    self.source.get_output_port(k).get_name()
                    for k in range(self.source.num_output_ports())
                )
            )
        self.builder.Connect(self.source.GetOutputPort(name), port)

    def watch(self, system: LeafSystem) -> None:
        """Connects what the cameras on the circle saw."""
        for name in self.setup.cameras:
            view = self._images[name].GetOutputPort("person_view")
            self.builder.Connect(view, system.GetInputPort(f"person_view_{name}"))

    def add_face(self, finder: FaceDirectionFinder, camera: str) -> None:
        """What the face camera sees, to what finds the face's direction."""
        self.add("face", finder)
        self._connect_image("color_image", camera, finder)
        view = self._images[camera].GetOutputPort("person_view")
        self.builder.Connect(view, finder.GetInputPort("person_view"))

    def connect(self, giver: System, taker: System, name: str) -> None:
        """Connects ports of one name."""
        self.builder.Connect(giver.GetOutputPort(name), taker.GetInputPort(name))

    def finish(
        self, stage: str, system: System, name: str, estimator: System, exported: bool = True
    ) -> None:
        """A stage ends in an output that the estimator needs."""
        self.stages[stage] = (system.GetOutputPort(name),)
        self.connect(system, estimator, name)
        if exported:
            self.export(system.GetOutputPort(name))
