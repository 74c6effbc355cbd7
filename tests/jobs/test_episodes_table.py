"""The table of audited episodes: cameras that moved, and poses that several episodes share."""

import csv
import io

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from drake_pose.camera.camera_files import describe_camera, load_cameras
from drake_pose.camera.models import PinholeCamera
from drake_pose.jobs.episodes_table import COLUMNS, batch_page, episodes_table
from tests.files.test_page import require_plain_page

HOME, BUMPED = [1.0, 0.0, 0.5], [1.0, 0.02, 0.5]


def camera(place, turn_deg=0.0, sd=0.001, **more):
    """Return a camera as an audit finds it, at a place [m]; ``sd`` in all directions [rad, m]."""
    X_WC = np.eye(4)
    X_WC[:3, :3] = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
    X_WC[:3, 3] = place
    entry = describe_camera(PinholeCamera("left", 640, 480, 500.0, 500.0, 320.0, 240.0, X_WC))
    return {
        "camera": entry, "X_WC": X_WC.tolist(), "focal_sd_px": None,
        "covariance": (sd**2 * np.eye(6)).tolist(), "off_mm": None, "off_deg": None,
        "translation_sd_mm": 1e3 * sd, "rotation_sd_deg": 0.1,
        "time_offset_s": 0.02, "time_offset_sd_s": 0.001,
    } | more  # fmt: skip


def totals(*given, **more):
    """Return the totals of an episode with one camera."""
    named = [
        {"what": "joint", "name": "A4", "text": ""},
        {"what": "frame", "name": "7", "text": ""},
    ]
    counts = {"frame_count": 9, "agreeing_count": 8, "findings": named}
    return counts | {"cameras": {"left": camera(*given, **more)}}


def table(episodes):
    """Return the rows of episodes.csv, the camera files' entries, and the sentences."""
    files, moves = episodes_table(episodes)
    rows = list(csv.DictReader(io.StringIO(files.pop("episodes.csv"))))
    return rows, {name: yaml.safe_load(text) for name, text in files.items()}, moves


def column(rows, name):
    return [row[name] for row in rows]


def test_a_significant_difference_to_earlier_episodes_is_a_move(tmp_path):
    episodes = {
        "first": totals(HOME),
        # Within the error of two poses with 1 mm per axis.
        "same": totals([1.001, -0.001, 0.5]),
        "bumped": totals(BUMPED, 1.0),
        "failed": {},
        "again": totals(BUMPED, 1.0),
    }
    rows, files, moves = table(episodes)
    assert tuple(rows[0]) == COLUMNS
    assert column(rows, "moved") == ["", "no", "yes", "no"]
    assert float(rows[2]["moved_deg"]) == pytest.approx(1.0)
    assert float(rows[2]["moved_mm"]) == pytest.approx(np.hypot(20.5, 0.5))
    assert [float(rows[2][name]) for name in "xyz"] == BUMPED
    assert (rows[0]["joints"], rows[0]["frames"], rows[0]["agreeing"]) == ("A4", "9", "8")
    assert column(rows, "camera_file") == ["cameras_1.yaml"] * 2 + ["cameras_2.yaml"] * 2
    # The distance of two poses of equal covariance has twice that covariance.
    p_value = chi2.sf(2.0 / 2.0, 6)
    assert float(rows[1]["p_value"]) == pytest.approx(p_value)
    (tmp_path / "before.yaml").write_text(yaml.safe_dump(files["cameras_1.yaml"]))
    before = load_cameras(tmp_path / "before.yaml")["left"]
    np.testing.assert_allclose(before.X_WC[:3, 3], [1.0005, -0.0005, 0.5])
    assert column(rows, "pose") == ["1", "1", "2", "2"]
    assert moves == (
        "camera 'left' moved by 1.00 degrees and 20.5 mm before episode bumped (p-value < 0.001)",
        "camera 'left', pose 1: first, same", "camera 'left', pose 2: bumped, again",
    )  # fmt: skip
    assert episodes_table({"scene": {"frame_count": 3, "agreeing_count": 3}}) == ({}, ())
    assert table({"one": totals(HOME)})[2] == ()


def test_a_camera_that_is_put_back_shares_its_earlier_pose():
    """Poses are shared by many episodes although each differs from the next by chance."""
    rng = np.random.default_rng(3)
    places = np.array([HOME] * 8 + [BUMPED] * 8 + [HOME] * 8)
    noisy = places + rng.normal(0.0, 0.001, places.shape)
    rows, files, moves = table({f"e{k:02d}": totals(list(one)) for k, one in enumerate(noisy)})
    assert column(rows, "pose") == ["1"] * 8 + ["2"] * 8 + ["1"] * 8
    assert [row["scene"] for row in rows if row["moved"] == "yes"] == ["e08", "e16"]
    assert len(files) == 3
    back = [one for one in moves if "moved back to pose 1 by 0.00 degrees and" in one]
    assert len(back) == 1
    assert back[0].endswith("before episode e16")
    assert sum("(p-value" in one for one in moves) == 1
    moves = table({k: totals(HOME) for k in ("a", "b")})[2]
    assert moves == ("camera 'left' has one pose in all 2 episodes",)
    ridden = totals(HOME)
    ridden["cameras"]["left"]["link"] = "hand"
    rows, files, moves = table({"a": ridden, "b": totals(HOME), "c": ridden})
    assert not any("moved" in one for one in moves)
    assert (column(rows, "pose"), len(files)) == (["1", "2", "1"], 3)


def test_combined_pose_is_the_information_weighted_mean():
    # A slow drift of insignificant steps is a move as well.
    drifting = {str(k): totals([0.005 * k, 0.0, 0.0], sd=0.002) for k in range(9)}
    moved = column(table(drifting)[0], "moved")
    assert 0 < moved.count("yes") < 5
    # The second camera has not moved and has one pose in all files.
    episodes = {str(k): totals([float(k), 0.0, 0.0]) for k in range(2)}
    sds = (0.001, 0.002)
    for one, x, turn, sd in zip(episodes.values(), (0.0, 0.005), (0.0, 0.1), sds, strict=True):
        one["cameras"]["right"] = camera([x, 0.0, 0.0], turn, sd)
    _, files, _ = table(episodes)
    lefts = [file["left"]["X_WC"][0][3] for file in files.values()]
    assert lefts == [0.0, 1.0]
    mean = np.average([0.0, 0.005], weights=np.power(sds, -2.0))
    turn = np.average([0.0, 0.1], weights=np.power(sds, -2.0))
    for file in files.values():
        X_WC = np.array(file["right"]["X_WC"])
        assert X_WC[0, 3] == pytest.approx(mean)
        found = Rotation.from_matrix(X_WC[:3, :3]).as_euler("xyz", degrees=True)
        np.testing.assert_allclose(found, [0.0, 0.0, turn], atol=1e-9)
    # With estimated focal lengths the surest episode's entry is used, not a mean.
    focal = [camera([k * 1e-3, 0.0, 0.0], sd=sd, focal_sd_px=2.0) for k, sd in enumerate(sds)]
    _, files, _ = table({str(k): {**totals(HOME), "cameras": {"left": one}}
                         for k, one in enumerate(focal)})  # fmt: skip
    assert files["cameras_1.yaml"]["left"] == focal[0]["camera"]
    # Many equal episodes are no surer than one, as their errors may be the same.
    many = {str(k): totals(HOME) for k in range(9)} | {"last": totals([1.004, 0.0, 0.5])}
    last = table(many)[0][-1]
    assert float(last["p_value"]) == pytest.approx(chi2.sf(16.0 / 2.0, 6))


def test_page_shows_displacements_and_offsets(tmp_path):
    episodes = {str(k): totals([1.0, 0.01 * k, 0.5], 3.0 * k) for k in range(3)}
    episodes["1"]["joint_offsets"] = {"A4": ("deg", 5.0, 0.5)}
    one = {"state": "finished", "errors": [], "frame_count": 8, "agreeing_count": 0, "findings": []}
    lost = {"state": "failed", "errors": [{"error": "/tmp/a/b: broken"}], "frame_count": 4,
            "found_count": 3, "mean_E_total": 0.25}  # fmt: skip
    content = {"scenes": {**dict.fromkeys(episodes, one), "lost": lost}, "moves": ["it moved"] * 5}
    batch_page(tmp_path, content, episodes).write(tmp_path)
    page = require_plain_page((tmp_path / "report.html").read_text())
    assert page.by_id["answer"] == f"3 of 4 scenes finished.{' It moved.' * 4}"
    titles = ("left: shift [mm]", "left: turn [deg]", "A4: joint offset [deg]")
    assert {*titles} <= {*page.plots}
    assert ["0", "finished", "0 of 8", "no error found"] in page.tables[0]
    assert ["lost", "failed", "3 of 4", "b: broken"] in page.tables[0]
    assert {"lost/report.html"} == {link for link in page.links if link.endswith("report.html")}
