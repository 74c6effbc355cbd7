"""Figures of masks, the persons that several cameras see, and which one to follow."""

import numpy as np
import pytest
from scipy import ndimage

from drake_pose.camera.models import ParallelCamera, circle_of_cameras, look_at
from drake_pose.fit.evidence import find_edge_points
from drake_pose.person import figures
from drake_pose.person.views import FrameViews, edge_spacing, see_silhouette

RING = circle_of_cameras(5, size=(160, 120), face_camera=False)
CAMERAS = list(RING.values())


def disc(camera, place, radius):
    """The mask of a ball, roughly: a disc about its projected middle."""
    uv = camera.project(np.array([place]))[0][0]
    size = radius * figures.pixels_per_metre(camera, np.array(place))
    v, u = np.indices((camera.height, camera.width))
    return np.hypot(u - uv[0], v - uv[1]) <= size


def seen(*balls):
    """The masks of balls (place, radius) in the ring's cameras."""
    nothing = np.zeros((120, 160), dtype=bool)
    return {n: np.any([nothing, *(disc(c, *b) for b in balls)], axis=0) for n, c in RING.items()}


@pytest.mark.parametrize("shape", [(200, 300), (485, 700)])
def test_figures_are_connected_components(shape):
    """Against scipy's labels; large pictures are subsampled, so places are near."""
    mask = np.zeros(shape, dtype=bool)
    step = max(1, min(shape) // 240)
    for top, left, height, width in (
        (20, 30, 60, 40),
        (100, 150, 30, 90),
        (150, 20, 9, 9),
        (5, 5, 2, 2),
    ):
        mask[top * step : (top + height) * step, left * step : (left + width) * step] = True
    found = figures.find_figures(mask)
    labels, _ = ndimage.label(mask, np.ones((3, 3)))
    parts = [np.argwhere(labels == k) for k in range(1, labels.max() + 1)]
    parts = sorted(parts, key=len, reverse=True)
    assert len(parts) == 4
    for figure, part in zip(found, parts, strict=False):
        assert figure.area == pytest.approx(len(part), rel=0.02 * step)
        np.testing.assert_allclose(figure.middle, part.mean(axis=0)[::-1], atol=step - 0.99)
        box = np.concatenate([part.min(axis=0)[::-1], part.max(axis=0)[::-1] + 1])
        np.testing.assert_allclose(figure.box, box, atol=step - 0.99)
    # Below a twentieth of the largest, or 2e-4 of the picture, a figure is a speck.
    assert len(found) == 2
    assert len(figures.find_figures(mask, speck=0.02)) == 3
    assert len(figures.find_figures(mask, speck=0.0)) == 3
    assert len(figures.find_figures(mask, speck=0.0, least_fraction=0.0)) == 4
    assert figures.find_figures(np.zeros(shape, bool)) == ()
    alone = mask & (labels != labels[tuple(parts[1][0])])
    np.testing.assert_array_equal(figures.cut_figures(mask, [found[1]]), alone)
    assert figures.cut_figures(mask, []) is mask


def test_distances_from_rays_and_the_middle_of_view():
    rng = np.random.default_rng(0)
    flat = ParallelCamera("flat", 161, 121, 90.0, 80.0, 60.0, look_at([2, 1, 1], [0, 0, 1]))
    for camera in (*CAMERAS[:2], flat):
        place, off = rng.normal([0, 0, 1], 0.4, 3), rng.normal(0, 0.1, 3)
        uv = camera.project(place[None])[0][0]
        along = camera.X_WC[:3, 2] if camera is flat else place - camera.X_WC[:3, 3]
        along = along / np.linalg.norm(along)
        found = figures.ray_distances(camera, uv, np.array([place, place + off, place + along]))
        np.testing.assert_allclose(found, [0, np.linalg.norm(np.cross(off, along)), 0], atol=1e-9)
    target = (0.3, -0.2, 1.1)
    cameras = circle_of_cameras(5, target=target, size=(161, 120), face_camera=False)
    np.testing.assert_allclose(figures.middle_of_view(list(cameras.values())), target, atol=1e-6)


def figure(camera, place, area=100.0, reach=9.0):
    uv = camera.project(np.array([place]))[0][0]
    return figures.Figure(uv, area, np.array([*(uv - reach), *(uv + reach)]))


@pytest.mark.parametrize("count", [1, 2, 3])
def test_persons_are_found_where_rays_of_figures_meet(count):
    """Each at its place, with its own figure in every camera that sees it, in any order."""
    rng = np.random.default_rng(count)
    for _ in range(8):
        angles = 2.0 * np.pi * (np.arange(count) / count + rng.uniform())
        places = np.column_stack([np.cos(angles), np.sin(angles), np.full(count, 1.0)])
        places += rng.uniform(-0.15, 0.15, (count, 3))
        areas = rng.uniform(80.0, 120.0, (count, len(CAMERAS)))
        order = [rng.permutation(count) for _ in CAMERAS]
        own = [
            [figure(camera, places[p], areas[p, k]) for p in order[k]]
            for k, camera in enumerate(CAMERAS)
        ]
        found = figures.find_persons(CAMERAS, own)
        assert len(found) == count
        for person in found:
            p = int(np.argmin(np.linalg.norm(places - person.position, axis=1)))
            np.testing.assert_allclose(person.position, places[p], atol=1e-6)
            assert {k: order[k][i] for k, i in person.figures.items()} == dict.fromkeys(range(5), p)
            assert person.area == np.sort(areas[p])[2]


def test_persons_need_two_cameras_and_rays_that_meet():
    here = [[figure(camera, (0, 0, 1), 50.0 + k)] for k, camera in enumerate(CAMERAS)]
    assert figures.find_persons(CAMERAS, [here[0], [], [], [], []]) == ()
    (person,) = figures.find_persons(CAMERAS, [*here[:2], [], [], []])
    assert (set(person.figures), person.area) == ({0, 1}, 50.0)
    # One camera shows a stranger, who is too far from the others' rays.
    stranger = [figure(CAMERAS[4], (0.1, 1.2, 1.0))]
    (person,) = figures.find_persons(CAMERAS, [*here[:4], stranger])
    np.testing.assert_allclose(person.position, [0, 0, 1], atol=1e-6)
    assert set(person.figures) == {0, 1, 2, 3}


def someone(x: float, area: float = 100.0, z: float = 1.0) -> figures.Person:
    return figures.Person(np.array([x, 0.0, z]), {0: 0}, area)


def test_separate_person_stands_apart_and_is_large():
    first = someone(0.0)
    for other, others, expected in (
        (someone(0.51, 26.0), [first], True),
        (someone(0.49, 90.0), [first], False),
        (someone(2.0, 24.0), [first, someone(9.0, 1.0)], False),
        # A figure above the person belongs to the person.
        (someone(0.0, 90.0, 3.0), [first], False),
        (someone(2.1, 90.0), [first, someone(2.0)], False),
    ):
        assert figures.is_separate(other, others) == expected


def test_unassigned_figure_is_a_strangers_if_nearer_to_another_or_large_and_far():
    camera, me = CAMERAS[0], np.array([0.0, 0.0, 1.0])
    him, between, away, near = (me + by * camera.X_WC[:3, 0] for by in (0.9, 0.4, -0.8, -0.6))
    for place, area, taken, others, expected in (
        (him, 20.0, {0: 0}, [him], True),
        (between, 40.0, {0: 0}, [him], False),
        (between, 40.0, {0: 0}, [], False),
        (near, 40.0, {0: 0}, [], False),
        (away, 40.0, {0: 0}, [], True),
        (away, 40.0, {0: 0}, [him], True),
        (away, 20.0, {0: 0}, [], False),
        (away, 40.0, {}, [], False),
    ):
        own = figure(camera, me, 100.0, 0.0), figure(camera, place, area, 0.0)
        person = figures.Person(me, taken, 100.0)
        persons = [person, *(figures.Person(one, {}, 100.0) for one in others)]
        found = figures.sort_figures({"0": camera}, {"0": own}, persons, person)
        assert (own[1] in found["0"][0]) == expected
    # The figure of another person is cut out, unless the hidden person is in its box.
    other = figures.Person(him, {0: 0}, 90.0)
    for hidden, expected in ((him + 0.1 * camera.X_WC[:3, 1], True), (me, False)):
        person = figures.Person(hidden, {}, 100.0)
        own = (figure(camera, him),)
        found = figures.sort_figures({"0": camera}, {"0": own}, [person, other], person)
        assert found["0"] == (() if expected else own, expected)
    assert figures.sort_figures({"0": camera}, {"0": own}, [other], None) == {"0": (own, False)}


def test_figure_is_merged_if_its_box_contains_a_hidden_person():
    """The hidden person's middle is inside the box, or a pixel outside one of its sides."""
    camera, me = CAMERAS[0], figures.Person(np.array([0.0, 0.0, 1.0]), {0: 0}, 100.0)
    hidden = figures.Person(np.array([-0.4, 0.0, 1.1]), {}, 90.0)
    own = figure(camera, me.position)
    uv = camera.project(hidden.position[None])[0][0]
    for side in (None, 0, 1, 2, 3):
        box = np.array([*(uv - 9.0), *(uv + 9.0)])
        if side is not None:
            box[side] = np.tile(uv, 2)[side] + (1.0 if side < 2 else -1.0)
        found = figures.sort_figures(
            {"0": camera}, {"0": (own._replace(box=box),)}, [me, hidden], me
        )
        assert found == {"0": ((), side is None)}


ME, HIM = ((-0.4, 0.1, 0.9), 0.25), ((0.8, 0.3, 1.0), 0.2)


def test_other_person_is_cut_out():
    both = seen(ME, HIM)
    for place, expected in ((np.array(ME[0]), ME), (np.array(HIM[0]), HIM), (None, ME)):
        masks, person, cut, merged = figures.keep_person(RING, both, place)
        np.testing.assert_allclose(person.position, expected[0], atol=0.03)
        assert not set(cut) & set(merged)
        assert len(cut) >= 3
        for name in set(RING) - set(merged):
            np.testing.assert_array_equal(masks[name], disc(RING[name], *expected))
        for name in set(RING) - set(cut):
            assert masks[name] is both[name]
    views = [see_silhouette(mask, 2.0) for mask in both.values()]
    frame, *found = figures.keep_views(FrameViews(CAMERAS, views), np.array(ME[0]))
    masks, _, *expected = figures.keep_person(RING, both, np.array(ME[0]))
    assert found == expected
    for camera, view in frame.pairs:
        np.testing.assert_array_equal(view.region, masks[camera.name])
        if camera.name in found[0]:
            edge = find_edge_points(view.region, edge_spacing(camera))
            np.testing.assert_array_equal(view.edge.uv, edge.uv)
    nobody = {name: 0 * mask for name, mask in both.items()}
    kept, person, *others = figures.keep_person(RING, nobody)
    assert (person, others) == (None, [(), ()])
    np.testing.assert_equal(kept, nobody)


@pytest.mark.parametrize(("gap", "far"), [(1, 0.39), (1, 0.41), (3, 0.39), (3, 0.41)])
def test_track_continues_within_a_step_also_after_a_gap(gap, far):
    first, then = someone(0.0), someone(far)
    tracks = figures.find_tracks([[], [first], *[[]] * (gap - 1), [then]])
    alone = [{1: first}, {gap + 1: then}]
    assert tracks == ([{1: first, gap + 1: then}] if far < 0.4 else alone)
    # The nearest pair is linked first.
    left, right, moved = someone(0.0), someone(0.3), someone(0.2)
    assert figures.find_tracks([[left, right], [moved]]) == [{0: left}, {0: right, 1: moved}]


def test_followed_person_is_seen_longest_and_may_return():
    me = [someone(0.0), someone(0.1), someone(3.0), someone(3.1)]
    him = [someone(-2.0, 80.0), someone(-2.1, 80.0)]
    frames = [[me[0]], [him[0], me[1]], [], [him[1]], [me[2]], [me[3]], []]
    found = figures.follow_one(frames, np.zeros(3), True)
    assert [found[k] for k in (0, 1, 4, 5, 6)] == [me[0], me[1], me[2], me[3], None]
    # Hidden persons are interpolated linearly, and have no figures.
    third = me[1].position + (me[2].position - me[1].position) / 3
    np.testing.assert_allclose(found[2].position, third)
    assert found[2].figures == {}
    # A track that overlaps the main one in a single frame is another person's.
    found = figures.follow_one([[him[0]], [him[1], me[0]], [me[1]], [me[1]]], np.zeros(3), True)
    assert found == [None, me[0], me[1], me[1]]
    each = figures.follow_one(frames, np.zeros(3), False)
    assert each == [me[0], me[1], None, him[1], me[2], me[3], None]
    equal = [[someone(-0.5), someone(0.2)]]
    assert figures.follow_one(equal, np.zeros(3), False) == [equal[0][1]]
    assert figures.follow_one([[], []], np.zeros(3), True) == [None, None]


def test_recording_tells_who_was_seen_where():
    """Alone, hidden from all cameras but one, absent, with another, and blind in one camera."""
    frames = [seen(ME), seen(ME), seen(), seen(ME, HIM), seen(ME)]
    for name in RING:
        if name != "camera_0":
            frames[1][name] &= False
    frames[4]["camera_3"] &= False
    recording = figures.PersonRecording(RING, lambda k: frames[k], 5, True)
    assert recording.seen == [0, 3, 4]
    assert recording.cameras_at(1) == {"camera_0"}
    assert recording.cameras_at(4) == set(RING) - {"camera_3"}
    faults = recording.faults()
    assert (faults.no_person, faults.blind) == ((1, 2), {"camera_3": (4,)})
    assert set(faults.others) == set(RING)
    assert {frame for own in faults.others.values() for frame in own} == {3}
    for name, mask in recording.read(3).items():
        is_merged = name in faults.merged
        np.testing.assert_array_equal(mask, frames[3][name] if is_merged else frames[0][name])
    assert 0.45 < recording.height < 0.6
    assert recording.covering == 0.0
    recording.leave_out("camera_1", 3)
    assert "camera_1" in recording.read(0)
    assert "camera_1" not in recording.read(3)
    assert "camera_1" in recording.read(3, with_all=True)
    whole = figures.PersonRecording(RING, lambda _: {n: ~m for n, m in frames[2].items()}, 2, True)
    assert whole.covering == 1.0
    nobody = figures.PersonRecording(RING, lambda _: frames[2], 2, True)
    assert np.isnan(nobody.height)
