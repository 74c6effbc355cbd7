"""Joint positions of every frame, from a table or estimated; pose trees and corrected models."""

import math
import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array
from drake_pose.body import (
    BASE_JOINTS,
    TARGET,
    ArticulatedModel,
    PoseTree,
    RootRotation,
    load_model,
    reshaped,
    xml_element,
)
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.episode import JointLog
from drake_pose.camera.episode_files import JOINT_TABLE
from drake_pose.camera.models import Camera
from drake_pose.camera.picture_files import frame_key
from drake_pose.errors import SceneError, SettingsError, UnknownNameError
from drake_pose.files.records import base_pose
from drake_pose.files.settings import AuditSettings, EstimateSettings, RegistrationSettings
from drake_pose.fit.parameters import carried_joints
from drake_pose.jobs.estimate.inputs import make_tree, missing_for_person
from drake_pose.jobs.estimate.measurements import read_measured_positions, with_leaders
from drake_pose.jobs.estimate.scene import estimate_scene
from drake_pose.person.pose_tracker import shape_parts
from drake_pose.registration.joint_offsets import KinematicParameter
from drake_pose.registration.standing_object import CalibrationTarget, fixed_link_error


@dataclass(frozen=True)
class KnownPositions:
    """Positions of all joints in each frame."""

    path: Path  # The table, or the scene from which positions were estimated.
    kinematics: TreeKinematics  # Of the pose tree.
    # (m,) values of the pose tree by ``frame_key``, a frame's number or name [rad or m].
    values: Mapping[int | str, Array]
    is_estimate: bool = False  # Whether positions were estimated from masks or pictures.
    warnings: tuple[str, ...] = ()  # For the user.
    # (nodes,) estimated factors of the nodes' radii; None: not estimated.
    radius_scales: Array | None = None

    def has(self, frame: str) -> bool:
        """Return whether a frame has positions."""
        return frame_key(frame) in self.values

    def of(self, frame: str, camera: str) -> Array:
        """Return the values (m,) of the pose tree in a frame, by its name [rad or m].

        camera: name of a camera with a mask of the frame, for the message.

        Raises SceneError: the table has no row of the frame.
        """
        if not self.has(frame):
            raise SceneError(
                f"{self.path}: has no row of frame '{frame}', for which camera '{camera}' has a "
                "mask; add its joint positions, or leave the frame out (--frame)"
            )
        return self.values[frame_key(frame)]

    def are_one_pose(self, rows: Iterable[Array], times: float = 1.0) -> bool:
        """Return whether the body stands still over rows (m,) of values [rad or m].

        times: factor of the maximum range of each value over all rows, 1 degree or 5 mm.
        """
        same = times * np.where(self.kinematics.is_angle, math.radians(1.0), 0.005)
        return bool((np.ptp(np.array(list(rows)), axis=0) < same).all())


def put_on_base(model: ArticulatedModel, table: JointLog) -> tuple[ArticulatedModel, JointLog]:
    """Return a model whose base moves on BASE_JOINTS, and a table with positions of these joints.

    These positions are 0 at the base pose of the table's first frame.

    model: the robot. table: with base poses.

    Raises ModelError: the model is no URDF.
    """
    X_WB = [base_pose(base) for base in (() if table.bases is None else table.bases)]
    first = X_WB[0]
    moved = model.with_base_joints(first)
    kept = [k for k, name in enumerate(table.names) if name in moved.position_names]
    turns = [Rotation.from_matrix(X[:3, :3] @ first[:3, :3].T).as_euler("ZYX") for X in X_WB]
    places = [X[:3, 3] - first[:3, 3] for X in X_WB]
    names = (*(table.names[k] for k in kept), *BASE_JOINTS)
    positions = np.column_stack([table.positions[:, kept], places, turns])
    return moved, replace(table, names=names, positions=positions, bases=None)


def read_known_positions(
    path: Path, kinematics: TreeKinematics, unobserved: bool = False, table: JointLog | None = None
) -> KnownPositions:
    """Return the positions in a table with columns for the frame and each joint that is not held.

    Args:
        path: the table (CSV).
        kinematics: of the pose tree; its held values are added.
        unobserved: whether columns of joints that move no visible part are allowed.
        table: the table's contents; None: it is read.

    Raises SceneError: the table cannot be read, lacks a joint, has an unusable column, or is not in
    radians and metres; UnknownNameError: the model has no joint of a column's name.
    """
    model, followers = kinematics.tree.model, kinematics.tree.followers
    table = table or read_measured_positions(path, model)
    q, couplings, warnings = with_leaders(model, followers, table.names, table.positions)
    held = {model.position_names[index] for index in kinematics.tree.held}
    needed = [name for name in kinematics.names if name not in held]
    missing = [name for name in needed if name not in {*table.names, *couplings}]
    if missing:
        raise SceneError(
            f"{path}: has no column for joint{'s' if len(missing) > 1 else ''} "
            f"{', '.join(missing)} of {model.path.name}; give the position of every joint in every "
            "frame [rad or m], or hold the joints that did not move: "
            f"--hold {missing[0]}=VALUE [deg or m]"
        )
    # Columns of joints that move no visible part, and of followers, are ignored.
    known = {*needed, *kinematics.tree.unobserved_positions} if unobserved else set(needed)
    known |= {model.position_names[one.follower] for one in followers}
    for column, name in enumerate(table.names if table.is_estimate else ()):
        # An estimate has columns of held positions, too; they must have the held values.
        index = model.position_index(name)
        usual = kinematics.tree.held.get(index, model.default_positions[index])
        if all(abs(row[column] - usual) < 1e-6 for row in table.positions):
            known.add(name)
    unused = [name for name in table.names if name not in known]
    if unused:
        raise SceneError(
            f"{path}: column '{unused[0]}' is a position that is held, or that places the whole "
            "robot in the world. Cameras are registered with the robot placed as in its model "
            "file: leave the column out"
        )
    values = np.tile(kinematics.lower, (len(q), 1))
    for k, name in enumerate(kinematics.names):
        if name in needed:
            values[:, k] = q[:, model.position_index(name)]
    of_frame = dict(zip(table.by_frame, values, strict=True))
    texts = (*table.warnings, *warnings)
    return KnownPositions(path, kinematics, of_frame, table.is_estimate, texts)


def own_joints(scene: Path, robot: ArticulatedModel, settings: AuditSettings) -> Path | None:
    """Return the scene's joint table; None: it has no table with all joints that are not held."""
    path = scene / JOINT_TABLE
    if not path.is_file():
        return None
    try:
        table = read_measured_positions(path, robot)
    except UnknownNameError:  # The table belongs to another model.
        return None
    tree = make_tree(robot, EstimateSettings(hold=settings.hold))
    held = {robot.position_names[index] for index in tree.held}
    leaders = with_leaders(robot, tree.followers, table.names, table.positions)[1]
    return path if {*TreeKinematics(tree).names} <= {*table.names, *leaders} | held else None


def still_joints(
    log: JointLog | None, model: ArticulatedModel, moves: float = 0.2
) -> tuple[str, ...]:
    """Return what may be wrong with an episode's log if its pictures are refused.

    These are revolute joints that read the same in all rows, as of an encoder that is stuck.

    Args:
        log: the log in the model's joints; None: there is none.
        model: the robot.
        moves: minimum range of the readings of joints that move [rad or m]; three or more do.
    """
    rows = np.zeros((1, 0)) if log is None else log.positions
    ranges = np.fmax.reduce(rows, axis=0) - np.fmin.reduce(rows, axis=0)
    if log is None or np.count_nonzero(ranges > moves) < 3:
        return ()
    return tuple(
        f"joint '{name}' reads {rows[0, k]:.4g} in all rows of the log, while others move: does "
        "its encoder work?"
        for k, name in enumerate(log.names)
        if ranges[k] == 0.0 and name in log.columns
        if model.position_kinds[model.position_index(name)] == "angle"
    )


def estimate_positions(
    scene_path: Path,
    model: ArticulatedModel,
    kinematics: TreeKinematics,
    known: Sequence[Camera],
    settings: EstimateSettings,
) -> KnownPositions:
    """Return joint positions estimated from the masks of cameras with known poses.

    Frames without an estimate are left out.

    Args:
        scene_path: the scene of masks.
        model: the body's model.
        kinematics: of the pose tree of `model`.
        known: the cameras with known poses.
        settings: of the estimate; `known` replaces its cameras.

    Raises SceneError: there are too few cameras with known poses, or they see the body in no frame;
    DrakePoseError: see ``estimate_scene``.
    """
    names = tuple(camera.name for camera in known)
    if not names:
        table = scene_path / JOINT_TABLE
        given = f"--joints {table}" if table.is_file() else "--joints"
        raise SceneError(
            f"{scene_path}: neither a camera's pose nor the body's joint positions are known: give "
            f"X_WC of one camera or more (of two for a person), or joint positions ({given})"
        )
    if len(names) < 2 and not missing_for_person(model):
        raise SceneError(
            f"{scene_path}: {names[0]} is the only camera with an X_WC, and one camera does not "
            "determine a person's position: give X_WC of two cameras or more, or the person's "
            "joint positions (--joints)"
        )
    found = estimate_scene(scene_path, model.path, None, replace(settings, cameras=names))
    columns = [found.position_names.index(name) for name in kinematics.names]
    values = {frame_key(row.frame): row.q[columns] for row in found.records.values() if row.found}
    if not values:
        raise SceneError(
            f"{scene_path}: camera {', '.join(names)} with known X_WC sees the body in no frame "
            "well enough to estimate its pose, so the other cameras cannot be registered: give the "
            "joint positions (--joints), or cameras with X_WC that see the body"
        )
    radius_scales = None
    if of_parts := found.summary.get("radius_scales"):
        parts, groups = shape_parts(kinematics.tree)
        radius_scales = np.array([of_parts.get(parts[group], 1.0) for group in groups])
    return KnownPositions(scene_path, kinematics, values, True, found.warnings, radius_scales)


def read_target(
    model: ArticulatedModel, settings: RegistrationSettings
) -> CalibrationTarget | None:
    """Return the calibration target that cameras on a link of the robot `model` see.

    None: the settings have no target, so the cameras see the robot.

    Raises SettingsError: the target is unusable, or no link carries the cameras.
    """
    if settings.target is None:
        return None
    if settings.on is None:
        raise SettingsError(
            f"{settings.target} and a camera that rides on no link both stand still, so masks of "
            "the target do not relate the camera to the robot: name the camera's link (--on LINK)"
        )
    other = load_model(settings.target, package_paths=settings.packages)
    held = make_tree(model, EstimateSettings(hold=settings.hold)).held
    named = {model.position_names[index]: value for index, value in held.items()}
    return CalibrationTarget(model, settings.on, named, make_tree(other, EstimateSettings()))


def make_registration_tree(
    model: ArticulatedModel, settings: RegistrationSettings, target: CalibrationTarget | None = None
) -> tuple[PoseTree, tuple[str, ...] | None]:
    """Return the pose tree, and the names of its nodes that masks show; None: all.

    With cameras on a link (``settings.on``) the tree starts at the link, and masks show the robot's
    static base or the target. Otherwise the tree starts in the world.

    target: the calibration target; None: the masks show the robot.

    Raises SettingsError: no part that masks show stands still, or no joint moves the link.
    """
    if target is not None:
        return target.tree(np.eye(4)), (TARGET,)
    tree = make_tree(model, EstimateSettings(hold=settings.hold))
    link = settings.on
    if link is None:
        return tree, None
    base = [node.name for node in tree.nodes if node.parent < 0 and not node.value_names]
    if not base:
        raise SettingsError(
            f"{model.path}: no visible link stands still, so the pose of a camera on link '{link}' "
            "is not observable; the robot's base needs visual geometry"
        )
    held = {model.position_names[index]: value for index, value in tree.held.items()}
    moved = model.pose_tree(
        link, root_position=np.zeros(3), root_rotation=RootRotation.fixed(), held=held
    )
    if not {node.name for node in moved.nodes[1:]} & set(base):
        raise fixed_link_error(model, link)
    return moved, tuple(base)


def still_links(tree: PoseTree, links: Mapping[str, str]) -> list[tuple[str, Array]]:
    """Return the cameras on links that stand still, with the pose X_WL (4, 4) of the link.

    tree: the robot's, in the world. links: link of each camera, by the camera's name.
    """
    poses, kinematics, plant = list[dict[str, Array]](), TreeKinematics(tree), tree.model.plant
    default, context = kinematics.flatten(tree.default_values()), plant.CreateDefaultContext()
    for values in (default, default + 0.5 * (kinematics.lower < kinematics.upper)):
        q, X_WB = tree.positions_from(kinematics.split(values))
        plant.SetPositions(context, q)
        X_BL = {k: plant.GetBodyByName(v).EvalPoseInWorld(context) for k, v in links.items()}
        poses.append({name: X_WB @ X.GetAsMatrix4() for name, X in X_BL.items()})
    return [(name, X) for name, X in poses[0].items() if np.allclose(X, poses[1][name])]


def corrected_urdf(
    model: ArticulatedModel,
    folder: Path | None,
    offsets: Mapping[str, float],
    shifts: Mapping[str, Sequence[float]],
) -> bytes | None:
    """Return the text of a model's URDF with corrected origins of joints.

    Args:
        model: the model.
        folder: the result folder, which mesh paths will be relative to.
        offsets: joint offsets by name [rad or m].
        shifts: by joint the shift (3,) of its origin in its parent link's frame [m].

    Returns the text; None if nothing is corrected, there is no folder, or the model is no URDF.
    """
    path = model.path
    if folder is None or not model.changes_shape or not (offsets or shifts):
        return None
    text = path.read_text(encoding="utf-8")
    root = xml_element(reshaped(text, joint_offsets=offsets, joint_shifts=shifts))
    for mesh in root.iter("mesh"):
        name = mesh.get("filename", "")
        if "://" not in name:
            mesh.set("filename", os.path.relpath(path.parent / name, folder))
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)


def joint_shifts(tree: PoseTree, scales: Sequence[KinematicParameter]) -> dict[str, list[float]]:
    """Return by joint the shift (3,) of its origin in its parent link's frame [m].

    scales: relative changes of links' lengths; joints carried by unchanged links have no entry.
    """
    longer = {scale.name: scale.value for scale in scales if scale.value}
    offsets = carried_joints(tree, longer)
    return {offset.joint: (longer[offset.link] * offset.p_L).tolist() for offset in offsets}
