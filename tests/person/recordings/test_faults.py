"""Cameras that moved, rigs that are mirrored or exchanged, others in view."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body import ArticulatedModel, bundled_model, load_model
from drake_pose.camera.models import Camera, circle_of_cameras
from drake_pose.fit.contour_fit import ContourFit
from drake_pose.fit.evidence import find_edge_points
from drake_pose.person.faults import (
    CameraComparison,
    CameraFault,
    FrameEdges,
    find_rig_fault,
    first_moved_frame,
)
from drake_pose.person.figures import (
    Figure,
    Person,
    PersonRecording,
    cut_figures,
    find_figures,
    find_persons,
    find_tracks,
    follow_one,
    is_separate,
    keep_person,
    keep_views,
    middle_of_view,
    sort_figures,
)
from drake_pose.person.pose_tracker import PersonPoseTracker
from drake_pose.person.views import FrameViews, see_silhouette
from tests.person.persons_in_view import see, stepping

Masks = list[dict[str, np.ndarray]]


@dataclass(frozen=True)
class Stage:
    person: ArticulatedModel
    fit: ContourFit
    cameras: Mapping[str, Camera]
    poses: np.ndarray
    masks: Masks

    def frames(self, masks: Masks) -> list[FrameEdges]:
        tracker = PersonPoseTracker(self.fit)
        return [
            FrameEdges({n: find_edge_points(m, 2.0) for n, m in own.items()}, tracker.values(q))
            for own, q in zip(masks, self.poses, strict=True)
        ]

    def find(self, masks: Masks) -> CameraFault | None:
        return CameraComparison(self.fit, self.cameras).find_fault(self.frames(masks))

    def seen_by_moved(self, name: str, turn: float, shift: tuple[float, float, float]) -> Masks:
        """What the rig sees where a camera was turned about the vertical [deg] and shifted [m]."""
        X_WC = self.cameras[name].X_WC.copy()
        R = Rotation.from_euler("z", turn, degrees=True).as_matrix()
        X_WC[:3, :3] = R @ X_WC[:3, :3]
        X_WC[:3, 3] += shift
        moved = {name: self.cameras[name].with_pose(X_WC)}
        seen = see(self.person, moved, self.poses)
        return [{**own, **new} for own, new in zip(self.masks, seen, strict=True)]


def make_stage(count: int) -> Stage:
    person = load_model(bundled_model("person"), check=False)
    cameras = circle_of_cameras(count, size=(160, 120), face_camera=False)
    poses = np.array([stepping(person, 0.4 * k, -0.2 + 0.1 * k, 0.1) for k in range(4)])
    fit = ContourFit(person.pose_tree())
    return Stage(person, fit, cameras, poses, see(person, cameras, poses))


@pytest.fixture(scope="module")
def four():
    return make_stage(4)


@pytest.fixture(scope="module")
def nine():
    return make_stage(9)


class TestMovedCamera:
    @pytest.mark.parametrize("stage", ["four", "nine"])
    @pytest.mark.slow
    def test_sound_rig_has_no_fault(self, stage, request):
        found = request.getfixturevalue(stage)
        assert found.find(found.masks) is None

    @pytest.mark.parametrize(
        ("turn", "shift"), [(3, (0, 0, 0)), (-10, (0, 0, 0)), (0, (0, 0, 0.05)), (0, (0.2, 0, 0))]
    )
    def test_moved_camera_is_found_among_four(self, turn, shift, four):
        fault = four.find(four.seen_by_moved("camera_1", turn, shift))
        assert (fault.name, fault.is_explained) == ("camera_1", True)

    def test_with_three_cameras_the_moved_one_stays_ambiguous(self, four):
        def three(masks: Masks) -> Masks:
            return [{n: m for n, m in own.items() if n != "camera_3"} for own in masks]

        fault = four.find(three(four.seen_by_moved("camera_1", 6.0, (0.0, 0.0, 0.0))))
        assert "camera_1" in (fault.name, *fault.alternatives)
        assert not fault.is_explained
        assert four.find(three(four.masks)) is None

    def test_camera_with_poor_masks_is_not_reported_as_moved(self, nine):
        """Frames lack the upper or lower half of the person in turn: no motion explains that."""
        masks = [dict(own) for own in nine.masks]
        for k, own in enumerate(masks):
            half = own["camera_2"].copy()
            rows = np.flatnonzero(half.any(axis=1))
            middle = int(rows.mean())
            half[slice(None, middle) if k % 2 else slice(middle, None)] = False
            own["camera_2"] = half
        fault = nine.find(masks)
        assert fault is None or (fault.name, fault.is_explained) == ("camera_2", False)

    def test_motion_of_an_unmoved_camera_is_zero(self, four):
        frames = four.frames(four.masks)
        camera = four.cameras["camera_0"]
        edges = [frame.edges["camera_0"] for frame in frames]
        comparison = CameraComparison(four.fit, four.cameras)
        motion = comparison.motion("camera_0", edges, [frame.values for frame in frames])
        assert motion.pixels < 0.5
        np.testing.assert_allclose(motion.X_WC[:3, 3], camera.X_WC[:3, 3], atol=0.05)

    def test_rolled_camera_turns_its_pictures_the_opposite_way(self, four):
        camera, view = four.cameras["camera_0"], four.frames(four.masks)[0]
        X_WC = camera.X_WC.copy()
        X_WC[:3, :3] = X_WC[:3, :3] @ Rotation.from_euler("z", 0.1).as_matrix()
        points = four.fit.kinematics.poses(view.values)[:, :3, 3]
        comparison, pairs = (
            CameraComparison(four.fit, four.cameras),
            [(view.edges["camera_0"], view.values)],
        )
        motion = comparison._describe(camera, camera.with_pose(X_WC), pairs, points)
        assert motion.turn == pytest.approx(-0.1)
        assert motion.inlier_ratio_after < motion.inlier_ratio_before

    def test_first_frame_after_the_motion(self):
        good, bad = [0.9, 0.95, 0.9], [0.2, 0.1, 0.3]
        assert first_moved_frame([*good, *bad], [*bad, *good]) == 3
        assert first_moved_frame(bad, good) == 0
        assert first_moved_frame(good, bad) == 3
        assert first_moved_frame([0.9, 0.3, 0.9, 0.2, 0.1], [0.1, 0.4, 0.2, 0.9, 0.9]) == 3


class TestRig:
    @pytest.mark.slow
    def test_sound_rig_has_no_fault(self, four, nine):
        assert find_rig_fault(four.cameras, four.masks[:2]) is None
        assert find_rig_fault(nine.cameras, nine.masks[:1]) is None

    @pytest.mark.parametrize(
        "names",
        [
            ("camera_1",),
            pytest.param(tuple(f"camera_{k}" for k in range(4)), marks=pytest.mark.slow),
        ],
    )
    def test_mirrored_pictures_are_named(self, names, four):
        good = four.masks[2:]
        spoilt = [{n: m[:, ::-1] if n in names else m for n, m in own.items()} for own in good]
        fault = find_rig_fault(four.cameras, spoilt)
        assert (fault.mirrored, fault.exchanged) == (names, ())
        for own, right in zip(spoilt, good, strict=True):
            np.testing.assert_equal(fault.undo(own), right)

    @pytest.mark.slow
    def test_exchanged_cameras_are_named(self, four):
        one, two = "camera_1", "camera_2"
        spoilt = [{**own, one: own[two], two: own[one]} for own in four.masks[:2]]
        fault = find_rig_fault(four.cameras, spoilt)
        assert (fault.mirrored, fault.exchanged) == ((), (one, two))
        np.testing.assert_equal(fault.undo(spoilt[0]), four.masks[0])

    @pytest.mark.slow
    def test_moved_camera_is_not_taken_for_a_mirrored_one(self, four):
        fault = find_rig_fault(four.cameras, four.seen_by_moved("camera_2", 10.0, (0, 0, 0))[:2])
        assert fault is None or (fault.mirrored, fault.exchanged) == ((), ())


def someone(x: float, area: float = 100.0, z: float = 1.0) -> Person:
    return Person(np.array([x, 0.0, z]), {0: 0}, area)


class TestOthers:
    def test_two_persons_are_located(self, nine):
        poses = [nine.poses[0], stepping(nine.person, 1.0, 0.5, 1.2)]
        both = see(nine.person, nine.cameras, np.array(poses))
        masks = [one | other for one, other in zip(*(own.values() for own in both), strict=True)]
        persons = find_persons(list(nine.cameras.values()), [find_figures(m) for m in masks])
        assert len(persons) == 2
        places = sorted((one.position for one in persons), key=lambda place: place[1])
        np.testing.assert_allclose(places[0][:2], poses[0][:2], atol=0.2)
        np.testing.assert_allclose(places[1][:2], [0.5, 1.2], atol=0.2)

    def test_other_person_is_cut_out(self, nine):
        other = see(nine.person, nine.cameras, np.array([stepping(nine.person, 1.0, 0.5, 1.2)]))[0]
        alone, place = nine.masks[0], np.array([-0.2, 0.1, 0.9])
        both = {name: mask | other[name] for name, mask in alone.items()}
        masks, person, cut, merged = keep_person(nine.cameras, both, place)
        assert person is not None
        assert set(cut) & set(merged) == set()
        assert len(cut) >= 4
        views = [see_silhouette(mask, 2.0) for mask in both.values()]
        frame, *found = keep_views(FrameViews(list(nine.cameras.values()), views), place)
        assert found == [cut, merged]
        for name, view in zip(alone, frame.views, strict=True):
            np.testing.assert_array_equal(view.region, masks[name])
            if name in cut:
                np.testing.assert_array_equal(view.region, alone[name])
                np.testing.assert_array_equal(view.edge.uv, find_edge_points(alone[name], 2.0).uv)

    def test_one_person_keeps_all_fragments(self, four):
        masks = {name: mask.copy() for name, mask in four.masks[0].items()}
        rows = np.flatnonzero(masks["camera_0"].any(axis=1))
        masks["camera_0"][int(rows.mean()) : int(rows.mean()) + 5] = False
        kept, _, *others = keep_person(four.cameras, masks)
        assert others == [(), ()]
        np.testing.assert_equal(kept, masks)
        empty = {name: np.zeros((120, 160), dtype=bool) for name in four.cameras}
        assert keep_person(four.cameras, empty)[1] is None

    def test_figures_of_large_pictures_are_cut_whole(self):
        mask = np.zeros((960, 1280), dtype=bool)
        mask[100:500, 101:303] = True
        alone = mask.copy()
        mask[203:397, 611:801] = True
        large, small = find_figures(mask)
        assert large.area > small.area
        np.testing.assert_allclose(small.middle, [705.5, 299.5], atol=4.0)
        np.testing.assert_array_equal(cut_figures(mask, [small]), alone)

    def test_frames_of_a_hidden_or_absent_person(self, four):
        """Seen, hidden from all cameras but one, absent, and seen again."""
        masks = [dict(four.masks[min(k, 3)]) for k in range(5)]
        for name in four.cameras:
            if name != "camera_0":
                masks[1][name] = np.zeros((120, 160), dtype=bool)
            masks[2][name] = np.zeros((120, 160), dtype=bool)
        recording = PersonRecording(four.cameras, lambda k: masks[k], 5, True)
        assert recording.seen == [0, 3, 4]
        faults = recording.faults()
        assert faults.no_person == (1, 2)
        assert (faults.blind, faults.others) == ({}, {})
        assert 1.3 < recording.height < 2.1

    def test_unassigned_figure_is_a_strangers_if_nearer_to_another_or_large_and_far(self):
        camera = circle_of_cameras(2, size=(160, 120), face_camera=False)["camera_0"]
        me = np.array([0.0, 0.0, 1.0])
        him, between, away = (me + by * camera.X_WC[:3, 0] for by in (0.9, 0.4, -0.8))
        sizes = {"large": 40.0, "small": 20.0}

        def is_strangers(place, area, figures, others):
            own = Figure(camera.project(me[None])[0][0], 100.0, np.zeros(4))
            seen = Figure(camera.project(place[None])[0][0], sizes[area], np.zeros(4))
            person = Person(me, figures, 100.0)
            persons = [person, *(Person(one, {}, 100.0) for one in others)]
            found = sort_figures({"0": camera}, {"0": (own, seen)}, persons, person)
            return seen in found["0"][0]

        assert is_strangers(him, "small", {0: 0}, [him])
        assert not is_strangers(between, "large", {0: 0}, [him])
        assert not is_strangers(between, "large", {0: 0}, [])
        assert is_strangers(away, "large", {0: 0}, [])
        assert is_strangers(away, "large", {0: 0}, [him])
        assert not is_strangers(away, "small", {0: 0}, [])
        assert not is_strangers(away, "large", {}, [])

    @pytest.mark.parametrize("side", [None, 0, 1, 2, 3], ids=lambda k: f"side {k}")
    def test_figure_is_merged_if_its_box_contains_a_hidden_person(self, side):
        """The hidden person's middle is inside the box, or a pixel outside one of its sides."""
        camera = circle_of_cameras(2, size=(160, 120), face_camera=False)["camera_0"]
        me = Person(np.array([0.0, 0.0, 1.0]), {0: 0}, 100.0)
        hidden = Person(np.array([-0.4, 0.0, 1.1]), {}, 90.0)
        uv = camera.project(hidden.position[None])[0][0]
        box = np.array([*(uv - 9.0), *(uv + 9.0)])
        if side is not None:
            box[side] = np.tile(uv, 2)[side] + (1.0 if side < 2 else -1.0)
        figure = Figure(camera.project(me.position[None])[0][0], 100.0, box)
        found = sort_figures({"0": camera}, {"0": (figure,)}, [me, hidden], me)
        assert found == {"0": ((), side is None)}

    @pytest.mark.parametrize(("gap", "far"), [(1, 0.39), (1, 0.41), (3, 0.39), (3, 0.41)])
    def test_track_continues_within_a_step_also_after_a_gap(self, gap, far):
        first, then = someone(0.0), someone(far)
        tracks = find_tracks([[], [first], *[[]] * (gap - 1), [then]])
        alone = [{1: first}, {gap + 1: then}]
        assert tracks == ([{1: first, gap + 1: then}] if far < 0.4 else alone)

    def test_followed_person_is_seen_longest_and_may_return(self):
        me = [someone(0.0), someone(0.1), someone(3.0), someone(3.1)]
        him = [someone(-2.0, 80.0), someone(-2.1, 80.0)]
        frames = [[me[0]], [him[0], me[1]], [], [him[1]], [me[2]], [me[3]], []]
        found = follow_one(frames, np.zeros(3), True)
        assert [found[k] for k in (0, 1, 4, 5, 6)] == [me[0], me[1], me[2], me[3], None]
        # Hidden persons are interpolated linearly, and have no figures.
        np.testing.assert_allclose(
            found[2].position, me[1].position + (me[2].position - me[1].position) / 3
        )
        assert found[2].figures == {}
        # A track that overlaps the main one in a single frame is another person's.
        found = follow_one([[him[0]], [him[1], me[0]], [me[1]], [me[1]]], np.zeros(3), True)
        assert found == [None, me[0], me[1], me[1]]
        each = follow_one(frames, np.zeros(3), False)
        assert each == [me[0], me[1], None, him[1], me[2], me[3], None]

    def test_middle_of_view_of_cameras_around_a_target_is_the_target(self):
        target = (0.3, -0.2, 1.1)
        cameras = circle_of_cameras(5, target=target, size=(161, 120), face_camera=False)
        np.testing.assert_allclose(middle_of_view(list(cameras.values())), target, atol=1e-6)

    @pytest.mark.parametrize(("side", "counts"), [(10, True), (7, False)])
    def test_specks_are_no_figures(self, side, counts):
        """The limit is 2e-4 of the picture, here 61 pixels."""
        mask = np.zeros((239, 1285), dtype=bool)
        mask[50 : 50 + side, 60 : 60 + side] = True
        found = find_figures(mask)
        assert [one.area for one in found] == [float(side**2)] * counts

    def test_separate_person_stands_apart_and_is_large(self):
        first = someone(0.0)
        assert is_separate(someone(2.0, 90.0), [first])
        assert not is_separate(someone(2.0, 1.0), [first])
        assert not is_separate(someone(0.1, 90.0), [first])
        # A figure above the person belongs to the person.
        assert not is_separate(someone(0.0, 90.0, 3.0), [first])
        assert not is_separate(someone(2.1, 90.0), [first, someone(2.0)])
