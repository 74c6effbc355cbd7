"""Write what a registration found in the forms of LeRobot: `register --export lerobot`."""

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drake_pose.camera.episode import JointLog
from drake_pose.camera.joint_map import motors_of
from drake_pose.camera.lerobot import INFO, camera_name
from drake_pose.camera.lerobot_tables import camera_fields
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.camera.servo_readings import TURN, Column, Encoding, JointReadings, Servos
from drake_pose.errors import SettingsError
from drake_pose.jobs.registration.inputs import RegistrationInputs

FOLDER = "lerobot"
"""Folder of these files in a result folder."""


@dataclass(frozen=True)
class HomingCorrection:
    """A motor's corrected homing offset."""

    motor: str  # Name of the motor.
    # before, after: homing offset in the file, and corrected [steps].
    before: int
    after: int
    shift: int  # Increase of the motor's positions by the correction [steps].
    reason: str = ""  # Why the offset is not corrected; "": it is.


def correct_homing(
    joint: JointReadings,
    motor_name: str,
    column: Column,
    offset: float,
    servos: Servos,
    encoding: Encoding,
) -> HomingCorrection:
    """Return the homing offset with which LeRobot reads the model's angle of a joint.

    The middle of the motor's range, where LeRobot reads 0, becomes the model's zero. The range's
    numbers stay, so that its ends are the same angles on both sides of the zero.

    Args:
        joint: the joint; its readings are not used.
        motor_name: name of the motor in the calibration file.
        column: the joint's column, as recorded.
        offset: the joint's offset, to be added to the recorded positions [rad].
        servos: the robot's motors.
        encoding: of the column's readings.
    """
    motor, step = servos.motors[motor_name], 2.0 * math.pi / TURN
    before = motor.homing
    if joint.is_gripper:
        reason = "its readings are an opening of 0 to 100, not an angle"
        return HomingCorrection(motor_name, before, before, 0, reason)
    sign = -1.0 if motor.is_inverted and not servos.is_dynamixel and encoding != "deg" else 1.0
    if servos.has_lists:
        # Calibrations by lists invert what the motor counts, then add the offset.
        counted = sign if encoding == "steps" else 1.0
        shift = round(math.copysign(offset / step, counted * column.scale * offset))
        return HomingCorrection(motor_name, before, before + shift, shift)
    middle = 0.5 * (motor.low + motor.high) if encoding == "steps" else 0.0
    zero = column.scale * middle + column.offset + offset
    shift, half = round(sign * zero / step), 0.5 * (motor.high - motor.low)
    if abs(shift) > 0.5 * half:
        # Model and motor have unrelated zeros, as in a model with limits on one side of 0.
        reason = (
            f"the middle of its range is {math.degrees(zero):.0f} degrees in the model, too far "
            "from its zero: calibrate it again with the arm in the middle of its range"
        )
        return HomingCorrection(motor_name, before, before, 0, reason)
    # Feetech: position = counted - homing offset; Dynamixel: plus.
    after = before + shift if servos.is_dynamixel else before - shift
    if not servos.is_dynamixel and abs(after) >= TURN // 2:
        # The register has a sign and 11 bits; positions are modulo a turn.
        after = max(after - int(math.copysign(TURN, after)), 1 - TURN // 2)
    return HomingCorrection(motor_name, before, after, shift)


def dump_column(joint: str, column: Column, offset: float) -> str:
    """Return a joint's line of a joint map, ``offset`` added to its positions [rad or m]."""
    scale, constant = float(column.scale), float(column.offset + offset)
    name = json.dumps(column.name)
    if column.ends is None:
        return f"{joint}: {{column: {name}, scale: {scale!r}, offset: {constant!r}}}\n"
    ends = [float(end) for end in column.ends]
    values = [scale * end + constant for end in ends]
    return f"{joint}: {{column: {name}, from: {ends}, to: {values}}}\n"


def require_data_set(inputs: RegistrationInputs) -> JointLog:
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
    links: Mapping[str, str],
    zeros: Mapping[str, Mapping[str, Any]],
) -> tuple[dict[str, bytes | str], list[str]]:
    """Return a joint map, a corrected calibration of the motors, and a copy of `meta`.

    Args:
        inputs: the registration's inputs.
        cameras: the cameras, with poses in the world, or in a link's frame.
        links: link of each camera that rides on one, by the camera's name.
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
    source = mapped.servos.path if mapped.servos else None
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
            feature["info"] = (feature.get("info") or {}) | camera_fields(
                camera, links.get(camera.name)
            )
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
    files[f"{FOLDER}/README.md"] = _readme(path, name, corrections, len(offsets))
    return files, notes


def _corrections(
    mapped: JointLog, offsets: Mapping[str, float]
) -> tuple[list[HomingCorrection], list[str]]:
    """Return the motors' corrections for joint offsets, and warnings of motors left as they were.

    offsets: significant joint offsets by joint [rad or m].
    """
    servos, none = mapped.servos, "--export lerobot: no calibration of the motors is written: "
    if servos is None or servos.path is None:
        return [], [
            f"{none}the robot's own is not in or beside the data set; name it (--joint-map FILE)"
        ]
    if mapped.unit in (None, "rad"):
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
                       offsets.get(joint.name, 0.0), servos, mapped.unit)
        for joint, motor in motors_of(mapped)
    ]  # fmt: skip
    kept = [f"{one.motor} ({one.reason})" for one in corrections if one.reason and one.motor]
    texts = [f"--export lerobot: motors whose calibration is left as it was: {'; '.join(kept)}"]
    return [one for one in corrections if not one.reason], texts if kept else []


def _readme(
    path: Path, calibration: str | None, corrections: Iterable[HomingCorrection], offset_count: int
) -> str:
    """Return a page that says what the files are, and how they are used.

    Args:
        path: the data set.
        calibration: name of the corrected calibration file; None: it is not written.
        corrections: of the motors in that file.
        offset_count: number of significant joint offsets.
    """
    text = f"""Found by `drake-pose register` in {path}, which is left as it was.

- `joint_map.yaml` (`--joint-map joint_map.yaml`): from the columns of episodes of this calibration
  to the model's joints [rad or m], {offset_count} joint offsets included.
- `meta/`, in place of the data set's own: `info.json` has `camera_intrinsics` (matrix [pixel]) and
  `camera_extrinsics` (4 x 4 [m]; x right, y down, z forward) of each camera, in the robot's base
  or, if `camera_link` names a link, on that link.
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
