"""The report of a registration from pictures: time offsets, focal lengths, parameters."""

from types import SimpleNamespace

import numpy as np
import pytest

from drake_pose.jobs.registration.pages import (
    audit_answer,
    clock_text,
    compared_frames,
    correction,
    detectable_offset,
    parameter_rows,
    registration_answer,
    registration_page,
)
from drake_pose.jobs.registration.tracks import describe_pictures
from drake_pose.registration.recording import TimeOffset
from tests.files.test_page import require_plain_page
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
def test_time_offset_is_told_beside_the_scores(tmp_path, late):
    offsets = np.linspace(-1.0, 1.0, 81)
    scores = np.column_stack([offsets, 1.0 - 0.3 * np.abs(offsets - late)])
    told = {"time_offset_s": late, "time_offset_sd_s": 0.02, "focal_sd_px": 5.0}
    registration_page(tmp_path, summary(time_offset_scores=scores.tolist(), **told)).write(tmp_path)
    page = require_plain_page((tmp_path / "report.html").read_text())
    text = "".join(page.plots["front"].itertext())
    assert f"{1e3 * late:.1f} ms ({1e3 * late - 39.2:.1f} to {1e3 * late + 39.2:.1f})" in text
    assert f" {abs(1e3 * late):.0f} ms {'later' if late > 0 else 'earlier'}" in text
    assert "Focal length 500.0 pixels (490.2 to 509.8)" in text


def test_a_camera_on_a_link_without_masks_has_no_unknown_numbers(tmp_path):
    fit = {"agrees": True, "E_total": None, "iou": None, "inlier_ratio": 0.8}
    one = summary(masks="none", points=9, link="hand", X_LC=np.eye(4).tolist(), mean_iou=None)
    del one["cameras"]["front"]["time_offset_scores"]
    one["cameras"]["front"]["frames"] = {"0000": fit}
    registration_page(tmp_path, one).write(tmp_path)
    page = require_plain_page((tmp_path / "report.html").read_text())
    assert page.table("camera")[1][1:3] == ["link hand", "0.0, 0.0, 0.0 mm"]
    assert page.table("frame")[1] == ["0000", "no mask", "no mask", "80.0 %", "agrees"]


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


def test_parameters_are_told_with_unit_interval_and_significance():
    sure = {"determined": True, "gauge": [], "value_deg": -2.0, "sd_deg": 0.1, "low_deg": -2.2,
            "high_deg": -1.8, "significant": True}  # fmt: skip
    longer = {"determined": True, "gauge": [], "value_percent": 3.0, "sd_percent": 1.0,
              "low_percent": 1.0, "high_percent": 5.0, "significant": True}  # fmt: skip
    rows = parameter_rows({
        "a": sure, "b": sure | {"significant": False},
        "c": sure | {"significant": False, "high_deg": 0.1}, "d": longer,
        "e": {"determined": False, "gauge": ["x", "y"]}, "f": {"determined": False, "gauge": []},
    })  # fmt: skip
    no = "not written into the URDF"
    assert rows == [
        ("a", "-2.00 deg", "-2.20 to -1.80 deg",
         "significant: reads 2.00 +- 0.10 degrees too high"),
        ("b", "-2.00 deg", "-2.20 to -1.80 deg",
         f"not significant at 5 % over all parameters: {no}"),
        ("c", "-2.00 deg", "-2.20 to 0.10 deg", f"0 is in its interval: {no}"),
        ("d", "3.00 %", "1.00 to 5.00 %", "significant"),
        ("e", "not determined", "any", "correlated with x, y"),
        ("f", "not determined", "any", "unseen"),
    ]  # fmt: skip


def test_answers_are_one_or_two_sentences():
    one = summary()["cameras"]["front"]
    other = one | {"modes": [{}, {}], "outliers": ["1"], "translation_sd_mm": 2.0, "zeros": {}}
    first = one | {"zeros": {"a": {"significant": True}, "b": {"significant": False}}}
    assert registration_answer({"front": one}, ()) == (
        "Camera front found, good to 1.0 mm and 0.10 deg (one standard deviation). All 1 frames "
        "agree."
    )
    text = registration_answer({"front": first, "back": other}, ["top"])
    for part in ("Cameras front, back found, good to 2.0 mm", "1 refused, see the warnings: top.",
                 "1 of 2 frames is left out as outlier.", "equally well: back.",
                 "1 of 2 joint offsets are significant."):  # fmt: skip
        assert part in text
    kinds = {"a": "angle", "b": "length", "c": "angle"}
    sizes = {"a": 0.31, "b": 0.0042, "c": None}
    none = {"findings": [], "minimum_detectable": sizes}
    text = audit_answer(none, kinds)
    assert "above 0.31 deg or 4.2 mm would have been detected, except those of c." in text
    assert "no joint offset could" in audit_answer(none | {"minimum_detectable": {}}, kinds)
    found = [{"what": "frame", "name": "3"}, {"what": "joint", "name": "a", "text": "it is off"}]
    wrong = {"findings": found, "frame_count": 9, "frames": {"3": {}}}
    assert audit_answer(wrong, kinds) == "Error found: it is off. 1 of 9 frames is an outlier: 3."
    wrong["findings"] = [*found, {"what": "camera", "name": "left", "text": ""}]
    assert audit_answer(wrong, kinds).startswith("2 errors found: joint 'a', camera 'left'. 1 of 9")
    assert detectable_offset(0.0123, "angle") == "0.012 deg"


def test_numbers_of_a_page():
    told = {"angle_deg": 2.0, "angle_sd_deg": 0.5, "shift_mm": 3.0, "shift_sd_mm": np.inf}
    assert correction(told) == "+2.00 deg (+1.02 to +2.98)"
    assert correction({"shift_percent": -3.0, "shift_sd_percent": 1.0}) == (
        "-3.00 % (-4.96 to -1.04)"
    )
    assert correction({"angle_deg": 2.0, "angle_sd_deg": 0.0}) == "no single value"
    assert compared_frames({"a": 0.1, "b": 0.3, "c": 0.2}) == ("b", "c")
    assert compared_frames({"a": 0.1}) == ("a",)
    one = summary(runner_up={"distance_mm": 12.3, "rotation_deg": 45.6, "margin_sd": 2.25})
    text = clock_text(one["cameras"]["front"])
    assert "time offset is not determined. Focal length 500.0 pixels, as given." in text
    assert "is 12 mm and 46 degrees away; less of the contours fits there, by 2.2 standard" in text
