"""Areas, hulls and refusals of projected surfaces, against drawn masks and known shapes."""

from contextlib import nullcontext

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from drake_pose.body import TriangleMesh
from drake_pose.camera.models import ParallelCamera, PinholeCamera
from drake_pose.errors import CameraError
from drake_pose.silhouette.outline import BendingOutline, TreeSurfaces, outline_from_mesh
from drake_pose.silhouette.scoring import (
    VisualHull,
    draw_mask,
    prefix_sums,
    require_visible,
    score_bodies,
    subtract_body,
)
from tests.body.models import load_limb
from tests.silhouette.shapes import box, each_camera, random_pose, soup

SIDEWAYS = np.array([[0.0, 0.0, -1.0, 4.0], [1, 0, 0, 0], [0, -1, 0, 0.1], [0, 0, 0, 1]])


@each_camera
def test_scores_equal_sums_over_masks(camera):
    rng = np.random.default_rng(4)
    size = (camera.height, camera.width)
    sets = rng.random((3, *size)) < np.array([0.1, 0.5, 0.9])[:, None, None]
    prefixes = np.array([prefix_sums(region) for region in sets])
    outlines = [outline_from_mesh(soup(rng, 20, 25, 0.3)) for _ in range(4)]
    poses = [random_pose(rng, (*rng.uniform(-0.5, 0.5, 2), 2.0)) for _ in range(60)]
    X_CN = np.reshape(poses, (15, 4, 4, 4))
    whole = score_bodies(outlines, X_CN, camera, prefixes)
    single = score_bodies([outlines[1]], X_CN[:, 1:2], camera, prefixes)
    assert whole.dtype == single.dtype == np.int64
    for n in range(len(X_CN)):
        parts = [draw_mask([o], X[None], camera) for o, X in zip(outlines, X_CN[n], strict=True)]
        union = np.any(parts, axis=0)
        np.testing.assert_array_equal(draw_mask(outlines, X_CN[n], camera), union)
        assert whole[n].tolist() == [union.sum(), *((union & region).sum() for region in sets)]
        alone = parts[1]
        assert single[n].tolist() == [alone.sum(), *((alone & region).sum() for region in sets)]
        # A body that is removed from a mask is removed from its sums.
        left, sums = sets[n % 3].copy(), prefixes[n % 3].copy()
        subtract_body(left, sums, outlines, X_CN[n], camera)
        np.testing.assert_array_equal(left, sets[n % 3] & ~union)
        np.testing.assert_array_equal(sums[:, 1:], np.cumsum(left, axis=1))
        assert not sums[:, 0].any()


def test_areas_with_bands_of_skin_are_those_of_single_poses(tmp_path):
    model, rng = load_limb(tmp_path), np.random.default_rng(1)
    tree, camera = model.pose_tree(), ParallelCamera("c", 90, 70, 90.0, 44.3, 33.1, SIDEWAYS)
    surfaces, sets = TreeSurfaces(tree), rng.random((2, 70, 90)) < 0.4
    prefixes = np.array([prefix_sums(mask) for mask in sets])
    posed = [tree.values_from_positions(q) for q in rng.uniform(model.lower, model.upper, (6, 5))]
    X_CN = np.array([camera.X_CW @ tree.node_poses(values) for values in posed])
    bands = [
        np.concatenate([node.skin.vertices(values[i][None]) for values in posed])
        for i, node in enumerate(tree.nodes)
        if node.skin is not None
    ]
    found = score_bodies([surfaces.whole(i) for i in range(3)], X_CN, camera, prefixes, bands)
    for areas, values, X in zip(found, posed, X_CN, strict=True):
        mask = draw_mask(surfaces.at(values), X, camera)
        assert list(areas) == [mask.sum(), *((mask & s).sum() for s in sets)]


def test_wrong_shapes_are_refused():
    """Of poses (n, nodes, 4, 4), prefixes (k, H, W + 1) and bands."""
    cube = box(1.0)
    bending = BendingOutline(outline_from_mesh(TriangleMesh.empty()), cube)
    pose, eight = np.eye(4)[None, None], len(bending.rest.vertices)
    band = np.zeros((1, eight, 3))
    for poses, shape, bands, words in (
        (pose, (0, 70, 90), [band], "prefixes of camera 'c'"),
        (pose, (70, 91), [band], "prefixes"),
        (pose[..., :3, :3], (0, 70, 91), [band], "poses"),
        (np.tile(pose, (1, 2, 1, 1)), (0, 70, 91), [band], "poses"),
        (pose[0], (0, 70, 91), [band], "poses"),
        (pose * np.nan, (0, 70, 91), [band], "poses must be finite"),
        (pose, (0, 70, 91), [], "bands of"),
        (pose, (0, 70, 91), [band[:, 1:]], "bands of"),
        (pose, (0, 70, 91), [np.tile(band, (2, 1, 1))], "bands of"),
        (pose, (0, 70, 91), [band * np.nan], "bands must be finite"),
    ):
        camera, sums = ParallelCamera("c", 90, 70, 60.0, 44.3, 33.1, np.eye(4)), np.zeros(shape)
        with pytest.raises(ValueError, match=words):
            score_bodies([bending], poses, camera, sums.astype(np.int32), bands)


PINHOLE = PinholeCamera("eye", 64, 48, 60.0, 60.0, 31.5, 23.5, np.eye(4))
PARALLEL = ParallelCamera("flat", 64, 48, 20.0, 31.5, 23.5, np.eye(4))
CUBE = outline_from_mesh(box(1.0))


def test_a_body_that_a_camera_cannot_show_is_refused():
    for camera, places, refused in (
        (PINHOLE, [(0, 0, 3)], None),
        (PARALLEL, [(0, 0, -3)], None),
        (PINHOLE, [(0, 0, 3), (0, 0, -3)], None),
        (PINHOLE, [(0.6, 0, 0)], None),  # Beside the camera, in part before it.
        (PINHOLE, [(0, 0, -3), (1, 0, -2)], "'eye'.*behind"),
        (PINHOLE, [(0, 0, 3), (0.1, 0.2, 0.3)], "'eye' is inside"),
        (PINHOLE, [(50, 0, 3)], "'eye'.*outside the picture"),
        (PARALLEL, [(0, 50, 3)], "'flat'.*outside the picture"),
        (PARALLEL, [(0, 0, 3), (38, 0, 3)], None),
        (PARALLEL, [(0, 0, 3), (45, 0, 3)], "'flat'.*larger than the picture"),
        (PINHOLE, [(0, 0, 3), (50, 0, 3)], "'eye'.*larger than the picture"),
    ):
        X_CN = np.tile(np.eye(4), (len(places), 1, 1))
        X_CN[:, :3, 3] = places
        with nullcontext() if refused is None else pytest.raises(CameraError, match=refused):
            require_visible([CUBE] * len(places), X_CN, camera)
    # A wall half a metre ahead encloses nothing, and nodes without a surface count nowhere.
    wall = TriangleMesh(np.array([[-1.0, -1, 0], [1, -1, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    surfaces = [CUBE, *map(outline_from_mesh, (TriangleMesh.empty(), wall))]
    X_CN = np.tile(np.eye(4), (3, 1, 1))
    X_CN[:, 2, 3] = 3.0, -9e9, 0.5
    require_visible(surfaces, X_CN, PINHOLE)
    X_CN[0, :3, 3] = 0.01, -0.03, 0.02
    with pytest.raises(CameraError, match="'eye' is inside"):
        require_visible([outline_from_mesh(box(0.1))], X_CN[:1], PINHOLE)


BALL = trimesh.creation.icosphere(3)
ELLIPSOID = outline_from_mesh(TriangleMesh(BALL.vertices * [0.05, 0.08, 0.2], BALL.faces))


def test_hull_of_a_ball_is_the_ball():
    """Radii fall with the distance from the centre, alike in all directions; 0 outside."""
    made = trimesh.creation.icosphere(4, radius=0.3)
    made.apply_translation([0.1, 0.2, -0.1])
    hull = VisualHull(outline_from_mesh(TriangleMesh(np.array(made.vertices), made.faces)))
    directions = Rotation.random(60, random_state=2).as_matrix()[:, 0]
    scale = 0.46 * 96 / 0.3
    for away in (0.0, 0.1, 0.2):
        radii = hull.radii([0.1, 0.2, -0.1] + away * directions)
        np.testing.assert_allclose(radii, 0.97 * (0.3 - away - 1.25 / scale), atol=1.6 / scale)
    assert not hull.radii([0.1, 0.2, -0.1] + 0.31 * directions).any()
    assert not hull.radii(np.full((1, 3), 5.0)).any()


def test_each_ball_reaches_farthest_beyond_those_before_it():
    hull = VisualHull(ELLIPSOID)
    few, more = (hull.spread_balls(count, points_per_side=9) for count in (4, 9))
    np.testing.assert_array_equal(few, more[:4])
    np.testing.assert_allclose(more[:, 3], hull.radii(more[:, :3]))
    steps = 0.2 * np.linspace(-1.0, 1.0, 9)
    grid = np.array(np.meshgrid(steps, steps, steps)).reshape(3, -1).T
    radii = hull.radii(grid)
    assert more[0, 3] == pytest.approx(radii.max())
    for k in range(1, 9):
        apart = np.linalg.norm(grid[:, None] - more[:k, :3], axis=2) - more[:k, 3]
        reach = np.where(radii > 0.0, apart.min(axis=1) + radii, -np.inf)
        own = np.linalg.norm(more[k, :3] - more[:k, :3], axis=1) - more[:k, 3]
        assert own.min() + more[k, 3] == pytest.approx(reach.max(), abs=1e-6)
    everything = hull.spread_balls(10_000, points_per_side=5)
    inside = hull.radii(0.2 * np.array(np.meshgrid(*[np.linspace(-1, 1, 5)] * 3)).reshape(3, -1).T)
    assert len(everything) == np.count_nonzero(inside)


def test_empty_surface_has_no_balls():
    empty = VisualHull(outline_from_mesh(TriangleMesh.empty()))
    assert empty.spread_balls(5).shape == (0, 4)
    assert empty.radii(np.zeros((2, 3))).tolist() == [0.0, 0.0]
