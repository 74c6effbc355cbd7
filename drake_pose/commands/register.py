"""The commands `drake-pose register` and `drake-pose audit`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.markup import escape
from rich.table import Table

from drake_pose.commands.common import (
    SPREAD,
    Json,
    Model,
    Out,
    Overlay,
    count_progress,
    output_console,
    print_files,
    print_result,
    say,
    worst_frames,
)
from drake_pose.files.settings import percent
from drake_pose.jobs.registration.settings import AuditSettings, RegistrationSettings

if TYPE_CHECKING:
    from drake_pose.jobs.registration.audit import SceneAudit
    from drake_pose.jobs.registration.register import SceneRegistration


def register(
    scene: Path,
    /,
    *,
    model: Model,
    out: Out,
    joints: Annotated[Path | None, Parameter(alias="-j")] = None,
    settings: Annotated[RegistrationSettings | None, SPREAD] = None,
    cameras: Path | None = None,
    overlay: Overlay = True,
    json: Json = False,
) -> None:
    r"""Find where cameras stand, from masks or a robot's recorded episode: no board, no guess.

    All rotations of a camera are tried; the best are fitted by the robot's contour, in the end only
    to what fits. The answer has a standard deviation for place and rotation, other poses that fit
    no worse, and the frames that contradict the others. The focal length and principal point of
    each camera must be known, and the pictures be free of distortion. The world is the model's: the
    robot's base, in most files. Five poses that differ much are enough. Cameras that have an X_WC
    are held, and compared with the robot.

    Without joint positions the body's poses are estimated from the cameras that have an X_WC: one
    for a robot on its base, two for a person; then poses and missing cameras are fitted together.
    --joints may also be the poses.csv of an estimate, in which the base may move.

    An episode needs no masks: pictures or videos beside joint positions by time or frame, a LeRobot
    data set, a folder of DROID, a ROS bag. The robot must move in view of a camera that stands
    still, or that rides on it (--on) and sees a --target. Of one that stands still is found, too,
    by how much pictures and joints are out of step, and an unknown focal length.

    Files in DIR: cameras.yaml, which estimate reads; report.html, which shows all of it;
    registration.yaml (6 x 6 covariance, other poses); summary.json; overlay/, overlay_as_given/; of
    an episode masks/ and joint_angles.csv, a scene of the frames that were looked at; with --export
    ros/, mujoco.xml, drake.yaml, rerun.rrd.

    A robot arm whose camera was not measured, and an episode of DROID:

        drake-pose register ../shared/data/arm_one_view --out results/camera \
          --model ../shared/data/arm_two_views/med7/med7.urdf \
          --joints ../shared/data/arm_one_view/joint_angles.csv

        drake-pose register ../shared/data/droid_episodes/short --out results/episode --focal \
          --model ../shared/data/droid_episodes/robot/panda_robotiq.urdf

    Args:
        scene: Folder with cameras.yaml, in which X_WC may be missing, and
            masks/<camera>/<frame>.png; or an episode: a folder or file.
        joints: Joint positions of every frame [rad or m]: a CSV file with the column frame and one
            for each joint; of an episode also by time. Default: the recording's own
            (joint_angles.csv); without any they are estimated from the cameras that have an X_WC.
        cameras: Camera file in place of the scene's or episode's own.
    """
    from drake_pose.jobs.registration.register import register_scene

    with count_progress("cameras", None) as advance:
        result = register_scene(
            scene, model, joints, out, settings, cameras=cameras, overlay=overlay,
            on_camera=advance,
        )  # fmt: skip
    print_result(result, json, _print_registration)


def audit(
    scene: Path,
    /,
    *,
    model: Model,
    joints: Annotated[Path | None, Parameter(alias="-j")] = None,
    out: Annotated[Path | None, Parameter(alias="-o")] = None,
    settings: Annotated[AuditSettings | None, SPREAD] = None,
    cameras: Path | None = None,
    overlay: Overlay = True,
    json: Json = False,
) -> None:
    r"""Say which frames, cameras or joints contradict the rest.

    Each frame is fitted by itself with its joints and cameras free to move a little. What all
    frames are off alike is the fault of a joint's zero, of a camera or of the base; a frame is
    named that is off from the others. Named is what is significant, errors of masks and surfaces
    counted, and moves outlines by a pixel or more. Of causes that explain the masks equally well
    all are told: with one camera, a base that has moved looks like a camera that has.

    Errors that are too large for that are searched: joints' offsets and signs over their whole
    range, focal lengths, exchanged cameras, mirrored masks, conventions of X_WC, cameras that moved
    half-way.

    An episode, as register takes it, needs no masks: each camera is found in its pictures without
    the given one, which is then compared with it; and by how much pictures and joints are out of
    step is told.

    Files in DIR: report.html, a page with all of it; summary.json; overlay/ of the frames that
    contradict the others; overlay_as_given/, the robot as given and as found.

    Whose positions are not those of the pictures:

        drake-pose audit ../shared/data/franka_one_view \
          --model ../shared/data/franka_one_view/panda/panda.urdf \
          --cameras ../shared/data/franka_one_view/cameras_reference.yaml \
          --joints ../shared/data/franka_one_view/joint_angles.csv

    Args:
        scene: Folder with cameras.yaml and masks/<camera>/<frame>.png; or an episode: a folder or
            file.
        joints: Joint positions of every frame [rad or m]: a CSV file with the column frame and one
            for each joint; of an episode also by time. Default: the recording's own
            (joint_angles.csv).
        out: Folder for the result; new or empty.
        cameras: Camera file in place of the scene's or episode's own.
    """
    from drake_pose.jobs.registration.audit import audit_scene

    with count_progress("frames", None) as advance:
        result = audit_scene(
            scene, model, joints, out, settings, cameras=cameras, overlay=overlay, on_frame=advance
        )
    print_result(result, json, _print_audit)


def _print_registration(result: SceneRegistration) -> None:
    """A row a frame and camera, of many the worst; where cameras stand, and how sure that is."""
    from drake_pose.files.folder import REPORT
    from drake_pose.jobs.registration.result import PARAMETERS, parameter_rows
    from drake_pose.silhouette.pictures.scenes import CAMERA_FILE

    console = output_console()
    misfits = [(name, one) for name, own in result.registered.items() for one in own.frames]
    shown, which = worst_frames([misfit.E_total for _, misfit in misfits])
    frames = Table("camera", "frame", "E_total", "IoU", "", title=f"Masks and robot{which}")
    for name, misfit in (misfits[k] for k in shown):
        word = "" if misfit.is_inlier else "contradicts the others"
        shares = percent(misfit.E_total), percent(misfit.iou)
        frames.add_row(escape(name), escape(misfit.frame), *shares, word)
    table = Table(
        "camera", "place [m]", "sd [mm]", "sd [deg]", "poses", "frames", "mean IoU", "seconds",
        title="Cameras in the robot's world",
    )  # fmt: skip
    for name, found in result.registered.items():
        one = result.summary["cameras"][name]
        agreeing = len(found.frames) - len(found.outliers)
        table.add_row(
            escape(name),
            ", ".join(f"{p:.4f}" for p in found.camera.X_WC[:3, 3]),
            f"{one['translation_sd_mm']:.2f}",
            f"{one['rotation_sd_deg']:.3f}",
            str(len(one["modes"])),
            f"{agreeing} of {len(found.frames)}",
            percent(one["mean_iou"]),
            f"{one['seconds']:.1f}",
        )
    console.print(frames)
    console.print(table)
    for name, one in result.summary["cameras"].items():
        if "time_offset_scores" in one:
            console.print(escape(f"camera '{name}': {_say_clock(one)}"), soft_wrap=True)
    first = next(iter(result.summary["cameras"].values()))
    for key, title, of, what in PARAMETERS:
        if first[key]:
            parameters = Table(of, what, "95 % interval", "", title=title)
            for row in parameter_rows(first[key]):
                parameters.add_row(*map(escape, row))
            console.print(parameters)
    if "target" in first:
        console.print(_say_target(first["target"]))
    for name, one in result.summary["cameras"].items():
        if one["suggestion"]:
            values = ", ".join(f"{k}={v:.3f}" for k, v in one["suggestion"]["positions"].items())
            console.print(
                escape(f"camera '{name}': a picture at {values} would tell its poses apart")
            )
    if result.folder is not None:
        print_files(("cameras", result.folder / CAMERA_FILE), ("report", result.folder / REPORT))


def _say_clock(one: Mapping[str, Any]) -> str:
    """How a camera's clock stands to the joints', and its focal length, where that was found."""
    texts = []
    if one["time_offset_s"] is not None:
        value, deviation = 1e3 * one["time_offset_s"], 1e3 * one["time_offset_sd_s"]
        word = "later" if value > 0.0 else "earlier"
        texts.append(
            f"its pictures show the joints of {abs(value):.0f} ms {word} by the joint log's clock "
            f"(sd {deviation:.0f} ms)"
        )
    if one["focal_sd_px"] is not None:
        texts.append(f"focal length {one['focal_px']:.1f} pixels (sd {one['focal_sd_px']:.1f})")
    return "; ".join(texts) or "its clock is not told apart from the joints'"


def _say_target(target: Mapping[str, Any]) -> str:
    """Where an object was found."""
    place = ", ".join(f"{row[3]:.4f}" for row in target["X_WT"][:3])
    return (
        f"target at {place} m in the robot's world, sd {target['translation_sd_mm']:.2f} mm, "
        f"{target['rotation_sd_deg']:.3f} deg; poses that look alike: {len(target['modes'])}"
    )


def _print_audit(result: SceneAudit) -> None:
    """A row for each contradiction, then how many frames agree."""
    console = output_console()
    contradictions = result.summary["contradictions"]
    if contradictions:
        table = Table("contradicts the rest", title="Masks, cameras and joint positions")
        for one in contradictions:
            table.add_row(escape(one["text"]))
        console.print(table)
    count, agree = result.summary["frame_count"], result.summary["agreeing_count"]
    console.print(f"{agree} of {count} frames agree")
    if not contradictions:
        but = ", but see the warnings" if result.warnings else ""
        say(f"drake-pose: nothing contradicts the rest{but}")
    if result.summary["minimum_detectable"]:
        noticed = result.summary["minimum_detectable"].items()
        told = ", ".join(f"{k} {'-' if one is None else f'{one:.2g}'}" for k, one in noticed)
        console.print(f"not noticed    joints off by less than {told} (deg or m)", soft_wrap=True)
    if result.folder is not None:
        print_files(("result", result.folder))
