"""Joint positions of every frame: from a table, or estimated from cameras whose place is known."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array
from drake_pose.body import BASE_JOINTS, ArticulatedModel
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.episode_files import JOINT_TABLE
from drake_pose.camera.models import Camera
from drake_pose.camera.picture_files import frame_key
from drake_pose.errors import SceneError
from drake_pose.files.records import base_pose
from drake_pose.files.settings import EstimateSettings
from drake_pose.jobs.estimate.inputs import missing_for_person
from drake_pose.jobs.estimate.measurements import (
    MeasuredPositions,
    check_units,
    read_measured_positions,
)
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.person.shape import shape_parts


@dataclass(frozen=True)
class KnownPositions:
    """Where all joints are in each frame.

    Args:
        path: of what says so.
        values: (m,) of the pose tree by ``frame_key`` [rad or m].
        is_estimate: whether they were estimated, so that they are off.
        warnings: what the user should know of it.
        radius_scales: (nodes,) how many times as wide as the model's the nodes were found to be.
    """

    path: Path
    kinematics: TreeKinematics
    values: Mapping[int | str, Array]
    is_estimate: bool = False
    warnings: tuple[str, ...] = ()
    radius_scales: Array | None = None

    def has(self, frame: str) -> bool:
        """Whether there is a row of a frame."""
        return frame_key(frame) in self.values

    def of(self, frame: str, camera: str) -> Array:
        """(m,) values of the pose tree in a frame that a camera sees [rad or m].

        Raises SceneError: the table has no row of it.
        """
        if not self.has(frame):
            raise SceneError(
                f"{self.path}: has no row of frame '{frame}', which camera '{camera}' has a mask "
                "of; add the joint positions of that moment, or leave the frame out (--frame)"
            )
        return self.values[frame_key(frame)]

    def are_one_pose(self, rows: Iterable[Array], times: float = 1.0) -> bool:
        """Whether joints are at one place in rows (m,), to `times` a degree or 5 mm."""
        same = times * np.where(self.kinematics.is_angle, math.radians(1.0), 0.005)
        return bool((np.ptp(np.array(list(rows)), axis=0) < same).all())


def put_on_base(
    model: ArticulatedModel, table: MeasuredPositions
) -> tuple[ArticulatedModel, MeasuredPositions]:
    """A model and its positions on BASE_JOINTS that move all of it as the table's bases say.

    Raises ModelError: the file is no URDF.
    """
    X_WB = {frame: base_pose(base) for frame, base in table.bases.items()}
    first = next(iter(X_WB.values()))
    moved = model.with_base_joints(first)
    kept = [k for k, name in enumerate(table.names) if name in moved.position_names]
    values = {}
    for frame, X in X_WB.items():
        turns = Rotation.from_matrix(X[:3, :3] @ first[:3, :3].T).as_euler("ZYX")
        place = X[:3, 3] - first[:3, 3]
        values[frame] = np.concatenate([table.values[frame][kept], place, turns])
    names = (*(table.names[k] for k in kept), *BASE_JOINTS)
    return moved, MeasuredPositions(table.path, names, values, is_estimate=table.is_estimate)


def read_known_positions(
    path: Path,
    kinematics: TreeKinematics,
    unobserved: bool = False,
    table: MeasuredPositions | None = None,
) -> KnownPositions:
    """Reads a table with the column frame and one for each joint that is not held.

    Args:
        kinematics: of the pose tree, whose model's positions the columns are.
        unobserved: whether there may be columns of joints that move nothing that is seen.
        table: what was read of it before; None: nothing was.

    Raises:
        SceneError: it cannot be read, lacks a joint, has a column that is of no use, or is not in
            radians and metres.
        UnknownNameError: the model has no joint of a column's name.
    """
    model = kinematics.tree.model
    table = table or read_measured_positions(path, model.position_names)
    held = {model.position_names[index] for index in kinematics.tree.held}
    asked = [name for name in kinematics.names if name not in held]
    missing = [name for name in asked if name not in table.names]
    if missing:
        raise SceneError(
            f"{path}: has no column for joint{'s' if len(missing) > 1 else ''} "
            f"{', '.join(missing)} of {model.path.name}; give the position "
            "of every joint in every frame [rad or m], or hold those that did not move: "
            f"--hold {missing[0]}=VALUE [deg or m]"
        )
    # What moves nothing that is seen may be there.
    known = {*asked, *kinematics.tree.unobserved_positions} if unobserved else set(asked)
    known |= {model.position_names[one.follower] for one in kinematics.tree.followers}
    for column, name in enumerate(table.names if table.is_estimate else ()):
        # A column that says nothing but that a position was held, or is as in the model's file.
        index = model.position_index(name)
        usual = kinematics.tree.held.get(index, model.default_positions[index])
        if all(abs(row[column] - usual) < 1e-6 for row in table.values.values()):
            known.add(name)
    unused = [name for name in table.names if name not in known]
    if unused:
        raise SceneError(
            f"{path}: column '{unused[0]}' is a position that is held, or that places the whole "
            "robot in the world; the cameras are found in the world in which the robot stands as "
            "its model's file has it: leave the column out"
        )
    columns = [table.names.index(name) if name in asked else -1 for name in kinematics.names]
    is_held = np.array(columns) < 0
    rows = table.values.items()
    values = {k: np.where(is_held, kinematics.lower, row[columns]) for k, row in rows}
    warnings = check_units(path, model, kinematics.names, values)
    return KnownPositions(path, kinematics, values, table.is_estimate, warnings)


def estimate_positions(
    scene_path: Path,
    model: ArticulatedModel,
    kinematics: TreeKinematics,
    known: Sequence[Camera],
    settings: EstimateSettings,
) -> KnownPositions:
    """Joint positions of the frames in which the known cameras tell them.

    Raises:
        SceneError: there are too few such cameras, or they see the body in no frame.
        DrakePoseError: as for an estimate.
    """
    names = tuple(camera.name for camera in known)
    if not names:
        table = scene_path / JOINT_TABLE
        given = f"--joints {table}" if table.is_file() else "--joints"
        raise SceneError(
            f"{scene_path}: neither a camera's place nor the body's joint positions are known: "
            f"give X_WC of one camera or more (of two for a person), or joint positions ({given})"
        )
    if len(names) < 2 and not missing_for_person(model):
        raise SceneError(
            f"{scene_path}: {names[0]} is the only camera that has an X_WC, and one camera does "
            "not tell where a person is: give X_WC of two cameras or more, or the person's joint "
            "positions (--joints)"
        )
    found = estimate_scene(scene_path, model.path, None, replace(settings, cameras=names))
    columns = [found.position_names.index(name) for name in kinematics.names]
    values = {frame_key(row.frame): row.q[columns] for row in found.records.values() if row.found}
    if not values:
        raise SceneError(
            f"{scene_path}: camera {', '.join(names)}, whose X_WC is known, sees the body in no "
            "frame well enough to tell its pose, so nothing tells where the others are: give its "
            "joint positions (--joints), or cameras with X_WC that see it"
        )
    radius_scales = None
    if of_parts := found.summary.get("radius_scales"):
        parts, groups = shape_parts(kinematics.tree)
        radius_scales = np.array([of_parts.get(parts[group], 1.0) for group in groups])
    return KnownPositions(scene_path, kinematics, values, True, found.warnings, radius_scales)
