"""Wrong input to a registration: the message names what is wrong; mostly nothing is written."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.cli import Result, assert_refused, run_command
from tests.jobs.registration.arm_scenes import ArmScene


def run(scene: ArmScene, out: Path, *more: str) -> Result:
    return run_command([*scene.register(out), *more])


Spoil = Callable[[ArmScene], None]


def change_rows(change: Callable[[list[list[str]]], object]) -> Spoil:
    def spoil(scene: ArmScene) -> None:
        rows = scene.rows()
        change(rows)
        scene.write_rows(rows)

    return spoil


def add_column(rows: list[list[str]]) -> None:
    for k, row in enumerate(rows):
        row.append("brake" if k == 0 else str(k))


def to_next(rows: list[list[str]]) -> None:
    """Give each frame the positions of the next one."""
    places = [row[1:] for row in rows[1:]]
    for row, place in zip(rows[1:], [*places[1:], places[0]], strict=True):
        row[1:] = place


def change_masks(change: Callable[[np.ndarray], np.ndarray], frames: str = "*") -> Spoil:
    def spoil(scene: ArmScene) -> None:
        for path in (scene.folder / "masks" / "left").glob(f"{frames}.png"):
            cv2.imwrite(str(path), change(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)))

    return spoil


def edit(name: str, **fields: object) -> Spoil:
    return lambda scene: scene.edit_cameras(name, **fields)


BEFORE_WORK: dict[str, tuple[Spoil, list[str]]] = {
    "no table": (lambda s: s.joints.unlink(), ["joints.csv: cannot read it"]),
    "a column of no joint": (
        change_rows(add_column), ["joints.csv has an unknown column", "'brake'", "turret_turn"],
    ),
    "a frame without row": (
        change_rows(lambda r: r.pop(3)), ["joints.csv", "'0002'", "camera 'left'", "--frame"],
    ),
    "an empty mask": (
        change_masks(np.zeros_like, "0003"), ["0003.png", "empty", "camera 'left'", "--frame"],
    ),
    "a mask of another size": (
        change_masks(lambda mask: mask[:, 1:], "0001"), ["0001.png", "319 x 240", "'0001'"],
    ),
    "a parallel camera": (
        edit("left", projection="parallel", pixels_per_metre=100.0, focal_x=None, focal_y=None,
             clipping_near=None),
        ["camera 'left' is a parallel camera", "focal length"],
    ),
    "a focal length in other units": (
        edit("left", focal_x=1e5, focal_y=1e5), ["camera 'left'", "100000 pixels", "degrees"],
    ),
    "a position that is none": (
        change_rows(lambda r: r[2].__setitem__(2, "1e308")), ["joints.csv", "frame 1", "no joint"],
    ),
    "no focal length": (edit("left", focal_x=None), ["camera 'left'", "needs focal_x"]),
    "all cameras stand": (
        edit("left", X_WC=np.eye(4).tolist()), ["every camera has an X_WC", "--camera left"],
    ),
    "no masks": (lambda s: shutil.rmtree(s.folder / "masks"), ["has no folder masks/"]),
    "no camera file": (lambda s: (s.folder / "cameras.yaml").unlink(), ["cameras.yaml"]),
}  # fmt: skip


@pytest.mark.parametrize("case", BEFORE_WORK)
def test_bad_input_is_refused_before_work(case: str, own_arm: ArmScene, out: Path) -> None:
    spoil, parts = BEFORE_WORK[case]
    spoil(own_arm)
    assert_refused(run(own_arm, out), *parts)
    assert not out.exists()


def test_unknown_names_are_refused(arm_scene: ArmScene, tmp_path: Path, out: Path) -> None:
    assert_refused(run(arm_scene, out, "--camera", "top"), "'top'", "left, right")
    assert_refused(run(arm_scene, out, "--frame", "9"), "'9'", "0004")
    assert_refused(run(arm_scene, out, "--hold", "nose=3"), "'nose'")
    assert_refused(run(arm_scene, out, "--hold", "nose"), "NAME=NUMBER", status=2)
    (tmp_path / "letter.txt").write_text("Do not lose me.")
    assert_refused(run(arm_scene, tmp_path), "not empty")


@pytest.mark.slow
class TestNoPoseExplains:
    @pytest.mark.parametrize(
        ("spoil", "part"),
        [
            (change_masks(lambda mask: mask[:, ::-1]), "they fit when they are mirrored"),
            (change_rows(to_next), "they fit with the joint positions of the previous frame"),
            (change_masks(lambda mask: cv2.circle(0 * mask, (150, 110), 60, 255, -1)), "robot"),
        ],
        ids=["mirrored", "one row off", "something else"],
    )
    def test_nothing_is_written(self, spoil, part, own_arm, out):
        spoil(own_arm)
        result = run(own_arm, out)
        assert_refused(result, "camera 'left': no pose explains its masks", part)
        assert not out.exists()
