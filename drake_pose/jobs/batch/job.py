"""The job file of `drake-pose batch`: which scenes are estimated, and how."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drake_pose.errors import SettingsError
from drake_pose.jobs.estimate.capture import bundled_person
from drake_pose.results.options import parse_root_position, parse_root_rotation
from drake_pose.results.settings import EstimateSettings
from drake_pose.results.summary import describe_job, file_digest
from drake_pose.yaml_files import read_yaml

CHUNK = 100
"""Frames in a chunk where nobody says."""

_TOP = ("chunk", "defaults", "scenes")
_OWN = ("scene", "model", "truth", "overlay", "replay", "audit", "camera_file")
# Settings of an estimate that an audit has, too.
_OF_AUDITS = ("cameras", "frames", "hold", "packages")


@dataclass(frozen=True)
class SceneJob:
    """One scene of a job.

    Args:
        name: of the result's folder.
        scene: the scene's folder.
        model: the body's model file; the bundled person where the job file names none.
        settings: of the estimate.
        truth: measured joint positions to compare with.
        overlay: whether overlays are written.
        replay: whether replay.html is made.
        chunk: frames in a chunk; the recording of a person who is followed is never cut, nor is
            one that is audited.
        audit: the table of joint positions that the scene is audited against; None: the scene is
            estimated.
        camera_file: for an audit, in place of the scene's cameras.yaml.
    """

    name: str
    scene: Path
    model: Path
    settings: EstimateSettings
    truth: Path | None = None
    overlay: bool = True
    replay: bool = True
    chunk: int = CHUNK
    audit: Path | None = None
    camera_file: Path | None = None

    def describe(self) -> dict[str, Any]:
        """Returns plain JSON values that tell whether a resumed job is still the same."""
        truth = None if self.truth is None else str(self.truth)
        described = describe_job(self.scene, self.model, self.settings)
        audited: dict[str, Any] = {}
        if self.audit is not None:
            files = {"audit": self.audit, "camera_file": self.camera_file}
            audited = {
                name: None if file is None else {"file": str(file), "sha256": file_digest(file)}
                for name, file in files.items()
            }
        return described | {"chunk": self.chunk, "truth": truth} | audited


def read_job(path: Path, chunk: int | None = None) -> tuple[SceneJob, ...]:
    """Reads a job file. Paths in it are relative to its folder.

    Args:
        path: the YAML file: ``scenes`` (name: settings), perhaps ``defaults`` for all of them, and
            ``chunk``.
        chunk: frames in a chunk, in place of the file's.

    Returns:
        The scenes, in the file's order.

    Raises:
        SettingsError: names the file, the scene and the setting at fault.
    """
    content = _mapping(read_yaml(path, SettingsError), str(path), _TOP)
    scenes = content.get("scenes")
    if not isinstance(scenes, dict) or not scenes:
        raise SettingsError(f"{path}: names no scenes; expected 'scenes:' with NAME: settings")
    length = content.get("chunk", CHUNK) if chunk is None else chunk
    _whole(length, f"{path}: chunk", path.parent)
    known = (*_OWN, *SETTINGS)
    defaults = content.get("defaults")
    defaults = {} if defaults is None else _mapping(defaults, f"{path}: defaults", known)
    jobs = []
    for name, entry in scenes.items():
        where = f"{path}: scene '{str(name)[:60]}'"
        if not isinstance(name, str) or not name or name[0] == "." or {"/", "\\"} & set(name):
            raise SettingsError(
                f"{where}: its name becomes a folder's: a text without slashes that does not "
                "begin with a dot; put numbers in quotes"
            )
        values = {**defaults, **({} if entry is None else _mapping(entry, where, known))}
        jobs.append(_scene_job(name, values, int(length), path.parent.absolute(), where))
    return tuple(jobs)


def _scene_job(
    name: str, values: Mapping[str, Any], chunk: int, base: Path, where: str
) -> SceneJob:
    if values.get("scene") is None:
        raise SettingsError(f"{where}: 'scene' is missing, the scene's folder")
    paths = {"model": bundled_person()} | {
        key: _path(values[key], f"{where}: {key}", base)
        for key in ("scene", "model", "truth", "audit", "camera_file")
        if values.get(key) is not None
    }
    overlay, replay = (
        _yes_or_no(values.get(key, True), f"{where}: {key}", base) for key in ("overlay", "replay")
    )
    settings = {
        key: SETTINGS[key](value, f"{where}: {key}", base)
        for key, value in values.items()
        if key in SETTINGS and value is not None
    }
    try:
        checked = EstimateSettings(**settings)
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from error
    _check_audit(paths, settings, where)
    return SceneJob(
        name, paths["scene"], paths["model"], checked, paths.get("truth"), overlay, replay, chunk,
        paths.get("audit"), paths.get("camera_file"),
    )  # fmt: skip


def _check_audit(paths: Mapping[str, Path], settings: Mapping[str, Any], where: str) -> None:
    """Refuses what an audit does not have, or has alone."""
    if "audit" not in paths:
        if "camera_file" in paths:
            raise SettingsError(f"{where}: camera_file is a setting of audits (audit: JOINTS.csv)")
        return
    others = [name for name in settings if name not in _OF_AUDITS]
    others += [name for name in ("truth",) if name in paths]
    if others:
        raise SettingsError(
            f"{where}: an audit has no setting {', '.join(others)}; it has: camera_file, overlay, "
            f"{', '.join(_OF_AUDITS)}"
        )


def _mapping(value: Any, where: str, known: tuple[str, ...] | None = None) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise SettingsError(f"{where}: expected NAME: VALUE lines")
    unknown = [] if known is None else [str(key)[:40] for key in value if key not in known]
    if unknown:
        raise SettingsError(
            f"{where}: there is no setting {', '.join(unknown)}; there is: {', '.join(known or ())}"
        )
    return value


def _text(value: Any, where: str, base: Path) -> str:
    if not isinstance(value, str):
        raise SettingsError(f"{where}: must be a text, not {value!r:.60}; put numbers in quotes")
    return value


def _texts(value: Any, where: str, base: Path) -> tuple[str, ...]:
    values = value if isinstance(value, list) else [value]
    return tuple(_text(one, where, base) for one in values)


def _number(value: Any, where: str, base: Path) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise SettingsError(f"{where}: must be a number, not {value!r:.60}")
    return float(value)


def _whole(value: Any, where: str, base: Path) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise SettingsError(f"{where}: must be a whole number, 1 or more, not {value!r:.60}")
    return value


def _yes_or_no(value: Any, where: str, base: Path) -> bool:
    if not isinstance(value, bool):
        raise SettingsError(f"{where}: must be true or false, not {value!r:.60}")
    return value


def _numbers(value: Any, where: str, base: Path) -> dict[str, float]:
    return {str(name): _number(one, where, base) for name, one in _mapping(value, where).items()}


def _path(value: Any, where: str, base: Path) -> Path:
    return base / _text(value, where, base)


def _packages(value: Any, where: str, base: Path) -> dict[str, Path]:
    return {
        str(name): _path(folder, f"{where}: {name}", base)
        for name, folder in _mapping(value, where).items()
    }


def _root_position(value: Any, where: str, base: Path) -> Any:
    if isinstance(value, list) and len(value) == 3:
        return tuple(_number(one, where, base) for one in value)
    parsed = _named(parse_root_position, _text(value, where, base), where)
    if isinstance(parsed, tuple) and isinstance(parsed[0], Path):
        return base / parsed[0], parsed[1]
    return parsed


def _root_rotation(value: Any, where: str, base: Path) -> Any:
    return _named(parse_root_rotation, _text(value, where, base), where)


def _named(parse: Callable[[str], Any], text: str, where: str) -> Any:
    try:
        return parse(text)
    except SettingsError as error:
        raise SettingsError(f"{where}: {error}") from None


SETTINGS: dict[str, Callable[[Any, str, Path], Any]] = {
    "cameras": _texts,
    "frames": _texts,
    "root": _text,
    "root_position": _root_position,
    "root_rotation": _root_rotation,
    "interval": _number,
    "length_interval": _number,
    "joint_intervals": _numbers,
    "outside_limit": _number,
    "candidates": _whole,
    "run_limit": _whole,
    "time_limit": _number,
    "hold": _numbers,
    "unseen": _texts,
    "method": _text,
    "angles": _text,
    "track": _yes_or_no,
    "packages": _packages,
    "start": _path,
}
"""How each setting of an estimate is read."""
