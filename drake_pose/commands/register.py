"""The commands `drake-pose check`, `masks`, `register` and `audit`, which prepare an estimate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from rich.markup import escape
from rich.table import Table

from drake_pose.commands.common import (
    SPREAD,
    Cameras,
    Joints,
    Json,
    Model,
    Out,
    Overlay,
    count_progress,
    output_console,
    print_files,
    print_json,
    print_result,
    say,
    warn,
    worst_frames,
)
from drake_pose.errors import ModelError, RegistrationError, listed
from drake_pose.files.settings import (
    AuditSettings,
    MaskSettings,
    Packages,
    RegistrationSettings,
    percent,
)

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
    """Print the camera poses with standard deviations, other estimates, and the worst frames."""
    from drake_pose.files.folder import REPORT
    from drake_pose.jobs.registration.result import PARAMETERS, parameter_rows
    from drake_pose.silhouette.pictures.scenes import CAMERA_FILE

    console = output_console()
    table = Table(
        "camera", "position, m", "sd, mm", "sd, deg", "poses", "inliers", "mean IoU", "seconds",
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
    console.print(table)
    for name, one in result.summary["cameras"].items():
        if "time_offset_scores" in one or "points" in one:
            console.print(escape(f"camera '{name}': {_say_clock(one)}"), soft_wrap=True)
    first = next(iter(result.summary["cameras"].values()))
    for key, title, of, what in PARAMETERS:
        if first[key]:
            parameters = Table(of, what, "95 % interval", "", title=title)
            for row in parameter_rows(first[key]):
                parameters.add_row(*map(escape, row))
            console.print(parameters)
    if target := first.get("target"):
        place = ", ".join(f"{row[3]:.4f}" for row in target["X_WT"][:3])
        console.print(
            f"target at {place} m in the robot's world, sd {target['translation_sd_mm']:.2f} mm, "
            f"{target['rotation_sd_deg']:.3f} deg; "
            f"poses in which it looks the same: {len(target['modes'])}"
        )
    misfits = [(name, one) for name, own in result.registered.items() for one in own.frames]
    if "points" in first:
        shown, which = worst_frames([-misfit.inlier_ratio for _, misfit in misfits], 8)
        frames = Table("camera", "frame", "points that fit", "", title=f"Standing scene{which}")
        shares: list[tuple[str, ...]] = [(percent(misfit.inlier_ratio),) for _, misfit in misfits]
    else:
        shown, which = worst_frames([misfit.E_total for _, misfit in misfits], 8)
        frames = Table("camera", "frame", "E_total", "IoU", "", title=f"Masks and robot{which}")
        shares = [(percent(misfit.E_total), percent(misfit.iou)) for _, misfit in misfits]
    for k in shown:
        name, misfit = misfits[k]
        word = "" if misfit.is_inlier else "outlier"
        frames.add_row(escape(name), escape(misfit.frame), *shares[k], word)
    console.print(frames)
    if result.folder is not None:
        print_files(("cameras", result.folder / CAMERA_FILE), ("report", result.folder / REPORT))


def _say_clock(one: Mapping[str, Any]) -> str:
    """Return a text of evidence, time offset and focal length in an entry of summary.json."""
    if "points" in one:
        texts = [
            f"from {one['points']} points of the scene: {percent(one['sightings_that_fit'])} of "
            f"{one['sightings']} sightings fit; the pose explains {percent(one['explained'])} of "
            f"the matches, and chance {percent(one['explained_by_chance'])}"
        ]
    else:
        texts = [
            f"its pose explains {percent(one['explained'])} of the changes in its pictures (by "
            f"chance: p-value {one['p_value']:.1g})"
        ]
    if one["time_offset_s"] is not None:
        value, deviation = 1e3 * one["time_offset_s"], 1e3 * one["time_offset_sd_s"]
        word = "later" if value > 0.0 else "earlier"
        texts.append(
            f"its pictures show the joints {abs(value):.0f} ms {word} than their time stamps say "
            f"(sd {deviation:.0f} ms)"
        )
    else:
        texts.append("its time offset is not determined")
    if one["focal_sd_px"] is not None:
        texts.append(f"focal length {one['focal_px']:.1f} pixels (sd {one['focal_sd_px']:.1f})")
    return "; ".join(texts)


def _print_audit(result: SceneAudit) -> None:
    """Print the errors, the number of consistent frames, and minimum detectable offsets."""
    console = output_console()
    findings = result.summary["findings"]
    if findings:
        table = Table("error", title="Errors in joint positions, cameras and frames")
        for one in findings:
            table.add_row(escape(one["text"]))
        console.print(table)
    count, agree = result.summary["frame_count"], result.summary["agreeing_count"]
    console.print(f"{agree} of {count} frames are consistent")
    if not findings:
        but = ", but see the warnings" if result.warnings else ""
        say(f"drake-pose: no error found{but}")
    if result.undetectable:
        console.print(result.undetectable, soft_wrap=True)
    if result.folder is not None:
        print_files(("result", result.folder))


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
        table = Table(
            "segment", "hangs on", "joints in the order of rotation", "triangles", "closed",
            title=escape(f"{report.name}: {len(report.nodes)} segments"),
        )  # fmt: skip
        units = {"angle": " deg", "length": " m"}
        for node in report.nodes:
            joints = [
                "{name}  {lower:g} .. {upper:g}".format(**joint)
                + units.get(joint["kind"], "")
                + (f"  (= {joint['follows']})" if joint["follows"] else "")
                for joint in node["joints"]
            ]
            texts = node["name"], node["parent"], "\n".join(joints) or "fixed"
            closed = "yes" if node["watertight"] else "no"
            table.add_row(*map(escape, texts), str(node["triangles"]), closed)
        output_console().print(table)
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
    """Print the number and sizes of each camera's masks, and the scene's folder."""
    console = output_console()
    for name, frames in result.summary["cameras"].items():
        good = [one["area"] for one in frames.values() if "area" in one]
        text = f"{len(good)} masks of {len(frames)} pictures"
        text += f", {min(good)} to {max(good)} pixels" if good else ""
        console.print(f"{escape(name or 'camera'):<14} {text}")
    print_files(("scene", result.folder))
