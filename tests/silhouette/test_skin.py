"""Surfaces with skin bands: the kernel against brute force and Drake's renderer."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body import TriangleMesh
from drake_pose.camera.models import ParallelCamera, PinholeCamera, look_at
from drake_pose.silhouette.bit_kernel import draw_bits, make_bit_view
from drake_pose.silhouette.contour_points import divide_outline
from drake_pose.silhouette.outline import (
    BendingOutline,
    PackedSurfaces,
    TreeSurfaces,
    outline_from_mesh,
)
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.scoring import draw_mask, prefix_sums, score_bodies, subtract_body
from tests.body.models import load_limb
from tests.silhouette.agreement import MAX_DIFFERENCE, measure_agreement
from tests.silhouette.shapes import brute_force_mask

SIDE = 160


def looking_along(direction, distance):
    """A camera's pose (4, 4) that looks at the limb's middle."""
    z = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
    middle, up = np.array([0.0, 0.0, 0.1]), (0, 0, 1) if abs(z[2]) < 0.9 else (0, 1, 0)
    return look_at(middle - distance * z, middle, up)


def cameras(rng):
    X_WC = [looking_along(rng.normal(size=3), 1.2) for _ in range(2)]
    middle = SIDE / 2 + 0.137
    return [
        ParallelCamera("parallel", SIDE, SIDE, 180.0, middle, middle, X_WC[0]),
        PinholeCamera("pinhole", SIDE, SIDE, 220.0, 220.0, middle, middle, X_WC[1]),
    ]


def pose(model, q, camera):
    tree = model.pose_tree()
    values = tree.values_from_positions(q)
    return values, camera.X_CW @ tree.node_poses(values)


def test_masks_match_brute_force(tmp_path):
    model = load_limb(tmp_path)
    tree = model.pose_tree()
    surfaces, rng, gained = TreeSurfaces(tree), np.random.default_rng(0), 0
    # The near plane of the last camera cuts a band.
    X_WC = looking_along([0, 1, 0.1], 0.06)
    near = PinholeCamera("near", SIDE, SIDE, 60.0, 60.0, 80.2, 79.7, X_WC, near=0.02)
    for camera in [*cameras(rng), near]:
        for _ in range(2):
            values, X_CN = pose(model, rng.uniform(model.lower, model.upper), camera)
            expected = np.zeros((SIDE, SIDE), dtype=bool)
            for node, part, X in zip(tree.nodes, values, X_CN, strict=True):
                expected |= brute_force_mask(node.surface(part), X, camera)
            drawn = draw_mask(surfaces.at(values), X_CN, camera)
            assert np.count_nonzero(drawn != expected) <= 3
            gained += np.count_nonzero(draw_mask(surfaces.rigid, X_CN, camera) != drawn)
    assert gained > 100


def test_batch_scores_equal_single_scores(tmp_path):
    model, rng = load_limb(tmp_path), np.random.default_rng(1)
    surfaces = TreeSurfaces(model.pose_tree())
    for camera in cameras(rng):
        sets = rng.random((2, SIDE, SIDE)) < 0.4
        prefixes = np.array([prefix_sums(mask) for mask in sets])
        posed = [pose(model, rng.uniform(model.lower, model.upper), camera) for _ in range(6)]
        X_CN = np.array([X for _, X in posed])
        bands = [
            np.concatenate([node.skin.vertices(values[i][None]) for values, _ in posed])
            for i, node in enumerate(model.pose_tree().nodes)
            if node.skin is not None
        ]
        whole = [surfaces.whole(i) for i in range(3)]
        found = score_bodies(whole, X_CN, camera, prefixes, bands)
        for areas, (values, X) in zip(found, posed, strict=True):
            outlines = surfaces.at(values)
            single = score_bodies(outlines, X[None], camera, prefixes)[0]
            np.testing.assert_array_equal(areas, single)
            mask = draw_mask(outlines, X, camera)
            assert list(areas) == [mask.sum(), *((mask & s).sum() for s in sets)]
            left, prefix = sets[0].copy(), prefixes[0].copy()
            subtract_body(left, prefix, outlines, X, camera)
            np.testing.assert_array_equal(left, sets[0] & ~mask)


def test_bits_have_the_band_at_their_sample(tmp_path):
    """Bit masks equal the kernel's masks at each of many samples of a node."""
    tree = load_limb(tmp_path).pose_tree()
    surfaces, rng = TreeSurfaces(tree), np.random.default_rng(2)
    skin = tree.nodes[2].skin
    values = rng.uniform(-2.0, 2.0, (12, 3))
    X_PN = tree.relative_transforms(2, values)
    X_WP = tree.node_poses([np.array([0.3]), np.array([0.5]), np.zeros(3)])[1:2]
    pairs = np.column_stack([np.zeros(12), np.arange(12)]).astype(np.int32)
    near = PinholeCamera("near", SIDE, SIDE, 60.0, 60.0, 80.1, 80.1, looking_along([0, 1, 0], 0.2))
    for camera, spread in zip([*cameras(rng), near], (0.0, 0.3, 0.3), strict=True):
        silhouette = rng.random((SIDE, SIDE)) < 0.5
        view = make_bit_view(silhouette, camera.kernel_parameters(), camera.X_CW, 0)
        celled = divide_outline(surfaces.rigid[2], spread, skin.mesh, skin.vertices(values))
        kept, areas, runs, words = draw_bits(celled, view, X_WP, X_PN, pairs, np.inf)
        assert kept.all()
        for i in range(12):
            X_CN = camera.X_CW @ X_WP @ X_PN[i]
            mask = draw_mask([surfaces.node_at(2, values[i])], X_CN, camera)
            inside = int((mask & silhouette).sum())
            assert list(areas[i]) == [inside, 0, mask.sum() - inside]
            _, count, begin = runs[i, 0]
            assert np.bitwise_count(words[begin : begin + count]).sum() == inside


@pytest.mark.parametrize("seed", range(2))
def test_masks_with_bands_match_drake(tmp_path, seed):
    model = load_limb(tmp_path)
    rng = np.random.default_rng(10 + seed)
    for camera in cameras(rng):
        worst, _, areas = measure_agreement(model, camera, 8, seed)
        assert worst <= MAX_DIFFERENCE, (camera.name, worst)
        assert (areas > 500).all()
    # A band has its child link's label, at any pose of the plant's world.
    renderer = LabelRenderer(model, camera)
    q = rng.uniform(model.lower, model.upper)
    X_WB = np.eye(4)
    X_WB[:3, :3] = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
    moved = LabelRenderer(model, camera.with_pose(X_WB @ camera.X_WC)).segments(q, X_WB)
    there = renderer.segments(q)
    assert np.count_nonzero(moved != there) <= 0.004 * (there >= 0).sum()
    names = {renderer.link_names[label] for label in np.unique(there) if label >= 0}
    assert names <= {"upper", "lower", "hand"}


def test_each_thread_deforms_its_own_copy(tmp_path):
    """Another thread deforms the band before the main thread reads it."""
    tree = load_limb(tmp_path).pose_tree()
    surfaces, rest = PackedSurfaces(TreeSurfaces(tree)), tree.default_values()
    ends = np.concatenate(rest), np.concatenate(rest) + 0.4
    held = surfaces.bend_to(ends[0])
    before = held.points.copy()
    with ThreadPoolExecutor(1) as pool:
        other = pool.submit(lambda: surfaces.at(ends[1]).points).result()
    assert np.abs(other - before).max() > 1e-3
    np.testing.assert_array_equal(held.points, before)


def test_bands_of_wrong_shape_are_refused():
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    tetrahedron = TriangleMesh(np.vstack([np.zeros(3), np.eye(3)]), faces)
    nothing = outline_from_mesh(TriangleMesh.empty())
    bending = BendingOutline(nothing, tetrahedron)
    camera = cameras(np.random.default_rng(4))[0]
    prefixes = np.zeros((0, SIDE, SIDE + 1), dtype=np.int32)
    X_CN = np.eye(4)[None, None]
    for bands in ([], [np.zeros((1, 3, 3))], [np.zeros((2, 4, 3))]):
        with pytest.raises(ValueError, match="bands of"):
            score_bodies([bending], X_CN, camera, prefixes, bands)
    with pytest.raises(ValueError, match="finite"):
        score_bodies([bending], X_CN, camera, prefixes, [np.full((1, 4, 3), np.nan)])
