"""The silhouette capture's diagram, compared with plain functions frame by frame."""

from dataclasses import replace

import numpy as np
import pytest

from drake_pose.errors import SettingsError
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.person.pose_tracker import PersonPoseTracker
from drake_pose.person.views import FrameViews, edge_spacing, see_silhouette
from drake_pose.silhouette.segmentation import person_region
from drake_pose.systems.cameras import picture_to_colour_image
from drake_pose.systems.person import build_silhouette_capture
from tests.systems.bench import Bench

# A power of two, so that all times between frames are exactly equal.
PERIOD = 1.0 / 32.0


@pytest.fixture(scope="module")
def cameras(studio):
    return dict(list(studio.ring.items())[::2])


@pytest.fixture(scope="module")
def backgrounds(studio, cameras):
    return {name: studio.backgrounds[name] for name in cameras}


@pytest.fixture(scope="module")
def tracker(studio):
    return PersonPoseTracker(ContourFit(studio.model.pose_tree()))


@pytest.fixture(scope="module")
def path(studio):
    return [studio.posed(left_upper_arm_z=40.0 + 4.0 * k, right_thigh_x=-5.0 * k) for k in range(5)]


def test_diagram_equals_the_plain_functions(studio, cameras, backgrounds, tracker, path):
    capture = build_silhouette_capture(tracker, cameras, backgrounds, PERIOD)
    assert list(capture.stages) == ["region", "edge"]
    # Deviations take time and are an output only if asked for.
    assert not capture.diagram.HasOutputPort("deviations")
    run = Bench(capture.diagram)
    own = capture.estimator.GetMyMutableContextFromRoot(run.context)
    assert capture.estimator.known_person(own) is None
    state = tracker.start(tracker.values(path[0]))
    capture.estimator.set_person(own, state)
    for k, q in enumerate(path):
        shots = {name: studio.picture(q, name) for name in cameras}
        images = {f"color_image_{n}": picture_to_colour_image(p) for n, p in shots.items()}
        run.advance((k + 0.5) * PERIOD, **images)
        for stage in capture.stages:
            capture.evaluate(run.context, stage)
        views = [
            see_silhouette(person_region(shot, backgrounds[name]), edge_spacing(cameras[name]))
            for name, shot in shots.items()
        ]
        state = tracker.update(tracker.predict(state), FrameViews(list(cameras.values()), views))
        positions = tracker.positions(state.values)
        np.testing.assert_array_equal(run["estimated_positions"], positions)
        known = capture.estimator.known_person(own)
        for name in ("inlier_ratio", "usual_misfit", "troubled_frames", "step"):
            np.testing.assert_array_equal(getattr(known, name), getattr(state, name))
    elbow = studio.model.position_index("left_upper_arm_z")
    assert np.degrees(positions[elbow] - q[elbow]) == pytest.approx(0.0, abs=3.0)


def test_a_person_set_as_lost_has_no_estimated_positions(cameras, backgrounds, tracker, path):
    capture = build_silhouette_capture(tracker, cameras, backgrounds, PERIOD)
    context = capture.diagram.CreateDefaultContext()
    own = capture.estimator.GetMyMutableContextFromRoot(context)
    estimated = capture.diagram.GetOutputPort("estimated_positions")
    state = tracker.start(tracker.values(path[1]), is_known=True)
    capture.estimator.set_person(own, state)
    np.testing.assert_allclose(estimated.Eval(context), path[1])
    lost = replace(tracker.start(state.values), inlier_ratio=0.1)
    capture.estimator.set_person(own, lost)
    assert np.isnan(estimated.Eval(context)).all()
    assert capture.estimator.known_person(own).inlier_ratio == 0.1


def test_each_camera_needs_a_background(cameras, backgrounds, tracker):
    last = list(cameras)[-1]
    known = {name: one for name, one in backgrounds.items() if name != last}
    with pytest.raises(SettingsError, match=last):
        build_silhouette_capture(tracker, cameras, known)
