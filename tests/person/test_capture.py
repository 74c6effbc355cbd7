"""Capture of recordings of a person of unknown proportions."""

import numpy as np
import pytest

from drake_pose.body import landmark_positions, load_landmarks
from drake_pose.camera.models import circle_of_cameras
from drake_pose.errors import SettingsError
from drake_pose.person.capture import capture_person, spread_over
from drake_pose.silhouette.pictures.scenes import load_scene
from drake_pose.silhouette.scoring import draw_mask
from tests.jobs.scenes import read_rows


def joint_errors(person, scene, frames, positions):
    """Return the errors of the joint centres in some frames at positions (frames, nq) [mm]."""
    landmarks, places = load_landmarks(person.path), {}
    for frame, q in zip(frames, positions, strict=True):
        found = landmark_positions(person, landmarks, q)
        places |= {(int(frame), name): p for name, p in zip(landmarks, found, strict=True)}
    return [
        1e3 * np.linalg.norm(places[key] - [float(row[axis]) for axis in "xyz"])
        for row in read_rows(scene.path / "joint_centres.csv")
        if (key := (int(row["frame"]), row["joint"])) in places and key[1] != "head_top"
    ]


def test_frames_are_spread_evenly():
    assert spread_over(range(10, 20), 4) == [10, 13, 16, 19]
    assert spread_over([3, 5], 4) == [3, 5]
    assert spread_over([], 3) == []


@pytest.mark.parametrize(("frames", "word"), [([], "one frame"), ([0, 1], "two cameras")])
def test_recordings_without_frames_or_persons_are_refused(shaped_person, frames, word):
    cameras = circle_of_cameras(2, size=(320, 240), face_camera=False)
    empty = {name: np.zeros((240, 320), dtype=bool) for name in cameras}
    with pytest.raises(SettingsError, match=word):
        capture_person(shaped_person.pose_tree(), cameras, lambda _: empty, frames)


@pytest.mark.parametrize("frame", ["0025", "0040"], ids=["leg", "turned about"])
def test_still_of_unknown_proportions_is_not_mistaken_for_another_pose(
    shaped_person, shared_data, frame
):
    """With average proportions a wrong leg, or a person turned about, fits better."""
    scene = load_scene(shared_data / "human_four_views")
    masks = {name: scene.read(name, frame) for name in scene.cameras}
    captured = capture_person(
        shaped_person.pose_tree(), scene.cameras, lambda _: masks, [0], is_sequence=False
    )
    assert np.nanmax(joint_errors(shaped_person, scene, [frame], captured.q)) < 120.0


@pytest.mark.slow
def test_real_person_of_unknown_proportions(shaped_person, shared_data):
    scene = load_scene(shared_data / "human_four_views")
    frames = scene.frames[::8]

    def read(k):
        return {name: scene.read(name, frames[k]) for name in scene.cameras}

    captured = capture_person(shaped_person.pose_tree(), scene.cameras, read, range(len(frames)))
    assert np.mean(joint_errors(shaped_person, scene, frames, captured.q)) < 60.0
    assert captured.deviations.shape == captured.q.shape
    angles = [k for k, kind in enumerate(shaped_person.position_kinds) if kind == "angle"]
    assert (captured.deviations[:, angles] > 0.003).all()
    assert np.median(captured.deviations[:, angles]) < 0.15
    assert (captured.q >= shaped_person.lower - 1e-9).all()
    assert (captured.q <= shaped_person.upper + 1e-9).all()
    k = len(frames) // 2
    X_WN = captured.tree.node_poses(captured.tree.values_from_positions(captured.q[k]))
    for name, mask in read(k).items():
        camera = scene.cameras[name]
        body = draw_mask(captured.outlines, camera.X_CW @ X_WN, camera)
        assert (body & mask).sum() / (body | mask).sum() > 0.7
