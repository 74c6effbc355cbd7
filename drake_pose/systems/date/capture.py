"""The paper's whole capture as a ready diagram (Date et al., figure 1)."""

from __future__ import annotations

from dataclasses import dataclass

from pydrake.geometry import Meshcat
from pydrake.systems.framework import (
    DiagramBuilder,
    InputPortIndex,
    LeafSystem,
    OutputPort,
    System,
)

from drake_pose.camera.models import Camera
from drake_pose.errors import SettingsError
from drake_pose.person.date.capture import CaptureSetup
from drake_pose.systems.bodies.posed_geometry import add_avatar
from drake_pose.systems.date.pose_estimator import PaperPoseEstimator
from drake_pose.systems.date.stages import (
    FaceDirectionFinder,
    FeatureFinder,
    HorizontalImage,
    PoseRecogniser,
)
from drake_pose.systems.staged_diagram import StagedDiagram


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
