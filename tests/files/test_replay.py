"""Replays, as the commands that Meshcat's page holds."""

import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from pydrake.geometry import Meshcat, MeshcatParams

from drake_pose.body import load_model
from drake_pose.camera.models import ParallelCamera
from drake_pose.files.replay import make_replay
from tests.body.models import link_poses
from tests.files.replays import object_of, played, tracks_of
from tests.jobs.scenes import camera

BODY, GHOST = "/drake/visualizer", "/drake/measured"


@pytest.fixture(scope="module")
def crane(tiny_scene):
    """A model, positions, measured positions, and poses of the base."""
    q = np.array([*tiny_scene.truth.values()])
    X_WB = np.repeat(np.eye(4)[None], len(q), axis=0)
    X_WB[:, :3, 3] = np.array([0.5, -0.2, 0.1]) + 0.1 * np.arange(len(q))[:, None]
    return load_model(tiny_scene.model, check=False), q, q + np.array([0.3, -0.1]), X_WB


def link_points(model, q, X_WB):
    """Return the vertices of each link in the world, in one frame."""
    poses = {link: X_WB @ pose for link, pose in link_poses(model, q).items()}
    return [
        mesh.vertices @ poses[link][:3, :3].T + poses[link][:3, 3]
        for link, mesh in model.link_meshes.items()
    ]


@pytest.mark.parametrize("is_flat", [False, True])
def test_cameras_are_drawn_and_the_view_is_beside_the_first(crane, is_flat):
    model, q, measured, X_WB = crane
    left = replace(camera("left", 30.0), center_x=60.0, focal_y=170.0)
    flat = ParallelCamera("flat", 200, 160, 100.0, 99.5, 70.5, camera("flat", 60.0).X_WC)
    cameras = [flat, left] if is_flat else [left, flat]
    told = played(make_replay(model, q, X_WB, cameras, 2.0, measured))
    rows = [*zip([*q, *measured], [*X_WB, *X_WB], strict=True)]
    points = np.concatenate([np.concatenate(link_points(model, *row)) for row in rows])
    low, high = points.min(axis=0), points.max(axis=0)
    middle, radius = 0.5 * (low + high), 0.5 * np.linalg.norm(high - low)
    corners = {(u - 0.5, v - 0.5) for u in (0, 200) for v in (0, 160)}
    for one in (left, flat):
        ends, material = object_of(told["set_object", f"/drake/cameras/{one.name}"])
        assert material["color"] == 0x0072B2
        # Frustums begin at the lens, or 2 radii before the body, and are .25 radii long.
        start = 0.0 if one is left else (middle - flat.X_WC[:3, 3]) @ flat.X_WC[:3, 2] - 2 * radius
        p_C = (ends - one.X_WC[:3, 3]) @ one.X_WC[:3, :3]
        is_far = np.abs(p_C[:, 2] - start - 0.25 * radius) < 1e-5
        near = p_C[~is_far] if one is left else p_C[~is_far, 2] - start
        np.testing.assert_allclose(near, 0.0, atol=1e-5)
        for which in (is_far, ~is_far)[: 1 + (one is flat)]:
            pixels = np.round(one.project(ends[which])[0], 2)
            assert {tuple(row) for row in pixels.tolist()} == corners
        # Four lines along the rays, and four around the far end.
        steps = np.abs(np.diff(p_C.reshape(-1, 2, 3), axis=1)[:, 0]) > 1e-5
        assert sorted(map(tuple, steps[~is_far.reshape(-1, 2).all(axis=1)][:, 2:])) == [(True,)] * 4
        around = steps[is_far.reshape(-1, 2).all(axis=1)]
        assert sorted(map(tuple, around)) == [(False, True, False)] * 2 + [(True, False, False)] * 2
    # Meshcat's y is up.
    view = told["set_property", "/Cameras/default/rotated/<object>"]["value"]
    eye, target = (np.array([x, -z, y]) for x, y, z in (view, told["set_target", None]["value"]))
    np.testing.assert_allclose(target, middle, atol=1e-9)
    towards = -flat.X_WC[:3, 2] if is_flat else left.X_WC[:3, 3] - middle
    c, s = np.cos(np.radians(20.0)), np.sin(np.radians(20.0))
    beside = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ towards
    np.testing.assert_allclose(
        eye - target, 1.7 * radius * beside / np.linalg.norm(beside), atol=1e-9
    )


@pytest.mark.parametrize(("period", "steps"), [(2.0, (0, 9)), (1.0, (0, 9)), (0.5, (0,))])
def test_body_and_ghost_move_in_time(crane, period, steps):
    """From a period of 1 s on, a frame has ten steps, and lasts until just before the next."""
    model, q, measured, X_WB = crane
    told = played(make_replay(model, q, X_WB, [camera("left")], period, measured))
    tracks, rate = tracks_of(told)
    each = 10 if len(steps) > 1 else 1
    assert rate == pytest.approx(each / period)
    for k in range(len(q)):
        for rows, path in ((q, BODY), (measured, GHOST)):
            poses = link_poses(model, rows[k])
            for link in model.link_meshes:
                # The body's links move below its base.
                own = poses[link][:3, 3] if path == BODY else (X_WB[k] @ poses[link])[:3, 3]
                (track,) = (
                    keys
                    for name, keys in tracks.items()
                    if re.fullmatch(rf"{path}/(.*/)?{link}", name)
                )
                for step in steps:
                    np.testing.assert_allclose(track[each * k + step], own, atol=1e-9)
        for step in steps:
            np.testing.assert_allclose(tracks[BODY][each * k + step], X_WB[k, :3, 3], atol=1e-9)
    _, material = object_of(told["set_object", f"{GHOST}/jib"])
    assert (material["color"], material["opacity"]) == (0x009E72, pytest.approx(0.4))
    alone = played(make_replay(model, q, X_WB, [camera("left")], period, None))
    assert not any(GHOST in str(path) for _, path in alone)


def test_a_replay_of_many_triangles_is_small_and_accurate(tmp_path):
    ball = trimesh.creation.icosphere(6, radius=0.1)
    ball.export(tmp_path / "ball.obj", include_normals=True)
    (tmp_path / "ball.urdf").write_text(
        '<robot name="ball"><link name="base"><visual><origin xyz="0.3 0 0"/><geometry>'
        '<mesh filename="ball.obj" scale="1 2 1"/></geometry></visual></link></robot>'
    )
    model = load_model(tmp_path / "ball.urdf", check=False)
    q = model.default_positions[None]
    page = make_replay(model, q, np.eye(4)[None], [camera("left")], 1.0, q, most_triangles=2000)
    empty = Meshcat(MeshcatParams(host="localhost", port=0)).StaticHtml()
    assert len(page) - len(empty) < 0.4e6
    told = played(page)
    (path,) = (one for one in told if one[0] == "set_object" and "measured" in one[1])
    points = object_of(told[path])[0] - [0.3, 0.0, 0.0]
    np.testing.assert_allclose(np.linalg.norm(points / [1, 2, 1], axis=1), 0.1, atol=0.003)
