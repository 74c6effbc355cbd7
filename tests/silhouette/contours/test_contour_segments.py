import numpy as np

from drake_pose.body import TriangleMesh
from drake_pose.camera import PinholeCamera
from drake_pose.silhouette import draw_mask, draw_segments, outline_from_mesh


def box(x: float, y: float, z: float) -> TriangleMesh:
    corners = np.array([(a, b, c) for a in (-x, x) for b in (-y, y) for c in (-z, z)])
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [(a, b, c) for a, b, c, _ in faces] + [(a, c, d) for a, _, c, d in faces]
    return TriangleMesh(corners, np.array(triangles))


def test_the_nearer_part_covers_the_other() -> None:
    camera = PinholeCamera("front", 100, 80, 100.0, 100.0, 49.5, 39.5, np.eye(4))
    outlines = [outline_from_mesh(box(0.1, 0.3, 0.05)), outline_from_mesh(box(0.3, 0.1, 0.05))]
    for far, near in ((0, 1), (1, 0)):
        X_CN = np.tile(np.eye(4), (2, 1, 1))
        X_CN[far, 2, 3], X_CN[near, 2, 3] = 2.0, 1.5
        segments = draw_segments(outlines, X_CN, camera)
        # Where the axis of both goes through the picture, and the nearer part is seen whole.
        assert segments[40, 50] == near + 1
        whole = draw_mask([outlines[near]], X_CN[[near]], camera)
        assert (segments[whole] == near + 1).all()
        np.testing.assert_array_equal(segments > 0, draw_mask(outlines, X_CN, camera))
        assert set(np.unique(segments)) == {0, 1, 2}
