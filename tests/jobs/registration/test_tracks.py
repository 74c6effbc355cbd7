"""Episodes of a camera on a wrist over a table, without masks or target."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from drake_pose.errors import RegistrationError, SettingsError
from drake_pose.files.settings import RegistrationSettings
from drake_pose.jobs.registration.audit import audit_scene
from drake_pose.jobs.registration.register import register_scene
from drake_pose.registration.hand_eye import motion
from tests.benchmarks.registration import pose_error
from tests.registration.recordings import write_images, write_log

NAMES = tuple(f"joint{k}" for k in range(6))
JOINTS = (
    ((0.0, 0.0, 0.3), (0, 0, 1)),
    ((0.0, 0.0, 0.1), (0, 1, 0)),
    ((0.0, 0.0, 0.3), (0, 1, 0)),
    ((0.0, 0.0, 0.25), (0, 0, 1)),
    ((0.0, 0.0, 0.1), (0, 1, 0)),
    ((0.0, 0.0, 0.08), (0, 0, 1)),
)
"""Where each joint is in its parent link [m], and its axis."""
SIZE, FOCAL, LATE = (320, 240), 260.0, 0.06
K = np.array([[FOCAL, 0.0, 159.5], [0.0, FOCAL, 119.5], [0.0, 0.0, 1.0]])
X_LC = np.eye(4)
X_LC[:3, :3] = Rotation.from_euler("zyx", [100.0, 8.0, -12.0], degrees=True).as_matrix()
X_LC[:3, 3] = 0.04, -0.05, 0.03
SWING = (0.15, 0.1, 0.12, 0.3, 0.25, 0.4)


def write_arm(path: Path) -> Path:
    """Write an arm whose base stands still; its last link is `link5`."""
    box = '<visual><geometry><box size="0.08 0.08 0.08"/></geometry></visual>'
    parts, parent = [f'<robot name="arm"><link name="base">{box}</link>'], "base"
    for k, (place, axis) in enumerate(JOINTS):
        parts.append(
            f'<link name="link{k}">{box}</link><joint name="joint{k}" type="revolute">'
            f'<parent link="{parent}"/><child link="link{k}"/>'
            f'<origin xyz="{" ".join(map(str, place))}"/><axis xyz="{" ".join(map(str, axis))}"/>'
            '<limit lower="-3" upper="3" effort="1" velocity="1"/></joint>'
        )
        parent = f"link{k}"
    path.write_text("".join(parts) + "</robot>")
    return path


def values_at(times: np.ndarray, swing: np.ndarray) -> np.ndarray:
    """Return joint positions (n, 6): the hand looks down, and swings."""
    middle = np.array([0.0, 0.5, 1.2, 0.0, np.pi - 1.7, 0.2])
    return middle + swing * np.sin(times[:, None] * (0.7, 0.9, 1.1, 1.3, 0.8, 1.0) + np.arange(6))


def link_pose(values: np.ndarray) -> np.ndarray:
    """Return the pose (4, 4) of the last link, by products of the joints' motions."""
    X = np.eye(4)
    for (place, axis), value in zip(JOINTS, values, strict=True):
        X = X @ motion(np.array([*(value * np.array(axis)), *place]))
    return X


def write_episode(folder: Path, swing: tuple[float, ...], objects: int = 150) -> Path:
    """Write 40 pictures of a table with things on it, taken LATE after their times, and a log."""
    rng = np.random.default_rng(4)
    table = np.full((1500, 1500, 3), 170, np.uint8)
    for _ in range(objects):
        at, colour = rng.integers(0, 1400, 2), rng.integers(0, 255, 3).tolist()
        cv2.rectangle(table, at.tolist(), (at + rng.integers(15, 90, 2)).tolist(), colour, -1)
        cv2.circle(
            table, rng.integers(0, 1500, 2).tolist(), int(rng.integers(8, 30)), colour[::-1], -1
        )
    pixel = 1.0 / len(table)
    to_world = np.array([[pixel, 0, 0.0], [0, pixel, -0.5], [0, 0, 0], [0, 0, 1]])
    times, pictures = np.arange(40) / 5.0, []
    for values in values_at(times + LATE, np.array(swing)):
        X_CW = np.linalg.inv(link_pose(values) @ X_LC)
        picture = cv2.warpPerspective(table, K @ X_CW[:3] @ to_world, SIZE, flags=cv2.INTER_AREA)
        picture[200:, 130:190] = table[100:140, 100:160] // 2  # A gripper.
        noisy = picture + rng.normal(0.0, 2.0, picture.shape)
        pictures.append(noisy.clip(0, 255).astype(np.uint8))
    write_images(folder / "images" / "wrist", pictures, times)
    camera = {"width": SIZE[0], "height": SIZE[1], "focal_x": FOCAL, "focal_y": FOCAL}
    camera |= {"center_x": 159.5, "center_y": 119.5}
    (folder / "cameras.yaml").write_text(yaml.safe_dump({"wrist": camera}))
    logged = np.arange(-0.5, 9.0, 1.0 / 15.0)
    write_log(folder / "joint_angles.csv", logged, values_at(logged, np.array(swing)), NAMES)
    return folder


@pytest.mark.slow
def test_a_wrist_camera_is_found_over_things_on_a_table(tmp_path):
    scene, arm = write_episode(tmp_path / "scene", SWING), write_arm(tmp_path / "arm.urdf")
    result = register_scene(scene, arm, out=tmp_path / "out")  # Its link is found, too.
    found = result.registered["wrist"]
    off = pose_error(found.camera.X_WC, X_LC)
    assert np.less(np.linalg.norm(off.reshape(2, 3), axis=1), [np.radians(0.5), 0.004]).all()
    assert np.all(np.abs(off) < 4.0 * np.sqrt(np.diag(found.covariance)))
    one = result.summary["cameras"]["wrist"]
    assert one["time_offset_s"] == pytest.approx(LATE, abs=0.005)
    assert one["explained"] > 2.0 * one["explained_by_chance"]
    assert yaml.safe_load((tmp_path / "out/cameras.yaml").read_text())["wrist"]["link"] == "link5"
    assert list((tmp_path / "out/overlay/wrist").glob("*.png"))
    assert "Circles: points of the scene" in (tmp_path / "out/report.html").read_text()
    file = yaml.safe_load((tmp_path / "out/cameras.yaml").read_text())
    for off, names in ((0.0, []), (0.05, ["wrist"])):
        file["wrist"]["X_LC"][0][3] = float(found.camera.X_WC[0, 3]) + off
        (given := tmp_path / "given.yaml").write_text(yaml.safe_dump(file))
        audit = audit_scene(scene, arm, out=tmp_path / f"audit{off}", cameras=given).audit
        assert [one.name for one in audit.common] == names
        assert audit.outliers == tuple(f"wrist-{frame}" for frame in found.outliers)
        assert sum(one.shift for one in audit.common) == pytest.approx(off)
    wrist = {key: one for key, one in file["wrist"].items() if key not in ("link", "X_LC")}
    given.write_text(yaml.safe_dump({"wrist": wrist | {"X_WC": X_LC.tolist()}}))
    audit = audit_scene(scene, arm, out=tmp_path / "standing", cameras=given)
    assert "has an X_WC, but moves with link 'link5'" in audit.answer


@pytest.mark.parametrize(
    ("swing", "objects", "lengths", "error", "said"),
    [
        ((0, 0, 0, 0, 0.3, 0), 150, (), RegistrationError, r"'link5' turns .* 0\.0 about"),
        (SWING, 0, (), RegistrationError, "'wrist': .* without texture"),
        (SWING, 0, ("all",), SettingsError, "lengths needs masks"),
    ],
)
def test_pictures_that_do_not_determine_what_is_asked_are_refused(
    tmp_path, swing, objects, lengths, error, said
):
    scene = write_episode(tmp_path / "scene", swing, objects)
    settings = RegistrationSettings(on="link5", lengths=lengths)
    with pytest.raises(error, match=said):
        register_scene(scene, write_arm(tmp_path / "arm.urdf"), settings=settings)
