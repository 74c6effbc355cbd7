"""Write the results of a registration: cameras, overlays, summary, report and exports."""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from drake_pose.arrays import Array, Picture
from drake_pose.body import TARGET_POSITIONS, PoseTree
from drake_pose.body.tree_kinematics import TreeKinematics
from drake_pose.camera.camera_files import dump_cameras
from drake_pose.camera.exchange import (
    dump_scenario,
    mujoco_cameras,
    ros_camera_info,
    ros_transforms,
)
from drake_pose.camera.models import Camera
from drake_pose.files.folder import AS_GIVEN, OVERLAY, without_nan, write_file, write_summary
from drake_pose.files.overlay import body_drawer, draw_overlay, draw_shapes, encode_png
from drake_pose.files.records import describe_job, describe_warnings, file_digest, versions
from drake_pose.files.settings import AuditSettings, percent
from drake_pose.input_files import csv_text
from drake_pose.jobs.registration.inputs import RegistrationInputs
from drake_pose.jobs.registration.pages import compared_frames, registration_page
from drake_pose.registration.findings import Diagnosis, Finding
from drake_pose.registration.joint_offsets import KinematicParameter
from drake_pose.registration.posed_frames import PosedFrame
from drake_pose.registration.register import RegisteredCamera, TargetPose
from drake_pose.silhouette.pictures.masks import encode_mask
from drake_pose.silhouette.pictures.scenes import CAMERA_FILE


def describe_camera(
    found: RegisteredCamera, seconds: float, link: str | None = None
) -> dict[str, Any]:
    """Return a camera's part of summary.json; lengths in m unless `_mm`, angles in `_deg`.

    Args:
        found: the camera.
        seconds: duration of the search [s].
        link: the link that carries the camera, in whose frame its pose is; None: the world.
    """
    pose, target_pose, X = "X_WC" if link is None else "X_LC", found.target, found.camera.X_WC
    target = {}
    if target_pose is not None:
        target = {
            **describe_pose("X_WT", target_pose.X_WT, target_pose),
            "modes": [
                {"X_WT": one.tolist()} for one in (target_pose.X_WT, *target_pose.alternatives)
            ],
            "determined": not len(target_pose.symmetry_axes),
            "covariance": target_pose.covariance.tolist(),
            "symmetry_axes": target_pose.symmetry_axes.tolist(),
        }
    return {
        **({} if link is None else {"link": link}),
        **describe_pose(pose, X, found),
        "modes": [{pose: one.tolist()} for one in (X, *found.alternatives)],
        "mean_iou": float(np.mean([frame.iou for frame in found.frames])),
        **({"target": target} if target else {}),
        "seconds": seconds,
        "outliers": list(found.outliers),
        "frames": {
            frame.frame: {
                "agrees": frame.is_inlier,
                "E_total": None if math.isnan(frame.E_total) else frame.E_total,
                "iou": None if math.isnan(frame.iou) else frame.iou,
                "inlier_ratio": frame.inlier_ratio,
            }
            for frame in found.frames
        },
    }


def describe_pose(name: str, X: Array, found: RegisteredCamera | TargetPose) -> dict[str, Any]:
    """Return a pose X (4, 4) as entry `name`, and the standard deviations [mm, deg] of `found`."""
    return {
        name: X.tolist(),
        "translation_sd_mm": 1e3 * found.translation_sd,
        "rotation_sd_deg": float(np.degrees(found.rotation_sd)),
    }


def describe_parameters(
    offsets: Sequence[KinematicParameter],
    link_scales: Sequence[KinematicParameter],
    kinematics: TreeKinematics,
) -> dict[str, dict[str, Any]]:
    """Return the summary's parts "zeros" on joint offsets and "lengths" on link scales.

    The entry of a joint or link says whether it is determined and significant; its value, standard
    deviation and 95 % interval [deg, mm or %] (None: not determined); and correlated unknowns.

    kinematics: of the pose tree, which tells joints that turn from joints that slide.
    """

    def describe(one: KinematicParameter, unit: str, factor: float) -> dict[str, Any]:
        """Return a parameter's entry; its numbers are multiplied by `factor`, to `unit`."""
        numbers = {"value": one.value, "sd": one.deviation, "low": one.low, "high": one.high}
        return {
            "determined": one.determined,
            "significant": one.significant,
            **{f"{k}_{unit}": factor * x if one.determined else None for k, x in numbers.items()},
            "gauge": list(one.gauge),
        }

    turns = dict(zip(kinematics.names, kinematics.is_angle, strict=True))
    units = {True: ("deg", math.degrees(1.0)), False: ("mm", 1e3)}
    return {
        "zeros": {one.name: describe(one, *units[bool(turns[one.name])]) for one in offsets},
        "lengths": {scale.name: describe(scale, "percent", 1e2) for scale in link_scales},
    }


def describe_run(
    inputs: RegistrationInputs, settings: AuditSettings, warnings: Sequence[str], seconds: float
) -> dict[str, Any]:
    """Return the part of summary.json on a run's files, settings, versions and duration [s]."""
    joints = inputs.joints
    job = describe_job(inputs.scene.path, inputs.model.path, settings, inputs.cameras)
    job["sha256"]["joints"] = joints and file_digest(joints)
    return {
        "seconds": seconds,
        **describe_warnings(warnings),
        "cameras": str(inputs.camera_file),
        "joints": joints and str(joints),
        **job,
        "versions": versions(),
    }


def write_result(
    path: Path,
    inputs: RegistrationInputs,
    cameras: Mapping[str, Camera],
    registered: Mapping[str, RegisteredCamera],
    summary: Mapping[str, Any],
    overlay: bool,
    urdf: bytes | None,
    pictures: Mapping[str, Mapping[str, Picture]],
) -> None:
    """Write the result folder.

    Args:
        path: the folder.
        inputs: with the final positions of the frames.
        cameras: cameras for the camera file, by name.
        registered: the registered cameras, by name, with the misfits of all their frames.
        summary: contents of summary.json.
        overlay: whether overlays are drawn.
        urdf: text of the robot with estimated joint offsets and link scales; None: no such file.
        pictures: (H, W, 3) by camera and frame name, of cameras registered from pictures, whose
            masks and joint positions are written, too; empty: masks were given.

    Raises OutputError: the folder cannot be written.
    """
    parts = summary["cameras"]
    for name, found in registered.items() if overlay else ():
        if not inputs.of(name):  # A camera registered from a standing scene has no silhouettes.
            continue
        titles = [
            f"{name}  frame {frame.frame}  E_total {percent(frame.E_total)}  IoU {frame.iou:.2f}  "
            f"{'agrees' if frame.is_inlier else 'OUTLIER'}"
            for frame in found.frames
        ]
        own = pictures[name] if pictures else {}
        titled = [
            one
            for one in zip(inputs.of(name), titles, strict=True)
            if not own or one[0].name in own
        ]
        write_overlays(path, inputs.tree, found.camera, titled, inputs.visible_nodes, own)
        for given in (camera for camera in inputs.given_cameras if camera.name == name):
            write_comparisons(path, inputs, inputs.of(name), given, found, own)
    names = TreeKinematics(inputs.tree).names
    names = tuple(name for name in names if name not in TARGET_POSITIONS)
    for camera in pictures:
        # Masks of the camera's frames, and joint positions corrected by its time offset.
        rows = [["frame", *names]]
        for frame in inputs.of(camera):
            write_file(path, f"masks/{camera}/{frame.name}.png", encode_mask(frame.mask))
            # The target's positions are the last ones, and 0.
            rows.append([frame.name, *map(repr, frame.values[: len(names)].tolist())])
        several = f"_{camera}" if len(pictures) > 1 else ""
        write_file(path, f"joint_angles{several}.csv", csv_text(rows))
    if urdf is not None:
        write_file(path, f"{inputs.model.path.stem}_calibrated.urdf", urdf)
    described = {}
    for name, entry in parts.items():
        found = registered[name]
        described[name] = without_nan(
            {
                **{key: entry[key] for key in ("link", "X_LC", "X_WC") if key in entry},
                "errors": ["turn_x", "turn_y", "turn_z", "x", "y", "z"],
                "covariance": found.covariance,
                "alternatives": found.alternatives,
                "outliers": list(found.outliers),
                **{key: entry[key] for key in ("zeros", "lengths", "target") if entry.get(key)},
            }
        )
    write_file(path, "registration.yaml", yaml.safe_dump(described, sort_keys=False))
    write_summary(path, summary)
    links = {name: part["link"] for name, part in parts.items() if "link" in part}
    formats = summary["settings"]["exports"]
    write_exports(path, formats, inputs, cameras.values(), links)
    write_file(path, CAMERA_FILE, dump_cameras(cameras, links))
    registration_page(path, summary).write(path)


def write_overlays(
    folder: Path,
    tree: PoseTree,
    camera: Camera,
    titled: Iterable[tuple[PosedFrame, str]],
    visible_nodes: Collection[str] | None,
    pictures: Mapping[str, Picture],
) -> None:
    """Draw the robot over each mask of a camera, or over its picture, below a title.

    Args:
        folder: the result folder.
        tree: the robot's pose tree, with the frames' values.
        camera: the camera at the pose from which the robot is drawn.
        titled: frames of the camera with their titles.
        visible_nodes: names of the nodes that are drawn; None: all.
        pictures: (H, W, 3) by frame; for other frames the mask is shown.
    """
    draw = body_drawer(tree, visible_nodes)
    for frame, title in titled:
        segments = draw(camera, frame.values)
        shown: NDArray[Any] = pictures.get(frame.name, frame.mask)
        picture = draw_overlay(shown, segments >= 0, segments, title)
        write_file(folder, f"{OVERLAY}/{camera.name}/{frame.name}.png", encode_png(picture))


def write_comparisons(
    folder: Path,
    inputs: RegistrationInputs,
    frames: Sequence[PosedFrame],
    given: Camera,
    found: RegisteredCamera,
    pictures: Mapping[str, Picture],
) -> None:
    """Draw the robot as seen by a camera at its given pose, and at its registered pose.

    Only the frames of `compared_frames` are drawn, over their pictures, or else their masks.

    Args:
        folder: the result folder.
        inputs: give the robot's pose tree.
        frames: of this camera.
        given, found: the camera at its given pose, and as registered.
        pictures: (H, W, 3) by frame.
    """
    draw = body_drawer(inputs.tree, inputs.visible_nodes)
    errors = {frame.frame: frame.E_total for frame in found.frames}
    for frame in (frame for frame in frames if frame.name in compared_frames(errors)):
        bodies = [draw(camera, frame.values) >= 0 for camera in (given, found.camera)]
        names, title = ("the camera as given", "as found"), f"{given.name}  frame {frame.name}"
        picture = draw_shapes(pictures.get(frame.name, frame.mask), bodies, names, title)
        write_file(folder, f"{AS_GIVEN}/{given.name}/{frame.name}.png", encode_png(picture))


def write_corrections(folder: Path, inputs: RegistrationInputs, found: Diagnosis) -> None:
    """Draw the robot as given and as found by an audit, if joints were corrected.

    At most eight frames are drawn into the folder AS_GIVEN, the largest errors first.
    """
    names, count = TreeKinematics(inputs.tree).names, 0
    draw = body_drawer(inputs.tree, inputs.visible_nodes)
    shown = [one for one in found.frames if one.frame in inputs.scene.frames]
    for frame in sorted(shown, key=lambda one: -one.pixels):
        own = [] if frame.finding is None or frame.finding in found.common else [frame.finding]
        seen = inputs.read(frame.frame)
        values = seen.values
        for finding in (*found.common, *own):
            values = corrected(values, names, finding)
        if np.array_equal(values, seen.values) or count == 8:
            continue
        count += 1
        for camera in (one for one in inputs.known_cameras if one.name in seen.masks):
            name, mask = camera.name, seen.masks[camera.name]
            bodies = [draw(camera, one) >= 0 for one in (seen.values, values)]
            title = f"{name}  frame {frame.frame}"
            picture = draw_shapes(mask, bodies, ("as given", "as found"), title)
            write_file(folder, f"{AS_GIVEN}/{name}/{frame.frame}.png", encode_png(picture))


def corrected(values: Array, names: Sequence[str], finding: Finding) -> Array:
    """Return the joint values (m,) corrected by a finding; unchanged if it corrects no joint.

    ``values``: (m,) joint values [rad or m]. ``names``: (m,) names of the joints. ``finding``: its
    kind and joints tell the correction.
    """
    added = dict(finding.joints)
    if finding.kind == "joint":
        added = {finding.name: finding.angle if finding.angle_sd > 0.0 else finding.shift}
    elif finding.kind == "sign" and finding.name in names and "to be added" not in finding.text:
        added = {finding.name: -2.0 * values[names.index(finding.name)]}
    return values + [added.get(name, 0.0) for name in names]


def write_exports(
    folder: Path,
    formats: Collection[str],
    inputs: RegistrationInputs,
    cameras: Iterable[Camera],
    links: Mapping[str, str],
) -> None:
    """Write exports for other programs into a result folder.

    Args:
        folder: the result folder.
        formats: of ``RegistrationSettings.exports``; "lerobot" is ignored here.
        inputs: the registration's inputs.
        cameras: cameras with poses in the world, or in the frames of links.
        links: by name of each camera on a link, the link, in whose frame the camera's pose is.

    Raises OutputError: an export cannot be written.
    """
    cameras = list(cameras)
    # ROS' name of the world: the link that is fixed at its origin, if any.
    kinematics, world = TreeKinematics(inputs.tree), "world"
    poses = kinematics.poses(kinematics.flatten(inputs.tree.default_values()))
    for node, X_WN in zip(inputs.tree.nodes, poses, strict=True):
        if node.parent < 0 and not node.value_names and np.allclose(X_WN, np.eye(4), atol=1e-6):
            world = node.name
            break
    for name, text in export_texts(formats, cameras, world, links).items():
        write_file(folder, name, text)


def export_texts(
    formats: Collection[str], cameras: list[Camera], world: str, links: Mapping[str, str]
) -> dict[str, str]:
    """Return the texts of exports by path in the result folder.

    formats: of ``RegistrationSettings.exports``; "lerobot" is ignored here. cameras: as of
    `write_exports`. world: frame of cameras on no link. links: by name of each other camera, its
    link.

    Raises CameraError: a format does not support a camera.
    """
    texts: dict[str, str] = {}
    if "ros" in formats:
        texts |= {f"ros/{camera.name}.yaml": ros_camera_info(camera) for camera in cameras}
        frames = {camera.name: links.get(camera.name, world) for camera in cameras}
        texts["ros/static_transforms.launch.xml"] = ros_transforms(cameras, frames)
    if "mujoco" in formats:
        texts["mujoco.xml"] = mujoco_cameras(cameras, links)
    if "drake" in formats:
        texts["drake.yaml"] = dump_scenario(cameras, links)
    return texts
