"""Names, kinds, limits and default values of a plant's positions."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Joint

from drake_pose.errors import ModelError, UnknownNameError

PositionKind = Literal["angle", "length", "quaternion"]

_KINDS: dict[str, tuple[PositionKind, ...]] = {
    "weld": (),
    "revolute": ("angle",),
    "prismatic": ("length",),
    "screw": ("angle",),
    "universal": ("angle", "angle"),
    "ball_rpy": ("angle", "angle", "angle"),
    "planar": ("length", "length", "angle"),
    "rpy_floating": ("angle", "angle", "angle", "length", "length", "length"),
    "quaternion_floating": (
        "quaternion",
        "quaternion",
        "quaternion",
        "quaternion",
        "length",
        "length",
        "length",
    ),
}
FLOATING_TYPES = ("rpy_floating", "quaternion_floating")


@dataclass(frozen=True)
class Positions:
    """What a plant's q means; all in the plant's order, arrays (nq,) and read-only."""

    names: tuple[str, ...]
    kinds: tuple[PositionKind, ...]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    defaults: NDArray[np.float64]


def describe_positions(
    plant: MultibodyPlant, given: Mapping[str, tuple[float, float]], where: str
) -> Positions:
    """Names, kinds and limits of all positions of a finalized plant.

    Args:
        plant: the plant.
        given: limits (lower, upper) [rad or m] by position name that replace the plant's own.
        where: the model's file, for messages.

    Raises:
        UnknownNameError: ``given`` names a position that does not exist.
        ModelError: a joint of an unknown type, or limits that cannot be searched; it names the
            joint.
    """
    names = plant.GetPositionNames(add_model_instance_prefix=False, always_add_suffix=False)
    scoped = plant.GetPositionNames(add_model_instance_prefix=True, always_add_suffix=False)
    names = [a if names.count(a) == 1 else b for a, b in zip(names, scoped, strict=True)]
    for name in given:
        if name not in names:
            raise UnknownNameError("joint", name, names, where)
    count = plant.num_positions()
    kinds: list[PositionKind] = ["angle"] * count
    lower, upper = np.full(count, -np.inf), np.full(count, np.inf)
    for joint in (plant.get_joint(index) for index in plant.GetJointIndices()):
        if joint.type_name() not in _KINDS:
            raise ModelError(
                f"joint '{joint.name()}' is of type '{joint.type_name()}', which cannot be "
                f"searched; use one of {', '.join(_KINDS)}"
            )
        span = slice(joint.position_start(), joint.position_start() + joint.num_positions())
        kinds[span] = _KINDS[joint.type_name()]
        if joint.type_name() not in FLOATING_TYPES:
            lower[span], upper[span] = _searchable_limits(joint, names[span], given)
    defaults = np.clip(plant.GetDefaultPositions(), lower, upper)
    for array in (lower, upper, defaults):
        array.setflags(write=False)
    return Positions(tuple(names), tuple(kinds), lower, upper, defaults)


def _searchable_limits(
    joint: Joint, names: list[str], given: Mapping[str, tuple[float, float]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Finite limits of one joint: those given, or a full turn for a joint that turns freely.

    A screw without limits gets a full turn too: Drake's parser reads no limits for screws.
    """
    lower = np.array(joint.position_lower_limits(), dtype=np.float64)
    upper = np.array(joint.position_upper_limits(), dtype=np.float64)
    for index, kind in enumerate(_KINDS[joint.type_name()]):
        low, high = lower[index], upper[index] = given.get(
            names[index], (lower[index], upper[index])
        )
        name = f"joint '{joint.name()}'"
        if joint.num_positions() > 1:
            name += f" (its {joint.position_suffix(index)})"
        if np.isnan(low) or np.isnan(high):
            raise ModelError(f"{name}: a limit is NaN; give numbers, lower first")
        if low > high:
            raise ModelError(f"{name}: lower limit {low:g} is above upper limit {high:g}")
        if np.isfinite(low) and np.isfinite(high):
            continue
        if kind == "length":
            continue  # It may say where the object stands: see unlimited_slides.
        if np.isfinite(low) or np.isfinite(high):
            raise ModelError(
                f"{name} has no limits: lower {low:g}, upper {high:g} [rad]; give it a lower and "
                f"an upper limit in the model file, or give load_model "
                f"limits={{'{names[index]}': (low, high)}}, so that its values can be searched"
            )
        lower[index], upper[index] = -np.pi, np.pi
    return lower, upper
