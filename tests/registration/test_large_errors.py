"""Laws of the search for large errors, against drawn pictures and errors that are put in."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from drake_pose.body import load_model
from drake_pose.camera.models import PinholeCamera
from drake_pose.registration.large_errors import (
    Correction,
    LargeErrorSearch,
    apply_corrections,
    joint_inlier_ratios,
    mask_excess_and_lack,
    mismatched_links,
    unchanged,
)
from drake_pose.registration.posed_frames import MultiViewFrame
from drake_pose.registration.register import RegistrationBody
from drake_pose.silhouette.scoring import draw_mask
from tests.body.models import joint, link, urdf, write
from tests.search.arms import arm_cameras

CAMERAS = arm_cameras()
NAMES = ["turn", "slide", "bend"]
FIRST = np.array([0.3, 0.1, 0.5])


@pytest.fixture(scope="module")
def body(tmp_path_factory: pytest.TempPathFactory) -> RegistrationBody:
    """A robot with a turning foot, a sliding beam and a hand that bends."""

    def box(sides: str, at: str) -> str:
        where = f'<origin xyz="{at}"/><geometry><box size="{sides}"/></geometry>'
        return f"<visual>{where}</visual>"

    parts = [
        link("world", ""),
        link("foot", box("0.2 0.12 0.3", "0.03 0 0.15")),
        link("beam", box("0.6 0.1 0.08", "0.15 0 0")),
        link("hand", box("0.07 0.1 0.35", "0 0.02 0.17")),
        joint("turn", "revolute", "world", "foot", limits='lower="-2.4" upper="2.4"', origin=""),
        joint(
            "slide", "prismatic", "foot", "beam", axis="1 0 0", origin='xyz="0 0 0.34"',
            limits='lower="-0.1" upper="0.3"',
        ),
        joint(
            "bend", "revolute", "beam", "hand", axis="0 1 0", origin='xyz="0.45 0 0"',
            limits='lower="-2" upper="2"',
        ),
    ]  # fmt: skip
    path = write(tmp_path_factory.mktemp("robot"), urdf(*parts))
    return RegistrationBody(load_model(path, check=False).pose_tree())


@pytest.fixture(scope="module")
def frames(body: RegistrationBody) -> list[MultiViewFrame]:
    rng, kinematics = np.random.default_rng(1), body.kinematics
    assert list(kinematics.names) == NAMES
    drawn = []
    for k in range(7):
        values = rng.uniform(0.9 * kinematics.lower, 0.9 * kinematics.upper)
        X_WN = kinematics.poses(values)
        masks = {one.name: draw_mask(body.medium, one.X_CW @ X_WN, one) for one in CAMERAS}
        drawn.append(MultiViewFrame(f"{k}", values, masks))
    return drawn


def logged(frames: Sequence[MultiViewFrame], j: int, places: np.ndarray) -> list[MultiViewFrame]:
    """Return the frames with value j logged as `places` (frames,)."""
    changed = [one.values.copy() for one in frames]
    for values, place in zip(changed, places, strict=True):
        values[j] = place
    return [replace(one, values=v) for one, v in zip(frames, changed, strict=True)]


def test_misfit_counts_the_pixels_of_scaled_pictures_that_differ(body, frames) -> None:
    """By drawing the body, and averaging the mask, in a picture of the smaller size."""
    wrong = logged(frames, 2, np.zeros(len(frames)))
    search = LargeErrorSearch(body, CAMERAS, wrong)
    size = np.sqrt(np.median([one.masks[c.name].sum() for one in frames for c in CAMERAS]))
    side = [round(min(1.0, 100.0 / size) * by) for by in (320, 240)]
    expected = np.zeros(len(frames))
    for k, frame in enumerate(wrong):
        for camera in CAMERAS:
            mask = frame.masks[camera.name].astype(float)
            small = cv2.resize(mask, side, interpolation=cv2.INTER_AREA)
            X_CN = camera.X_CW @ body.kinematics.poses(frame.values)
            drawn = draw_mask(body.coarse, X_CN, camera.resized(*side))
            expected[k] += np.count_nonzero(drawn ^ (small > 0.5))
    nothing = Correction("", "", CAMERAS, unchanged)
    np.testing.assert_allclose(search.misfits(nothing), expected)
    assert (search.misfits(replace(nothing, cameras=CAMERAS[:1])) < expected).all()
    right = LargeErrorSearch(body, CAMERAS, frames).misfits(nothing)
    assert 5.0 * right.sum() < expected.sum()


@pytest.mark.parametrize(
    ("j", "sign", "by", "kind"),
    [
        (0, 1.0, 1.0, "offset"), (1, 1.0, 0.12, "offset"), (1, 1.0, -0.08, "offset"),
        (2, 1.0, -0.7, "offset"), (2, 1.0, 2.6, "offset"), (0, -1.0, 0.0, "sign"),
        (2, -1.0, 0.0, "sign"), (2, -1.0, 0.6, "sign"), (1, -1.0, 0.0, "sign"),
        (0, 1.0, 0.06, None), (1, 1.0, 0.004, None), (2, 1.0, 0.0, None),
    ],
)  # fmt: skip
def test_offsets_and_signs_are_found(body, frames, j, sign, by, kind) -> None:
    """The correction undoes what was done to the log; errors in a fit's reach are left to it."""
    true = np.array([one.values[j] for one in frames])
    wrong = logged(frames, j, sign * (true - by))
    found = LargeErrorSearch(body, CAMERAS, wrong).find((), NAMES[j : j + 1])
    if kind is None:
        assert found is None
        return
    assert found is not None
    assert (found.kind, found.name, found.cameras) == (kind, NAMES[j], CAMERAS)
    assert found.amount == pytest.approx(by, abs=0.012 if j == 1 else np.radians(1.2))
    again = np.array([found.apply(one).values for one in wrong])
    read = np.array([one.values[j] for one in wrong])
    np.testing.assert_allclose(again[:, j], sign * read + found.amount)
    others = np.delete(again, j, axis=1)
    np.testing.assert_array_equal(others, np.delete([f.values for f in frames], j, axis=1))


@pytest.mark.parametrize("j", [0, 1, 2])
def test_a_log_without_meaning_is_searched_in_each_frame(body, frames, j) -> None:
    rng, true = np.random.default_rng(2), np.array([one.values[j] for one in frames])
    low, high = body.kinematics.lower[j], body.kinematics.upper[j]
    wrong = logged(frames, j, rng.uniform(low, high, len(frames)))
    found = LargeErrorSearch(body, CAMERAS, wrong).find((), [NAMES[j]])
    assert found is not None
    assert (found.kind, found.name) == ("log", NAMES[j])
    again = np.array([found.apply(one).values[j] for one in wrong])
    np.testing.assert_allclose(again, true, atol=0.012 if j == 1 else np.radians(2.0))
    # With right positions in the log, other positions in each frame are no better.
    assert LargeErrorSearch(body, CAMERAS, frames).find((), NAMES) is None


def test_positions_beyond_limits_are_not_searched_in_each_frame(tmp_path_factory):
    """A bar looks the same after half a turn, which is out of its limits."""
    bar = '<visual><geometry><box size="0.7 0.1 0.1"/></geometry></visual>'
    limits = f'lower="{np.pi - 1.2}" upper="{np.pi + 1.2}"'
    at = {"limits": limits, "origin": 'xyz="0 0 0.4"', "axis": "1 0 1"}
    text = urdf(
        link("world", ""), link("bar", bar), joint("turn", "revolute", "world", "bar", **at)
    )
    tree = load_model(write(tmp_path_factory.mktemp("bar"), text), check=False).pose_tree()
    one, rng, frames = RegistrationBody(tree), np.random.default_rng(4), []
    true = np.pi + np.array([-1.0, -0.6, -0.2, 0.3, 0.7, 1.1])
    for q in true:
        X_WN = one.kinematics.poses(np.array([q]))
        masks = {c.name: draw_mask(one.medium, c.X_CW @ X_WN, c) for c in CAMERAS}
        frames.append(MultiViewFrame("", np.array([q]), masks))
    wrong = logged(frames, 0, np.pi + rng.uniform(-1.2, 1.2, len(true)))
    found = LargeErrorSearch(one, CAMERAS, wrong).find((), ["turn"])
    assert found is not None
    assert found.kind == "log"
    again = np.array([found.apply(frame).values[0] for frame in wrong]) % (2.0 * np.pi)
    np.testing.assert_allclose(again, true, atol=np.radians(2.0))


def test_the_simplest_correction_that_explains_is_chosen(body, frames) -> None:
    """Among corrections that do the same, that of the lowest rank; a useless one never."""
    wrong = logged(frames, 2, np.array([one.values[2] + 0.5 for one in frames]))
    search = LargeErrorSearch(body, CAMERAS, wrong)
    right = [search.joint_correction("reading", "bend", 1.0, -0.5, rank) for rank in (3.0, 2.0)]
    useless = Correction("reading", "none", CAMERAS, unchanged, 0.0, 0.0)
    worse = search.joint_correction("reading", "bend", 1.0, 0.4, 0.0)
    half = search.joint_correction("reading", "bend", 1.0, -0.2, 0.0)
    assert search.find([*right, useless, worse, half], ()) is right[1]
    assert search.find([useless, worse], ()) is None
    # A constant is preferred to other positions in each frame, which explain a little more.
    free = replace(right[0], kind="log")
    near = search.joint_correction("reading", "bend", 1.0, -0.47, 9.0)
    assert search.find([free, near], ()) is near
    assert search.find([free, half], ()) is free
    small = search.joint_correction("reading", "bend", 1.0, -0.06, 0.0)
    assert search.find([small], ()) is None
    assert search.find([small], (), max_remaining=1.0) is small


def test_other_focal_lengths_explain_pictures_unless_near(body, frames) -> None:
    for factor, near in ((1.2, False), (1.03, True)):
        zoomed = tuple(
            replace(one, focal_x=factor * one.focal_x, focal_y=factor * one.focal_y)
            for one in CAMERAS
        )
        search = LargeErrorSearch(body, zoomed, frames)
        by = 1.0 / factor - 1.0
        focal = Correction("focal", "focal lengths", CAMERAS, unchanged, by)
        assert search.find([focal], (), max_remaining=1.0) is (None if near else focal)
        nothing = Correction("", "", zoomed, unchanged)
        assert search.misfits(focal).sum() < search.misfits(nothing).sum()


def test_corrections_are_applied_in_order(body, frames) -> None:
    search = LargeErrorSearch(body, CAMERAS, frames)
    first, second = (
        search.joint_correction(*one, 0.0)
        for one in (("offset", "bend", 1.0, 0.3), ("sign", "bend", -1.0, 0.1))
    )
    q = frames[0].values[2]
    assert apply_corrections([first, second], frames[0]).values[2] == -(q + 0.3) + 0.1
    assert apply_corrections([second, first], frames[0]).values[2] == -q + 0.1 + 0.3
    assert frames[0].values[2] == q


@pytest.mark.parametrize("factor", [1, 3])
def test_excess_and_lack_are_areas_away_from_the_outline(body, factor: int) -> None:
    """Whatever the picture's resolution; a dilation by less than the band does not count."""
    camera: PinholeCamera = CAMERAS[0].resized(factor * 320, factor * 240)
    drawn = draw_mask(body.medium, camera.X_CW @ body.kinematics.poses(FIRST), camera)
    area = drawn.sum()

    def off(mask: np.ndarray) -> tuple[float, float]:
        return mask_excess_and_lack(body, camera, FIRST, mask, float(np.sqrt(area)))

    assert off(drawn) == (0.0, 0.0)
    for change in (cv2.dilate, cv2.erode):
        one_pixel = change(drawn.view(np.uint8), np.ones((3, 3), np.uint8)).view(bool)
        assert max(off(one_pixel)) < 0.005
    side = int(np.sqrt(0.3 * area))
    more = drawn.copy()
    more[:side, :side] = True
    assert off(more) == pytest.approx((side**2 / (side**2 + area), 0.0), rel=0.08)
    rows = np.flatnonzero(drawn.any(axis=1))
    less = drawn.copy()
    less[: rows[len(rows) // 2]] = False
    excess, lack = off(less)
    assert excess == 0.0
    assert lack == pytest.approx((area - less.sum()) / less.sum(), rel=0.25)
    # An empty mask: the whole body is in excess, over the usual area.
    assert off(drawn & False) == pytest.approx((0.0, 1.0), rel=0.08)


def test_ratios_of_joints_and_links_are_fractions_of_their_outlines() -> None:
    """A joint's ratio is that of all links that it moves; unseen joints have none."""

    def fit(moved: Sequence[Sequence[int]], matched: Sequence[Sequence[float]]) -> SimpleNamespace:
        moves = np.array(moved, float)[:, :, None] * [0.0, 1.0, 0.0]
        mask = SimpleNamespace(moves=moves)
        return SimpleNamespace(compared_masks=(mask,), matched_lengths=np.array(matched))

    # Three links in a chain; columns: three joints, the last of which moves nothing seen, a camera.
    moved = [[1, 0, 0, 1], [1, 1, 0, 1], [0, 0, 1, 1]]
    fits = [fit(moved, [[30, 30], [10, 1], [0, 0]]), fit(moved, [[50, 20], [10, 5], [0.0, 0.0]])]
    found = joint_inlier_ratios(fits, ["a", "b", "c"])
    assert found == {"a": pytest.approx(56 / 100), "b": pytest.approx(6 / 20)}
    assert joint_inlier_ratios([], ["a"]) == {}
    assert mismatched_links(fits) == [(1, pytest.approx(6 / 20))]
    # A link with a hundredth of the outlines is not judged; one with a thirtieth is.
    for part, judged in ((0.01, 0), (1 / 30, 1)):
        few = [fit([[1], [1]], [[1.0 - part, 1.0], [part, 0.0]])]
        assert len(mismatched_links(few)) == judged
