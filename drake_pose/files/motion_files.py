"""Motion files: joint centres as CSV and TRC, positions as MOT, and motion as BVH.

The joints of a BVH skeleton are the links with geometry, and links from which several of these
branch; the far half of a limb is left out if its length is constant. Zero rotations are the default
pose with the captured lengths. Offsets are in centimetres, rotations in degrees in the order Z, X,
Y; x points forward, y up, z right, as in TRC. The root, and every joint whose position in its
parent changes, has position channels and a zero offset, which all readers interpret alike.
"""

import warnings
from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path

import numpy as np
from pydrake.multibody.tree import PrismaticJoint
from scipy.spatial.transform import Rotation

from drake_pose.arrays import Array, Mask
from drake_pose.body import (
    ArticulatedModel,
    Landmark,
    PlantKinematics,
    landmark_positions,
    landmarks_file,
    load_landmarks,
)
from drake_pose.errors import SettingsError
from drake_pose.files.folder import BVH, JOINT_CENTRES, MOT, TRC, write_file
from drake_pose.files.records import BASE_COLUMNS, FrameRecord, base_cells, base_pose, user_units
from drake_pose.input_files import csv_text

# Rotation from the scene's world W (z up) to the file's world Y (y up).
R_YW = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


def write_motion(
    folder: Path,
    model: ArticulatedModel,
    frames: Sequence[str],
    records: Sequence[FrameRecord],
    rate_hz: float | None,
) -> list[str]:
    """Write joint_centres.csv, and for a sequence TRC, MOT and BVH files; return warnings.

    Joint centres (also in TRC) need a landmarks.yaml beside the model; BVH needs that or a skin,
    since no tool for robots reads it. Files of a sequence hold all frames from the first to the
    last record; frames without a record count as frames without a pose. If no record has a pose, no
    file is written.

    Args:
        folder: the result folder.
        model: the model of the positions.
        frames: names of the scene's frames, in order.
        records: estimates of some or all of the frames, in order.
        rate_hz: frame rate [Hz]; None if the frames are not a sequence: only joint_centres.csv is
            written.

    Raises ModelError: the landmarks cannot be read; OutputError: a file cannot be written.
    """
    has_landmarks = landmarks_file(model.path).is_file()
    landmarks = load_landmarks(model.path) if has_landmarks else {}
    if not any(record.found for record in records):
        return []
    known = {record.frame: record for record in records}
    frames = frames[frames.index(records[0].frame) : frames.index(records[-1].frame) + 1]
    lost = FrameRecord("", np.full(len(model.position_names), np.nan), None, None, np.nan)
    own = [known.get(frame, lost) for frame in frames]
    q, X_WB = np.array([record.q for record in own]), None
    if any(record.base is not None for record in records):
        X_WB = np.array([base_pose(record.base) for record in own])
    if landmarks:
        names, centres = list(landmarks), joint_centres(model, landmarks, q, X_WB)
        write_file(folder, JOINT_CENTRES, centres_as_csv(frames, names, centres))
        if rate_hz is not None:
            write_file(folder, TRC, centres_as_trc(names, centres, rate_hz))
    if rate_hz is None:
        return []
    write_file(folder, MOT, positions_as_mot(model, q, rate_hz, X_WB))
    if not (landmarks or model.skin):
        return []
    text, filled = motion_as_bvh(model, q, X_WB, rate_hz)
    write_file(folder, BVH, text)
    if not filled:
        return []
    return [
        f"{BVH}: {filled} of {len(frames)} frames have no pose and repeat the last known one; use "
        "the other files, which leave these frames out, to see where"
    ]


def joint_centres(
    model: ArticulatedModel, landmarks: Mapping[str, Landmark], q: Array, X_WB: Array | None = None
) -> Array:
    """Return landmark positions (frames, n, 3) in the scene's world [m]; nan where q is.

    ``landmarks``: n by name. ``q``: (frames, nq) [rad or m]. ``X_WB``: (frames, 4, 4) poses of the
    plant's world in the scene's; None: identity.
    """
    places = np.full((len(q), len(landmarks), 3), np.nan)
    for k in np.flatnonzero(np.isfinite(q).all(axis=1)):
        base = None if X_WB is None else X_WB[k]
        places[k] = landmark_positions(model, landmarks, q[k], base)
    return places


def centres_as_csv(frames: Sequence[str], names: Sequence[str], places: Array) -> str:
    """Return the text of joint_centres.csv: a row for each frame and joint, in the order given.

    ``places``: (frames, joints, 3) [m]; frames with a nan are left out.
    """
    cells = [
        [frame, name, *(f"{number:.4f}" for number in place)]
        for frame, row in zip(frames, places, strict=True)
        if np.isfinite(row).all()
        for name, place in zip(names, row, strict=True)
    ]
    return csv_text([["frame", "joint", "x", "y", "z"], *cells])


def centres_as_trc(names: Sequence[str], places: Array, rate_hz: float) -> str:
    """Return the text of a TRC file of joint centres: millimetres, y up, frames counted from 1.

    ``names``: (joints,) names of the markers. ``places``: (frames, joints, 3) positions in the
    world, z up [m]; nan becomes an empty field. ``rate_hz``: frame rate [Hz].
    """
    count = len(places)
    head = ["DataRate", "CameraRate", "NumFrames", "NumMarkers", "Units", "OrigDataRate",
            "OrigDataStartFrame", "OrigNumFrames"]  # fmt: skip
    values = [f"{rate_hz:g}", f"{rate_hz:g}", count, len(names), "mm", f"{rate_hz:g}", 1, count]
    axes = [f"{axis}{k}" for k in range(1, len(names) + 1) for axis in "XYZ"]
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{TRC}",
        "\t".join(head),
        "\t".join(str(value) for value in values),
        "\t".join(["Frame#", "Time", *(cell for joint in names for cell in (joint, "", ""))]),
        "\t".join(["", "", *axes]),
        "",
    ]
    # A rotation: x forward, y left, z up becomes x forward, y up, z right.
    turned = 1e3 * np.stack([places[..., 0], places[..., 2], -places[..., 1]], axis=-1)
    for k, row in enumerate(turned.reshape(count, -1)):
        cells = ["" if np.isnan(number) else f"{number:.3f}" for number in row]
        lines.append("\t".join([str(k + 1), f"{k / rate_hz:.6f}", *cells]))
    return "\n".join(lines) + "\n"


def positions_as_mot(
    model: ArticulatedModel, q: Array, rate_hz: float, X_WB: Array | None = None
) -> str:
    """Return the text of a MOT file of positions in degrees and metres, with columns by name.

    Args:
        model: the model of the positions.
        q: (frames, nq) positions [rad or m]; frames with a nan have no row.
        rate_hz: frame rate [Hz].
        X_WB: (frames, 4, 4) poses of the plant's world in the scene's world, for BASE_COLUMNS
            [m and unit quaternion]; None: no such columns.
    """
    known = np.flatnonzero(np.isfinite(q).all(axis=1))
    names, columns = list(model.position_names), [known / rate_hz, q[known] * user_units(model)]
    if X_WB is not None:
        names += BASE_COLUMNS
        columns.append(np.array([base_cells(X) for X in X_WB[known]]))
    head = [
        "positions", "version=1", f"nRows={len(known)}", f"nColumns={1 + len(names)}",
        "inDegrees=yes", "endheader", "\t".join(["time", *names]),
    ]  # fmt: skip
    text = StringIO()
    np.savetxt(text, np.column_stack(columns), "%.6f", "\t", header="\n".join(head), comments="")
    return text.getvalue()


Skeleton = tuple[tuple[str, int], ...]
"""Joints of a BVH skeleton: name of the link ("world" if several parts stand on it), and index of
the parent joint in the skeleton, -1 for the root."""


def skeleton_of(model: ArticulatedModel, q: Array, stays: float = 1e-5) -> Skeleton:
    """Return the joints of a model's BVH skeleton, parents before children.

    ``model``: the model. ``q``: (frames, nq) positions [rad or m], in which constant lengths are
    detected. ``stays``: range of a prismatic joint below which it is constant [m].
    """
    plant, names, seen = model.plant, model.link_names, model.link_meshes
    # Children of each body: (body, whether by a constant length, whether by a moving joint).
    children: list[list[tuple[int, bool, bool]]] = [[] for _ in names]
    for index in plant.GetJointIndices():
        joint = plant.get_joint(index)
        is_length = joint.type_name() == PrismaticJoint.kTypeName
        is_still = is_length and bool(np.ptp(q[:, joint.position_start()]) < stays)
        moves = joint.num_positions() > 0 and not is_still
        child = int(joint.child_body().index())
        children[int(joint.parent_body().index())].append((child, is_still, moves))
    found: list[tuple[str, int]] = []

    def branches(body: int) -> int:
        """Return the number of children that have geometry or carry a body that has."""
        return sum(names[k] in seen or branches(k) > 0 for k, *_ in children[body])

    def walk(body: int, parent: int, length: bool, motion: bool) -> None:
        """Append the joints of a body and of all bodies below it to ``found``.

        ``parent`` is the index in ``found`` of the last joint above the body. ``length`` and
        ``motion``: whether a constant length and a moving joint lie between both.
        """
        is_half = parent >= 0 and length and not motion and branches(body) > 0
        if (names[body] in seen or branches(body) > 1) and not is_half:
            found.append((names[body], parent))
            parent, length, motion = len(found) - 1, False, False
        for child, is_still, moves in children[body]:
            walk(child, parent, length or is_still, motion or moves)

    walk(0, -1, False, False)
    return tuple(found)


def motion_as_bvh(
    model: ArticulatedModel, q: Array, X_WB: Array | None, rate_hz: float, stays: float = 1e-5
) -> tuple[str, int]:
    """Return the text of a BVH file, and the number of its frames that repeat another frame's pose.

    Args:
        model: the model of the positions.
        q: (frames, nq) positions [rad or m]; a frame of nan gets the last known pose before it, or
            the first known one.
        X_WB: (frames, 4, 4) poses of the plant's world in the scene's world; None: identity.
        rate_hz: frame rate [Hz].
        stays: displacement below which a joint is fixed in its parent [m].

    Raises SettingsError: no frame has a pose.
    """
    known = np.flatnonzero(np.isfinite(q).all(axis=1))
    if not len(known):
        raise SettingsError("a BVH file needs at least one frame with a pose")
    skeleton = skeleton_of(model, q[known])
    # Poses of the joints' links L in the file's world Y: (frames, n, 4, 4); X_Y0: at the defaults.
    kinematics, X_YW = PlantKinematics(model), np.eye(4)
    X_YW[:3, :3] = R_YW
    bodies = [model.link_index(link) for link, _ in skeleton]
    X_BL = np.array([[kinematics.pose_at(body, row) for body in bodies] for row in q[known]])
    X_YL = (X_YW if X_WB is None else (X_YW @ X_WB[known])[:, None]) @ X_BL
    X_Y0 = X_YW @ np.array([kinematics.pose(body) for body in bodies])
    # A joint frame J is parallel to Y at the default pose: R_YL = R_YJ R_Y0.
    R_YJ = X_YL[..., :3, :3] @ np.swapaxes(X_Y0[:, :3, :3], 1, 2)
    parents = [max(parent, 0) for _, parent in skeleton]
    R_PY = np.swapaxes(R_YJ[:, parents], 2, 3)
    p_YL = X_YL[..., :3, 3]
    p_PJ = (R_PY @ (p_YL - p_YL[:, parents])[..., None])[..., 0]
    R_PJ = R_PY @ R_YJ
    p_PJ[:, 0], R_PJ[:, 0] = p_YL[:, 0], R_YJ[:, 0]
    offsets = p_PJ.mean(axis=0)
    slides = np.abs(p_PJ - offsets).max(axis=(0, 2)) > stays
    slides[0] = True
    offsets[slides] = 0.0
    # Farthest vertex of each joint's link, in the axes of Y at the default pose [m].
    tips = np.zeros((len(skeleton), 3))
    for k, (link, _) in enumerate(skeleton):
        mesh = model.link_meshes.get(link)
        if mesh is not None:
            farthest = np.argmax(np.linalg.norm(mesh.vertices, axis=1))
            tips[k] = X_Y0[k, :3, :3] @ mesh.vertices[farthest]
    columns = [
        np.hstack([*([100.0 * p_PJ[:, k]] if slides[k] else []), _smooth_angles(R_PJ[:, k])])
        for k in range(len(skeleton))
    ]
    rows = np.hstack(columns)
    # Index of the last known frame at or before each frame, else of the first known one.
    source = np.maximum(np.searchsorted(known, np.arange(len(q)), side="right") - 1, 0)
    text = [
        "HIERARCHY",
        *_hierarchy(skeleton, offsets, slides, tips),
        "MOTION",
        f"Frames: {len(q)}",
        f"Frame Time: {1.0 / rate_hz:.8f}",
        *(" ".join(f"{number:.6f}" for number in rows[k]) for k in source),
    ]
    return "\n".join(text) + "\n", len(q) - len(known)


def _smooth_angles(R: Array) -> Array:
    """Return Euler angles (n, 3) Z, X, Y [deg] of R (n, 3, 3), each nearest to the frame before."""
    with warnings.catch_warnings():
        # At 90 degrees about X only the sum of the other angles is determined.
        warnings.filterwarnings("ignore", message="Gimbal lock", category=UserWarning)
        angles = Rotation.from_matrix(R).as_euler("ZXY", degrees=True)
    for k in range(1, len(angles)):
        z, x, y = angles[k]
        ways = np.array([(z, x, y), (z + 180.0, 180.0 - x, y + 180.0)])
        ways -= 360.0 * np.round((ways - angles[k - 1]) / 360.0)
        angles[k] = ways[np.argmin(np.abs(ways - angles[k - 1]).sum(axis=1))]
    return np.asarray(angles)


def _hierarchy(skeleton: Skeleton, offsets: Array, slides: Mask, tips: Array) -> list[str]:
    """Return the lines of a BVH file's HIERARCHY after its first, in centimetres.

    Args:
        skeleton: (n,) joints.
        offsets: (n, 3) positions in their parents [m].
        slides: (n,) whether the position in the parent changes: the joint has position channels.
        tips: (n, 3) end sites, used for joints without children [m].
    """
    lines: list[str] = []

    def offset(place: Array) -> str:
        return " ".join(["OFFSET", *(f"{100.0 * number:.6f}" for number in place)])

    def write(k: int, depth: int) -> None:
        """Append the lines of joint k and all joints below it, indented by ``depth`` tabs."""
        link, tab = skeleton[k][0], "\t" * depth
        name = "".join("_" if c.isspace() or c in "{}" else c for c in link)
        positions = ("Xposition", "Yposition", "Zposition") if slides[k] else ()
        channels = (*positions, "Zrotation", "Xrotation", "Yrotation")
        lines.extend([f"{tab}{'JOINT' if depth else 'ROOT'} {name}", tab + "{"])
        lines.append(f"{tab}\t{offset(offsets[k])}")
        lines.append(f"{tab}\tCHANNELS {len(channels)} {' '.join(channels)}")
        below = [n for n, (_, parent) in enumerate(skeleton) if parent == k]
        for n in below:
            write(n, depth + 1)
        if not below:
            ends = ("End Site", "{", "\t" + offset(tips[k]), "}")
            lines.extend(f"{tab}\t{line}" for line in ends)
        lines.append(tab + "}")

    write(0, 0)
    return lines
