"""A second process that compiles the kernels that a search needs last.

On two cores the first start takes a third less time. The process runs
``python -m drake_pose.jobs.estimate.compile_ahead``; compiled kernels are cached on disk.
"""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.compiled import is_stored
from drake_pose.fit.contour_fit import pack_views
from drake_pose.fit.evidence import find_edge_points
from drake_pose.fit.kernel import assemble_normal_equations, compare_contours
from drake_pose.fit.surfaces import simplify_surfaces
from drake_pose.search import MultiStartSearch, ViewsFit
from drake_pose.search.multi_start import MEDIUM_STAGES, small_match
from drake_pose.silhouette.outline import TreeSurfaces, pack
from drake_pose.silhouette.scoring import draw_labels


@contextmanager
def compiling_ahead() -> Iterator[None]:
    """Run the second process during the block, unless the kernels are cached already."""
    if is_stored(assemble_normal_equations):
        yield
        return
    command = [sys.executable, "-m", "drake_pose.jobs.estimate.compile_ahead"]
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        try:
            yield
        finally:
            process.terminate()


def main() -> None:
    """Compile the kernels of a search from its end to its start, with a small body and picture."""
    tree, view = small_match()
    surfaces = simplify_surfaces(TreeSurfaces(tree))
    # The kernel that takes longest comes first; the first process compiles earlier steps meanwhile.
    views = pack_views([view.camera], [find_edge_points(view.mask, 1.0)])
    X_WN = tree.node_poses(tree.default_values())
    compare_contours(pack(surfaces), X_WN, *views, np.ones((1, 4)), 0, 1.0, False)
    draw_labels(surfaces, range(1, 1 + len(surfaces)), view.camera.X_CW @ X_WN, view.camera)
    fit, search = ViewsFit(TreeKinematics(tree), surfaces, [view]), MultiStartSearch(tree)
    fit.refine(fit.kinematics.flatten(tree.default_values()), MEDIUM_STAGES)
    search.match([view])


if __name__ == "__main__":
    main()
