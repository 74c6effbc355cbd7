"""Walking through a place by gestures: commands from a stance, and the way walked (Date, table 1).

Facing right or left turns the view, standing ahead of or behind the rest place walks.
"""

from __future__ import annotations

import math

import numpy as np

from drake_pose.arrays import Array

NO_COMMAND = (0, 0)

TURN_RATE, SPEED, BODY_RADIUS = math.radians(40.0), 0.9, 0.3
"""How fast the view turns [rad/s] and one walks [m/s], and how near one comes to walls [m]."""
# A command begins at one threshold and ends at a lower one, so that noise does not toggle it: how
# far the face is turned away from the rest direction [rad], and how far one stands from the rest
# place [m].
_TURN, _STEP = (math.radians(25.0), math.radians(15.0)), (0.18, 0.10)
# How much higher than the other a lifted foot is [m]; without another step for so long nobody walks
# on the spot any more [s].
_LIFT, _PAUSE = 0.05, 1.0


def stance_of(left_W: Array, head_W: Array, feet_W: Array) -> Array:
    """How a person stands: (5,) the face's heading [rad], head's and feet's x and y [m].

    Args:
        left_W: (3,) the direction to the face's left, level also where the person looks down.
        head_W, feet_W: (3,) and (2, 3) where they are [m]; midway between the feet counts.
    """
    heading = math.atan2(-left_W[0], left_W[1])
    return np.array([heading, *head_W[:2], *np.asarray(feet_W)[:, :2].mean(axis=0)])


def offsets_from_rest(stance: Array, rest: Array) -> tuple[float, float]:
    """How far a stance (5,) is from the one at rest: turned to the left [rad], and ahead [m].

    Ahead is the lesser of the head's and the feet's way, 0 if they differ: leaning is no step.
    """
    turned = stance[0] - rest[0]
    turned = math.atan2(math.sin(turned), math.cos(turned))
    forward = np.array([math.cos(rest[0]), math.sin(rest[0])])
    head, feet = (stance[1:] - rest[1:]).reshape(2, 2) @ forward
    ahead = math.copysign(min(abs(head), abs(feet)), head) if head * feet > 0.0 else 0.0
    return turned, ahead


def recognise_command(stance: Array, rest: Array, last: tuple[int, int]) -> tuple[int, int]:
    """Table 1: the command that a stance gives; whoever is lost from sight stops.

    Args:
        stance, rest: (5,) from stance_of.
        last: the command before.

    Returns:
        Turning: 1 left, -1 right, 0 not; walking: 1 forward, -1 backward, 0 not.
    """
    if not np.isfinite(stance).all():
        return NO_COMMAND
    turned, ahead = offsets_from_rest(stance, rest)
    return _switch(turned, last[0], *_TURN), _switch(ahead, last[1], *_STEP)


NO_STEPS = (0.0, 0.0, 0.0)


def follow_steps(lift: float, steps: Array, seconds: float) -> Array:
    """Counts the steps of somebody who may be walking on the spot; one foot held up is one step.

    Args:
        lift: how much higher the left foot is than the right one [m]; nan: not seen.
        steps: (3,) the foot lifted last (1 left, -1 right, 0 none), since when it was [s], and how
            many steps, each with the other foot, were taken without a pause.
        seconds: since the last frame.
    """
    foot, since, count = steps[0], steps[1] + seconds, steps[2]
    if since > _PAUSE:
        count = 0.0
    if abs(lift) >= _LIFT and math.copysign(1.0, lift) != foot:
        return np.array([math.copysign(1.0, lift), 0.0, count + 1.0])
    return np.array([foot, since, count])


def walks_on_spot(steps: Array) -> bool:
    """Whether steps (3,) of follow_steps are walking on the spot: one foot, then the other."""
    return bool(steps[2] >= 2.0)


def follow_command(
    pose: Array,
    command: tuple[int, int],
    seconds: float,
    half_size: float = math.inf,
    obstacles: Array | None = None,
) -> Array:
    """The walker's pose (3,), its heading in -pi..pi, after a command was followed for a while.

    Turning and walking at once is an exact arc; the walker slides along walls and obstacles.

    Args:
        pose: (3,) x, y [m] and heading [rad].
        command: from recognise_command.
        half_size: the place is a square about the origin; half its side [m].
        obstacles: (n, 3) x, y and radius of round obstacles [m].
    """
    turn = command[0] * TURN_RATE * seconds
    middle = pose[2] + 0.5 * turn
    chord = command[1] * SPEED * seconds * float(np.sinc(0.5 * turn / math.pi))
    place = pose[:2] + chord * np.array([math.cos(middle), math.sin(middle)])
    for x, y, radius in np.empty((0, 3)) if obstacles is None else obstacles:
        away = place - (x, y)
        distance, allowed = float(np.linalg.norm(away)), radius + BODY_RADIUS
        if 0.0 < distance < allowed:
            place = place + away * (allowed / distance - 1.0)
    limit = half_size - BODY_RADIUS
    heading = math.atan2(math.sin(pose[2] + turn), math.cos(pose[2] + turn))
    return np.array([*np.clip(place, -limit, limit), heading])


def _switch(value: float, last: int, begin: float, end: float) -> int:
    """1, -1 or 0: a value beyond a threshold, the lower one where it was so before."""
    if last and value * last > end:
        return last
    return int(math.copysign(1, value)) if abs(value) >= begin else 0
