"""Scenes without cameras.yaml, and roots whose position is not known."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from drake_pose.commands.main import app
from tests.cli import CliRunner
from tests.jobs.scenes import NAMES, TinyScene, camera, read_rows

BEAM = ("--method", "beam", "--interval", "20", "--frame", "0", "--no-replay")


@pytest.fixture
def bare_scene(own_scene: TinyScene) -> TinyScene:
    """Masks alone."""
    (own_scene.folder / "cameras.yaml").unlink()
    for path in (own_scene.folder / "masks" / "front").iterdir():
        path.rename(own_scene.folder / "masks" / path.name)
    shutil.rmtree(own_scene.folder / "masks" / "front")
    return own_scene


def run(runner: CliRunner, scene: TinyScene, out: Path, *more: str) -> tuple[np.ndarray, dict]:
    """The positions and the record of the first frame."""
    given = [str(scene.folder), "--model", str(scene.model), "--out", str(out), *BEAM, *more]
    result = runner.invoke(app, ["estimate", *given])
    assert result.exit_code == 0, result.output
    (row,) = read_rows(out / "poses.csv")
    summary = json.loads((out / "summary.json").read_text())
    return np.array([float(row[name]) for name in NAMES]), summary["frames"]["0000"]


def test_masks_alone(bare_scene: TinyScene, runner: CliRunner, tmp_path: Path) -> None:
    """Pose and scale are found, as far as a parallel camera can stand for the pinhole."""
    q, record = run(runner, bare_scene, tmp_path / "out")
    np.testing.assert_allclose(q, bare_scene.truth["0000"], atol=np.radians(6.0))
    assert record["E_total"] < 0.08
    true_camera = camera("front")
    # The crane stands in the world's origin.
    depth = np.linalg.norm(true_camera.X_WC[:2, 3])
    assert record["camera_scale"] == pytest.approx(true_camera.focal_x / depth, rel=0.06)
    assert (tmp_path / "out" / "overlay" / "camera" / "0000.png").is_file()


def test_a_root_position_that_is_not_known(
    tiny_scene: TinyScene, runner: CliRunner, tmp_path: Path
) -> None:
    q, record = run(runner, tiny_scene, tmp_path / "out", "--root-position", "unknown")
    np.testing.assert_allclose(q, tiny_scene.truth["0000"], atol=np.radians(6.0))
    assert record["E_total"] < 0.03
    assert record["camera_scale"] is None


@pytest.mark.parametrize("unknown", ["camera", "position"])
@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--method", "paper"], "--method beam"),
        (["--method", "beam", "--angles", "grid"], "angles are continuous"),
    ],
)
def test_what_needs_a_known_root_is_refused(
    bare_scene: TinyScene,
    tiny_scene: TinyScene,
    runner: CliRunner,
    tmp_path: Path,
    unknown: str,
    options: list[str],
    told: str,
) -> None:
    scene = bare_scene if unknown == "camera" else tiny_scene
    more = ["--root-position", "unknown"] if unknown == "position" else []
    given = [str(scene.folder), "--model", str(scene.model), "--out", str(tmp_path / "out")]
    result = runner.invoke(app, ["estimate", *given, *options, *more])
    assert result.exit_code == 1
    assert told in " ".join(result.stderr.split())
