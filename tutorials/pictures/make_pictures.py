"""Draw the pages' pictures with the program: python tutorials/pictures/make_pictures.py."""

import os

os.environ.setdefault("LP_NUM_THREADS", "0")

import tempfile
from pathlib import Path

import cv2
import numpy as np
from pydrake.geometry import LightParameter, MakeRenderEngineVtk, RenderEngineVtkParams, SceneGraph
from pydrake.multibody.plant import MultibodyPlant

from drake_pose.body import ArticulatedModel, bundled_model, load_model
from drake_pose.camera.exchange import camera_to_drake
from drake_pose.camera.models import PinholeCamera
from drake_pose.files.overlay import paint_agreement
from drake_pose.jobs.demo import run_demo
from drake_pose.search import PaperSearch, PaperSearchSettings, View
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer

FOLDER = Path(__file__).resolve().parent
ROOT_POSITION = np.array([0.0, 0.0, 1.49])
POSE_DEG = {
    "head_y": 20,
    "right_upper_arm_z": -80,
    "right_forearm_x": -100,
    "left_upper_arm_x": -20,
    "left_upper_arm_z": 60,
    "left_forearm_x": -20,
    "waist_z": 20,
    "left_thigh_x": -60,
    "left_thigh_z": 20,
    "left_shin_x": 100,
}


def colour_image(model: ArticulatedModel, camera: PinholeCamera, q: np.ndarray) -> np.ndarray:
    """Return the body as Drake's renderer shows it on white (H, W, 3)."""
    scene_graph, plant = SceneGraph(), MultibodyPlant(time_step=0.0)
    source = plant.RegisterAsSourceForSceneGraph(scene_graph)
    model.add_to(plant, scene_graph)
    light = LightParameter(
        type="directional", direction=np.array([0.15, 0.25, 1.0]), frame="camera"
    )
    parameters = RenderEngineVtkParams(default_clear_color=np.ones(3), lights=[light])
    scene_graph.AddRenderer("renderer", MakeRenderEngineVtk(parameters))
    plant.Finalize()
    plant_context, context = plant.CreateDefaultContext(), scene_graph.CreateDefaultContext()
    plant.SetPositions(plant_context, q)
    poses = plant.get_geometry_pose_output_port().Eval(plant_context)
    scene_graph.get_source_pose_port(source).FixValue(context, poses)
    query = scene_graph.get_query_output_port().Eval(context)
    colour_camera, _, X_WC = camera_to_drake(camera, renderer_name="renderer")
    image = query.RenderColorImage(colour_camera, scene_graph.world_frame_id(), X_WC)
    return image.data[:, :, :3].copy()


def woman_picture() -> np.ndarray:
    """Return the true woman, her silhouette, the estimate and the overlay, side by side."""
    X_WC = np.eye(4)
    X_WC[:3, :3] = np.column_stack([[0, 1, 0], [0, 0, -1], [-1, 0, 0]])
    X_WC[:3, 3] = [4.0, 0.0, 0.9]
    camera = PinholeCamera("front", 480, 600, 1250.0, 1250.0, 190.0, 310.0, X_WC)
    woman = load_model(bundled_model("woman"))
    q = np.array(woman.default_positions)
    q[woman.position_index("position_z")] = ROOT_POSITION[2]
    for name, angle in POSE_DEG.items():
        q[woman.position_index(name)] = np.radians(angle)
    renderer = LabelRenderer(woman, camera)
    mask = renderer.mask(q)
    search = PaperSearch(woman.pose_tree(root_position=ROOT_POSITION), PaperSearchSettings())
    result = search.match([View(camera, mask)])
    runs = result.runs
    print(f"woman: E_total {result.E_total:.2%}, {runs} runs, {result.seconds:.2f} s")
    segments = renderer.segments(result.q)
    silhouette = np.repeat(np.where(mask, 255, 24).astype(np.uint8)[:, :, None], 3, axis=2)
    overlay = paint_agreement(mask, segments >= 0, segments)
    return np.hstack(
        [colour_image(woman, camera, q), silhouette, colour_image(woman, camera, result.q), overlay]
    )


def demo_picture() -> np.ndarray:
    """Return the overlay that the demonstration writes."""
    with tempfile.TemporaryDirectory() as folder:
        run_demo(Path(folder) / "demo")
        (file,) = Path(folder).glob("demo/overlay/*/*.png")
        return cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB)


def save(name: str, picture: np.ndarray, height: int) -> None:
    """Write a picture (H, W, 3), scaled to a height [pixel]."""
    width = round(picture.shape[1] * height / picture.shape[0])
    small = cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(FOLDER / name), cv2.cvtColor(small, cv2.COLOR_RGB2BGR))


if __name__ == "__main__":
    save("woman.png", woman_picture(), 320)
    save("demo.png", demo_picture(), 640)
