"""The commands `drake-pose check`, `masks`, `register` and `audit`, which prepare an estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from drake_pose.commands.common import (
    SPREAD,
    Cameras,
    Joints,
    Json,
    Model,
    Out,
    Overlay,
    count_progress,
    print_json,
    print_line,
    print_result,
    print_table,
    say,
    warn,
)
from drake_pose.errors import ModelError, RegistrationError, listed
from drake_pose.files.settings import AuditSettings, MaskSettings, Packages, RegistrationSettings

if TYPE_CHECKING:
    from drake_pose.jobs.masks import SceneMasks
    from drake_pose.jobs.registration.audit import SceneAudit
    from drake_pose.jobs.registration.register import SceneRegistration


def register(
    scene: Path,
    /,
    *,
    model: Model,
    out: Out,
    joints: Joints = None,
    cameras: Cameras = None,
    settings: Annotated[RegistrationSettings | None, SPREAD] = None,
    overlay: Overlay = True,
    json: Json = False,
) -> None:
    r"""Find camera poses from a recorded episode or a robot's silhouettes, without a board.

    The result is each camera's pose X_WC [m] in the model's world (in most files the robot's base),
    with standard deviations of position and rotation, other poses that fit equally well, and the
    frames that are outliers. No initial guess is needed.

        drake-pose register ../shared/data/droid_episodes/short --out results/episode --focal \
          --model ../shared/data/droid_episodes/robot/panda_robotiq.urdf

    An episode needs no masks. The robot must move in view of a static camera, or carry the camera
    (--on) over a scene that stands still. The time offset between pictures and joints is estimated
    as well, and the focal length if it is unknown.

    From masks, the cameras' intrinsics must be known, and five poses that differ much are enough.
    Cameras that have an X_WC keep it. Without joint positions the body's poses are estimated from
    these cameras (one for a robot with a fixed base, two for a person). --joints may also be the
    poses.csv of drake-pose estimate, in which the base may move.

    Files in the output folder: report.html (start here); cameras.yaml, which estimate reads;
    registration.yaml (6 x 6 covariance, other poses); summary.json; overlay/; overlay_as_given/;
    for an episode masks/ and joint_angles.csv; with --export ros/, mujoco.xml, drake.yaml or
    lerobot/.

    Args:
        scene: Folder with masks/<camera>/<frame>.png and cameras.yaml, in which X_WC may be
            missing; or an episode, a folder or file.
    """
    from drake_pose.jobs.registration.register import register_scene

    with count_progress("cameras", None) as advance:
        result = register_scene(
            scene, model, joints, out, settings, cameras=cameras, overlay=overlay,
            on_camera=advance,
        )  # fmt: skip
    print_result(result, json, _print_registration)
    _stop_if_refused([*result.refused], len(result.registered))


def audit(
    scene: Path,
    /,
    *,
    model: Model,
    out: Annotated[
        Path | None,
        Parameter(
            alias="-o", help="Folder for the result, new or empty. Default: no files are written."
        ),
    ] = None,
    joints: Joints = None,
    cameras: Cameras = None,
    settings: Annotated[AuditSettings | None, SPREAD] = None,
    overlay: Overlay = True,
    json: Json = False,
) -> None:
    r"""Find errors in joint positions, cameras and frames of a scene.

    Each frame is fitted by itself, with its joints and cameras free to move. A deviation that all
    frames share is an error of a joint offset, a camera or the base; a frame that deviates from the
    others is an outlier. An error is reported if it is significant and moves the contours by a
    pixel or more. All causes that explain the masks equally well are reported.

        drake-pose audit ../shared/data/franka_one_view \
          --model ../shared/data/franka_one_view/panda/panda.urdf \
          --cameras ../shared/data/franka_one_view/cameras_reference.yaml \
          --joints ../shared/data/franka_one_view/joint_angles.csv

    An episode, as for register, needs no masks: each camera is found in its pictures without the
    given pose, which is then compared with the one found.

    Files in the output folder: report.html (start here); summary.json; overlay/ of the frames that
    are outliers; overlay_as_given/, the robot as given and as found.

    Args:
        scene: Folder with cameras.yaml and masks/<camera>/<frame>.png; or an episode, a folder or
            file.
    """
    from drake_pose.jobs.registration.audit import audit_scene

    with count_progress("frames", None) as advance:
        result = audit_scene(
            scene, model, joints, out, settings, cameras=cameras, overlay=overlay, on_frame=advance
        )
    print_result(result, json, _print_audit)
    refused = [one["name"] for one in result.summary["findings"] if one["what"] == "refused"]
    _stop_if_refused(refused, len(result.summary["found_cameras"]))


def _stop_if_refused(refused: Sequence[str], accepted: int) -> None:
    """Raise a RegistrationError if cameras, given by name, were refused beside accepted ones."""
    if refused:
        raise RegistrationError(
            f"{len(refused)} of {len(refused) + accepted} cameras refused: {listed(refused)}"
        )


def _print_registration(result: SceneRegistration) -> None:
    """Print the answer, the camera poses with standard deviations, and other estimates."""
    from drake_pose.jobs.registration import pages

    cameras = result.summary["cameras"]
    print_line(pages.registration_answer(cameras, result.refused))
    for table in (pages.camera_table(cameras), *pages.robot_tables(cameras)):
        print_table(table.head, table.rows, table.closed)
    for name, one in cameras.items():
        if "time_offset_scores" in one or "points" in one:
            print_line(f"camera '{name}': {pages.clock_text(one)}")


def _print_audit(result: SceneAudit) -> None:
    """Print the answer and the errors."""
    print_line(result.answer)
    summary = result.summary
    print_table(("error",), [(one["text"],) for one in summary["findings"]])
    print_line(f"{summary['agreeing_count']} of {summary['frame_count']} frames are consistent")


def check(file: Path, /, *, package: Packages | None = None, json: Json = False) -> None:
    """Check whether a model can be used for pose estimation, and if not, why.

    A usable model has visual geometry, and limits on every prismatic joint that is searched. The
    table shows the pose tree in the order of the search: each link, its parent, the joints between
    them in the order of rotation with their limits, and the number of triangles. Exit status 1: the
    model cannot be used.

    Collision geometry, transmissions and plugins are not read. A joint that mimics another one
    shares its unknown. Loops and gearboxes are named in a warning and not enforced. Expand xacro
    macros first.

        drake-pose check urdf/woman/woman.urdf
        drake-pose check arm.urdf --package arm_description=ros/arm_description

    Args:
        file: The model: URDF, SDFormat, MJCF or .dmd.yaml.
        package: Folder of the package of package://NAME/... files; repeat for several.
    """
    from drake_pose.body import describe_model

    report = describe_model(file, package_paths=package or {})
    if json:
        print_json({**asdict(report), "path": str(report.path), "usable": report.usable})
    elif report.usable:
        units, rows = {"angle": " deg", "length": " m"}, []
        for node in report.nodes:
            joints = [
                "{name}  {lower:g} .. {upper:g}".format(**joint)
                + units.get(joint["kind"], "")
                + (f"  (= {joint['follows']})" if joint["follows"] else "")
                for joint in node["joints"]
            ]
            texts = node["name"], node["parent"], "\n".join(joints) or "fixed"
            rows.append((*texts, str(node["triangles"]), "yes" if node["watertight"] else "no"))
        head = ("segment", "hangs on", "joints in the order of rotation", "triangles", "closed")
        print_table(head, rows, f"{report.name}: {len(report.nodes)} segments")
    warn(*report.warnings)
    if report.errors:
        raise ModelError("; ".join(report.errors))
    say("drake-pose: the model is fit for use")


def masks(
    source: Path,
    /,
    *,
    out: Annotated[Path, Parameter(alias="-o", metavar="SCENE")],
    settings: Annotated[MaskSettings | None, SPREAD] = None,
    overlay: Overlay = True,
    json: Json = False,
) -> None:
    """Make a scene of masks, from masks of other tools or from pictures.

    Masks of other tools are COCO files, black and white pictures, or black and white videos. In
    pictures and videos the object is what differs from a picture of the empty room (--background).
    --background median takes each pixel's median over the recording, which works only if the body
    does not stay in one place; the command warns if it does.

    Files in SCENE: masks/; cameras.yaml; scene.yaml; overlay/ (the pictures with the masks'
    contours: look at them); summary.json (area and warnings of each mask, and why it was rejected).

        drake-pose masks RECORDING --background median --out scene

    Args:
        source: Folder with images/<camera>/<frame>.png or .jpg, with videos/<camera>.mp4, or with
            pictures of a single camera; a picture; a video; a COCO file (.json); an episode of a
            LeRobot data set or DROID; or a ROS bag.
        out: Folder for the scene. It must be new or empty.
    """
    from drake_pose.jobs.masks import make_masks

    with count_progress("masks", None) as advance:
        result = make_masks(source, out, settings, overlay=overlay, on_mask=advance)
    print_result(result, json, _print_masks)


def _print_masks(result: SceneMasks) -> None:
    """Print the number and sizes of each camera's masks."""
    for name, frames in result.summary["cameras"].items():
        good = [one["area"] for one in frames.values() if "area" in one]
        text = f"{len(good)} masks of {len(frames)} pictures"
        text += f", {min(good)} to {max(good)} pixels" if good else ""
        print_line(f"{name or 'camera':<20} {text}")
