"""The report of a registration from pictures: time offsets, focal lengths, parameters."""

from types import SimpleNamespace

import numpy as np
import pytest

from drake_pose.jobs.registration.result import (
    make_registration_report,
    plot_offset,
)
from drake_pose.jobs.registration.tracks import describe_pictures
from drake_pose.registration.recording import TimeOffset
from tests.search.arms import arm_cameras


def summary(**camera):
    one = {
        "X_WC": np.eye(4).tolist(), "translation_sd_mm": 1.0, "rotation_sd_deg": 0.1,
        "modes": [{}], "mean_iou": 0.9, "seconds": 1.0, "outliers": [], "zeros": {},
        "lengths": {}, "masks": "found", "focal_px": 500.0, "focal_sd_px": None,
        "time_offset_s": None, "time_offset_sd_s": None, "time_offset_scores": [],
        "explained": 0.42, "p_value": 2e-6, "runner_up": None,
        "frames": {"0000": {"agrees": True, "E_total": 0.1, "iou": 0.9, "inlier_ratio": 0.8}},
    }  # fmt: skip
    return {
        "scene": "episode", "model": "arm.urdf", "warnings": [], "cameras": {"front": one | camera}
    }  # fmt: skip


@pytest.mark.parametrize("late", [0.1, -0.35])
def test_time_offset_is_drawn_at_the_peak_of_the_scores(tmp_path, late):
    offsets = np.linspace(-1.0, 1.0, 81)
    # Two offsets have not been scanned.
    scores = np.column_stack([offsets, 1.0 - 0.3 * np.abs(offsets - late)])[
        [*range(5), *range(7, 81)]
    ]
    told = {"time_offset_s": late, "time_offset_sd_s": 0.02, "focal_sd_px": 5.0}
    page = make_registration_report(tmp_path, summary(time_offset_scores=scores.tolist(), **told))
    assert f"{1e3 * late:.1f} ms ({1e3 * late - 39.2:.1f} to {1e3 * late + 39.2:.1f})" in page
    assert f" {abs(1e3 * late):.0f} ms {'later' if late > 0 else 'earlier'}" in page
    assert "Focal length 500.0 pixels (490.2 to 509.8)" in page
    assert page.count('<img class="plot" src="data:image/') == 1
    (axes,) = plot_offset({"time_offset_scores": scores.tolist(), **told}).axes
    curve, line = (one.get_xydata() for one in axes.lines)
    np.testing.assert_allclose(curve, scores * [1e3, 100.0])
    np.testing.assert_allclose(line[:, 0], curve[curve[:, 1].argmax(), 0], atol=1e-9)
    band = axes.patches[0].get_extents().transformed(axes.transData.inverted())
    assert (band.x0, band.x1) == pytest.approx((1e3 * late - 39.2, 1e3 * late + 39.2))


def test_summary_of_time_offset_focal_length_and_runner_up(tmp_path):
    camera, scores = arm_cameras()[0], np.array([[0.0, 0.5], [0.1, 1.0]])
    clock = TimeOffset(0.1, 0.02, scores, drift=1e-3, drift_deviation=1e-4)
    one = SimpleNamespace(
        found=SimpleNamespace(camera=camera), time_offset=clock, focal_deviation=0.01,
        fit=SimpleNamespace(explained=0.3, contour=0.2), evidence=SimpleNamespace(p_value=1e-3),
        runner_up=None,
    )  # fmt: skip
    told = describe_pictures(one)
    assert (told["time_offset_s"], told["time_offset_sd_s"]) == (0.1, 0.02)
    assert (told["time_drift"], told["time_drift_sd"]) == (1e-3, 1e-4)
    assert told["focal_sd_px"] == pytest.approx(0.01 * camera.focal_x)
    # The other camera stands as far away on the opposite side of the world's origin.
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    other = describe_pictures(
        SimpleNamespace(**{**vars(one), "runner_up": (camera.X_CW @ turned, 7.5)})
    )["runner_up"]
    aside = np.linalg.norm(camera.X_WC[:2, 3])
    assert other["distance_mm"] == pytest.approx(2e3 * aside)
    assert (other["rotation_deg"], other["margin_sd"]) == (pytest.approx(180.0, abs=1e-4), 7.5)
    untold = SimpleNamespace(**{**vars(one), "focal_deviation": 0.0, "time_offset": None})
    told = describe_pictures(untold)
    for name in ("time_offset_s", "time_offset_sd_s", "time_drift", "time_drift_sd", "focal_sd_px"):
        assert told[name] is None
