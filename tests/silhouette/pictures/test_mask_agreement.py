import numpy as np
import pytest

from drake_pose.silhouette.pictures.masks import signed_distances


def test_signed_distances_are_those_to_the_nearest_pixel_of_the_other_kind() -> None:
    mask = np.random.default_rng(4).random((14, 17)) < 0.6
    found = signed_distances(mask)
    inside, outside = np.argwhere(mask), np.argwhere(~mask)
    for row, column in np.ndindex(mask.shape):
        others = outside if mask[row, column] else inside
        nearest = np.linalg.norm(others - [row, column], axis=1).min() - 0.5
        expected = -nearest if mask[row, column] else nearest
        assert found[row, column] == pytest.approx(expected, abs=1e-4)
