"""A second process that compiles a search's last kernels: on two cores a third less waiting.

``python -m drake_pose.jobs.estimate.compile_ahead``; what is compiled is shared.
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
from drake_pose.search.multi_start import small_match
from drake_pose.silhouette.outline import TreeSurfaces, pack


@contextmanager
def compiling_ahead() -> Iterator[None]:
    """Lets a second process compile as long as the kernels are not stored and the block runs."""
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
    """Goes through a search from its end to its beginning, with a small body and picture."""
    tree, view = small_match()
    surfaces = simplify_surfaces(TreeSurfaces(tree))
    # The kernel that takes longest, by itself: the first process compiles what comes before it.
    views = pack_views([view.camera], [find_edge_points(view.mask, 1.0)])
    X_WN = tree.node_poses(tree.default_values())
    compare_contours(pack(surfaces), X_WN, *views, np.ones((1, 4)), 0, 1.0, False)
    fit, search = ViewsFit(TreeKinematics(tree), surfaces, [view]), MultiStartSearch(tree)
    fit.refine(fit.kinematics.flatten(tree.default_values()), search.settings.medium)
    search.match([view])


if __name__ == "__main__":
    main()
