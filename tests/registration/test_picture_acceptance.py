"""What a camera fitted to pictures must reach to be accepted."""

from types import SimpleNamespace

import numpy as np
import pytest

from drake_pose.errors import RegistrationError
from drake_pose.registration.picture_acceptance import PictureStart, accept_fit
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
