"""A joint whose limits are two turns apart, from pictures to the result folder."""

import csv

import numpy as np
import pytest

from drake_pose.camera.camera_files import save_cameras
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.silhouette.pictures.masks import write_mask
from tests.jobs.scenes import read_rows
from tests.search.turning import crane, views_of


def test_an_encoder_that_has_turned_once_more_is_no_error(tmp_path):
    """As a UR5: measured 331.5 degrees inside limits of 360, which looks like -28.5."""
    model = crane(tmp_path)
    truth = np.radians([178.0, 331.5])
    (view,) = views_of(model, truth)
    scene = tmp_path / "scene"
    mask = scene / "masks" / view.camera.name / "0000.png"
    mask.parent.mkdir(parents=True)
    save_cameras(scene / "cameras.yaml", [view.camera])
    write_mask(mask, view.mask)
    with (scene / "joint_angles.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["frame", *model.position_names], [0, *truth]])
    out = tmp_path / "out"
    result = estimate_scene(scene, model.path, out=out, replay=False)
    (row,) = read_rows(out / "poses.csv")
    q = np.degrees([float(row["swing"]), float(row["luff"])])
    assert q[0] == pytest.approx(178.0, abs=2.0)
    assert q[1] == pytest.approx(-28.5, abs=2.0)
    for joint in read_rows(out / "joints.csv"):
        value = q[model.position_index(joint["joint"])]
        assert float(joint["low"]) <= value <= float(joint["high"])
    families = read_rows(out / "families.csv")
    assert len(families) == 2
    errors = result.records["0000"].joint_errors
    assert set(errors) == {"swing", "luff"}
    assert max(abs(error) for error in errors.values()) < 2.0
