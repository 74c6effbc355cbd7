"""Helpers of the tests of bundled models: .obj files, closed surfaces and masks."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import trimesh

from drake_pose.body import ArticulatedModel
from drake_pose.camera.models import ParallelCamera, look_at
from drake_pose.silhouette.outline import outline_from_mesh
from drake_pose.silhouette.scoring import draw_mask

URDF = Path(__file__).resolve().parents[2] / "urdf"


def written_again(name: str, folder: Path, *options: str) -> list[Path]:
    """Run a model's script into a folder; return the files, relative to the folder."""
    script = URDF / name / f"make_{name}.py"
    subprocess.run([sys.executable, "-B", str(script), "--out", str(folder), *options], check=True)
    return sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())


def committed(name: str) -> list[Path]:
    """Return the files that a model's script writes, relative to the model's folder."""
    folder = URDF / name
    kinds = (".obj", ".mtl", ".urdf", ".yaml")
    return sorted(p.relative_to(folder) for p in folder.rglob("*") if p.suffix in kinds)


def read_obj(path: Path) -> trimesh.Trimesh:
    """Read a surface without merging vertices; check that normals point outwards."""
    rows = [line.split() for line in path.read_text().splitlines()]
    vertices, normals = (
        np.array([row[1:] for row in rows if row[0] == kind], dtype=np.float64)
        for kind in ("v", "vn")
    )
    corners = [[corner.split("//") for corner in row[1:]] for row in rows if row[0] == "f"]
    faces = np.array(corners, dtype=np.int64) - 1
    np.testing.assert_array_equal(faces[..., 0], faces[..., 1])
    mesh = trimesh.Trimesh(vertices, faces[..., 0], process=False)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=2e-3)
    along = np.einsum("ij,ij->i", normals[mesh.faces].mean(axis=1), mesh.face_normals)
    assert np.mean(along > 0.0) > 0.99
    return mesh


def assert_closed(mesh: trimesh.Trimesh) -> None:
    """Check that every shell is closed and faces outwards."""
    assert np.all(mesh.area_faces > 0.0)
    for shell in mesh.split(only_watertight=False):
        assert shell.is_watertight
        assert shell.is_winding_consistent
        assert shell.volume > 0.0


class Silhouettes:
    """Draws masks of a model by a parallel camera from any side."""

    def __init__(self, model: ArticulatedModel):
        self.tree = model.pose_tree()
        self.outlines = [outline_from_mesh(node.mesh) for node in self.tree.nodes]

    def mask(
        self, q: np.ndarray, towards: np.ndarray, target: np.ndarray, size: float
    ) -> np.ndarray:
        """Return a mask (400, 400) seen from a direction (3,), `size` [m] wide."""
        X_WC = look_at(target + 10.0 * np.asarray(towards) / np.linalg.norm(towards), target)
        camera = ParallelCamera("side", 400, 400, 400.0 / size, 199.5, 199.5, X_WC)
        X_WN = self.tree.node_poses(self.tree.values_from_positions(q))
        return draw_mask(self.outlines, camera.X_CW @ X_WN, camera)
