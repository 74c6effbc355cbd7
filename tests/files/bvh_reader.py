"""A small BVH reader for tests, written from the description of the format."""

from dataclasses import dataclass, field

import numpy as np


@dataclass
class Joint:
    """A joint of a BVH file; an end site has no channels."""

    name: str
    parent: int
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    channels: list[str] = field(default_factory=list)


@dataclass
class Motion:
    """A BVH file: joints, frame time [s], and channels (frames, n)."""

    joints: list[Joint]
    frame_time: float
    rows: np.ndarray

    def places(self) -> dict[str, np.ndarray]:
        """Return the positions (frames, 3) of each joint by name [cm]."""
        found = [self._pose(row) for row in self.rows]
        return {
            joint.name: np.array([frame[k] for frame in found])
            for k, joint in enumerate(self.joints)
        }

    def _pose(self, row: np.ndarray) -> list[np.ndarray]:
        """Return the positions of all joints: offset plus position channels, then rotations."""
        turns, places, at = [], [], 0
        for joint in self.joints:
            turn, place = (
                (np.eye(3), np.zeros(3))
                if joint.parent < 0
                else (turns[joint.parent], places[joint.parent])
            )
            moved = joint.offset.copy()
            for channel in joint.channels:
                axis, kind = "XYZ".index(channel[0]), channel[1:]
                if kind == "position":
                    moved[axis] += row[at]
                at += 1
            place = place + turn @ moved
            at -= len(joint.channels)
            for channel in joint.channels:
                if channel[1:] == "rotation":
                    turn = turn @ about("XYZ".index(channel[0]), np.radians(row[at]))
                at += 1
            turns.append(turn)
            places.append(place)
        assert at == len(row)
        return places


def about(axis: int, angle: float) -> np.ndarray:
    """Return the rotation matrix (3, 3) about x, y or z."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[j, i], matrix[i, j] = np.sin(angle), -np.sin(angle)
    return matrix


def read_bvh(text: str) -> Motion:
    """Parse a file with one skeleton."""
    hierarchy, motion = text.split("MOTION\n")
    words = hierarchy.split()
    assert words.pop(0) == "HIERARCHY"
    joints: list[Joint] = []
    open_joints: list[int] = []
    while words:
        word = words.pop(0)
        if word in ("ROOT", "JOINT", "End"):
            name = words.pop(0)
            parent = open_joints[-1] if open_joints else -1
            ended = joints[parent].name + "_end" if word == "End" else name
            joints.append(Joint(ended, parent))
            assert words.pop(0) == "{"
            open_joints.append(len(joints) - 1)
        elif word == "OFFSET":
            joints[open_joints[-1]].offset = np.array([float(words.pop(0)) for _ in range(3)])
        elif word == "CHANNELS":
            count = int(words.pop(0))
            joints[open_joints[-1]].channels = [words.pop(0) for _ in range(count)]
        else:
            assert word == "}"
            open_joints.pop()
    assert not open_joints
    lines = motion.splitlines()
    count, period = int(lines[0].split(":")[1]), float(lines[1].split(":")[1])
    rows = np.array([[float(cell) for cell in line.split()] for line in lines[2:]])
    assert len(rows) == count
    return Motion(joints, period, rows)
