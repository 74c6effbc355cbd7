"""An arm with another gripper than the model's, by Drake's renderer."""

from pathlib import Path

import numpy as np
import pytest

from drake_pose.body import load_model
from drake_pose.camera.camera_files import save_cameras
from drake_pose.errors import UnknownNameError
from drake_pose.files.settings import RegistrationSettings
from drake_pose.input_files import csv_text
from drake_pose.jobs.registration.register import register_scene
from drake_pose.silhouette.pictures.label_renderer import LabelRenderer
from tests.benchmarks.registration import write_box_arm
from tests.jobs.scenes import edit_camera
from tests.registration.arm_pictures import errors, looking_at
from tests.written_files import write_mask

BOX = '<visual><origin xyz="{}"/><geometry><box size="{}"/></geometry></visual>'
HAND, OTHER_HAND = BOX.format("0 0 0.05", "0.04 0.12 0.1"), BOX.format("0.05 0 0.1", "0.2 0.03 0.2")
CAMERA = looking_at(np.array([1.2, -1.0, 0.8]), np.array([0.0, 0.0, 0.45]), 0.05)


def write_arm(path: Path, hand: str) -> Path:
    """Write the arm of boxes with a hand and a finger."""
    text = write_box_arm(path).read_text().replace("</robot>", "")
    text += (
        f'<link name="hand">{hand}</link><joint name="weld" type="fixed"><parent link="box4"/>'
        '<child link="hand"/><origin xyz="0 0 0.1"/></joint>'
        f'<link name="finger">{BOX.format("0 0.02 0.13", "0.02 0.02 0.06")}</link>'
        '<joint name="slide" type="prismatic"><parent link="hand"/><child link="finger"/>'
        '<axis xyz="0 1 0"/><limit lower="0" upper="0.02" effort="1" velocity="1"/></joint>'
    )
    path.write_text(f"{text}</robot>")
    return path


@pytest.fixture(scope="module")
def odd(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A scene of masks with its joint positions, and the model file given."""
    folder = tmp_path_factory.mktemp("odd")
    drawn = load_model(write_arm(folder / "drawn.urdf", OTHER_HAND))
    given, rng = write_arm(folder / "given.urdf", HAND), np.random.default_rng(2)
    masks = folder / "scene" / "masks" / "eye"
    masks.mkdir(parents=True)
    renderer, rows = LabelRenderer(drawn, CAMERA), [["frame", *drawn.position_names]]
    for k in range(8):
        q = rng.uniform(0.6 * drawn.lower, 0.6 * drawn.upper)
        write_mask(masks / f"{k:04d}.png", renderer.mask(q))
        rows.append([f"{k:04d}", *q.tolist()])
    (folder / "scene" / "joint_angles.csv").write_text(csv_text(rows))
    save_cameras(folder / "scene" / "cameras.yaml", [CAMERA])
    edit_camera(folder / "scene" / "cameras.yaml", "eye", X_WC=None)
    return folder / "scene", given


@pytest.mark.parametrize("without", [(), ("hand",)])
def test_what_does_not_look_like_the_model_is_named_or_left_out(odd, without) -> None:
    found = register_scene(*odd, settings=RegistrationSettings(without=without))
    texts = [one for one in found.warnings if "of the contour of link" in one]
    assert any("'box4' (with hand)" in one for one in texts) == bool(texts) == (not without)
    assert errors(found.cameras["eye"].X_WC, CAMERA.X_WC) < (0.003, 0.003)


def test_a_link_is_left_out_with_what_it_carries(odd) -> None:
    model = load_model(odd[1], check=False)
    assert model.carried_by("box3") == ("box3", "box4", "hand", "finger")
    assert model.carried_by("finger") == ("finger",)
    left = model.without(model.carried_by("box4"))
    assert {*left.link_meshes} == {"box0", "box1", "box2", "box3"}
    with pytest.raises(UnknownNameError, match="gripper"):
        register_scene(*odd, settings=RegistrationSettings(without=("gripper",)))
