"""Scenes without cameras.yaml, and roots whose position is not known."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from drake_pose.body import load_model
from drake_pose.errors import SettingsError
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.estimate.scene import estimate_scene
from tests.jobs.scenes import NAMES, TinyScene, camera, read_rows, run_estimate


@pytest.fixture
def bare_scene(own_scene: TinyScene) -> TinyScene:
    """Masks alone."""
    (own_scene.folder / "cameras.yaml").unlink()
    for path in (own_scene.folder / "masks" / "front").iterdir():
        path.rename(own_scene.folder / "masks" / path.name)
    shutil.rmtree(own_scene.folder / "masks" / "front")
    return own_scene


def run(scene: TinyScene, out: Path, *more: str) -> tuple[np.ndarray, dict]:
    """The positions and the record of the first frame."""
    _, summary = run_estimate(scene, out, "--method", "beam", "--frame", "0", "--no-replay", *more)
    (row,) = read_rows(out / "poses.csv")
    return np.array([float(row[name]) for name in NAMES]), summary["frames"]["0000"]


def test_masks_alone(bare_scene: TinyScene, out: Path) -> None:
    """Pose and scale are found, as far as a parallel camera can stand for the pinhole."""
    q, record = run(bare_scene, out)
    np.testing.assert_allclose(q, bare_scene.truth["0000"], atol=np.radians(6.0))
    assert record["E_total"] < 0.08
    true_camera = camera("front")
    # The crane stands in the world's origin.
    depth = np.linalg.norm(true_camera.X_WC[:2, 3])
    assert record["camera_scale"] == pytest.approx(true_camera.focal_x / depth, rel=0.06)
    assert (out / "overlay" / "camera" / "0000.png").is_file()
    # Nothing says how sure it is: each joint may be anywhere inside its limits.
    limits = load_model(bare_scene.model, check=False)
    for k, joint in enumerate(record["joints"].values()):
        ends = np.degrees([limits.lower[k], limits.upper[k]])
        assert not joint["determined"]
        assert [joint["low"], joint["high"]] == pytest.approx(ends)


def test_a_root_position_that_is_not_known(tiny_scene: TinyScene, out: Path) -> None:
    q, record = run(tiny_scene, out, "--root-position", "unknown")
    np.testing.assert_allclose(q, tiny_scene.truth["0000"], atol=np.radians(6.0))
    assert record["E_total"] < 0.03
    assert record["camera_scale"] is None


def test_what_needs_a_known_root_is_refused(tiny_scene: TinyScene, bare_scene: TinyScene) -> None:
    settings = EstimateSettings(method="paper")
    for scene, more in ((bare_scene, None), (tiny_scene, "unknown")):
        with pytest.raises(SettingsError, match="--method beam"):
            estimate_scene(scene.folder, scene.model, None, replace(settings, root_position=more))
