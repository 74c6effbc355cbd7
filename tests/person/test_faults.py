"""Cameras that moved, and rigs whose pictures are mirrored or exchanged."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body import ArticulatedModel
from drake_pose.camera.models import Camera, circle_of_cameras
from drake_pose.errors import CameraError, MaskError, SettingsError
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.fit.evidence import find_edge_points
from drake_pose.person import faults
from drake_pose.person.figures import pixels_per_metre
from drake_pose.person.pose_tracker import PersonPoseTracker
from tests.person.persons_in_view import see, stepping

Masks = list[dict[str, np.ndarray]]


@dataclass(frozen=True)
class Stage:
    person: ArticulatedModel
    fit: ContourFit
    cameras: Mapping[str, Camera]
    poses: np.ndarray
    masks: Masks

    def frames(self, masks: Masks) -> list[faults.FrameEdges]:
        tracker = PersonPoseTracker(self.fit)
        return [
            faults.FrameEdges(
                {n: find_edge_points(m, 2.0) for n, m in own.items()}, tracker.values(q)
            )
            for own, q in zip(masks, self.poses, strict=True)
        ]

    def find(self, masks: Masks) -> faults.CameraFault | None:
        return faults.CameraComparison(self.fit, self.cameras).find_fault(self.frames(masks))

    def moved(self, name: str, R: Rotation, shift: tuple[float, float, float]) -> Camera:
        """A camera that was turned about its own axes and shifted in the world [m]."""
        X_WC = self.cameras[name].X_WC.copy()
        X_WC[:3, :3] = X_WC[:3, :3] @ R.as_matrix()
        X_WC[:3, 3] += shift
        return self.cameras[name].with_pose(X_WC)

    def seen_by(self, camera: Camera) -> Masks:
        """What the rig sees where a camera moved."""
        seen = see(self.person, {camera.name: camera}, self.poses)
        return [{**own, **new} for own, new in zip(self.masks, seen, strict=True)]


@pytest.fixture(scope="module")
def four(person):
    cameras = circle_of_cameras(4, size=(160, 120), face_camera=False)
    poses = np.array([stepping(person, 0.4 * k, -0.2 + 0.1 * k, 0.1) for k in range(4)])
    fit = ContourFit(person.pose_tree())
    return Stage(person, fit, cameras, poses, see(person, cameras, poses))


def pan(degrees):
    return Rotation.from_euler("y", degrees, degrees=True)


def test_moved_camera_is_found_among_four(four):
    assert four.find(four.masks) is None
    for turn, shift in ((pan(3.0), (0.0, 0.0, 0.0)), (pan(0.0), (0.2, 0.0, 0.0))):
        fault = four.find(four.seen_by(four.moved("camera_1", turn, shift)))
        assert (fault.name, fault.is_explained) == ("camera_1", True)


def test_with_three_cameras_the_moved_one_stays_ambiguous(four):
    def three(masks: Masks) -> Masks:
        return [{n: m for n, m in own.items() if n != "camera_3"} for own in masks]

    fault = four.find(three(four.seen_by(four.moved("camera_1", pan(6.0), (0.0, 0.0, 0.0)))))
    assert "camera_1" in (fault.name, *fault.alternatives)
    assert not fault.is_explained
    assert four.find(three(four.masks)) is None
    # Two cameras cannot disagree.
    pairs = [{n: m for n, m in list(own.items())[:2]} for own in four.masks]
    assert four.find(pairs) is None


@pytest.mark.parametrize(
    ("roll", "shift"), [(0.0, (0.0, 0.0, 0.0)), (0.1, (0.0, 0.0, 0.0)), (0.0, (0.0, 0.3, 0.1))]
)
def test_motion_is_that_of_the_persons_joints_in_the_pictures(four, roll, shift):
    """By the projections of the joints; a camera that rolls turns its pictures the other way."""
    camera = four.cameras["camera_0"]
    moved = four.moved("camera_0", Rotation.from_euler("z", roll), shift)
    frames = four.frames(four.seen_by(moved))
    comparison, values = (
        faults.CameraComparison(four.fit, four.cameras),
        [one.values for one in frames],
    )
    motion = comparison.motion("camera_0", [one.edges["camera_0"] for one in frames], values)
    points = np.concatenate([four.fit.kinematics.poses(one)[:, :3, 3] for one in values])
    before, after = (one.project(points)[0] for one in (camera, moved))
    pixels = np.sqrt(((after - before) ** 2).sum(axis=1).mean())
    assert motion.pixels == pytest.approx(pixels, abs=0.5)
    np.testing.assert_allclose(motion.shift, (after - before).mean(axis=0), atol=0.5)
    size = pixels_per_metre(camera, points.mean(axis=0))
    assert motion.metres == pytest.approx(motion.pixels / size)
    assert motion.turn == pytest.approx(-roll, abs=0.02)
    assert motion.inlier_ratio_after > 0.95
    assert (motion.inlier_ratio_before < 0.9) == bool(pixels)
    np.testing.assert_allclose(motion.X_WC[:3, 3], moved.X_WC[:3, 3], atol=0.15)
    values_alone, ratio = comparison.pose_without(frames[0], "camera_0")
    off = four.fit.kinematics.poses(values_alone) - four.fit.kinematics.poses(values[0])
    assert np.abs(off[:, :3, 3]).max() < 0.03
    assert ratio > 0.95


def test_first_frame_after_the_motion():
    """By brute force: all frames before it fit better as calibrated, those from it as moved."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        before, after = rng.uniform(0.0, 1.0, (2, 6))
        sums = [before[:k].sum() + after[k:].sum() for k in range(7)]
        assert faults.first_moved_frame(before, after) == int(np.argmax(sums))
    for ratio, expected in ((0.73, True), (0.71, False)):
        assert faults.is_explained(SimpleNamespace(inlier_ratio_after=ratio), 0.8) == expected


def test_recordings_without_a_plausible_person_are_refused():
    for seen, covering, height, error in (
        ([0], 0.5, 0.11, None),
        ([0], 0.0, 2.99, None),
        ([], 0.0, 1.7, SettingsError),
        ([0], 0.51, 1.7, MaskError),
        ([0], 0.0, 0.09, CameraError),
        ([0], 0.0, 3.01, CameraError),
        ([0], 0.0, np.nan, CameraError),
    ):
        recording = SimpleNamespace(seen=seen, covering=covering, height=height)
        if error is None:
            assert faults.require_person(recording, 3) is recording
        else:
            with pytest.raises(error):
                faults.require_person(recording, 3)


def test_mirrored_or_exchanged_pictures_are_named_and_mended(four):
    good, one, two = four.masks[2], "camera_1", "camera_2"
    assert faults.find_rig_fault(four.cameras, [good]) is None
    assert faults.find_rig_fault(four.cameras, [{one: good[one]}]) is None
    for spoilt, mirrored, exchanged in (
        ({**good, one: good[one][:, ::-1]}, (one,), ()),
        ({**good, one: good[two], two: good[one]}, (), (one, two)),
        ({name: mask[:, ::-1] for name, mask in good.items()}, tuple(good), ()),
    ):
        fault = faults.find_rig_fault(four.cameras, [spoilt])
        assert (fault.mirrored, fault.exchanged) == (mirrored, exchanged)
        assert fault.is_identified
        np.testing.assert_equal(fault.undo(spoilt), good)
        assert np.mean(list(fault.filled.values())) < 0.99
    # What no such change mends has no name.
    spoilt = {**good, one: np.roll(good[one], 50, axis=1)}
    fault = faults.find_rig_fault(four.cameras, [spoilt])
    assert not fault.is_identified
    assert faults.find_rig_fault(four.cameras, [spoilt], faulty_above=1.0) is None
