"""Opens an episode, whatever recorded it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from drake_pose.camera.episodes.bags import BAGS, open_bag
from drake_pose.camera.episodes.droid import TRAJECTORY, open_droid
from drake_pose.camera.episodes.episode import Episode
from drake_pose.camera.episodes.folder import open_folder, read_joint_table
from drake_pose.camera.episodes.lerobot import INFO, open_lerobot
from drake_pose.errors import SceneError, SettingsError

_EXPECTED = (
    f"expected a LeRobot data set ({INFO}), a folder of DROID ({TRAJECTORY}), a bag (.bag, .mcap, "
    ".db3, or a folder with metadata.yaml), or a folder with videos/<camera>.mp4 or "
    "images/<camera>/<frame>.png"
)
# What is found in a folder is listed up to so many names.
_LISTED = 8


def open_episode(
    path: str | Path, *, joints: str | Path | None = None, episode: int | None = None
) -> Episode:
    """Opens an episode in a folder or file of any of the formats in `tutorials/file_formats.md`.

    Args:
        joints: a table of joint positions, in place of the recording's own.
        episode: its number in a LeRobot data set; None: the only one that is there.

    Raises:
        SceneError: names what was found and what is expected, or what is damaged or missing; and
            the extra `episodes`, where a library of it is.
        UnknownNameError: a data set has no such episode here.
        SettingsError: a number for what holds one episode only.
        CameraError: a camera file cannot be used.
    """
    path = Path(path)
    if not path.exists():
        raise SceneError(f"{path}: no such folder or file; {_EXPECTED}")
    log, warnings = (None, []) if joints is None else read_joint_table(Path(joints))
    if (path / INFO).exists():
        found = open_lerobot(path, log, episode)
        return replace(found, warnings=(*warnings, *found.warnings))
    if episode is not None:
        raise SettingsError(f"--episode {episode}: {path} is no LeRobot data set, but one episode")
    inside = sorted(one.name for one in path.iterdir()) if path.is_dir() else []
    bags = [path / name for name in inside if name.endswith(BAGS)]
    if path.name == TRAJECTORY or TRAJECTORY in inside:
        found = open_droid(path.parent if path.is_file() else path, log)
    elif path.suffix in BAGS or "metadata.yaml" in inside:
        found = open_bag(path, log)
    elif {"images", "videos"} & set(inside):
        found = open_folder(path, log)
    elif len(bags) == 1:
        found = open_bag(bags[0], log)
    else:
        what = ", ".join(inside[:_LISTED]) if path.is_dir() else "a file of another kind"
        raise SceneError(f"{path}: is no episode: {what or 'empty'}; {_EXPECTED}")
    return replace(found, warnings=(*warnings, *found.warnings))
