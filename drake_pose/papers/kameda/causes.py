"""Why angles are wrong though the silhouette is matched exactly (Kameda et al., 6.1)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from drake_pose.camera.models import Camera
from drake_pose.search.scoring import SampledTree
from drake_pose.silhouette.areas.scoring import draw_labels

# So few pixels of a segment, or of a difference, are not seen.
_UNSEEN = 20


class Causes(NamedTuple):
    """Why a silhouette does not tell a wrong pose from the true one; both may hold, or neither.

    Neither holds where a segment turns about its own axis.

    Attributes:
        hidden: a segment whose angles are wrong is hidden in both poses: the paper's occlusion.
        inner_edges: edges inside the silhouette differ.
    """

    hidden: bool
    inner_edges: bool


def causes_of_wrong_angles(
    sampled: SampledTree,
    camera: Camera,
    true_values: Sequence[np.ndarray],
    found_values: Sequence[np.ndarray],
) -> Causes:
    """Why a pose is not told from another that has the same silhouette.

    Args:
        sampled: the body.
        camera: the camera.
        true_values, found_values: of each node [rad or m].
    """
    nodes = len(sampled.tree.nodes)
    images = [
        draw_labels(
            sampled.surfaces.at(values),
            range(1, 1 + nodes),
            camera.X_CW @ sampled.tree.node_poses(values),
            camera,
        )
        for values in (true_values, found_values)
    ]
    seen = np.max([np.bincount(one.ravel(), minlength=1 + nodes)[1:] for one in images], axis=0)
    wrong = [
        not np.allclose(true, found, atol=1e-4)
        for true, found in zip(true_values, found_values, strict=True)
    ]
    hidden = bool((seen[wrong] < _UNSEEN).any())
    return Causes(hidden, bool((images[0] != images[1]).sum() >= _UNSEEN))
