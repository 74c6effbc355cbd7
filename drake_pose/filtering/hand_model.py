"""Hand models of Shimada et al.: a palm, and fingers that are chains of hinges and segments.

The palm's frame has its origin at the wrist, x towards the fingers, y in the direction in which
they bend, and z across the palm.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from pydrake.multibody.tree import Joint, RevoluteJoint

from drake_pose.arrays import Array, Indices
from drake_pose.body import ArticulatedModel
from drake_pose.errors import ModelError
from drake_pose.filtering.inequalities import JointPrior, couplings_file, load_joint_prior
from drake_pose.filtering.state import StateLayout

TURN, BASE, SEGMENT = 0, 1, 2
"""Kinds of a step along a finger: a rotation, a translation to its base, or along a segment."""

PALM = ("palm_width", "palm_height", "palm_thickness")
WRIST = ("wrist_x", "wrist_y")
QUATERNION = ("palm_qw", "palm_qx", "palm_qy", "palm_qz")
PALM_EDGES = ("left", "right", "top", "bottom")

# R_PL: from the palm's link (y along the fingers, z out of the palm) to the palm's frame.
_FROM_LINK = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])


# Number of points of a palm's outline. That at the wrist is of the vertices up to the first height,
# that at the knuckles of those between the next two, at the third [fractions of the palm's height].
_POINTS, _WRIST, _KNUCKLES = 16, 0.07, (0.78, 0.84, 0.85)


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
    # Sizes of the palm in the model's file, and lengths if they were read from it [m].
    sizes: Mapping[str, float]
    hidden: tuple[str, ...] = ()  # Names among ``measured`` that silhouettes do not show.
    prior: JointPrior | None = None  # Prior of the joints, over ``angles``; None: there is none.

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
        """The measurements (13): points [pixel]; alpha [rad]; rho [pixel]; scale; joints' prior."""
        points = [f"{i}{j}" for i in self.fingers for j in (0, *self.joints)]
        lines = [f"{i}{j}" for i in self.fingers for j in self.joints]
        lines += [f"palm_{edge}" for edge in PALM_EDGES]
        return (
            *WRIST,
            *(f"point_{point}_{axis}" for point in points for axis in "xy"),
            *(f"{kind}_{line}" for line in lines for kind in ("alpha", "rho")),
            "scale",
            *(f"prior_{k}" for k in range(0 if self.prior is None else len(self.prior.mean))),
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
    sizes = {"palm_width": 0.07, "palm_height": 0.08, "palm_thickness": 0.02}
    return HandModel(("1", "2"), tuple(steps), np.full((2, 4), 0.008), box, rows, sizes)


TWO_FINGERS = _two_fingers()
"""The hand of ``urdf/two_finger_hand``."""


def palm_rotation(R_CL: Array) -> Array:
    """Return R_CP (3, 3) of the palm in a camera, given that of its link, see ``read_hand``."""
    return np.asarray(R_CL @ _FROM_LINK.T)


def read_hand(model: ArticulatedModel, palm: str = "palm") -> HandModel:
    """Return the hand of a model such as ``urdf/hand``: the hinges on its palm, and their places.

    ``model``: the model. The palm's link has its origin at the wrist, y along the fingers and z out
    of the palm. ``palm``: name of the palm's link.

    Raises UnknownNameError: the model has no such link; ModelError: a joint on the palm begins no
    finger, fingers have different numbers of segments, or a mesh has no vertices where a thickness
    is measured.
    """
    model.link_index(palm)
    plant, context = model.plant, model.plant.CreateDefaultContext()
    # A floating palm keeps its default quaternion, because zero is not a rotation.
    floats = [kind == "quaternion" for kind in model.position_kinds]
    plant.SetPositions(context, np.where(floats, model.default_positions, 0.0))
    X_PW = plant.GetFrameByName(palm).CalcPoseInWorld(context).inverse()
    beyond: dict[str, list[Joint]] = {}
    for joint in map(plant.get_joint, plant.GetJointIndices()):
        beyond.setdefault(joint.parent_body().name(), []).append(joint)
    chains, frames = [], []
    for first in beyond.get(palm, []):
        chain = [first]
        while found := beyond.get(chain[-1].child_body().name()):
            chain += found
        has_mesh = chain[-1].child_body().name() in model.link_meshes
        if not has_mesh or not all(isinstance(joint, RevoluteJoint) for joint in chain):
            raise ModelError(
                f"{model.path}: '{first.name()}' on '{palm}' begins no finger: a finger is a chain "
                "of hinges whose last link has a mesh"
            )
        poses = [X_PW @ j.frame_on_parent().CalcPoseInWorld(context) for j in chain]
        chains.append(chain)
        frames.append([(X.translation(), X.rotation().matrix()) for X in poses])
    if not chains or palm not in model.link_meshes:
        raise ModelError(f"{model.path}: '{palm}' has no fingers, or no mesh")
    size = np.ptp(model.link_meshes[palm].vertices @ _FROM_LINK.T, axis=0)
    size[0] = max(float(one[0][0][1]) for one in frames)
    sizes = dict(zip(("palm_height", "palm_thickness", "palm_width"), size.tolist(), strict=True))
    read = [_read_finger(model, *one, size, sizes) for one in zip(chains, frames, strict=True)]
    if len({len(radii) for _, radii in read}) != 1:
        raise ModelError(f"{model.path}: the fingers on '{palm}' differ in the number of segments")
    rings = _palm_rings(model, palm, size[0]) / size
    low, side = rings[0].min(axis=0), 0.8 * np.ptp(rings[0, :, 2]) * np.array([0.5, -0.5])
    depths = 0.5 * np.array([rings[0, :, 1].min(), rings[0, :, 1].max()])
    rows = np.array([[[[x, y, z] for z in side] for y in depths] for x in (1.0, low[0])])
    names = tuple(chain[0].name().split("_")[0] for chain in chains)
    hidden = ("alpha_palm_top", "rho_palm_top")
    steps, radii = tuple(steps for steps, _ in read), np.array([radii for _, radii in read])
    hand = HandModel(names, steps, radii, rings, rows, sizes, hidden)
    file = couplings_file(model.path)
    return replace(hand, prior=load_joint_prior(file, hand.angles)) if file.is_file() else hand


def _read_finger(
    model: ArticulatedModel,
    chain: Sequence[Joint],
    frames: Sequence[tuple[Array, Array]],
    size: Array,
    sizes: dict[str, float],
) -> tuple[tuple[Step, ...], list[float]]:
    """Return a finger's steps and radii [m], and add its lengths to ``sizes``.

    ``chain``: joints from the palm outwards. ``frames``: by joint, origin (3,) and rotation (3, 3)
    of its parent frame in the palm's link. ``size``: (3,) height, thickness, width of the palm [m].
    """
    base = _FROM_LINK @ frames[0][0] / size
    elements = ("palm_height", "palm_thickness", "palm_width")
    steps = [
        Step(name, BASE, tuple(row)) for name, row in zip(elements, np.diag(base), strict=True)
    ]
    radii, last = [], ""
    for k, (joint, (place, R)) in enumerate(zip(chain, frames, strict=True)):
        offset = place - frames[max(k - 1, 0)][0]
        length = float(np.linalg.norm(offset))
        if length > 1e-6:
            steps.append(Step(f"length_{last}", SEGMENT, tuple(_FROM_LINK @ offset / length)))
            sizes[f"length_{last}"] = length
        axis = _FROM_LINK @ R @ joint.revolute_axis()
        steps.append(Step(joint.name(), TURN, tuple(axis)))
        last = joint.child_body().name()
        if last in model.link_meshes:
            radii.append(_radius(model, last, -0.003, 0.003))
    end = model.link_meshes[last].vertices[:, 1].max()
    radii.append(_radius(model, last, end - 0.010, end - 0.004))
    steps.append(Step(f"length_{last}", SEGMENT, tuple(_FROM_LINK @ R[:, 1])))
    sizes[f"length_{last}"] = float(end - radii[-1])
    return tuple(steps), radii


def _radius(model: ArticulatedModel, link: str, low: float, high: float) -> float:
    """Return half of the extent [m] along x of a link's vertices with low <= y <= high [m]."""
    return 0.5 * float(np.ptp(_band(model, link, low, high)[:, 0]))


def _band(model: ArticulatedModel, link: str, low: float, high: float) -> Array:
    """Return the vertices (n, 3) of a link's mesh with low <= y <= high in its frame [m].

    Raises ModelError: there is none.
    """
    vertices = model.link_meshes[link].vertices
    band = vertices[(vertices[:, 1] >= low) & (vertices[:, 1] <= high)]
    if not len(band):
        raise ModelError(
            f"{model.path}: the mesh of link '{link}' has no vertex {1e3 * low:.0f} to "
            f"{1e3 * high:.0f} mm along the link's y axis, where a hand's thickness is measured; "
            "give it more vertices there"
        )
    return band


def _palm_rings(model: ArticulatedModel, palm: str, height: float) -> Array:
    """Return a palm's outlines (2, _POINTS, 3) [m] at wrist and knuckles, in the palm's frame.

    ``model``: the hand. ``palm``: name of the palm's link. ``height``: height of the palm [m].
    """
    low = float(model.link_meshes[palm].vertices[:, 1].min())
    angles = 2.0 * np.pi * np.arange(_POINTS) / _POINTS
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    first, last, place = (fraction * height for fraction in _KNUCKLES)
    bands = ((low, low + _WRIST * height), (first, last))
    rings = np.zeros((2, len(angles), 3))
    for ring, (begin, end), x in zip(rings, bands, (low, place), strict=True):
        band = _band(model, palm, begin, end) @ _FROM_LINK.T
        ring[:] = band[np.argmax(band[:, 1:] @ directions.T, axis=0)]
        ring[:, 0] = x
    return rings
