"""Benchmarks: ratios measured in one process (`make bench`)."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple

import cv2
import numpy as np
import trimesh
from pydrake.common import MemoryFile
from pydrake.geometry import (
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    InMemoryMesh,
    MakeRenderEngineVtk,
    Mesh,
    PerceptionProperties,
    RenderEngineVtkParams,
    RenderLabel,
    SceneGraph,
)
from pydrake.math import RigidTransform
from rich.console import Console
from scipy.spatial.transform import Rotation

from drake_pose.body.formats.packages import bundled_model
from drake_pose.body.model import load_model
from drake_pose.body.surfaces.mesh import TriangleMesh
from drake_pose.camera.drake import camera_to_drake
from drake_pose.camera.models import Camera, ParallelCamera, PinholeCamera
from drake_pose.papers.date_capture import SilhouetteTrack, Studio
from drake_pose.papers.kameda import (
    experiment_camera,
    experiment_search,
    run_experiment,
)
from drake_pose.papers.kameda_figures import grid_table
from drake_pose.person.date.walking_motion import FEWEST_FRAMES, MOTIONS, make_motion
from drake_pose.silhouette.areas.outline import outline_from_mesh
from drake_pose.silhouette.areas.scoring import prefix_sums, score_bodies
from drake_pose.systems.colour_images import picture_to_colour_image
from tests.benchmarks.scenes import print_table
from tests.silhouette.agreement import measure_agreement

_RENDERER = "benchmark"
# Kameda's: 2.26 pixels a centimetre.
_SIDE, _SCALE = 700, 226.0
_RADIUS, _LENGTH = 0.088, 0.44
_CANDIDATES, _IMAGES = 1000, 30
_CAMERAS, _FRAMES = (4, 8, 16), 12


class KernelFigures(NamedTuple):
    """Of one segment, its triangles, and the time to score one candidate against two sets and of
    one Drake label image [us].
    """

    triangles: int
    kernel_microseconds: float
    label_image_microseconds: float


def measure_kernel(columns: int = 14, rows: int = 16, seed: int = 0) -> KernelFigures:
    """Times the span kernel against Drake label images of the same limb in the same poses.

    The limb is 44 cm by 17.6 cm, in a picture of 700 x 700 pixels at Kameda's scale (100 x 40
    pixels); 14 x 16 give 420 triangles, 72 x 71 give 10,080.

    Args:
        columns, rows: how finely the limb is divided around and along.
        seed: of the poses.
    """
    mesh = limb_mesh(columns, rows)
    camera = ParallelCamera("benchmark", _SIDE, _SIDE, _SCALE, 0.5 * _SIDE, 0.5 * _SIDE, np.eye(4))
    rng = np.random.default_rng(seed)
    X_CN = np.tile(np.eye(4), (_CANDIDATES, 1, 1))
    X_CN[:, :3, :3] = Rotation.random(_CANDIDATES, random_state=rng).as_matrix()
    X_CN[:, :3, 3] = rng.uniform(-1.0, 1.0, (_CANDIDATES, 3))
    prefixes = np.array([prefix_sums(rng.random((_SIDE, _SIDE)) < 0.5) for _ in range(2)])
    outline = outline_from_mesh(mesh)
    kernel = _fastest(lambda: score_bodies([outline], X_CN[:, None], camera, prefixes), 20)
    render = _label_images(mesh, camera, X_CN[:_IMAGES])
    images = _fastest(render, 3)
    return KernelFigures(len(mesh.triangles), kernel / _CANDIDATES * 1e6, images / _IMAGES * 1e6)


def limb_mesh(columns: int, rows: int) -> TriangleMesh:
    """Returns a closed ellipsoid of 2 columns (rows - 1) triangles."""
    polar = np.pi * np.arange(1, rows) / rows
    around = 2.0 * np.pi * np.arange(columns) / columns
    ring = np.column_stack([np.cos(around), np.sin(around), np.zeros(columns)])
    rings = ring * np.sin(polar)[:, None, None]
    rings[:, :, 2] = np.cos(polar)[:, None]
    unit = np.vstack([[[0.0, 0.0, 1.0]], rings.reshape(-1, 3), [[0.0, 0.0, -1.0]]])
    following = np.roll(np.arange(columns), -1)
    last = len(unit) - 1
    triangles = [[0, 1 + a, 1 + b] for a, b in enumerate(following)]
    for first in range(1, 1 + columns * (rows - 2), columns):
        for a, b in enumerate(following):
            lower = first + columns
            triangles += [[first + a, lower + a, lower + b], [first + a, lower + b, first + b]]
    first = last - columns
    triangles += [[first + a, last, first + b] for a, b in enumerate(following)]
    semi_axes = np.array([_RADIUS, _RADIUS, 0.5 * _LENGTH])
    return TriangleMesh(unit * semi_axes, np.array(triangles, dtype=np.int32))


def _label_images(
    mesh: TriangleMesh, camera: ParallelCamera, X_CN: np.ndarray
) -> Callable[[], None]:
    """Returns a function that renders Drake's label image of a mesh in each pose."""
    scene_graph = SceneGraph()
    source = scene_graph.RegisterSource("benchmark")
    frame = scene_graph.RegisterFrame(source, GeometryFrame("segment"))
    shape = Mesh(InMemoryMesh(mesh_file=MemoryFile(obj_text(mesh), ".obj", "segment")))
    instance = GeometryInstance(RigidTransform(), shape, "segment")
    properties = PerceptionProperties()
    properties.AddProperty("label", "id", RenderLabel(1))
    instance.set_perception_properties(properties)
    scene_graph.RegisterGeometry(source, frame, instance)
    scene_graph.AddRenderer(_RENDERER, MakeRenderEngineVtk(RenderEngineVtkParams()))
    context = scene_graph.CreateDefaultContext()
    color, _, X_WC = camera_to_drake(camera, renderer_name=_RENDERER)
    poses = [RigidTransform(X) for X in X_CN]

    def render() -> None:
        for pose in poses:
            vector = FramePoseVector()
            vector.set_value(frame, pose)
            scene_graph.get_source_pose_port(source).FixValue(context, vector)
            query = scene_graph.get_query_output_port().Eval(context)
            query.RenderLabelImage(color, scene_graph.world_frame_id(), X_WC)

    return render


def obj_text(mesh: TriangleMesh) -> str:
    """Returns a mesh as OBJ text with normals, which Drake's VTK engine insists on."""
    surface = trimesh.Trimesh(mesh.vertices, mesh.triangles, process=False)
    return str(surface.export(file_type="obj", include_normals=True))


def _fastest(function: Callable[[], object], repeats: int) -> float:
    """Returns the shortest time of a call [s], after one that warms up."""
    function()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        function()
        times.append(time.perf_counter() - start)
    return min(times)


def measure_cost(cameras: int, size: tuple[int, int] = (640, 480), seed: int = 0) -> np.ndarray:
    """Processor time of region and edge, and of the pose (2,), a frame [ms], the medians.

    A person walks before this many cameras, the face camera included, and is known at first.
    """
    studio = Studio.build(cameras, size, np.random.default_rng([seed, 1]))
    motion = make_motion(studio.skeleton, 4 * FEWEST_FRAMES, seed)
    begin = motion.names.index(MOTIONS[0])
    track = SilhouetteTrack.build(studio.model, studio.cameras, studio.backgrounds)
    track.place(motion.q[begin])
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for q in motion.q[begin : begin + _FRAMES]:
            shots = studio.pictures(q)
            track.step({name: picture_to_colour_image(one) for name, one in shots.items()})
    finally:
        cv2.setNumThreads(threads)
    laps = [(lap["region"] + lap["edge"], lap["pose"]) for lap in track.milliseconds]
    return np.asarray(np.median(laps, axis=0))


def _agreement_rows() -> Iterator[tuple[str, ...]]:
    """The span kernel against Drake's label images, 200 random poses of each bundled body."""
    parallel = experiment_camera()
    centre = parallel.center_x, parallel.center_y
    pinhole = PinholeCamera("front", _SIDE, _SIDE, 1130.0, 1130.0, *centre, parallel.X_WC)
    cameras: dict[str, Camera] = {"parallel": parallel, "pinhole": pinhole}
    held = dict.fromkeys(("position_x", "position_y", "position_z"), 0.0)
    for name in ("woman", "man"):
        model = load_model(bundled_model(name))
        for projection, camera in cameras.items():
            worst, mean, _ = measure_agreement(model, camera, held=held)
            yield name, projection, f"{worst:.3%}", f"{mean:.4%}"


def main() -> None:
    """Print what kernel, agreement with Drake, Date's capture and experiment A come to here."""
    rows = []
    for columns, rings in ((14, 16), (72, 71)):
        triangles, kernel, image = measure_kernel(columns, rings)
        rows.append(
            (str(triangles), f"{kernel:.1f} us", f"{image:.0f} us", f"{image / kernel:.0f}")
        )
    headings: tuple[str, ...] = ("triangles", "kernel, a candidate", "Drake label image", "ratio")
    print_table("One segment, 700 x 700 pixels, one core", headings, rows)
    title = "XOR of the kernel's masks and Drake's, 200 random poses"
    print_table(title, ("body", "projection", "worst", "mean"), _agreement_rows())
    rows = []
    for cameras in _CAMERAS:
        seen, pose = measure_cost(cameras)
        costs = (seen, pose, seen + pose, (seen + pose) / cameras)
        rows.append((str(cameras), *(f"{cost:.1f}" for cost in costs)))
    headings = ("cameras", "region and edge", "pose", "all", "a camera")
    title = "Date, all silhouettes, 640 x 480, one core: milliseconds a frame"
    print_table(title, headings, rows)
    start = time.process_time()
    result = run_experiment(experiment_search())
    seconds = time.process_time() - start
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    Console().print(
        grid_table([[result]]),
        f"experiment A: {seconds:.1f} s CPU on one core; peak memory {memory:.0f} MiB",
    )


if __name__ == "__main__":
    main()
