"""Parts of the person: shapes of the bundled bodies' generator, recoloured, joined and cut."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from body_generator import extremities, head, limbs, torso
from body_generator.measures import Build, Measures, joint_positions
from body_generator.shapes import Shell

# Kinds of parts: the joint of each in ``joint_positions``, and the joint at its end.
# Each kind of part, the joint it hangs on in ``joint_positions``, and the joint at its end.
PARTS = {
    "head": ("head", "chest"),
    "trunk": ("chest", "thigh"),
    "upper_arm": ("upper_arm", "forearm"),
    "forearm": ("forearm", "hand"),
    "hand": ("hand", None),
    "thigh": ("thigh", "shin"),
    "shin": ("shin", "foot"),
    "foot": ("foot", None),
}
CLOTHES = {"upper_arm": "shirt", "forearm": "shirt", "thigh": "trousers", "shin": "trousers"}
OVERLAP = 0.13  # reach of a cut part's halves beyond the middle, as a fraction of the part
LARGEST_BROW = 0.06  # hair shells broader than this are no brows and are left out [m]


@dataclass(frozen=True)
class Proportions:
    """Factors on the average person's parts, by kind of part; others keep their size.

    Attributes:
        lengths: along a part, from its joint to the next.
        girths: across a part, in both directions.
    """

    lengths: dict[str, float]
    girths: dict[str, float]


@dataclass(frozen=True)
class Figure:
    """A person of given measures and proportions."""

    measures: Measures
    build: Build
    proportions: Proportions

    def axis(self, part: str) -> np.ndarray:
        """Return the direction from a part's joint to the next (3,) on the left side."""
        start, end = PARTS[part]
        if part in ("head", "trunk", "hand", "foot") or end is None:
            return np.array([0.0, 0.0, -1.0] if part == "foot" else [0.0, -1.0, 0.0])
        joints = joint_positions(self.measures)
        step = joints[end] - joints[start]
        return np.asarray(step / np.linalg.norm(step))

    def stretch(self, part: str) -> np.ndarray:
        """Return the linear map (3, 3) of a part's proportions, in its link's frame."""
        length = self.proportions.lengths.get(part, 1.0)
        girth = self.proportions.girths.get(part, 1.0)
        axis = self.axis(part)
        return np.asarray(girth * np.eye(3) + (length - girth) * np.outer(axis, axis))

    def offset(self, parent: str, joint: str) -> np.ndarray:
        """Return a joint of ``joint_positions`` in its parent part's frame (3,) [m]."""
        joints = joint_positions(self.measures)
        return np.asarray(self.stretch(parent) @ (joints[joint] - joints[PARTS[parent][0]]))

    def shells(self, part: str) -> dict[str, list[Shell]]:
        """Return a left or middle part's surfaces by material, in its link's frame."""
        shapes: dict[str, Callable[[Measures, Build], list[Shell]]] = {
            "upper_arm": limbs.upper_arm,
            "forearm": limbs.forearm,
            "hand": extremities.hand,
            "thigh": limbs.thigh,
            "shin": limbs.shin,
            "foot": extremities.foot,
        }
        if part == "head":
            found = _head(self.measures, self.build)
        elif part == "trunk":
            found = {
                "shirt": _painted(torso.chest(self.measures, self.build), "shirt"),
                "trousers": _painted(self.hips(), "trousers"),
            }
        else:
            material = CLOTHES.get(part, "skin")
            found = {material: _painted(shapes[part](self.measures, self.build), material)}
        matrix = self.stretch(part)
        return {
            material: [shell.transformed(matrix) for shell in shells]
            for material, shells in found.items()
        }

    def hips(self) -> list[Shell]:
        """Return belly, hips and buttocks in the trunk's frame, with average proportions."""
        joints = joint_positions(self.measures)
        step = joints["waist"] - joints["chest"]
        return [shell.moved(step) for shell in torso.waist(self.measures, self.build)]


def _head(measures: Measures, build: Build) -> dict[str, list[Shell]]:
    """Return head and neck without hair, by material."""
    found: dict[str, list[Shell]] = {}
    names = {"skin": "skin", "eye": "eyes", "lips": "lips", "hair": "brows"}
    for shell in head.head(measures, build):
        material = str(shell.materials[0])
        if material == "hair" and np.ptp(shell.vertices[:, 0]) > LARGEST_BROW:
            continue
        found.setdefault(names[material], []).extend(_painted([shell], names[material]))
    return found


def _painted(shells: list[Shell], material: str) -> list[Shell]:
    """Return shells with all triangles in one material."""
    return [replace(s, materials=np.full(len(s.triangles), material)) for s in shells]


def cut(shell: Shell, low: float, high: float) -> Shell:
    """Return the piece of a lofted shell between two heights y [m], closed again.

    Whole rings of vertices are kept, so the flat ends lie slightly inside. A rounded end between
    the heights stays round.
    """
    count = len(shell.vertices) - 2
    around = int(np.count_nonzero(np.any(shell.triangles == count + 1, axis=1)))
    rings = shell.vertices[:count].reshape(-1, around, 3)
    heights = rings[:, :, 1].mean(axis=1)
    kept = np.flatnonzero((heights >= low) & (heights <= high))
    first, last = int(kept[0]), int(kept[-1])
    pieces = rings[first : last + 1]
    bottom = shell.vertices[count] if first == 0 else pieces[0].mean(axis=0)
    top = shell.vertices[count + 1] if last == len(rings) - 1 else pieces[-1].mean(axis=0)
    vertices = np.concatenate([pieces.reshape(-1, 3), [bottom, top]])
    triangles = _tube_triangles(len(pieces), around)
    return Shell(vertices, triangles, np.full(len(triangles), shell.materials[0]))


def _tube_triangles(rings: int, around: int) -> np.ndarray:
    """Return the triangles of rings, upwards, closed by two poles: the last vertices, low, high."""
    here = np.arange(rings * around).reshape(rings, around)
    beside = np.roll(here, -1, axis=1)
    lower = np.stack([here[:-1], beside[:-1], beside[1:]], axis=-1).reshape(-1, 3)
    upper = np.stack([here[:-1], beside[1:], here[1:]], axis=-1).reshape(-1, 3)
    low, high = rings * around, rings * around + 1
    bottom = np.stack([beside[0], here[0], np.full(around, low)], axis=-1)
    top = np.stack([here[-1], beside[-1], np.full(around, high)], axis=-1)
    return np.concatenate([lower, upper, bottom, top]).astype(np.int32)


def halves(shell: Shell, end: float) -> tuple[Shell, Shell]:
    """Return a limb's half at its own joint (y = 0) and its half at the next joint (y = end)."""
    middle, reach = 0.5 * end, OVERLAP * abs(end)
    return cut(shell, middle - reach, np.inf), cut(shell, -np.inf, middle + reach)
