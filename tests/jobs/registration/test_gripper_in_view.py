"""A camera on a wrist that sees its gripper, where the scene alone does not determine its pose."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.errors import RegistrationError
from drake_pose.jobs.registration.register import SceneRegistration, register_scene
from drake_pose.jobs.registration.settings import RegistrationSettings
from tests.benchmarks.episodes import write_episode
from tests.benchmarks.wrist_rooms import Gripper, simulate_wrist

JOINTS = (
    ("0 0 0.3", "0 0 1"), ("0 0 0.1", "0 1 0"), ("0 0 0.3", "0 1 0"), ("0 0 0.25", "0 0 1"),
    ("0 0 0.1", "0 1 0"), ("0 0 0.08", "0 0 1"),
)  # fmt: skip
"""Where each joint is in its parent link [m], and its axis."""
GRIPPER = Gripper(
    "arm.urdf", "link5",
    dict(zip((f"joint{k}" for k in range(6)), (0.0, 0.5, 1.2, 0.0, np.pi - 1.7, 0.2), strict=True)),
    0.0, {"finger": (0.0, 0.05)}, 0.12, (0.06, 0.09),
)  # fmt: skip


def box(size: str, place: str, turn: str = "0 0 0") -> str:
    return (
        f'<visual><origin xyz="{place}" rpy="{turn}"/><geometry><box size="{size}"/></geometry>'
        "</visual>"
    )


def write_arm(path: Path, *, other: bool = False) -> None:
    """Write an arm with a gripper of a thumb and a finger that slides; other: of another shape."""
    parts, parent = (
        [f'<robot name="arm"><link name="base">{box("0.1 0.1 0.1", "0 0 0")}</link>'],
        "",
    )
    palm = box("0.03 0.1 0.05", "0 0 0.03") + box("0.02 0.03 0.07", "0 -0.035 0.09")
    finger = box("0.015 0.012 0.09", "0.005 0 0.09") + box("0.03 0.012 0.02", "0 0 0.13")
    if other:
        palm = box("0.09 0.04 0.03", "0 0 0.03") + box("0.02 0.06 0.05", "0.03 0 0.06")
        finger = box("0.04 0.03 0.05", "-0.02 0.01 0.11", "0.5 0 0.4")
    for k, (place, axis) in enumerate(JOINTS):
        shape = palm if k == 5 else box("0.05 0.05 0.1", "0 0 0.04")
        parts.append(
            f'<link name="link{k}">{shape}</link><joint name="joint{k}" type="revolute">'
            f'<parent link="{parent or "base"}"/><child link="link{k}"/>'
            f'<origin xyz="{place}"/><axis xyz="{axis}"/>'
            '<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
        )
        parent = f"link{k}"
    parts.append(
        f'<link name="finger_link">{finger}</link><joint name="finger" type="prismatic">'
        '<parent link="link5"/><child link="finger_link"/><axis xyz="0 1 0"/>'
        '<limit lower="0" upper="0.05" effort="1" velocity="1"/></joint></robot>'
    )
    path.write_text("".join(parts))


def register(
    folder: Path, out: Path | None = None, on: str = "link5", **given
) -> tuple[SceneRegistration, np.ndarray]:
    """Simulate an episode, and register its camera; returns the true X_LC (4, 4), too."""
    write_arm(folder / "arm.urdf")
    model, episode = simulate_wrist(folder, folder, GRIPPER, **{"count": 40} | given)
    write_episode(folder / "scene", model, episode, 50.0, {}, (0.0, 0.0))
    settings = RegistrationSettings(on=on)
    found = register_scene(folder / "scene", folder / "arm.urdf", out=out, settings=settings)
    return found, episode.camera.X_WC


def errors(found: SceneRegistration, X_LC: np.ndarray) -> np.ndarray:
    """Return the errors (6,) of the camera's pose, over their standard deviations."""
    one = found.registered["wrist"]
    turn = Rotation.from_matrix(one.camera.X_WC[:3, :3] @ X_LC[:3, :3].T).as_rotvec()
    off = np.concatenate([turn, one.camera.X_WC[:3, 3] - X_LC[:3, 3]])
    assert np.linalg.norm(off[3:]) < 0.003
    assert np.linalg.norm(turn) < np.radians(1.0)
    return np.asarray(off / np.sqrt(np.diag(one.covariance)))


@pytest.mark.slow
def test_the_gripper_gives_the_pose_above_a_bare_table(tmp_path: Path) -> None:
    found, X_LC = register(tmp_path, tmp_path / "out", seed=1, contrast=0.02, things=0)
    assert np.abs(errors(found, X_LC)).max() < 4.0
    one = found.summary["cameras"]["wrist"]
    assert one["evidence"] == "gripper"
    assert one["gripper"]["contours_that_fit"] > 0.8
    assert one["gripper"]["told"] > 1.5 * one["gripper"]["told_by_chance"]
    assert one["time_offset_s"] == pytest.approx(0.03, abs=0.03)
    assert any("from the gripper in its pictures alone" in text for text in found.warnings)
    assert list((tmp_path / "out/overlay/wrist").glob("*.png"))


@pytest.mark.slow
def test_another_gripper_is_refused(tmp_path: Path) -> None:
    write_arm(tmp_path / "other.urdf", other=True)
    drawn = replace(GRIPPER, file="other.urdf")
    with pytest.raises(RegistrationError, match="Nor does the gripper in its pictures help"):
        register(tmp_path, seed=2, contrast=0.02, things=0, drawn=drawn)


@pytest.mark.slow
def test_scene_and_gripper_agree(tmp_path: Path) -> None:
    found, X_LC = register(tmp_path, seed=3)
    assert np.abs(errors(found, X_LC)).max() < 4.0
    assert found.summary["cameras"]["wrist"]["evidence"] == "scene and gripper"


@pytest.mark.slow
def test_a_wrong_link_is_refused_and_the_right_one_named(tmp_path: Path) -> None:
    with pytest.raises(RegistrationError, match="On link 'link5' a pose explains"):
        register(tmp_path, seed=3, on="link4")
