"""Groups of images by time stamps, against brute force."""

import math

import numpy as np
import pytest

from drake_pose.systems.picture_capture import Synchroniser


def play(synchroniser, recorded, delays):
    """Add images in the order of arrival, and return the groups."""
    arrivals = sorted(
        (time + delay, camera, time, k)
        for camera, stream in recorded.items()
        for (time, k), delay in zip(stream, delays[camera], strict=True)
    )
    found = []
    for _, camera, time, k in arrivals:
        synchroniser.add(camera, time, k)
        while (group := synchroniser.take()) is not None:
            found.append(group)
    for camera in recorded:
        synchroniser.finish(camera)
    while (group := synchroniser.take()) is not None:
        found.append(group)
    return found


def brute_force(recorded, tolerance):
    """Group the images by scanning all of them for each group."""
    rest = {name: list(stream) for name, stream in recorded.items()}
    found = []
    while any(rest.values()):
        begin = min(time for stream in rest.values() for time, _ in stream)
        group = {}
        for name, stream in rest.items():
            near = [one for one in stream if one[0] - begin <= tolerance]
            if near:
                group[name] = near[0][1]
                stream.remove(near[0])
        found.append((begin, group))
    return found


@pytest.mark.parametrize("seed", range(6))
def test_groups_match_brute_force(seed):
    generator = np.random.default_rng(seed)
    recorded = {
        f"c{k}": [(float(t), i) for i, t in enumerate(np.cumsum(generator.exponential(0.1, 80)))]
        for k in range(generator.integers(2, 5))
    }
    # Images arrive late and interleaved, but in order for each camera.
    delays = {name: np.sort(generator.random(80)) for name in recorded}
    synchroniser = Synchroniser(recorded, 0.04, 1e9)
    found = play(synchroniser, recorded, delays)
    assert found == brute_force(recorded, 0.04)
    assert not synchroniser.changes


def test_a_camera_that_stops_is_awaited_then_ignored_until_it_returns():
    synchroniser = Synchroniser(["a", "b"], 0.05, 0.25)
    synchroniser.add("a", 0.0, "a0")
    synchroniser.add("b", 0.01, "b0")
    assert synchroniser.take()[1] == {"a": "a0", "b": "b0"}
    for k in (1, 2, 3):
        synchroniser.add("a", 0.1 * k, f"a{k}")
        assert synchroniser.take() is None
    assert synchroniser.take(now=0.36)[0] == pytest.approx(0.1)
    assert synchroniser.changes == [("b", 0.01, True)]
    # It is not awaited again, and not reported twice.
    assert synchroniser.take()[1] == {"a": "a2"}
    assert synchroniser.take()[1] == {"a": "a3"}
    assert synchroniser.take() is None
    assert len(synchroniser.changes) == 1
    # An image of a finished group is late and does not count as a return.
    assert not synchroniser.add("b", 0.31, "b3")
    assert synchroniser.late == {"a": 0, "b": 1}
    assert synchroniser.add("b", 0.41, "b4")
    assert synchroniser.changes[1:] == [("b", 0.41, False)]
    assert synchroniser.take() is None, "a is waited for"
    synchroniser.add("a", 0.4, "a4")
    assert synchroniser.take()[1] == {"a": "a4", "b": "b4"}


def test_a_camera_without_any_image_is_reported():
    synchroniser = Synchroniser(["a", "b"], 0.0, 0.1)
    assert synchroniser.add("a", 0.0, 0)
    assert not synchroniser.add("a", 0.0, 0), "a time stamp that does not go on"
    assert synchroniser.take() is None
    assert synchroniser.take(now=0.1) is not None
    ((camera, time, _),) = synchroniser.changes
    assert camera == "b"
    assert math.isnan(time)
