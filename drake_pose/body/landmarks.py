"""Anatomical landmarks of a model: named points fixed to its links, from ``landmarks.yaml``."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drake_pose.arrays import Array, Indices
from drake_pose.body.link_graph import PlantKinematics, build_link_graph
from drake_pose.body.parsed_model import ParsedModel
from drake_pose.body.pose_tree import PoseTree
from drake_pose.errors import ModelError, SettingsError, require_known
from drake_pose.input_files import read_yaml, typed_entry


@dataclass
class Landmark:
    """A named point of the object."""

    link: str = ""  # The link that the point is fixed to.
    # (3,) position in the link's frame [m].
    point: np.ndarray = field(default_factory=lambda: np.full(3, np.nan))


@dataclass(frozen=True, eq=False)
class NodeLandmarks:
    """Landmarks in the frames of a pose tree's nodes."""

    names: tuple[str, ...]  # Names of the landmarks.
    nodes: Indices  # (n,) index of each landmark's node.
    points: Array  # (n, 3) positions in the nodes' frames [m].

    def positions(self, X_WN: Array) -> Array:
        """Return the landmarks (..., n, 3) in the world [m], given X_WN (..., nodes, 4, 4)."""
        X = np.asarray(X_WN, dtype=np.float64)[..., self.nodes, :, :]
        rotated = np.einsum("...nij,nj->...ni", X[..., :3, :3], self.points)
        return np.asarray(rotated + X[..., :3, 3])


def landmarks_file(model_path: Path | str) -> Path:
    """Return the path of a model's landmarks: ``landmarks.yaml`` beside the model file."""
    return Path(model_path).with_name("landmarks.yaml")


def load_landmarks(model_path: Path | str) -> dict[str, Landmark]:
    """Read the landmarks, by name, from ``landmarks.yaml`` in a model file's folder.

    The file maps each name to a link and a point in that link's frame [m]::

        landmarks:
          left_elbow: {link: left_forearm, point: [0, 0, 0]}

    Raises ModelError: the file cannot be read or is invalid; the message names the file and the
    entry.
    """
    file = landmarks_file(model_path)
    content = read_yaml(file, ModelError)
    entries = content.get("landmarks") if isinstance(content, dict) else None
    if not isinstance(entries, dict) or not entries or set(content) != {"landmarks"}:
        raise ModelError(f"{file}: one mapping 'landmarks' with at least one entry is expected")
    landmarks = {}
    for name, entry in entries.items():
        landmark = typed_entry(entry, Landmark, f"{file}: '{name}'", ModelError)
        if not landmark.link:
            raise ModelError(f"{file}: '{name}': link must be a link's name")
        if landmark.point.shape != (3,) or not np.all(np.isfinite(landmark.point)):
            raise ModelError(f"{file}: '{name}': point must be three finite numbers [m]")
        landmarks[str(name)] = landmark
    return landmarks


def landmark_positions(
    model: ParsedModel, landmarks: Mapping[str, Landmark], q: Array, X_WB: Array | None = None
) -> Array:
    """Return the landmarks (n, 3) in the world [m], in the mapping's order.

    Args:
        model: the model that the landmarks' links belong to.
        landmarks: the n landmarks by name (``load_landmarks``).
        q: (nq,) the plant's positions [rad or m].
        X_WB: (4, 4) pose of the plant's world frame in the world; None: the identity.

    Raises SettingsError: q has the wrong size or is not finite; UnknownNameError: a landmark's link
    does not exist.
    """
    positions = np.asarray(q, dtype=np.float64)
    count = len(model.position_names)
    if positions.shape != (count,) or not np.all(np.isfinite(positions)):
        raise SettingsError(f"{model.path}: q must be {count} finite numbers")
    bodies = [_body(model, name, landmark.link) for name, landmark in landmarks.items()]
    kinematics = PlantKinematics(model)
    points = np.empty((len(landmarks), 3))
    for row, (body, landmark) in enumerate(zip(bodies, landmarks.values(), strict=True)):
        X = kinematics.pose_at(body, positions)
        points[row] = X[:3, :3] @ landmark.point + X[:3, 3]
    return points if X_WB is None else points @ X_WB[:3, :3].T + X_WB[:3, 3]


def landmarks_of_nodes(tree: PoseTree, landmarks: Mapping[str, Landmark]) -> NodeLandmarks:
    """Return the landmarks in the frames of a tree's nodes, for fast evaluation at many poses.

    ``landmarks``: the landmarks by name (``load_landmarks``).

    Raises UnknownNameError: a landmark's link does not exist; ModelError: a landmark's link moves
    with no node, because it has no geometry.
    """
    model = tree.model
    graph = build_link_graph(model, None)
    node_of_group = {graph.group_of(node.name): index for index, node in enumerate(tree.nodes)}
    kinematics = PlantKinematics(model)
    nodes, points = [], []
    for name, landmark in landmarks.items():
        body = _body(model, name, landmark.link)
        group = graph.group_of(landmark.link)
        if group not in node_of_group:
            raise ModelError(
                f"{model.path}: landmark '{name}' is on link '{landmark.link}', which moves with "
                f"no visible part; use one of {', '.join(node.name for node in tree.nodes)}"
            )
        nodes.append(node_of_group[group])
        X_BN = kinematics.pose(model.link_index(tree.nodes[nodes[-1]].name))
        X_BL = kinematics.pose(body)
        p_B = X_BL[:3, :3] @ landmark.point + X_BL[:3, 3]
        points.append(X_BN[:3, :3].T @ (p_B - X_BN[:3, 3]))
    return NodeLandmarks(
        tuple(landmarks), np.array(nodes, dtype=np.int64), np.array(points).reshape(-1, 3)
    )


def _body(model: ParsedModel, name: str, link: str) -> int:
    """Return the index of ``link`` among the plant's bodies; errors name the landmark ``name``."""
    where = f"{landmarks_file(model.path)}: '{name}': {model.path.name}"
    require_known("link", (link,), model.link_names, where)
    return model.link_index(link)
