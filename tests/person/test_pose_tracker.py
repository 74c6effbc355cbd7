"""Tracking of a person by all silhouettes, uncertainty of a pose, and a person's shape."""

from dataclasses import replace

import numpy as np
import pytest

from drake_pose.body import TriangleMesh
from drake_pose.camera.models import circle_of_cameras
from drake_pose.errors import ModelError
from drake_pose.fit.contour_fit import ContourFit, pack_views
from drake_pose.fit.evidence import NO_EDGE, find_edge_points
from drake_pose.fit.levenberg_marquardt import AnnealingStage
from drake_pose.fit.surfaces import with_radius_scales
from drake_pose.person import pose_tracker
from drake_pose.person.date.skeleton import load_skeleton
from drake_pose.person.date.walking import make_motion
from drake_pose.person.search import LENIENT, SIGNIFICANT
from drake_pose.person.views import FrameViews, see_silhouette
from drake_pose.silhouette.outline import outline_from_mesh
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.scoring import draw_mask
from tests.person.persons_in_view import SIDES, posed, see, stepping


class World:
    def __init__(self, person):
        self.person, self.ring = person, circle_of_cameras(5, size=(320, 240), face_camera=False)
        self.cameras = list(self.ring.values())
        self.fit = ContourFit(person.pose_tree())
        self.tracker = pose_tracker.PersonPoseTracker(self.fit)

    def values(self, **degrees):
        return self.tracker.values(posed(self.person, **degrees))

    def frame(self, q, left_out=0):
        """The views of all cameras but the first `left_out`."""
        views = [see_silhouette(mask, 4.0) for mask in see(self.person, self.ring, [q])[0].values()]
        return FrameViews(self.cameras[left_out:], views[left_out:])

    def follow(self, belief, frame):
        return self.tracker.update(self.tracker.predict(belief), frame)

    def off(self, values, q):
        """The largest error of a joint centre [mm]."""
        return joint_error(self.tracker, values, q)

    def drawn(self, values, outlines):
        """The edges of surfaces at values, drawn by the span kernel, packed for a fit."""
        X_WN = self.fit.kinematics.poses(values)
        masks = [draw_mask(outlines, camera.X_CW @ X_WN, camera) for camera in self.cameras]
        return pack_views(self.cameras, [find_edge_points(mask, 4.0) for mask in masks])

    def deviations(self, values, views, **more):
        compared = self.fit.compare(views, values, STEP)
        covariance, *_ = pose_tracker.pose_uncertainty(self.fit, compared, **more)
        return dict(zip(self.fit.kinematics.names, np.sqrt(np.diag(covariance)), strict=True))


def joint_error(tracker, values, q):
    """The largest distance of joint centres at values and at positions [mm]."""
    places = [
        tracker.plan.landmarks.positions(tracker.fit.kinematics.poses(v))
        for v in (values, tracker.values(q))
    ]
    return 1e3 * np.linalg.norm(places[0] - places[1], axis=1).max()


@pytest.fixture(scope="module")
def world(person):
    return World(person)


WALKING = {
    "left_upper_arm_x": 25.0, "right_upper_arm_x": -25.0, "left_forearm_x": -25.0,
    "right_forearm_x": -25.0, "left_thigh_x": -25.0, "right_thigh_x": 20.0, "left_shin_x": 10.0,
    "right_shin_x": 35.0, "left_upper_arm_z": 10.0, "right_upper_arm_z": -10.0,
}  # fmt: skip


STEP = AnnealingStage(0.03, 0.05)


class TestTracker:
    def test_positions_and_values_are_inverse(self, world):
        q = posed(world.person, **WALKING, head_y=120)
        np.testing.assert_allclose(world.tracker.positions(world.tracker.values(q)), q, atol=1e-12)
        turned = world.tracker.values(q)
        turned[world.tracker.plan.heading] += 2 * np.pi
        np.testing.assert_allclose(world.tracker.positions(turned), q, atol=1e-12)

    def test_person_is_found_and_tracked_although_a_camera_drops_out(self, world):
        q = posed(world.person, **WALKING)
        state = world.tracker.update(None, world.frame(q))
        assert world.off(state.values, q) < 40.0
        for k in range(1, 6):
            q = posed(
                world.person,
                **{name: (1 - 0.2 * k) * a for name, a in WALKING.items()},
                head_y=5 * k,
            )
            state = world.follow(state, world.frame(q, left_out=int(k >= 3)))
            assert world.off(state.values, q) < 30.0, k

    def test_a_belief_says_how_the_frame_was_explained(self, world):
        """The step is the change of the values; the usual misfit is the lowest or a mean."""
        tracker, q = world.tracker, posed(world.person, **WALKING)
        start = tracker.start(tracker.values(q), is_known=True)
        moved = posed(world.person, **WALKING, head_y=4.0)
        found = world.follow(start, world.frame(moved))
        np.testing.assert_allclose(found.step, found.values - start.values, atol=1e-12)
        usual = 1.0 + (found.misfit - 1.0) / tracker.settings.memory
        assert found.usual_misfit == pytest.approx(min(found.misfit, usual))
        assert (found.troubled_frames, found.ahead, found.is_lost) == (0, 0.0, False)
        assert found.inlier_ratio > 0.95
        for judged, evidence, is_lost in ((0, -9.0, False), (1, 1.0, True), (4, 1.9, True),
                                          (4, 2.1, False), (1, 1.1, False)):  # fmt: skip
            own = replace(start, judged=judged, evidence=evidence * SIGNIFICANT)
            assert own.is_lost == is_lost

    def test_motion_fades_away(self, world):
        persistence = world.tracker.settings.persistence
        start = world.tracker.start(world.tracker.values(posed(world.person)))
        moving = replace(start, step=np.ones(len(start.values)))
        for frames in (1.0, 2.0, 50.0):
            moved = world.tracker.predict(moving, frames).values - start.values
            np.testing.assert_allclose(moved, persistence * (1.0 - np.exp(-frames / persistence)))
        twice = world.tracker.predict(world.tracker.predict(moving))
        np.testing.assert_allclose(twice.values, world.tracker.predict(moving, 2.0).values)

    @pytest.mark.parametrize("frame", [30, 54], ids=["legs exchanged", "turned about"])
    def test_similar_pose_is_not_chosen(self, person, frame):
        """Walking before nine cameras, where another pose fits nearly as well."""
        q = make_motion(load_skeleton(person), 120, 0).q[frame]
        ring = circle_of_cameras(9, face_camera=False)
        masks = [LabelRenderer(person, camera).mask(q) for camera in ring.values()]
        tracker = pose_tracker.PersonPoseTracker(
            ContourFit(person.pose_tree(), noise=pose_tracker.NOISE), LENIENT
        )
        seen = FrameViews([*ring.values()], [see_silhouette(mask, 4.0) for mask in masks])
        assert joint_error(tracker, tracker.update(None, seen).values, q) < 30.0

    def test_lost_arm_is_searched_again(self, world):
        lifted = posed(
            world.person, **{**WALKING, "left_upper_arm_z": 110.0, "left_forearm_x": -20.0}
        )
        state = world.tracker.start(world.tracker.values(posed(world.person, **WALKING)))
        frame = world.frame(lifted)
        for _ in range(4):
            state = world.follow(state, frame)
        assert world.off(state.values, lifted) < 25.0

    def test_empty_silhouettes(self, world):
        empty = see_silhouette(np.zeros((240, 320), dtype=bool), 4.0)
        frame, values = FrameViews(world.cameras, [empty] * len(world.cameras)), world.values()
        assert world.tracker.update(None, frame) is None
        state = world.follow(world.tracker.start(values), frame)
        assert state.inlier_ratio == 0.0
        np.testing.assert_allclose(state.values, values, atol=1e-6)

    def test_person_is_found_again_within_two_frames_of_full_view(self, world):
        """The lower half of every silhouette is missing at first, as if it were not there."""
        q, halves = posed(world.person, **WALKING), []
        for mask in see(world.person, world.ring, [q])[0].values():
            mask[int(np.flatnonzero(mask.any(axis=1)).mean()) :] = False
            halves.append(see_silhouette(mask, 4.0))
        frame = FrameViews(world.cameras, halves)
        state = world.tracker.update(None, frame)
        for _ in range(4):
            state = world.follow(state, frame)
        for _ in range(2):
            state = world.follow(state, world.frame(q))
        assert (world.off(state.values, q) < 25.0, state.is_lost) == (True, False)


POSE = {
    "left_upper_arm_z": 50.0, "right_upper_arm_z": -60.0, "left_forearm_x": -70.0,
    "right_forearm_x": -50.0, "left_thigh_x": -30.0, "left_shin_x": 50.0, "right_shin_x": 15.0,
}  # fmt: skip


def deformed(outlines, generator, size):
    """Shift and stretch every part at random, with this standard deviation [m]."""
    found = []
    for outline in outlines:
        middle = outline.vertices.mean(axis=0)
        wide = np.sqrt(((outline.vertices - middle) ** 2).mean(axis=0))
        growth = 1.0 + generator.normal(0.0, size, 3) / wide
        vertices = middle + growth * (outline.vertices - middle)
        vertices = vertices + generator.normal(0.0, size, 3)
        found.append(outline_from_mesh(TriangleMesh(vertices, outline.triangles)))
    return tuple(found)


class TestUncertainty:
    @pytest.mark.parametrize("size", [0.0, 0.003])
    def test_true_values_are_within_two_standard_deviations(self, world, size):
        generator = np.random.default_rng(3)
        ratios, surfaces = [], []
        for _ in range(4):
            pose = {name: angle * generator.uniform(0.7, 1.3) for name, angle in POSE.items()}
            true = world.values(**pose, head_y=generator.uniform(-20, 20))
            views = world.drawn(true, deformed(world.fit.outlines, generator, size))
            values = world.fit.fit(views, true, [STEP] * 6).values
            covariance, _, surface = pose_tracker.pose_uncertainty(
                world.fit, world.fit.compare(views, values, STEP)
            )
            ratios.append((values - true) / np.sqrt(np.diag(covariance)))
            surfaces.append(surface)
        inside = (np.abs(ratios) < 2.0).mean()
        assert 0.8 < inside <= 1.0
        assert 0.2 < np.mean(np.square(ratios)) < 2.0
        if size:
            assert 0.3 * size < np.median(surfaces) < 3.0 * size
        else:
            assert np.median(surfaces) < 0.002

    def test_held_and_unobservable_values_have_the_variances_that_are_known(self, world):
        """Of values that nothing shows, that of a uniform distribution between their limits."""
        values, kinematics = world.values(**POSE), world.fit.kinematics
        empty = pack_views(world.cameras, [NO_EDGE] * len(world.cameras))
        found = world.deviations(values, empty)
        widest = np.where(kinematics.is_angle, 2.0 * np.pi, 10.0)
        spans = np.minimum(kinematics.upper - kinematics.lower, widest)
        np.testing.assert_allclose(list(found.values()), spans / np.sqrt(12.0), rtol=1e-6)
        edges = world.drawn(values, world.fit.outlines)
        held = np.array([name == "left_upper_arm_z" for name in kinematics.names])
        exact = world.deviations(values, edges, held=held)
        assert exact["left_upper_arm_z"] == 0.0
        rough = world.deviations(values, edges, held=held, held_covariance=np.array([[0.2**2]]))
        assert rough["left_upper_arm_z"] == pytest.approx(0.2)
        assert rough["left_upper_arm_y"] > 1.5 * exact["left_upper_arm_y"]
        assert rough["right_shin_x"] < 1.5 * exact["right_shin_x"]


def test_tracker_has_the_known_lengths_and_radius_scales(shaped_person):
    tree = shaped_person.pose_tree()
    held = pose_tracker.shape_values(tree)
    assert held.any() > held[: len(tree.nodes[0].value_names)].any()
    parts, groups = pose_tracker.shape_parts(tree)
    # Left, right and end pieces belong to one part.
    assert len(parts) < len(tree.nodes)
    assert not any(word in part for part in parts for word in ("left_", "right_", "_end"))
    plain = pose_tracker.tracker_of_person(tree, None)
    scales = np.where(np.array(groups) == 2, 1.5, 1.0)
    values = np.where(np.cumsum(held) == 1, 0.07 * held, 0.0)
    outlines = with_radius_scales(plain.fit.outlines, scales)
    nothing = np.zeros((0, 0))
    known = pose_tracker.tracker_of_person(
        tree, pose_tracker.PersonShape({}, {}, values, nothing, nothing, outlines)
    )
    q = known.positions(known.with_held(np.full(len(held), 0.3)))
    np.testing.assert_allclose(known.values(q)[held], values[held])
    np.testing.assert_allclose(known.values(q)[~held], 0.3)
    for scale, one, other in zip(scales, plain.fit.outlines, known.fit.outlines, strict=True):
        times = np.array([scale, 1.0, scale])
        np.testing.assert_allclose(other.vertices, times * one.vertices, atol=1e-9)


PAIRS = {"thigh": -0.03, "shin": 0.03, "upper_arm": 0.025, "forearm": -0.02}
LENGTHS = {"trunk_stretch": 0.03}
LENGTHS |= {f"{side}_{part}_stretch": way for part, way in PAIRS.items() for side in SIDES}


def test_lengths_and_radius_scales_are_found(shaped_person):
    cameras = circle_of_cameras(5, size=(320, 240), face_camera=False)
    fit = ContourFit(shaped_person.pose_tree(), noise=pose_tracker.NOISE)
    order = [shaped_person.position_index(name) for name in fit.kinematics.names]
    factors = {"trunk": 1.1, "thigh": 1.2, "shin": 0.9}
    radius_scales = np.ones(len(fit.outlines))
    for k, node in enumerate(fit.tree.nodes):
        for part, factor in factors.items():
            if part in node.name:
                radius_scales[k] = factor
    outlines = with_radius_scales(fit.outlines, radius_scales)
    frames, starts = [], []
    for phase in np.linspace(0.0, 2 * np.pi, 6, endpoint=False):
        q = stepping(shaped_person, phase, knees=45.0)
        starts.append(q[order])
        worn = q.copy()
        for name, stretch in LENGTHS.items():
            worn[shaped_person.position_index(name)] = stretch
        X_WN = fit.kinematics.poses(worn[order])
        masks = [draw_mask(outlines, c.X_CW @ X_WN, c) for c in cameras.values()]
        frames.append((list(cameras.values()), [find_edge_points(m, 3.0) for m in masks]))
    shape = pose_tracker.fit_shape(fit, frames, np.array(starts))
    found = dict(zip(fit.kinematics.names, shape.values, strict=True))
    off = np.array([found[name] - stretch for name, stretch in LENGTHS.items()])
    assert np.abs(off).max() < 0.02
    assert np.abs(off).mean() < 0.5 * np.mean(np.abs(list(LENGTHS.values())))
    for part, factor in factors.items():
        assert shape.radius_scales[part] == pytest.approx(factor, abs=0.05), part
    off = np.array([x - LENGTHS.get(name, 0.0) for name, x in shape.lengths.items()])
    assert 0.05 < off @ np.linalg.solve(shape.covariance, off) / len(off) < 2.0


def test_model_of_fixed_lengths_is_refused(person):
    with pytest.raises(ModelError, match="shape joints"):
        pose_tracker.fit_shape(ContourFit(person.pose_tree()), [], np.zeros((0, 23)))
