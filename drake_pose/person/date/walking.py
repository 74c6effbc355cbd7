"""Walking through a virtual place by gestures (Date et al., table 1), and motions for simulation.

Facing right or left turns the view; standing ahead of or behind the rest place walks.
"""

import math
from dataclasses import dataclass

import numpy as np

from drake_pose.arrays import Array
from drake_pose.errors import SettingsError
from drake_pose.person.date.skeleton import Skeleton, registered_positions


@dataclass(frozen=True)
class WalkSettings:
    """Thresholds of the gestures, and what their commands do.

    A command begins at the first threshold of a pair and ends at the second, lower one, so that
    noise does not toggle it.
    """

    turn_rate: float = math.radians(40.0)  # Of the view [rad/s].
    speed: float = 0.9  # Of walking [m/s].
    body_radius: float = 0.3  # Least distance from walls and obstacles [m].
    # Thresholds of the face's turn from the rest direction [rad].
    turn: tuple[float, float] = (math.radians(25.0), math.radians(15.0))
    step: tuple[float, float] = (0.18, 0.10)  # Thresholds of the distance from the rest place [m].
    lift: float = 0.05  # Least height of a lifted foot above the other one [m].
    pause: float = 1.0  # Walking on the spot ends at this time after the last step [s].
    # Pose in which a walk begins: x, y [m] and heading [rad].
    start: tuple[float, float, float] = (-8.0, 0.0, 0.0)
    half_size: float = 12.0  # Half the side of the square place, whose middle is the origin [m].


WALK = WalkSettings()


def stance_of(left_W: Array, head_W: Array, feet_W: Array) -> Array:
    """Return how a person stands (5,): heading of the face [rad], x, y of the head and feet [m].

    ``left_W``: (3,) direction to the left of the face; its horizontal part gives the heading.
    ``feet_W``: (2, 3); their mean counts.
    """
    heading = math.atan2(-left_W[0], left_W[1])
    return np.array([heading, *head_W[:2], *np.asarray(feet_W)[:, :2].mean(axis=0)])


def offsets_from_rest(stance: Array, rest: Array) -> tuple[float, float]:
    """Return the turn to the left [rad] and the way ahead [m] of a stance (5,) from that at rest.

    The way ahead is the head's or the feet's, the shorter one; 0 if their signs differ, as when a
    person leans.
    """
    turned = stance[0] - rest[0]
    turned = math.atan2(math.sin(turned), math.cos(turned))
    forward = np.array([math.cos(rest[0]), math.sin(rest[0])])
    head, feet = (stance[1:] - rest[1:]).reshape(2, 2) @ forward
    ahead = math.copysign(min(abs(head), abs(feet)), head) if head * feet > 0.0 else 0.0
    return turned, ahead


def recognise_command(stance: Array, rest: Array, last: tuple[int, int]) -> tuple[int, int]:
    """Return turning (1 left, -1 right) and walking (1 ahead, -1 back) of table 1; 0: none.

    ``stance``, ``rest``: (5,) of stance_of; not seen: stop. ``last``: the previous command.
    """
    if not np.isfinite(stance).all():
        return 0, 0
    turned, ahead = offsets_from_rest(stance, rest)
    return _switch(turned, last[0], *WALK.turn), _switch(ahead, last[1], *WALK.step)


def count_steps(lift: float, steps: Array, seconds: float) -> Array:
    """Count the steps of walking on the spot; a foot that stays lifted is one step.

    ``lift``: height of the left foot above the right one [m]; nan: not seen. ``steps``: (3,) foot
    lifted last (1 left, -1 right, 0 none), time since then [s], and number of steps with
    alternating feet since the last pause; zeros at first. Two steps are walking on the spot.
    ``seconds``: time since the last frame [s].

    Returns (3,) the new steps.
    """
    foot, since, count = steps[0], steps[1] + seconds, steps[2]
    if since > WALK.pause:
        count = 0.0
    if abs(lift) >= WALK.lift and math.copysign(1.0, lift) != foot:
        return np.array([math.copysign(1.0, lift), 0.0, count + 1.0])
    return np.array([foot, since, count])


def apply_command(pose: Array, command: tuple[int, int], seconds: float, obstacles: Array) -> Array:
    """Return the walker's pose (3,) after a command was followed for a time; heading in -pi..pi.

    Turning and walking together give an exact arc. The walker slides along walls and obstacles.

    Args:
        pose: (3,) x, y [m] and heading [rad].
        command: from recognise_command.
        seconds: for which the command was followed [s].
        obstacles: (n, 3) x, y and radius of round obstacles [m].
    """
    turn = command[0] * WALK.turn_rate * seconds
    middle = pose[2] + 0.5 * turn
    chord = command[1] * WALK.speed * seconds * float(np.sinc(0.5 * turn / math.pi))
    place = pose[:2] + chord * np.array([math.cos(middle), math.sin(middle)])
    for x, y, radius in obstacles:
        away = place - (x, y)
        distance, allowed = float(np.linalg.norm(away)), radius + WALK.body_radius
        if 0.0 < distance < allowed:
            place = place + away * (allowed / distance - 1.0)
    limit = WALK.half_size - WALK.body_radius
    heading = math.atan2(math.sin(pose[2] + turn), math.cos(pose[2] + turn))
    return np.array([*np.clip(place, -limit, limit), heading])


def _switch(value: float, last: int, begin: float, end: float) -> int:
    """Return the sign, -1 or 1, of a value whose magnitude reaches `begin`; otherwise 0.

    If its sign is `last`, -1 or 1, it needs to exceed `end` only.
    """
    if last and value * last > end:
        return last
    return int(math.copysign(1, value)) if abs(value) >= begin else 0


UPRIGHT = ("walk", "reach", "turn", "cross")
"""Motions with an upright trunk, which the paper asks for (4.2)."""

REGISTERED = "registered"
FEWEST_FRAMES = 40


def _sides(left: float = 1.0, right: float = 1.0, **degrees: float) -> dict[str, float]:
    """Return angles [deg] by joint on both sides, from those without a side, `degrees`.

    `left` and `right` are the factors of each side.
    """
    sides = {"left": left, "right": right}
    return {f"{side}_{joint}": k * a for joint, a in degrees.items() for side, k in sides.items()}


_ARMS_ASIDE = {"left_forearm_x": -95.0, "left_upper_arm_y": -35.0}
_LEFT_ACROSS = {"left_upper_arm_x": -45.0, "left_forearm_x": -85.0}
_RIGHT_ACROSS = {"right_upper_arm_x": -55.0, "right_forearm_x": -75.0}

MOTIONS = {
    "walk": [
        _sides(side, -side, upper_arm_x=28.0, thigh_x=-25.0)
        | {"left_shin_x": 18.0 - 12.0 * side, "right_shin_x": 18.0 + 12.0 * side}
        | _sides(forearm_x=-25.0)
        for side in (1.0, -1.0)
    ],
    "reach": [
        {"left_upper_arm_x": -85.0, "left_forearm_x": -35.0},
        {"left_upper_arm_x": -140.0, "right_upper_arm_z": -75.0, "right_forearm_x": -85.0},
        _sides(right=-1.0, upper_arm_z=80.0) | _ARMS_ASIDE,
    ],
    "lean": [{"neck_base_x": 35.0} | _sides(thigh_x=-35.0)],
    "crouch": [
        {"neck_base_x": 12.0}
        | _sides(thigh_x=-75.0, shin_x=110.0)
        | _sides(right=-1.0, thigh_z=15.0)
    ],
    "turn": [{"head_y": 45.0}, {"head_y": -45.0}],
    "cross": [_LEFT_ACROSS | _RIGHT_ACROSS | _sides(right=-1.0, upper_arm_y=-45.0)],
}
"""Key poses of all motions, in order: angles [deg] by joint; other joints are relaxed.

The registered pose is shown before the first and after the last motion."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Positions q (n, nq) [rad, m] of n frames, and each one's motion or gesture, or REGISTERED."""

    q: Array
    names: tuple[str, ...]


def make_motion(skeleton: Skeleton, frames: int, seed: int) -> Motion:
    """Make the registered pose, all motions in turn, and the registered pose again.

    The lower foot stands on the floor in every frame. The whole takes 120 frames or more; if fewer
    are asked for, the first ones are returned.

    ``skeleton``: of the person. ``frames``: number of frames. ``seed``: draws the size of each
    motion, 0.85 to 1.15, and where the person stands. Raises SettingsError: there are fewer than
    FEWEST_FRAMES frames.
    """
    if frames < FEWEST_FRAMES:
        raise SettingsError(f"Date's experiment needs {FEWEST_FRAMES} frames or more, not {frames}")
    generator = np.random.default_rng(seed)
    registered = registered_positions(skeleton)
    relaxed = _positions(skeleton, {}, 1.0)
    # In fewer frames the motions would be faster than people's, so not all of them are shown.
    whole = max(frames, 120)
    still = whole // 20
    # The time from key pose to key pose is the same in all motions.
    steps = np.cumsum([0, *(len(keys) + 1 for keys in MOTIONS.values())])
    lengths = np.diff(np.rint((whole - 2 * still) * steps / steps[-1]).astype(int))
    rows, names = [registered] * still, [REGISTERED] * still
    before = registered
    for (motion, poses), length in zip(MOTIONS.items(), lengths, strict=True):
        size = generator.uniform(0.85, 1.15)
        after = registered if motion == "cross" else relaxed
        keys = [before, *(_positions(skeleton, key, size) for key in poses), after]
        rows += list(_through(keys, int(length)))
        names += [motion] * int(length)
        before = relaxed
    rows += [registered] * still
    names += [REGISTERED] * still
    q = np.array(rows)
    # The person moves over the floor on a slow loop with a radius of 20 cm.
    phase, along = generator.uniform(0, 2 * np.pi), np.linspace(0, 2 * np.pi, whole)
    loop = np.column_stack([np.cos(along + phase), np.sin(2 * along + phase)])
    q[:, skeleton.head_positions[:2]] = 0.2 * loop + generator.uniform(-0.1, 0.1, 2)
    for row in q:
        _stand_on_floor(skeleton, row)
    return Motion(q[:frames], tuple(names[:frames]))


COMMANDS = ("turn left", "turn right", "walk ahead", "walk behind")
"""Commands of table 1."""


def make_gestures(skeleton: Skeleton, frames: int = 84) -> Motion:
    """Make the registered pose, rest, and each of COMMANDS by its gesture, with rest in between.

    To walk, the person stands 30 cm ahead or behind, and walks on the spot. The frames' names are
    the gestures. Each takes `frames` frames.
    """
    registered, rest = registered_positions(skeleton), _positions(skeleton, {}, 1.0)
    rows, names = list(_through([registered, registered, rest], 24)), [REGISTERED] * 24
    lifted = [{f"{side}_thigh_x": -50.0, f"{side}_shin_x": 75.0} for side in ("left", "right")]
    for name, size in zip(COMMANDS, (1.0, -1.0, 1.0, -1.0), strict=True):
        if name.startswith("turn"):
            gesture = [_positions(skeleton, {"head_y": 45.0 * size}, 1.0)] * 4
        else:
            gesture = [_positions(skeleton, key, 1.0) for key in [{}, *2 * lifted, {}]]
            for q in gesture:
                q[skeleton.head_positions[0]] = 0.3 * size
        rows += [*_through([rest, *gesture, rest], frames)]
        names += [name] * frames
    for q in rows:
        _stand_on_floor(skeleton, q)
    return Motion(np.array(rows), tuple(names))


def _positions(skeleton: Skeleton, key: dict[str, float], size: float) -> Array:
    """Return q (nq,) of a key pose: angles [deg] by joint, times a size; the rest is relaxed."""
    q = np.zeros(len(skeleton.lower))
    relaxed = _sides(forearm_x=-10.0) | _sides(right=-1.0, upper_arm_z=8.0)
    for name, degrees in {**relaxed, **{n: size * d for n, d in key.items()}}.items():
        q[skeleton.model.position_index(name)] = math.radians(degrees)
    return skeleton.clip(q)


def _through(keys: list[Array], count: int) -> Array:
    """Return positions (count, nq) through key poses (nq,), slower at each, without the first."""
    place = np.linspace(0.0, len(keys) - 1.0, count + 1)[1:]
    index = np.minimum(place.astype(int), len(keys) - 2)
    weight = 0.5 - 0.5 * np.cos(np.pi * (place - index))
    poses = np.array(keys)
    return np.asarray(poses[index] + weight[:, None] * (poses[index + 1] - poses[index]))


def _stand_on_floor(skeleton: Skeleton, q: Array) -> None:
    """Move the head of q (nq,), in place, so that the lower foot's middle is 4 cm above the floor.

    The head stays at most 20 cm above its height in the upright pose.
    """
    height, standing = 0.04, skeleton.features(np.zeros(len(q)))
    head = float(-standing[3:, 2].mean()) + height
    q[skeleton.head_positions[2]] = 0.0
    lowest = float(skeleton.features(q)[3:, 2].min())
    q[skeleton.head_positions[2]] = min(head + 0.2, height - lowest)
