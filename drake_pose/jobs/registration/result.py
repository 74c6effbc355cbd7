"""Write the results of a registration: cameras, overlays, summary, report and exports."""

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
from drake_pose.errors import listed
from drake_pose.files.folder import OVERLAY, REPORT, without_nan, write_file, write_summary
from drake_pose.files.overlay import draw_overlay, draw_shapes, encode_png
from drake_pose.files.records import describe_job, file_digest, versions
from drake_pose.files.report_page import new_plot, overlay_picture, page_template, plot_uri
from drake_pose.files.settings import AuditSettings, percent
from drake_pose.input_files import csv_text
from drake_pose.jobs.registration.inputs import RegistrationInputs
from drake_pose.jobs.registration.words import describe_reading
from drake_pose.registration.joint_offsets import KinematicParameter
from drake_pose.registration.posed_frames import PosedFrame
from drake_pose.registration.register import (
    RegisteredCamera,
    TargetPose,
)
from drake_pose.silhouette.outline import outline_from_mesh
from drake_pose.silhouette.pictures.masks import encode_mask
from drake_pose.silhouette.pictures.scenes import CAMERA_FILE
from drake_pose.silhouette.scoring import draw_labels

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def describe_camera(
    found: RegisteredCamera,
    seconds: float,
    link: str | None = None,
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
        "warnings": list(warnings),
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
    """Write the result folder; the camera file is written last.

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
    write_file(path, REPORT, make_registration_report(path, summary))
    links = {name: part["link"] for name, part in parts.items() if "link" in part}
    formats = summary["settings"]["exports"]
    write_exports(path, formats, inputs, cameras.values(), links)
    write_file(path, CAMERA_FILE, dump_cameras(cameras, links))


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
        segments = draw(camera, frame)
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
        shown: NDArray[Any] = pictures.get(frame.name, frame.mask)
        bodies = [draw(camera, frame) >= 0 for camera in (given, found.camera)]
        names = ("the camera as given", "as found")
        picture = draw_shapes(shown, bodies, names, f"{given.name}  frame {frame.name}")
        write_file(folder, f"{AS_GIVEN}/{given.name}/{frame.name}.png", encode_png(picture))


def body_drawer(
    tree: PoseTree, visible_nodes: Collection[str] | None
) -> Callable[[Camera, PosedFrame], NDArray[np.intp]]:
    """Return a function that draws the body as seen by a camera, at the values of a frame.

    The drawing (H, W) has for each pixel the index of the drawn node that it shows, or -1.

    visible_nodes: names of the nodes that are drawn; None: all.
    """
    kinematics, names = TreeKinematics(tree), visible_nodes
    shown = [k for k, node in enumerate(tree.nodes) if names is None or node.name in names]
    outlines = [outline_from_mesh(tree.nodes[k].mesh) for k in shown]

    def draw(camera: Camera, frame: PosedFrame) -> NDArray[np.intp]:
        X_CN = camera.X_CW @ kinematics.poses(frame.values)[shown]
        labels = draw_labels(outlines, np.arange(1, len(shown) + 1), X_CN, camera)
        return np.asarray(labels, np.intp) - 1

    return draw


AS_GIVEN = "overlay_as_given"
"""Folder of pictures that compare given and registered camera poses."""

# Number of pictures of each camera in the report, from the worst to the best frame.
_PICTURES = 6
PARAMETERS = (
    ("zeros", "Joint offsets, to be added to positions", "joint", "offset"),
    ("lengths", "Link scales, relative changes of length", "link", "change"),
)
"""Of each kind of parameter: its key in the summary, a title, who has it, and what it is."""

NORMAL = 1.96
"""Half-width of a 95 % interval in standard deviations."""


def parameter_rows(parameters: Mapping[str, Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Return rows of the report's table of joint offsets or link scales.

    parameters: entries by joint or link, see `describe_parameters`.

    A row has the name, the value with its unit, the 95 % interval, and its significance in words.
    """
    rows: list[tuple[str, ...]] = []
    for name, entry in parameters.items():
        if not entry["determined"]:
            gauge = f", correlated with {', '.join(entry['gauge'])}" if entry["gauge"] else ""
            rows.append((name, "", "", f"not determined{gauge}"))
            continue
        key = next(key for key in entry if key.startswith("value_"))
        unit = key.removeprefix("value_")
        value = f"{entry[key]:.2f} {'%' if unit == 'percent' else unit}"
        interval = f"{entry[f'low_{unit}']:.2f} to {entry[f'high_{unit}']:.2f}"
        within = entry[f"low_{unit}"] <= 0.0 <= entry[f"high_{unit}"]
        word = "0 is in its interval" if within else "not significant at 5 % over all parameters"
        word = "significant" if entry["significant"] else f"{word}: not written into the URDF"
        if entry["significant"] and unit != "percent":
            word += f": {describe_reading(entry[key], entry[f'sd_{unit}'], unit)}"
        rows.append((name, value, interval, word))
    return rows


def make_registration_report(folder: Path, summary: Mapping[str, Any]) -> str:
    """Return the text of report.html, with the overlays in the result folder.

    summary: content of summary.json.
    """
    # The robot's parameters are the same in the parts of all cameras.
    first = next(iter(summary["cameras"].values()))
    pictures, pairs = [], []
    for camera, entry in summary["cameras"].items():
        # Overlays are shown from the worst frame to the best.
        # Frames without a silhouette are ordered by the fraction of points that do not fit.
        errors = {
            frame: 1.0 - part["inlier_ratio"] if part["E_total"] is None else part["E_total"]
            for frame, part in entry["frames"].items()
        }
        shown = (
            frame for frame in errors if (folder / OVERLAY / camera / f"{frame}.png").is_file()
        )
        in_order = sorted(shown, key=lambda frame: -errors[frame])
        count = min(_PICTURES, len(in_order))
        for k in np.linspace(0, len(in_order) - 1, count).round().astype(int):
            frame = in_order[k]
            pictures.append(overlay_picture(folder, camera, frame, errors[frame]))
        for frame in compared_frames(errors):
            pairs.append(overlay_picture(folder, camera, frame, errors[frame], AS_GIVEN))
    figures = [(name, plot_offset(one)) for name, one in summary["cameras"].items()]
    return page_template("drake_pose.jobs.registration").render(
        summary=summary,
        answer=registration_answer(summary["cameras"], summary.get("refused", ())),
        kind="camera poses",
        title=Path(str(summary["scene"])).name or str(summary["scene"]),
        model=Path(str(summary["model"])).name,
        target=first.get("target"),
        parameters=[
            (title, of, what, parameter_rows(first[key]))
            for key, title, of, what in PARAMETERS
            if first[key]
        ],
        by_pictures=first["masks"] == "found",
        by_points=first["masks"] == "none",
        # Cameras that see a target have no time offset.
        clocks=first["masks"] == "found" and "time_offset_scores" in first,
        offsets={name: figure and plot_uri(figure) for name, figure in figures},
        normal=NORMAL,
        pictures=[picture for picture in pictures if picture is not None],
        pairs=[picture for picture in pairs if picture is not None],
    )


def registration_answer(cameras: Mapping[str, Mapping[str, Any]], refused: Collection[str]) -> str:
    """Return the result in a few sentences.

    Args:
        cameras: the parts of summary.json by camera.
        refused: names of cameras without an accepted pose.
    """
    parts = list(cameras.values())
    shift, turn = (
        max(part[key] for part in parts) for key in ("translation_sd_mm", "rotation_sd_deg")
    )
    outliers = sum(len(part["outliers"]) for part in parts)
    count = sum(len(part["frames"]) for part in parts)
    what = "frame" if len(parts) == 1 else "picture" if parts[0]["masks"] == "found" else "mask"
    words = "Camera found" if len(parts) == 1 else f"{len(parts)} cameras found"
    up_to = "" if len(parts) == 1 else "up to "
    texts = [f"{words}, with a standard deviation of {up_to}{shift:.1f} mm and {turn:.2f} deg."]
    if refused:
        texts.insert(0, f"{len(refused)} refused, see the warnings: {listed([*refused])}.")
    are = "is an outlier" if outliers == 1 else "are outliers"
    texts.append(f"{outliers} of {count} {what}s {are}.")
    if ambiguous := [name for name, camera in cameras.items() if len(camera["modes"]) > 1]:
        texts.append(f"Other poses fit equally well: {listed(ambiguous)}.")
    for key, name in (("zeros", "joint offsets"), ("lengths", "link scales")):
        if found := parts[0][key]:
            significant = sum(one["significant"] for one in found.values())
            texts.append(f"{significant} of {len(found)} {name} are significant.")
    return " ".join(texts)


def compared_frames(errors: Mapping[str, float]) -> Sequence[str]:
    """Return the frames that are drawn to compare camera poses: the worst, and the median one.

    errors: E_total by frame; at least one.
    """
    in_order = sorted(errors, key=lambda frame: -errors[frame])
    return tuple(dict.fromkeys([in_order[0], in_order[len(in_order) // 2]]))


def plot_offset(camera: Mapping[str, Any]) -> "Figure | None":
    """Plot the scores of scanned time offsets; None: there are none.

    A vertical line marks the estimated offset, in its 95 % interval.

    camera: its part of summary.json.
    """
    tried = np.array(camera.get("time_offset_scores") or ()).reshape(-1, 2)
    if len(tried) < 2:
        return None
    figure, axes = new_plot()
    axes.plot(1e3 * tried[:, 0], 100.0 * tried[:, 1], marker=".", markersize=3)
    if camera["time_offset_s"] is not None:
        value, margin = 1e3 * camera["time_offset_s"], 1e3 * NORMAL * camera["time_offset_sd_s"]
        axes.axvspan(value - margin, value + margin, color="#c5dfee")
        axes.axvline(value, color="#d55e00")
        axes.set_xlim(1e3 * tried[0, 0], 1e3 * tried[-1, 0])
    return figure


def check_exports(formats: Collection[str], cameras: Iterable[Camera]) -> None:
    """Refuse exports that could not be written, before any work.

    formats: of ``RegistrationSettings.exports``; "lerobot" is ignored here.

    Raises CameraError: a format does not support a camera.
    """
    _texts(formats, list(cameras), "world", {})


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
    for name, text in _texts(formats, cameras, world, links).items():
        write_file(folder, name, text)


def _texts(
    formats: Collection[str], cameras: list[Camera], world: str, links: Mapping[str, str]
) -> dict[str, str]:
    """Return the texts of exports by path in the result folder.

    formats: of the exports. cameras: as of `write_exports`. world: frame of cameras on no link.
    links: by name of each other camera, its link.
    """
    texts: dict[str, str] = {}
    if "ros" in formats:
        texts |= {f"ros/{camera.name}.yaml": ros_camera_info(camera) for camera in cameras}
        frames = {camera.name: links.get(camera.name, world) for camera in cameras}
        texts["ros/static_transforms.launch.xml"] = ros_transforms(cameras, frames)
    if "mujoco" in formats:
        texts["mujoco.xml"] = mujoco_cameras(cameras)
    if "drake" in formats:
        texts["drake.yaml"] = dump_scenario(cameras, links)
    return texts
