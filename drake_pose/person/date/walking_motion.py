"""The simulated person's motion in Date's experiment: known positions in every frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from drake_pose.arrays import Array
from drake_pose.errors import SettingsError
from drake_pose.person.date.recognition import registered_positions
from drake_pose.person.date.skeleton import Skeleton

KeyPose = dict[str, float]

MOTIONS = ("walk", "reach", "lean", "crouch", "turn", "cross")
"""The motions, in their order; before the first and after the last the registered pose is shown."""

UPRIGHT = ("walk", "reach", "turn", "cross")
"""Those with an upright trunk, which the paper asks for."""

REGISTERED = "registered"
FEWEST_FRAMES = 40

# In fewer frames the motions would be faster than people are; so they are not all shown.
_WHOLE = 120


def _sides(left: float = 1.0, right: float = 1.0, **degrees: float) -> KeyPose:
    """Angles [deg] of joints on both sides, times what is theirs."""
    sides = {"left": left, "right": right}
    return {f"{side}_{joint}": k * a for joint, a in degrees.items() for side, k in sides.items()}


_RELAXED: KeyPose = _sides(forearm_x=-10.0) | _sides(right=-1.0, upper_arm_z=8.0)


def _stride(side: float) -> KeyPose:
    swung = _sides(side, -side, upper_arm_x=28.0, thigh_x=-25.0)
    bent = {"left_shin_x": 18.0 - 12.0 * side, "right_shin_x": 18.0 + 12.0 * side}
    return swung | bent | _sides(forearm_x=-25.0)


# Angles [deg] that differ from the relaxed pose; a motion goes from one to the next and back.
_KEY_POSES: Mapping[str, tuple[KeyPose, ...]] = {
    "walk": (_stride(1.0), _stride(-1.0)),
    "reach": (
        {"left_upper_arm_x": -85.0, "left_forearm_x": -35.0},
        {"left_upper_arm_x": -140.0, "right_upper_arm_z": -75.0, "right_forearm_x": -85.0},
        _sides(right=-1.0, upper_arm_z=80.0) | {"left_forearm_x": -95.0, "left_upper_arm_y": -35.0},
    ),
    "lean": ({"neck_base_x": 35.0} | _sides(thigh_x=-35.0),),
    "crouch": (
        {"neck_base_x": 12.0}
        | _sides(thigh_x=-75.0, shin_x=110.0)
        | _sides(right=-1.0, thigh_z=15.0),
    ),
    "turn": ({"head_y": 45.0}, {"head_y": -45.0}),
    "cross": (
        {"left_upper_arm_x": -45.0, "left_forearm_x": -85.0}
        | {"right_upper_arm_x": -55.0, "right_forearm_x": -75.0}
        | _sides(right=-1.0, upper_arm_y=-45.0),
    ),
}


@dataclass(frozen=True, eq=False)
class Motion:
    """Positions q (n, nq) [rad or m], and each frame's motion: of MOTIONS, or REGISTERED."""

    q: Array
    names: tuple[str, ...]


def make_motion(skeleton: Skeleton, frames: int, seed: int) -> Motion:
    """The registered pose, then all motions of a person whose lower foot stands, then it again.

    All takes 120 frames or more; of fewer the first are given. The seed draws how far motions go
    (85 to 115 per cent) and where the person stands.

    Raises SettingsError below FEWEST_FRAMES frames.
    """
    if frames < FEWEST_FRAMES:
        raise SettingsError(f"Date's experiment needs {FEWEST_FRAMES} frames or more, not {frames}")
    generator = np.random.default_rng(seed)
    registered = registered_positions(skeleton)
    relaxed = _positions(skeleton, {}, 1.0)
    whole = max(frames, _WHOLE)
    still = whole // 20
    # From key pose to key pose it always takes about as long.
    steps = np.cumsum([0, *(len(_KEY_POSES[motion]) + 1 for motion in MOTIONS)])
    lengths = np.diff(np.rint((whole - 2 * still) * steps / steps[-1]).astype(int))
    rows, names = [registered] * still, [REGISTERED] * still
    before = registered
    for motion, length in zip(MOTIONS, lengths, strict=True):
        size = generator.uniform(0.85, 1.15)
        after = registered if motion == MOTIONS[-1] else relaxed
        keys = [before, *(_positions(skeleton, key, size) for key in _KEY_POSES[motion]), after]
        rows += list(_through(keys, int(length)))
        names += [motion] * int(length)
        before = relaxed
    rows += [registered] * still
    names += [REGISTERED] * still
    q = np.array(rows)
    q[:, skeleton.head_positions[:2]] = _path(whole, generator)
    for row in q:
        _stand_on_floor(skeleton, row)
    return Motion(q[:frames], tuple(names[:frames]))


def _positions(skeleton: Skeleton, key: KeyPose, size: float) -> Array:
    """Positions of a key pose, its angles times a size."""
    q = np.zeros(len(skeleton.lower))
    for name, degrees in {**_RELAXED, **{n: size * d for n, d in key.items()}}.items():
        q[skeleton.model.position_index(name)] = math.radians(degrees)
    return skeleton.clip(q)


def _through(keys: list[Array], count: int) -> Array:
    """(count, nq) positions from key to key, resting at each for a moment."""
    place = np.linspace(0.0, len(keys) - 1.0, count + 1)[1:]
    index = np.minimum(place.astype(int), len(keys) - 2)
    share = 0.5 - 0.5 * np.cos(np.pi * (place - index))
    poses = np.array(keys)
    return np.asarray(poses[index] + share[:, None] * (poses[index + 1] - poses[index]))


def _path(frames: int, generator: np.random.Generator) -> Array:
    """(frames, 2) where the person stands on the floor: a slow loop of 20 cm [m]."""
    phase, along = generator.uniform(0, 2 * np.pi), np.linspace(0, 2 * np.pi, frames)
    loop = np.column_stack([np.cos(along + phase), np.sin(2 * along + phase)])
    return np.asarray(0.2 * loop + generator.uniform(-0.1, 0.1, 2))


def _stand_on_floor(skeleton: Skeleton, q: Array) -> None:
    """Moves the head up or down so that the lower foot is where a standing person's are."""
    standing = skeleton.features(np.zeros(len(q)))
    head = float(-standing[3:, 2].mean()) + _FOOT_HEIGHT
    q[skeleton.head_positions[2]] = 0.0
    lowest = float(skeleton.features(q)[3:, 2].min())
    q[skeleton.head_positions[2]] = min(head + 0.2, _FOOT_HEIGHT - lowest)


_FOOT_HEIGHT = 0.04
