"""Laws of what a registration compares: poses and overlaps."""

import cv2
import numpy as np

from drake_pose.registration.posed_frames import PosedFrames
from drake_pose.registration.register import (
    distinct_poses,
    frame_misfits,
    keep_distinct,
    overlap_areas,
)
from drake_pose.silhouette.scoring import draw_mask


def test_poses_are_distinct_if_points_are_apart_in_pictures(posed: PosedFrames) -> None:
    """By more than 3 % of the silhouettes' size, from all that were kept before."""
    X_CW, size = posed.camera.X_CW, posed.size
    depth = float((X_CW[:3, :3] @ posed.middle + X_CW[:3, 3])[2])

    def moved(pixels: float) -> np.ndarray:
        X = X_CW.copy()
        X[0, 3] += pixels * depth / posed.camera.focal_x
        return X

    poses = [moved(k * size) for k in (0.0, 0.025, 0.036, 0.05, 0.08, -0.02)]
    found = distinct_poses(posed, poses)
    assert [any(one is pose for one in found) for pose in poses] == [
        True, False, True, False, True, False
    ]  # fmt: skip
    assert len(distinct_poses(posed, poses, apart=0.0)) == 6
    assert [*keep_distinct([1, 5, 2, 9, 6], lambda a, b: abs(a - b) > 1)] == [1, 5, 9]


def test_overlaps_count_pixels_of_scaled_pictures(posed: PosedFrames) -> None:
    X_CW = posed.camera.X_CW
    other = X_CW.copy()
    other[:3, 3] += [0.05, -0.03, 0.1]
    for side in (60.0, np.inf):
        camera = posed.downscaled(side)
        scale = min(1.0, side / posed.size)
        size = round(scale * 640), round(scale * 480)
        assert (camera.width, camera.height) == size
        found = overlap_areas(posed, np.array([X_CW, other]), side)
        for i, X in enumerate((X_CW, other)):
            for k, frame in enumerate(posed.frames):
                drawn = draw_mask(posed.outlines, X @ posed.X_WN[k], camera)
                mask = frame.mask.astype(np.float32)
                shown = cv2.resize(mask, size, interpolation=cv2.INTER_AREA) > 0.5
                counts = [np.count_nonzero(one) for one in (drawn, shown, drawn & shown)]
                assert found[i, k].tolist() == counts
    ratios, inliers = np.array([0.9, 0.3]), np.array([True, False])
    first, second = frame_misfits(posed, X_CW, ratios, inliers)
    assert (first.frame, first.inlier_ratio, first.is_inlier) == (posed.frames[0].name, 0.9, True)
    assert not second.is_inlier
    assert first.E_total < 0.05 < 0.9 < first.iou
