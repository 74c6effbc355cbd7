"""Large errors in all frames are found with their sizes, in Drake's masks of an arm."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drake_pose.body import load_model
from drake_pose.camera.camera_files import save_cameras
from drake_pose.camera.models import Camera
from drake_pose.errors import MaskError
from drake_pose.jobs.registration.audit import SceneAudit, audit_scene
from drake_pose.jobs.registration.diagnosis import last_before_change
from drake_pose.registration.hand_eye import motion
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from drake_pose.silhouette.pictures.masks import read_mask
from tests.jobs.registration.arm_scenes import ArmScene, write_arm_scene
from tests.written_files import write_mask

COUNT = 8


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> ArmScene:
    """Eight correct frames of two cameras."""
    scene = write_arm_scene(tmp_path_factory.mktemp("right"), count=COUNT, seed=9)
    save_cameras(scene.folder / "cameras.yaml", scene.cameras)
    return scene


@pytest.fixture
def scene(right: ArmScene, tmp_path: Path) -> ArmScene:
    """A copy that may be changed."""
    return right.copy(tmp_path)


def audit(scene: ArmScene, cameras: Sequence[Camera] = ()) -> SceneAudit:
    """Audit a scene, with other cameras if they are given."""
    if cameras:
        save_cameras(scene.folder / "cameras.yaml", {one.name: one for one in cameras})
    return audit_scene(scene.folder, scene.model, scene.joints)


def change(scene: ArmScene, joint: str, changed: Callable[[float], float]) -> np.ndarray:
    """Change a column of the log, and return by how much, modulo a turn [deg]."""
    header, *rows = scene.rows()
    j, off = header.index(joint), []
    for row in rows:
        value = float(row[j])
        row[j] = repr(float(changed(value)))
        off.append(np.degrees(float(row[j]) - value))
    scene.write_rows([header, *rows])
    return np.abs((np.array(off) + 180.0) % 360.0 - 180.0)


def masks(
    scene: ArmScene,
    spoilt: Callable[[np.ndarray], np.ndarray],
    frames: str = "*",
    cameras: str = "*",
) -> None:
    """Change the masks of some frames."""
    for path in scene.folder.rglob(f"masks/{cameras}/{frames}.png"):
        write_mask(path, spoilt(read_mask(path)))


def told(result: SceneAudit) -> list[tuple[str, str]]:
    return [(one["cause"], one["cause_name"]) for one in result.summary["findings"]]


def test_correct_scene_gives_no_findings(right: ArmScene) -> None:
    result = audit(right)
    assert (told(result), result.warnings) == ([], ())


@pytest.mark.parametrize(
    ("joint", "changed", "cause", "said"),
    [
        ("turret_turn", lambda q: q - np.radians(20.0), "joint", "too low"),
        ("elbow_turn", lambda q: q + np.radians(40.0), "joint", "too high"),
        ("shoulder_turn", lambda q: -q, "sign", "other sign"),
        ("hand_turn", lambda _: 0.0, "log", "link 'hand'.* neither .* has 0 in all frames"),
    ],
)
def test_errors_of_a_column_are_measured(scene, joint, changed, cause, said) -> None:
    off = change(scene, joint, changed).max()
    result = audit(scene)
    assert told(result) == [(cause, joint)]
    one = result.summary["findings"][0]
    assert re.search(said, one["text"])
    near = 4.0 if cause != "joint" else max(4.0 * one["angle_sd_deg"], 0.3)
    assert abs(one["angle_deg"]) == pytest.approx(off, abs=near)
    assert one["angle_sd_deg"] < 1.0
    assert result.summary["agreeing_count"] == (COUNT if cause == "joint" else 0)


def test_short_link_is_measured(scene, tmp_path) -> None:
    """The model's shoulder carries the next joint at 315 mm, not at 350."""
    text = scene.model.read_text()
    assert text.count('xyz="0 0 0.35"') == 1
    short = tmp_path / "short.urdf"
    short.write_text(text.replace('xyz="0 0 0.35"', 'xyz="0 0 0.315"'))
    result = audit(replace(scene, model=short))
    assert told(result) == [("length", "shoulder")]
    off = result.summary["findings"][0]
    assert abs(off["shift_percent"] - 100.0 / 9.0) < 3.0 * off["shift_sd_percent"] < 3.0


ASIDE = "far from the middle"


@pytest.mark.parametrize(
    ("spoil", "text", "warned"),
    [
        (lambda one: one.with_pose(np.linalg.inv(one.X_WC)), "inverse", ""),
        (lambda one: one.with_pose(one.X_WC @ np.diag([1, -1, -1, 1])), "OpenGL", "body behind it"),
        (lambda one: one.with_scaled_intrinsics(2.0, 2.0), "640 x 480 .* divide .* by 2", ASIDE),
    ],
)
def test_convention_of_poses_and_intrinsics_is_recognised(scene, spoil, text, warned) -> None:
    """With and without the robot in the camera's view."""
    result = audit(scene, [spoil(one) for one in scene.cameras.values()])
    (one,) = result.summary["findings"]
    assert result.summary["agreeing_count"] == COUNT
    assert re.search(text, one["text"])
    assert re.search(warned, " ".join(result.warnings))
    if warned == ASIDE:
        said = [one for one in result.warnings if ASIDE in one]
        assert [re.search("'(.*?)'", one)[1] for one in said] == [*scene.cameras]


def test_shifted_principal_points_are_measured(scene) -> None:
    cameras = [replace(one, center_x=one.center_x + 25.0) for one in scene.cameras.values()]
    result = audit(scene, cameras)
    assert result.summary["agreeing_count"] == COUNT
    (text,) = (
        one["text"] for one in result.summary["findings"] if "principal points" in one["text"]
    )
    for name in scene.cameras:
        x, y = map(float, re.search(rf"'{name}' add ([-\d]+), ([-\d]+) px", text).groups())
        assert (x, y) == (pytest.approx(-25.0, abs=4.0), pytest.approx(0.0, abs=3.0))


def test_mirrored_masks_are_found(scene) -> None:
    masks(scene, lambda mask: mask[:, ::-1])
    (one,) = audit(scene).summary["findings"]
    assert "masks of all cameras: they fit when they are mirrored" in one["text"]


def test_moved_cameras_are_found_with_the_frame(scene) -> None:
    """Each camera is rotated by two degrees about its centre, and shifted by 2 cm."""
    poses = [list(map(float, row[1:])) for row in scene.rows()[1:]]
    model, moved = load_model(scene.model), {}
    for name, one in scene.cameras.items():
        X_WC = one.X_WC.copy()
        X_WC[:3, :3] = Rotation.from_euler("z", 2.0, degrees=True).as_matrix() @ X_WC[:3, :3]
        X_WC[:3, 3] += [0.0, 0.0, 0.02]
        moved[name] = one.with_pose(X_WC)
        renderer = LabelRenderer(model, moved[name])
        for k in range(4, COUNT):
            mask = renderer.mask(np.array(poses[k]))
            write_mask(scene.folder / "masks" / name / f"{k:04d}.png", mask)
    result = audit(scene)
    assert {*told(result)} == {("moved", "left"), ("moved", "right")}
    for one in result.summary["findings"]:
        assert "was moved after frame '0003'" in one["text"]
        assert one["angle_deg"] == pytest.approx(2.0, abs=max(0.3, 3.0 * one["angle_sd_deg"]))
        # The shift of the camera's centre, not of the robot in its view.
        assert one["shift_mm"] == pytest.approx(20.0, abs=max(5.0, 3.0 * one["shift_sd_mm"]))
    assert result.summary["agreeing_count"] == 4


def test_masks_with_excess_lack_or_nothing_are_warned_of(scene) -> None:
    def with_shadow(mask: np.ndarray) -> np.ndarray:
        """Add a patch with a quarter of the mask's area in a corner."""
        spoilt, side = mask.copy(), int(np.sqrt(0.25 * mask.sum()))
        spoilt[:side, :side] = True
        return spoilt

    def without_upper_half(mask: np.ndarray) -> np.ndarray:
        rows = np.flatnonzero(mask.any(axis=1))
        return mask & (np.arange(len(mask)) >= int(rows.mean()))[:, None]

    masks(scene, with_shadow, "000[0-3]", "left")
    masks(scene, np.zeros_like, "0006", "left")
    masks(scene, without_upper_half, "*", "right")
    said = "\n".join(audit(scene).warnings)
    assert re.search("'left'.* 0006 are black", said)
    assert re.search("'left'.* 0000-0003 show .*more than the robot", said)
    assert re.search("'right': the masks of frames .* of the robot: is something", said)
    assert said.count("black") == 1


def test_inverted_masks_are_refused(scene) -> None:
    masks(scene, np.logical_not)
    with pytest.raises(MaskError, match=r"left/000\d.png.*inverted"):
        audit(scene)


def test_positions_of_another_frame_are_recognised(scene) -> None:
    header, *rows = scene.rows()
    others = zip(rows, rows[-1:] + rows[:-1], strict=True)
    scene.write_rows([header, *([row[0], *other[1:]] for row, other in others)])
    assert "the masks: they fit with the joint positions of the next frame" in audit(scene).answer


def test_cameras_far_from_their_given_poses_are_found(scene) -> None:
    """One metre and 30 degrees: no convention, and out of reach of fits of single frames."""
    left, right = scene.cameras.values()
    X_WC = motion(np.radians([0.0, 0.0, 30.0, 0.0, 0.0, 0.0])) @ left.X_WC
    (one,) = audit(scene, [left.with_pose(X_WC), right]).summary["findings"]
    assert (one["what"], one["name"]) == ("camera", "left")
    assert one["angle_deg"] == pytest.approx(30.0, abs=1.0)


@pytest.mark.parametrize(
    ("wrong", "last"),
    [("00011", 2), ("11000", 1), ("00001", None), ("01100", None), ("00000", None), ("11", None)],
)
def test_a_change_has_outliers_on_one_side_only(wrong, last) -> None:
    assert last_before_change([one == "1" for one in wrong]) == last
