"""Benchmark of how the cost of one step of the fit grows (``python -m tests.benchmarks.growth``).

A chain of limbs is fitted to its own silhouettes: contours are compared in all frames and cameras,
and the normal equations are solved once. One quantity grows at a time.
"""

import math
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from drake_pose.body import TriangleMesh, load_model
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.models import circle_of_cameras
from drake_pose.fit.evidence import Observation, find_edge_points, pack_evidence
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.parameters import BodyParameters
from drake_pose.fit.problem import Problem, Unknowns
from drake_pose.silhouette.outline import outline_from_mesh
from drake_pose.silhouette.scoring import draw_mask
from tests.benchmarks.speed import fastest, limb_mesh
from tests.benchmarks.tables import print_table

GROWING = {
    "cameras": (1, 2, 4, 8, 16),
    "joints": (6, 12, 24, 60),
    "triangles": (1e2, 1e3, 1e4, 1e5, 1e6),
    "pixels": (1e5, 1e6, 1e7),
    "frames": (1, 10, 100, 1000),
}
"""Values of each quantity; the others have the defaults of ``measure_step``. Triangles are those of
all nodes."""


def measure_step(
    cameras: int = 2, joints: int = 6, triangles: float = 1e3, pixels: float = 1e5, frames: int = 1
) -> float:
    """Return the CPU time of one step [s]."""
    columns = max(4, round(math.sqrt(0.5 * triangles / (joints + 1))))
    limb, links = limb_mesh(columns, columns + 1), joints + 1
    seen_as = '<visual><geometry><sphere radius="0.05"/></geometry></visual>'
    parts = ['<link name="world"/><joint name="base" type="fixed"><parent link="world"/>']
    parts += ['<child link="limb0"/></joint>']
    parts += [f'<link name="limb{k}">{seen_as}</link>' for k in range(links)]
    parts += [
        f'<joint name="joint{k}" type="revolute"><parent link="limb{k}"/>'
        f'<child link="limb{k + 1}"/>'
        f'<origin xyz="0 0 {1.6 / links:.4f}"/><axis xyz="{k % 2} {1 - k % 2} 0"/>'
        '<limit lower="-2" upper="2" effort="1" velocity="1"/></joint>'
        for k in range(joints)
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "chain.urdf"
        path.write_text(f'<robot name="chain">{"".join(parts)}</robot>')
        tree = load_model(path, check=False).pose_tree()
    mesh = TriangleMesh(limb.vertices * 4.0 / links, limb.faces.astype(np.int32))
    kinematics, outlines = TreeKinematics(tree), [outline_from_mesh(mesh)] * len(tree.nodes)
    size = round(math.sqrt(pixels * 4.0 / 3.0)), round(math.sqrt(pixels * 0.75))
    seen = list(circle_of_cameras(cameras, size=size, face_camera=False).values())
    X_WN = kinematics.poses(np.full(len(kinematics.names), 0.05))
    edges = [find_edge_points(draw_mask(outlines, one.X_CW @ X_WN, one), 1.0) for one in seen]
    body = BodyParameters(kinematics, outlines)
    problem = Problem(body, seen, [Unknowns(kinematics.names)])
    steps = (AnnealingStage(0.01, 1e-6),)
    several = [Observation(pack_evidence(edges))] * frames
    return fastest(lambda: problem.solve(several, steps), 3)


def growth_rows() -> Iterator[tuple[str, ...]]:
    """Yield for each growing quantity: its values, times per step [ms] and the exponent."""
    for name, values in GROWING.items():
        times = [measure_step(**{name: value}) for value in values]
        # The exponent is taken at the end, where constant costs matter less.
        last = [math.log(one[-1] / one[-2]) for one in (values, times)]
        yield (
            name,
            ", ".join(f"{value:g}" for value in values),
            ", ".join(f"{1e3 * one:.2g}" for one in times),
            f"{last[1] / last[0]:.2f}",
        )


if __name__ == "__main__":
    headings = ("grows", "values", "milliseconds", "exponent at the end")
    print_table("One step of the fit", headings, growth_rows())
