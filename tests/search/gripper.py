"""A gripper on an arm, with mimic or independent fingers."""

from pathlib import Path

from drake_pose.body import ArticulatedModel, load_model
from tests.body.models import joint, link, urdf, write


def _box(middle: str, size: str) -> str:
    return f'<visual><origin xyz="{middle}"/><geometry><box size="{size}"/></geometry></visual>'


def gripper(folder: Path, *, follows: bool) -> ArticulatedModel:
    """Return the gripper; ``follows``: whether the right finger mimics the left one."""
    mast, hand = ({"axis": "1 0 0", "limits": f'lower="-{r}" upper="{r}"'} for r in (1.2, 1.5))
    finger = {"limits": 'lower="0" upper="0.08"', "origin": 'xyz="0 0 .06"'}
    mimic = '<mimic joint="left_joint"/>' if follows else ""
    text = urdf(
        link("mast", _box("0 0 .15", ".05 .05 .3")),
        link("hand", _box("0 0 .03", ".06 .24 .06")),
        link("left", _box("0 .01 .05", ".03 .02 .1")),
        link("right", _box("0 -.01 .05", ".03 .02 .1")),
        joint("mast_joint", "revolute", "world", "mast", origin="", **mast),
        joint("hand_joint", "revolute", "mast", "hand", origin='xyz="0 0 .3"', **hand),
        joint("left_joint", "prismatic", "hand", "left", axis="0 1 0", **finger),
        joint("right_joint", "prismatic", "hand", "right", axis="0 -1 0", more=mimic, **finger),
    )
    return load_model(write(folder, text, f"gripper_{follows}.urdf"), check=False)
