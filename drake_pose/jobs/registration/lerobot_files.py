"""Write what a registration found in the forms of LeRobot: `register --export lerobot`."""

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from drake_pose.camera.joint_map import MappedJoints, motors_of
from drake_pose.camera.lerobot import INFO, camera_name
from drake_pose.camera.lerobot_tables import camera_fields
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.camera.servo_readings import HomingCorrection, correct_homing, dump_column
from drake_pose.errors import SettingsError
from drake_pose.jobs.registration.inputs import RegistrationInputs

FOLDER = "lerobot"
"""Folder of these files in a result folder."""


def require_data_set(inputs: RegistrationInputs) -> MappedJoints:
    """Return the mapped joint log of the LeRobot data set that is registered.

    Raises SettingsError: the recording is no LeRobot data set, or a joint table (--joints) is used.
    """
    path = inputs.scene.path
    if inputs.mapped is None or not (path / INFO).is_file() or inputs.joints is not None:
        raise SettingsError(
            f"{path}: --export lerobot needs a LeRobot data set ({INFO}), and its own joint log: "
            + ("leave --joints out" if (path / INFO).is_file() else "leave it out")
        )
    return inputs.mapped


def lerobot_files(
    inputs: RegistrationInputs,
    cameras: Iterable[Camera],
    link: str | None,
    zeros: Mapping[str, Mapping[str, Any]],
) -> tuple[dict[str, bytes | str], list[str]]:
    """Return a joint map, a corrected calibration of the motors, and a copy of `meta`.

    Args:
        inputs: the registration's inputs.
        cameras: the cameras, with poses in the world, or in the link's frame.
        link: the link that carries the cameras; None: they stand in the world.
        zeros: the summary's entries on joint offsets, by joint, see ``describe_parameters``.

    Returns:
        the files' contents by path in the result folder; and warnings of what is left out, and why.
    """
    units = {"value_deg": math.radians(1.0), "value_mm": 1e-3}
    offsets = {
        joint: units[key] * entry[key]
        for joint, entry in zeros.items()
        for key in units
        if entry["significant"] and entry.get(key) is not None
    }
    mapped, path = require_data_set(inputs), inputs.scene.path
    columns = mapped.columns.items()
    lines = [dump_column(joint, one, offsets.get(joint, 0.0)) for joint, one in columns]
    files: dict[str, bytes | str] = {f"{FOLDER}/joint_map.yaml": "".join(lines)}
    corrections, notes = _corrections(mapped, offsets)
    source = mapped.log.servos.path if mapped.log.servos else None
    if corrections and source is not None:
        content = json.loads(source.read_bytes())
        for entry in corrections:
            if "motor_names" in content:
                content["homing_offset"][content["motor_names"].index(entry.motor)] = entry.after
            else:
                content[entry.motor]["homing_offset"] = entry.after
        files[f"{FOLDER}/{source.name}"] = json.dumps(content, indent=4) + "\n"
    for file in sorted(one for one in (path / INFO).parent.rglob("*") if one.is_file()):
        files[f"{FOLDER}/{file.relative_to(path)}"] = file.read_bytes()
    info, written = json.loads((path / INFO).read_bytes()), set[str]()
    for camera in cameras:
        if not isinstance(camera, PinholeCamera) or camera.name in inputs.lenses:
            notes.append(
                f"--export lerobot: camera '{camera.name}' is left out of {FOLDER}/{INFO}, as its "
                "pictures are distorted: use cameras.yaml"
            )
        else:
            key = next(k for k in info["features"] if camera.name in (k, camera_name(k)))
            feature = info["features"][key]
            written.add(key)
            feature["info"] = (feature.get("info") or {}) | camera_fields(camera, link)
    for key in {*info["features"]} - written:
        named = camera_name(key)
        if named in inputs.left_out:
            notes.append(
                f"--export lerobot: camera '{named}' is left out of {FOLDER}/{INFO}, as it has no "
                "pose"
            )
        if named in {*inputs.left_out, *inputs.recordings}:
            # The data set's own pose would look like one that was found.
            (info["features"][key].get("info") or {}).pop("camera_extrinsics", None)
    files[f"{FOLDER}/{INFO}"] = json.dumps(info, indent=4) + "\n"
    name = source.name if corrections and source is not None else None
    files[f"{FOLDER}/README.md"] = _readme(path, name, corrections, offsets)
    return files, notes


def _corrections(
    mapped: MappedJoints, offsets: Mapping[str, float]
) -> tuple[list[HomingCorrection], list[str]]:
    """Return the motors' corrections for joint offsets, and warnings of motors left as they were.

    offsets: significant joint offsets by joint [rad or m].
    """
    servos, none = mapped.log.servos, "--export lerobot: no calibration of the motors is written: "
    if servos is None or servos.path is None:
        return [], [
            f"{none}the robot's own is not in or beside the data set; name it (--joint-map FILE)"
        ]
    if mapped.encoding is None:
        return [], [f"{none}the joint log holds angles or is mapped, not readings of motors"]
    if not (servos.is_so or servos.is_dynamixel):
        return [], [
            f"{none}robot_type '{servos.robot}' does not tell whose motors they are, and with it "
            "the sign of homing_offset; correct it by joint_map.yaml"
        ]
    if not offsets:
        return [], [f"{none}no joint offset is significant (--zeros all estimates them)"]
    corrections = [
        correct_homing(joint, motor, mapped.columns[joint.name],
                       offsets.get(joint.name, 0.0), servos, mapped.encoding)
        for joint, motor in motors_of(mapped)
    ]  # fmt: skip
    kept = [f"{one.motor} ({one.reason})" for one in corrections if one.reason and one.motor]
    texts = [f"--export lerobot: motors whose calibration is left as it was: {'; '.join(kept)}"]
    return [one for one in corrections if not one.reason], texts if kept else []


def _readme(
    path: Path,
    calibration: str | None,
    corrections: Iterable[HomingCorrection],
    offsets: Mapping[str, float],
) -> str:
    """Return a page that says what the files are, and how they are used.

    Args:
        path: the data set.
        calibration: name of the corrected calibration file; None: it is not written.
        corrections: of the motors in that file.
        offsets: significant joint offsets [rad or m].
    """
    text = f"""Found by `drake-pose register` in {path}, which is left as it was.

- `joint_map.yaml` (`--joint-map joint_map.yaml`): from the columns of episodes of this calibration
  to the model's joints [rad or m], {len(offsets)} joint offsets included.
- `meta/`, in place of the data set's own: `info.json` has `camera_intrinsics` (matrix [pixel]) and
  `camera_extrinsics` (4 x 4, camera in the robot's base [m]; x right, y down, z forward).
"""
    if calibration is None:
        return text
    text += f"""- `{calibration}`, in place of the robot's own: its calibration with corrected
  `homing_offset`, by which LeRobot reads the model's angles. Connect, and let LeRobot write it to
  the motors. Episodes recorded before belong to the old one.

| motor | homing_offset | corrected | its positions change by [steps] |
| --- | --- | --- | --- |
"""
    for motor in corrections:
        text += f"| {motor.motor} | {motor.before} | {motor.after} | {motor.shift:+d} |\n"
    return (
        text + "\n`range_min` and `range_max` are as they were, now about the model's zero: at one "
        "end the range may lie beyond where the joint was moved. Approach its ends slowly.\n"
    )
