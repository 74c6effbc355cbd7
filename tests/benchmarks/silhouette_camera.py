"""Benchmark: SilhouetteCamera against RgbdSensor's label image in one diagram (`make bench`)."""

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydrake.geometry import MakeRenderEngineVtk, RenderEngineVtkParams
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import RgbdSensor

from drake_pose.body import ParsedModel, bundled_model, load_model
from drake_pose.camera.exchange import camera_to_drake
from drake_pose.camera.models import PinholeCamera, look_at
from drake_pose.silhouette.pictures.label_renderer import EMPTY, label_data
from drake_pose.systems.cameras import SilhouetteCamera
from tests.benchmarks.speed import limb_mesh, write_limb
from tests.benchmarks.tables import print_table

_RENDERER = "benchmark"
_BEND, _ROUNDS, ARM_LINKS = 0.7, 5, 15
_LINK = """
<link name="link_{k}"><visual><origin xyz="0 0 0.06"/><geometry>
  <mesh filename="{mesh}" scale="0.7 0.7 0.3"/></geometry></visual></link>
<joint name="joint_{k}" type="revolute"><parent link="{parent}"/><child link="link_{k}"/>
  <origin xyz="0 0 {length}"/><axis xyz="{axis}"/>
  <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>"""


class CameraFigures(NamedTuple):
    """Comparison of both cameras."""

    ours: float  # Mean CPU time per image of SilhouetteCamera, including poses [s].
    drakes: float  # The same of RgbdSensor.
    worst: float  # Fraction of the body's pixels with different labels.
    mean: float


def arm_model(folder: Path) -> ParsedModel:
    """Return an arm of 15 links of 480 triangles, 13 cm long and 12 cm apart."""
    mesh = write_limb(folder, limb_mesh(16, 16))
    parents = ["world", *(f"link_{k}" for k in range(ARM_LINKS))]
    links = [
        _LINK.format(
            k=k, mesh=mesh, parent=parents[k], length=0.12 * (k > 0), axis=("1 0 0", "0 1 0")[k % 2]
        )
        for k in range(ARM_LINKS)
    ]
    path = folder / "arm.urdf"
    path.write_text(f'<robot name="arm"><link name="world"/>{"".join(links)}</robot>')
    return load_model(path, check=False)


def measure_camera(model: ParsedModel, camera: PinholeCamera, poses: int = 100) -> CameraFigures:
    """Compare labels and CPU time of both cameras in random poses, bent by up to 0.7 rad."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, 0.0)
    model.add_to(plant, scene_graph)
    plant.Finalize()
    scene_graph.AddRenderer(_RENDERER, MakeRenderEngineVtk(RenderEngineVtkParams()))
    color, depth, X_WC = camera_to_drake(camera, renderer_name=_RENDERER, depth_range=(0.01, 60.0))
    sensor = builder.AddSystem(RgbdSensor(scene_graph.world_frame_id(), X_WC, color, depth))
    builder.Connect(scene_graph.get_query_output_port(), sensor.query_object_input_port())
    ours = builder.AddSystem(SilhouetteCamera(plant, scene_graph, camera))
    builder.Connect(plant.get_body_poses_output_port(), ours.GetInputPort("body_poses"))
    context = builder.Build().CreateDefaultContext()
    rng = np.random.default_rng(0)
    low, high = np.maximum(model.lower, -_BEND), np.minimum(model.upper, _BEND)
    held = np.char.startswith(np.array(model.position_names), "position_")
    q = np.where(held, 0.0, rng.uniform(low, np.maximum(low, high), (poses, len(low))))
    own = plant.GetMyMutableContextFromRoot(context)
    labels, seconds = [], []
    for port in (ours.GetOutputPort("label_image"), sensor.label_image_output_port()):
        port_context = port.get_system().GetMyContextFromRoot(context)
        port.Eval(port_context)
        images, spent = [], np.zeros((poses, _ROUNDS))
        for k, positions in enumerate(q):
            for j in range(_ROUNDS):
                plant.SetPositions(own, positions)
                start = time.process_time()
                image = port.Eval(port_context)
                spent[k, j] = time.process_time() - start
            images.append(label_data(image).copy())
        labels.append(images)
        seconds.append(float(spent.min(axis=1).mean()))
    differing = [
        np.count_nonzero(one != other) / np.count_nonzero(other != EMPTY)
        for one, other in zip(*labels, strict=True)
    ]
    return CameraFigures(*seconds, max(differing), float(np.mean(differing)))


def _rows(folder: Path) -> Iterator[tuple[str, ...]]:
    man = load_model(bundled_model("man"))
    for name, model, eye, target in (
        ("arm", arm_model(folder), (2.0, 0.0, 0.6), (0.0, 0.0, 0.6)),
        ("man", man, (2.5, 0.0, 0.3), (0.0, 0.0, 0.0)),
    ):
        X_WC = look_at(eye, target)
        camera = PinholeCamera("front", 640, 480, 540.0, 540.0, 319.5, 239.5, X_WC)
        one = measure_camera(model, camera)
        triangles = sum(len(mesh.triangles) for mesh in model.link_meshes.values())
        times = f"{one.ours * 1e3:.2f} ms", f"{one.drakes * 1e3:.2f} ms"
        ratio, differ = f"{one.drakes / one.ours:.1f}", (f"{one.worst:.3%}", f"{one.mean:.3%}")
        yield name, str(len(model.link_meshes)), f"{triangles:,}", *times, ratio, *differ


def main() -> None:
    """Print the cost of a label image of 640 x 480 pixels with and without a renderer."""
    title = "A label image, 640 x 480 pixels, CPU time (least of 5, mean of 100 poses)"
    headings = (
        *("body", "links", "triangles", "SilhouetteCamera", "RgbdSensor", "ratio"),
        *("labels differ, worst", "mean"),
    )
    with tempfile.TemporaryDirectory() as folder:
        print_table(title, headings, _rows(Path(folder)))


if __name__ == "__main__":
    main()
