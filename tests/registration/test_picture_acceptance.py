"""What a camera fitted to pictures must reach to be accepted."""

from types import SimpleNamespace

import numpy as np
import pytest

from drake_pose.errors import RegistrationError
from drake_pose.fit.background import COLOURS, KnownBackground, foreground_picture
from drake_pose.registration.picture_acceptance import PictureStart, accept_fit, best_first
from drake_pose.registration.picture_search import PosedPicture, RoughPose, segment_picture
from drake_pose.registration.recording import NO_CLOCK
from tests.registration.episodes import PaintedEpisode


@pytest.mark.parametrize(
    ("ratio", "explained", "by_chance", "why"),
    [
        # Ratio and explained fraction must be sufficient together.
        (0.46, 0.27, 0.05, r"46% .*minimum 48%"),
        (0.46, 0.30, 0.05, None),
        # Neither replaces the other one.
        (0.39, 0.60, 0.05, r"minimum 40%"),
        (0.60, 0.30, 0.20, r"p-value 0\.2"),
        (0.74, 0.005, 0.0, r"p-value 0\.4"),
        # So many contours fit in no wrong pose that explains something.
        (0.76, 0.13, 0.20, None),
        (0.76, 0.11, 0.20, r"p-value"),
    ],
)
def test_poses_are_accepted_by_two_numbers_together(
    episode: PaintedEpisode, ratio: float, explained: float, by_chance: float, why: str | None
) -> None:
    ratios = np.array([ratio - 0.1, ratio + 0.1])
    fit = SimpleNamespace(views=(None,))
    best = SimpleNamespace(fit=fit, ratios=ratios, explained=explained)
    start = PictureStart(episode.camera, (), NO_CLOCK, (), by_chance)
    # An accepted fit is asked for its covariance next.
    error, words = (AttributeError, "covariance") if why is None else (RegistrationError, why)
    with pytest.raises(error, match=words):
        accept_fit(best, None, start, np.zeros(5), 0.0)


def test_poses_are_ranked_by_what_they_explain_and_by_their_contours() -> None:
    """A wrong pose may explain more."""
    right, poor, wide, blind = (
        RoughPose(None, None, explained, ratios)
        for explained, ratios in (
            (0.10, {"a": 0.6, "b": 0.8}),
            (0.05, {"a": 0.2, "b": 0.4}),
            (0.40, {"a": 0.1, "b": 0.3}),
            (0.00, {"a": 0.1}),
        )
    )
    assert right.agreement == pytest.approx(0.8)
    ranked = best_first([blind, poor, right, wide])
    assert ranked == [right, wide, poor, blind]


def test_pictures_are_segmented_up_to_a_distance_from_the_body() -> None:
    """The distance is a fraction of the square root of the body's area, here 0.5 times 20."""
    covered = np.zeros((80, 80), bool)
    covered[30:50, 30:50] = True
    colours, deviations = np.full((80, 80, 3), 60.0, np.float32), np.ones((80, 80), np.float32)
    alike = np.zeros(COLOURS)
    known = KnownBackground(colours, deviations, np.zeros((80, 80), bool), alike, alike)
    posed = PosedPicture("a", np.zeros(1), np.full((80, 80, 3), 200, np.uint8))
    frame = segment_picture(posed, known, np.eye(3, 4, dtype=np.float32), covered, around=0.5)
    unknown = foreground_picture(np.zeros((1, 1), np.float32))[0, 0]
    known_rows, known_columns = np.nonzero((frame.foreground != unknown).any(axis=2))
    for places in (known_rows, known_columns):
        assert (places.min(), places.max()) == (20, 59)
