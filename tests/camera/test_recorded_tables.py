"""Times, joint positions and camera poses as data sets record them."""

import numpy as np
import pyarrow as pa
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.camera.episode_files import recorded_pose
from drake_pose.camera.lerobot_tables import is_picture, row_times

TIMES = 3.0 + 0.1 * np.arange(9)


def times_of(column, rate: float | None = 10.0, **others) -> tuple[np.ndarray, list[str]]:
    warnings: list[str] = []
    columns = {**({} if column is None else {"timestamp": column}), **others}
    table = pa.table({**columns, "other": np.arange(9)})
    return row_times(table, rate, "file.parquet", warnings), warnings


@pytest.mark.parametrize("stretch", [0.5, 0.75, 1.3, 2.0])
def test_times_at_another_rate_are_used_and_told(stretch) -> None:
    found, (text,) = times_of(stretch * TIMES)
    np.testing.assert_allclose(found, stretch * TIMES)
    assert f"the rows' times are {0.1 * stretch:.4g} s apart, but at 10 Hz" in text
    assert "would be 0.1 s" in text


@pytest.mark.parametrize(
    ("key", "kind", "more", "found"),
    [
        ("observation.image", ("image", [4, 4, 3]), {}, True),
        ("observation.images.top", ("video", [4, 4, 3]), {}, True),
        ("top", ("uint8", [4, 4, 3]), {}, True),
        ("top", ("uint8", [3, 4, 4]), {}, True),
        ("depth", ("uint16", [4, 4, 1]), {}, False),
        ("depth", ("uint16", [1, 4, 4]), {}, False),
        ("top", ("video", [4, 4, 3]), {"info": {"video.is_depth_map": True}}, False),
        ("top", ("video", [4, 4, 3]), {"info": {"video.is_depth_map": False}}, True),
        ("state", ("float32", [7]), {}, False),
    ],
)
def test_colour_images_are_told_from_depth_and_numbers(key, kind, more, found) -> None:
    assert is_picture(key, {"dtype": kind[0], "shape": kind[1], **more}) == found


def test_a_recorded_pose_is_the_median_of_rows_as_droid_writes_them() -> None:
    """Position, and angles about the fixed axes x, y and z; half a turn is no jump."""
    rng, warnings = np.random.default_rng(2), []
    row = np.array([0.3, -0.2, 0.5, 3.14159, 0.2, -1.1])
    rows = row + 1e-4 * rng.normal(size=(31, 6))
    rows[:, 3] = np.mod(rows[:, 3] + np.pi, 2.0 * np.pi) - np.pi
    assert np.ptp(rows[:, 3]) > 6.0
    found = recorded_pose(rows, "eye", warnings)
    assert found is not None
    assert warnings == []
    turn = np.eye(3)
    for axis, angle in zip("xyz", row[3:], strict=True):
        turn = Rotation.from_euler(axis, angle).as_matrix() @ turn
    np.testing.assert_allclose(found[:3, :3], turn, atol=2e-4)
    np.testing.assert_allclose(found[:3, 3], row[:3], atol=2e-4)
    np.testing.assert_array_equal(found[3], [0, 0, 0, 1])
    rows[:3] += 0.5
    again = recorded_pose(rows, "eye", warnings)
    np.testing.assert_allclose(again, found, atol=1e-4)
    assert "vary by 500 mm and 28.7 degrees; their median is used" in warnings[0]
    (single,) = [recorded_pose(row, "eye", [])]
    np.testing.assert_allclose(single, found, atol=3e-4)


@pytest.mark.parametrize(
    ("rows", "told"),
    [
        (np.zeros((3, 5)), "are not x, y, z"), (np.full((3, 6), np.nan), "are not x, y, z"),
        (np.array([[0.0] * 6, [0.004] * 6]), None),
        (np.array([[0.0] * 6, [0.006] + [0.0] * 5]), "vary by 6 mm and 0.0 degrees"),
        (np.array([[0.0] * 6, [0.0] * 5 + [0.006]]), "vary by 0 mm and 0.3 degrees"),
    ],
)  # fmt: skip
def test_useless_or_moving_poses_are_told(rows, told) -> None:
    warnings: list[str] = []
    found = recorded_pose(rows, "eye", warnings)
    assert (found is None) == (told is not None and "not x" in told)
    assert len(warnings) == (told is not None)
    assert all(f"camera 'eye': its recorded extrinsics {told}" in text for text in warnings)
