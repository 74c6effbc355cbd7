"""Label images; the span kernel against Drake's renderer."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import trimesh
from pydrake.geometry import RenderLabel

from drake_pose.body import load_model
from drake_pose.camera.models import ParallelCamera, PinholeCamera
from drake_pose.silhouette.outline import outline_from_mesh
from drake_pose.silhouette.pictures.label_renderer import (
    LabelRenderer,
    label_image_to_mask,
    mask_to_label_image,
)
from drake_pose.silhouette.scoring import draw_mask
from tests.body.models import joint, link, load_limb, urdf, write
from tests.silhouette.agreement import MAX_DIFFERENCE, measure_agreement
from tests.silhouette.shapes import random_pose

SHAPES = {
    "box": '<box size="0.3 0.2 0.5"/>',
    "sphere": '<sphere radius="0.2"/>',
    "cylinder": '<cylinder radius="0.12" length="0.5"/>',
    "capsule": '<drake:capsule radius="0.1" length="0.4"/>',
    "ellipsoid": '<drake:ellipsoid a="0.1" b="0.2" c="0.3"/>',
    "open mesh": '<mesh filename="open.obj" scale="0.2 0.25 0.3"/>',
}


def write_open_mesh(path):
    """A cube without a top, with an inner wall and a fin: neither closed nor a manifold."""
    z, y, x = np.indices((2, 2, 2)).reshape(3, 8) * 2 - 1
    points = np.vstack([np.column_stack([x, y, z]), [0, 0, 2]])
    quads = [(0, 1, 3, 2), (0, 4, 5, 1), (1, 5, 7, 3), (3, 7, 6, 2)]
    faces = [[q[0], q[k], q[k + 1]] for q in quads for k in (1, 2)] + [[0, 3, 7], [4, 5, 8]]
    trimesh.Trimesh(points, faces, process=False).export(path, include_normals=True)


def model_of(folder, shapes):
    """A chain on the world with one link for each shape."""
    write_open_mesh(folder / "open.obj")
    parts, parent = [], "world"
    for i, shape in enumerate(shapes):
        name, axis = f"link_{i}", ("1 0 0", "0 1 0", "0 0.6 0.8")[i % 3]
        solid = f'<origin xyz="0 0 0.25" rpy="0.3 0 0.2"/><geometry>{SHAPES[shape]}</geometry>'
        parts.append(link(name, f"<visual>{solid}</visual>"))
        at = {"origin": 'xyz="0 0 0.4"', "limits": 'lower="-2" upper="2"'}
        parts.append(joint(f"{name}_joint", "revolute", parent, name, axis=axis, **at))
        parent = name
    text = urdf(*parts).replace("<robot", '<robot xmlns:drake="http://drake.mit.edu"')
    return load_model(write(folder, text), check=False)


def looking_at_origin(rng, distance):
    """A pose X_WC with the origin near the image's middle."""
    X_WC = random_pose(rng, (0.0, 0.0, 0.0))
    X_WC[:3, 3] = -distance * X_WC[:3, 2] + rng.uniform(-0.1, 0.1, 3)
    return X_WC


def cameras(rng):
    """A parallel camera, a pinhole camera, and one whose near plane cuts the model."""
    first, second, third = (looking_at_origin(rng, distance) for distance in (3.0, 3.0, 0.6))
    return [
        ParallelCamera("parallel", 500, 400, 180.0, 230.3, 210.7, first),
        PinholeCamera("far", 480, 360, 400.0, 410.0, 250.2, 170.6, second),
        PinholeCamera("close", 480, 360, 200.0, 210.0, 250.2, 170.6, third, near=0.4),
    ]


@pytest.mark.parametrize("shape", list(SHAPES))
def test_masks_of_every_shape_match_drake(tmp_path, shape):
    model = model_of(tmp_path, [shape, shape])
    for seed in range(2):
        for camera in cameras(np.random.default_rng(seed)):
            worst, overall, _ = measure_agreement(model, camera, 5, seed)
            assert worst <= MAX_DIFFERENCE, (shape, camera.name, worst)
            # Primitives with 45 or 60 sides instead of VTK's 50 would differ by 0.0016 or more.
            assert shape == "open mesh" or overall <= 3e-4, (shape, camera.name, overall)


def test_masks_with_bands_of_skin_match_drake(tmp_path):
    """A band has its child link's label, at any pose of the plant's world."""
    model = load_limb(tmp_path)
    for distance, seed in ((1.2, 10), (0.9, 11)):
        rng = np.random.default_rng(seed)
        X_WC, middle = looking_at_origin(rng, distance), (80.137, 80.137)
        for camera in (
            ParallelCamera("parallel", 160, 160, 180.0, *middle, X_WC),
            PinholeCamera("pinhole", 160, 160, 220.0, 220.0, *middle, X_WC),
        ):
            worst, _, areas = measure_agreement(model, camera, 8, seed)
            assert worst <= MAX_DIFFERENCE, (camera.name, worst)
            assert np.median(areas) > 500
    renderer, q = LabelRenderer(model, camera), rng.uniform(model.lower, model.upper)
    there, X_WB = renderer.segments(q), random_pose(rng, (0.1, -0.2, 0.3))
    for own in (camera, ParallelCamera("parallel", 160, 160, 180.0, *middle, X_WC)):
        there = LabelRenderer(model, own).segments(q)
        moved = LabelRenderer(model, own.with_pose(X_WB @ own.X_WC)).segments(q, X_WB)
        assert np.count_nonzero(moved != there) <= 0.004 * (there >= 0).sum()
    names = {renderer.link_names[label] for label in np.unique(there) if label >= 0}
    assert names <= {"upper", "lower", "hand"}


def test_labels_are_those_of_links(tmp_path):
    model = model_of(tmp_path, ["box", "sphere"])
    camera = cameras(np.random.default_rng(2))[0]
    renderer = LabelRenderer(model, camera)
    q = np.array([0.4, -0.7])
    segments = renderer.segments(q)
    seen = {renderer.link_names[label]: label for label in np.unique(segments) if label >= 0}
    assert {*seen} == {"link_0", "link_1"}
    np.testing.assert_array_equal(segments >= 0, renderer.mask(q))
    poses = renderer.link_poses(q)
    for name, label in seen.items():
        outline = outline_from_mesh(model.link_meshes[name])
        alone = draw_mask([outline], (camera.X_CW @ poses[label])[None], camera)
        assert np.count_nonzero((segments == label) & ~alone) <= max(2, 0.002 * alone.sum())


def test_wrong_positions_and_threads_are_refused(tmp_path):
    camera = ParallelCamera("c", 40, 30, 9.0, 20.0, 15.0, np.eye(4))
    renderer = LabelRenderer(model_of(tmp_path, ["box"]), camera)
    for q in (np.zeros(2), np.array([np.nan])):
        with pytest.raises(ValueError, match=r"q must be \(1,\)"):
            renderer.mask(q)
    with ThreadPoolExecutor(1) as pool, pytest.raises(RuntimeError, match="thread"):
        pool.submit(renderer.mask, np.zeros(1)).result()


def test_masks_are_converted_to_label_images_and_back():
    """Drake's reserved labels are not objects."""
    mask = np.zeros((20, 30), dtype=bool)
    mask[4:9, 3:20] = True
    image, empty = mask_to_label_image(mask), int(RenderLabel.kEmpty)
    assert (image.width(), image.height()) == (30, 20)
    np.testing.assert_array_equal(image.data[..., 0], np.where(mask, 1, empty))
    for shape in (image, image.data, image.data[..., 0]):
        np.testing.assert_array_equal(label_image_to_mask(shape), mask)
    labels = np.full((4, 5), empty, dtype=np.int16)
    labels[1, 2], labels[3, 3] = 7, 9
    reserved = RenderLabel.kDontCare, RenderLabel.kDoNotRender, RenderLabel.kUnspecified
    labels[0, :3] = [*map(int, reserved)]
    assert np.argwhere(label_image_to_mask(labels)).tolist() == [[1, 2], [3, 3]]
    assert np.argwhere(label_image_to_mask(labels, [9])).tolist() == [[3, 3]]
