"""Hand models of Shimada et al.: a palm, and fingers that are chains of hinges and segments.

The palm's frame has its origin at the wrist, x towards the fingers, y in the direction in which
they bend, and z across the palm.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from drake_pose.arrays import Array, Indices
from drake_pose.filtering.state import StateLayout

TURN, BASE, SEGMENT = 0, 1, 2
"""Kinds of a step along a finger: a rotation, a translation to its base, or along a segment."""

PALM = ("palm_width", "palm_height", "palm_thickness")
WRIST = ("wrist_x", "wrist_y")
QUATERNION = ("palm_qw", "palm_qx", "palm_qy", "palm_qz")
PALM_EDGES = ("left", "right", "top", "bottom")


class Chains(NamedTuple):
    """A hand as arrays for ``project_hand``; elements are indices into ``HandModel.visible``."""

    firsts: Indices  # (F + 1,) index of each finger's first step.
    # kinds, elements: (S,) kind and element of each ``Step``, finger by finger.
    kinds: Indices
    elements: Indices
    vectors: Array  # (S, 3) vector of each ``Step``.
    # rings, rows: see ``HandModel``.
    rings: Array
    rows: Array
    palm: Indices  # (3,) elements of the palm's height, thickness and width.
    lines: Indices  # (L, 2) indices of the points that are the lines' ends.


class Step(NamedTuple):
    """A step from the palm outwards along a finger, with all joints at 0."""

    element: str  # Name in the state: an angle [rad], a length [m], or a size of the palm [m].
    kind: int  # TURN, BASE or SEGMENT.
    # Axis of a rotation, or translation per unit of the element, in the palm's frame.
    vector: tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class HandModel:
    """A palm that is a convex body, and fingers with the same number of segments each."""

    fingers: tuple[str, ...]  # (F) names.
    # Steps of each finger, from the palm's origin to the centre of the fingertip.
    steps: tuple[tuple[Step, ...], ...]
    radii: Array  # (F, J + 1) radii of the fingers at base, joints and tip [m].
    # (2, K, 3) outlines of the palm at the wrist and at the fingers, as fractions of its height,
    # thickness and width along x, y and z. The palm is their convex hull.
    rings: Array
    # (2, R, 2, 3) end points of candidates for its far and its near edge, as such fractions.
    rows: Array
    sizes: Mapping[str, float]  # Lengths and sizes of the palm in the model's file [m].

    @cached_property
    def flexions(self) -> tuple[str, ...]:
        """The angle at each segment's root, finger by finger."""
        return tuple(turns[-1] for turns in self._turns())

    @cached_property
    def spreads(self) -> tuple[str, ...]:
        """All other angles."""
        return tuple(name for turns in self._turns() for name in turns[:-1])

    @cached_property
    def lengths(self) -> tuple[str, ...]:
        """The segments' lengths, finger by finger."""
        return tuple(s.element for steps in self.steps for s in steps if s.kind == SEGMENT)

    @property
    def angles(self) -> tuple[str, ...]:
        """All angles: spreads, then flexions."""
        return (*self.spreads, *self.flexions)

    @property
    def joints(self) -> range:
        """Numbers of a finger's segments, from 1."""
        return range(1, self.radii.shape[1])

    def _turns(self) -> list[list[str]]:
        """Return the names of the rotations before each segment."""
        found: list[list[str]] = [[]]
        for step in (step for steps in self.steps for step in steps):
            if step.kind == TURN:
                found[-1].append(step.element)
            elif step.kind == SEGMENT:
                found.append([])
        return found[:-1]

    @cached_property
    def layout(self) -> StateLayout:
        """The state (5): wrist [pixel], quaternion, angles; their rates; lengths and palm sizes."""
        return StateLayout((*WRIST, *QUATERNION, *self.angles), (*self.lengths, *PALM))

    @cached_property
    def measured(self) -> tuple[str, ...]:
        """The measurements (13): points [pixel]; alpha [rad]; rho [pixel]; scale."""
        points = [f"{i}{j}" for i in self.fingers for j in (0, *self.joints)]
        lines = [f"{i}{j}" for i in self.fingers for j in self.joints]
        lines += [f"palm_{edge}" for edge in PALM_EDGES]
        return (
            *WRIST,
            *(f"point_{point}_{axis}" for point in points for axis in "xy"),
            *(f"{kind}_{line}" for line in lines for kind in ("alpha", "rho")),
            "scale",
        )

    @cached_property
    def visible(self) -> Indices:
        """Indices of the state's elements on which the image depends: all but the rates."""
        return self.layout.indices((*WRIST, *QUATERNION, *self.angles, *self.lengths, *PALM))

    @cached_property
    def line_ends(self) -> Indices:
        """(L, 2) indices of the lines' end points: the fingers' lines, then the palm's edges."""
        count = len(self.fingers)
        bases = np.arange(count * len(self.joints)) + np.repeat(np.arange(count), len(self.joints))
        starts = np.r_[bases, self.radii.size + np.arange(0, 8, 2)]
        return np.column_stack([starts, starts + 1])

    @cached_property
    def chains(self) -> Chains:
        """The hand as arrays."""
        names = (*WRIST, *QUATERNION, *self.angles, *self.lengths, *PALM)
        steps = [step for one in self.steps for step in one]
        return Chains(
            np.cumsum([0, *(len(one) for one in self.steps)]),
            np.array([step.kind for step in steps]),
            np.array([names.index(step.element) for step in steps]),
            np.array([step.vector for step in steps]),
            self.rings,
            self.rows,
            np.array([names.index(PALM[k]) for k in (1, 2, 0)]),
            self.line_ends,
        )


def _two_fingers() -> HandModel:
    """Return the hand of Shimada et al., figure 5: a box, and two fingers of three segments."""
    steps = []
    for i, side in ((1, 0.25), (2, -0.25)):
        own = [
            Step(f"spread_{i}", TURN, (0.0, 1.0, 0.0)),
            Step("palm_height", BASE, (1.0, 0.0, 0.0)),
            Step("palm_width", BASE, (0.0, 0.0, side)),
        ]
        for j in (1, 2, 3):
            own.append(Step(f"flexion_{i}{j}", TURN, (0.0, 0.0, 1.0)))
            own.append(Step(f"length_{i}{j}", SEGMENT, (1.0, 0.0, 0.0)))
        steps.append(tuple(own))
    box = np.array([[[x, y, z] for y in (-0.5, 0.5) for z in (0.5, -0.5)] for x in (0.0, 1.0)])
    rows = box[::-1].reshape(2, 2, 2, 3)
    drawn = {"1": 0.055, "2": 0.03, "3": 0.025}
    sizes = {f"length_{i}{j}": length for i in (1, 2) for j, length in drawn.items()}
    sizes |= {"palm_width": 0.07, "palm_height": 0.08, "palm_thickness": 0.02}
    return HandModel(("1", "2"), tuple(steps), np.full((2, 4), 0.008), box, rows, sizes)


TWO_FINGERS = _two_fingers()
"""The hand of ``urdf/two_finger_hand``."""
