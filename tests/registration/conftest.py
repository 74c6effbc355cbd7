"""A small arm on a plate in the world, and a recording of a swinging arm."""

from collections.abc import Callable
from typing import Any

import pytest

from drake_pose.body import ArticulatedModel
from drake_pose.registration.posed_frames import PosedFrames
from drake_pose.registration.recording import Recording
from drake_pose.registration.register import RegistrationBody
from tests.registration.arm_pictures import MIDDLE, PLACE, looking_at, see
from tests.registration.episodes import LATE, PaintedEpisode, painted_episode
from tests.search.arms import arm_tree


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> ArticulatedModel:
    return arm_tree(tmp_path_factory.mktemp("arm")).model


@pytest.fixture(scope="module")
def body(model: ArticulatedModel) -> RegistrationBody:
    return RegistrationBody(model.pose_tree())


@pytest.fixture(scope="session")
def episode(tmp_path_factory: pytest.TempPathFactory) -> PaintedEpisode:
    return painted_episode(tmp_path_factory.mktemp("arm"), late=LATE)


@pytest.fixture(scope="session")
def recording(episode: PaintedEpisode) -> Callable[..., Recording]:
    """Return a function that makes the episode's recording, with some fields replaced."""

    def record(**changes: Any) -> Recording:
        given = {
            "names": tuple(f"{k:04d}" for k in range(len(episode.times))),
            "values_at": lambda offset: episode.values_at(episode.times + offset),
            "read": lambda k: episode.pictures[k],
            "times": episode.times,
        }
        return Recording(**(given | changes))

    return record


@pytest.fixture(scope="module")
def posed(model: ArticulatedModel, body: RegistrationBody) -> PosedFrames:
    """Two frames of the arm in one camera."""
    camera = looking_at(PLACE, MIDDLE, 0.1)
    frames = see(model, body, camera, 2, 4)
    return PosedFrames(body.kinematics, body.coarse, camera, frames, 0.02)
