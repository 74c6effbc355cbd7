"""Cameras in Drake's own YAML: a CameraConfig, a mapping of some, or a Scenario's ``cameras``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml
from pydrake.common.yaml import yaml_dump, yaml_dump_typed, yaml_load, yaml_load_typed
from pydrake.systems.sensors import CameraConfig

from drake_pose.camera.drake import camera_from_config, camera_to_config
from drake_pose.camera.models import Camera, PinholeCamera
from drake_pose.errors import CameraError

# What yaml_load_typed raises, and some values of CameraConfig end a process that does not ask.
_BAD_CONFIG = (RuntimeError, ValueError, TypeError, KeyError, AttributeError, SystemExit)


def read_configs(entries: Mapping[str, Any], path: Path) -> dict[str, PinholeCamera]:
    """Returns the cameras of CameraConfig entries as ``read_yaml`` gives them with their tags.

    Args:
        entries: by a name, which is the camera's unless its ``name`` says another.
        path: the file, for messages.

    Raises:
        CameraError: names the file, the camera and what is wrong.
    """
    cameras: dict[str, PinholeCamera] = {}
    for key, entry in entries.items():
        where = f"{path}: camera '{key}'"
        content = {} if entry is None else entry
        if not isinstance(content, dict):
            raise CameraError(f"{where}: expected the fields of a CameraConfig")
        try:
            config = yaml_load_typed(schema=CameraConfig, data=yaml_dump(content))
        except (*_BAD_CONFIG, yaml.YAMLError) as error:
            raise CameraError(
                f"{where}: no CameraConfig: {' '.join(str(error).split())}"
            ) from error
        if "name" not in content:
            config.name = str(key)
        try:
            camera = camera_from_config(config)
        except CameraError as error:
            raise CameraError(f"{path}: {error}") from error
        if camera.name in cameras:
            raise CameraError(f"{path}: camera '{camera.name}' is given twice")
        cameras[camera.name] = camera
    return cameras


def dump_scenario(cameras: Mapping[str, Camera] | Iterable[Camera]) -> str:
    """The text of a Scenario with these cameras, which Drake's ``LoadScenario`` and we read.

    Label images are on, which an estimator needs, and Drake's default is that they are not.

    Raises:
        CameraError: a parallel camera, or one whose principal point lies outside its picture.
    """
    listed = cameras.values() if isinstance(cameras, Mapping) else cameras
    content = {}
    for camera in listed:
        config = camera_to_config(camera)
        content[camera.name] = yaml_load(
            data=yaml_dump_typed(config, schema=CameraConfig, defaults=CameraConfig())
        )
    return str(yaml_dump({"cameras": content}))


def save_scenario(path: str | Path, cameras: Mapping[str, Camera] | Iterable[Camera]) -> None:
    """Writes the ``cameras`` of a Drake Scenario, which ``load_cameras`` reads, too.

    Raises:
        CameraError: as ``dump_scenario``; and when the file cannot be written.
    """
    text = dump_scenario(cameras)
    try:
        Path(path).write_text(text, encoding="utf-8")
    except OSError as error:
        raise CameraError(f"{path}: cannot write the cameras: {error.strerror}") from error
