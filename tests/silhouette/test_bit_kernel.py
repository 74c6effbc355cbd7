"""Bit masks against the span kernel's masks.

Pruning by balls and discs is compared with brute force in ``tests/search``.
"""

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation

from drake_pose.camera.models import ParallelCamera, PinholeCamera
from drake_pose.silhouette.bit_kernel import draw_bits, make_bit_view
from drake_pose.silhouette.contour_points import divide_outline
from drake_pose.silhouette.outline import outline_from_mesh
from drake_pose.silhouette.scoring import draw_mask
from tests.silhouette.shapes import soup

_POSES = 60


def crooked_surface(seed):
    """Random triangles: open, intersecting, with edges of one and of several triangles."""
    return outline_from_mesh(soup(np.random.default_rng(seed), 30, 60, 0.07))


CAMERAS = [
    ParallelCamera("parallel", 90, 70, 180.0, 40.3, 33.7, np.eye(4)),
    PinholeCamera("pinhole", 90, 70, 150.0, 170.0, 40.3, 33.7, np.eye(4)),
]


def random_poses(seed, depth=1.0):
    X = np.tile(np.eye(4), (_POSES, 1, 1))
    generator = np.random.default_rng(seed)
    X[:, :3, :3] = Rotation.random(_POSES, random_state=generator).as_matrix()
    X[:, :3, 3] = generator.uniform(-0.25, 0.25, (_POSES, 3)) + np.array([0.0, 0.0, depth])
    return X


def random_mask(seed):
    mask = np.zeros((70, 90), dtype=bool)
    mask[12:55, 20:71] = np.random.default_rng(seed).random((43, 51)) < 0.8
    return mask


def read_bits(view, numbers, run, words):
    """The mask (H, W) that a run of words encodes."""
    first, count, place = run
    row = np.zeros(int(numbers[-1, -1]) // 64 + 1, dtype=np.uint64)
    row[first : first + count] = words[place : place + count]
    bits = np.unpackbits(row.view(np.uint8), bitorder="little")
    is_pixel = np.diff(numbers, axis=1) > 0
    part = np.zeros(is_pixel.shape, dtype=bool)
    part[is_pixel] = bits[: int(is_pixel.sum())]
    mask = np.zeros((int(view.camera[7]), int(view.camera[6])), dtype=bool)
    top, left, height, width = view.window
    mask[top : top + height, left : left + width] = part
    return mask


PAIRS = np.column_stack([np.zeros(_POSES), np.arange(_POSES)]).astype(np.int32)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: camera.name)
@pytest.mark.parametrize("spread", [0.0, 0.25])
def test_bits_equal_the_span_kernels_pixels(camera, spread):
    outline, mask = crooked_surface(1), random_mask(2)
    view = make_bit_view(mask, camera.kernel_parameters(), camera.X_CW, 5)
    # At some poses the cells are invalid, and the near plane cuts some.
    X_WN = np.concatenate([random_poses(3)[: _POSES // 2], random_poses(4, 0.2)[_POSES // 2 :]])
    celled = divide_outline(outline, spread)
    kept, areas, runs, words = draw_bits(celled, view, np.eye(4)[None], X_WN, PAIRS, np.inf)
    assert kept.all()
    band = np.zeros(mask.shape, dtype=bool)
    for i, X in enumerate(X_WN):
        drawn = draw_mask([outline], (camera.X_CW @ X)[None], camera)
        assert np.array_equal(read_bits(view, view.inside, runs[i, 0], words), drawn & mask)
        near = read_bits(view, view.margin, runs[i, 1], words)
        band |= near
        assert not (near & (mask | ~drawn)).any()
        far = int((drawn & ~mask & ~near).sum())
        assert areas[i].tolist() == [int((drawn & mask).sum()), int(near.sum()), far]
    distance = distance_transform_edt(~mask)
    assert band.any()
    assert distance[band].max() <= 5 * np.sqrt(2.0)
