"""Exceptions of drake_pose.

Every message names the file, link, joint, camera or frame at fault, says what was expected, and
what to do about it.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar


class DrakePoseError(Exception):
    """Base of all errors that drake_pose raises on purpose."""


class ModelError(DrakePoseError):
    """A model file cannot be used: unreadable, without visual geometry, without limits, ..."""


class CameraError(DrakePoseError):
    """A camera file or a camera's parameters cannot be used."""


class MaskError(DrakePoseError):
    """A mask cannot be used: unreadable, wrong size, empty, full, or not two-valued."""


class SceneError(DrakePoseError):
    """A scene folder, or a recorded episode, cannot be used."""


class SettingsError(DrakePoseError):
    """A setting is out of its range."""


class OutputError(DrakePoseError):
    """A result cannot be written where it was asked for."""


class RegistrationError(DrakePoseError):
    """Silhouettes and joint positions that no pose of a camera explains."""


class ClusterError(DrakePoseError):
    """Workers cannot be started or reached, or are not fit for the work."""


class UnknownNameError(DrakePoseError):
    """A link, joint, camera or frame of that name does not exist.

    Args:
        kind: what was looked up, for example ``"link"``.
        name: the name that was asked for.
        known: the names that exist.
        where: where it was looked up, for example a file's path.
    """

    def __init__(self, kind: str, name: str, known: Iterable[str], where: str) -> None:
        self.kind = kind
        self.name = name
        self.known = tuple(known)
        listing = ", ".join(self.known) if self.known else "(none)"
        super().__init__(f"{where} has no {kind} '{name}'; it has: {listing}")


def listed(names: Sequence[str], most: int = 5) -> str:
    """Names as a message has them: of many the first, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


_typed: ContextVar[bool] = ContextVar("typed", default=False)


@contextmanager
def options_in_messages() -> Iterator[None]:
    """While the command line runs: messages name its options."""
    token = _typed.set(True)
    try:
        yield
    finally:
        _typed.reset(token)


def for_caller(text: str) -> str:
    """A message that names options as they are typed, or for a Python call its arguments.

    ``--joints FILE`` becomes ``joints=FILE``, ``--camera`` ``cameras``; commands stay as they are.
    """
    if _typed.get():
        return text
    names = {"camera": "cameras", "frame": "frames", "class": "classes", "export": "exports"}
    names |= {"package": "packages", "no-track": "track=False"}

    def argument(found: re.Match[str]) -> str:
        if found["command"]:
            return found[0]
        name = names.get(found["name"], found["name"].replace("-", "_"))
        value = found["value"]
        if value is None:
            return name
        key, equals, what = value.partition("=")
        if equals:
            return f"{name}={{'{key}': {what}}}"
        return f"{name}='{value}'" if value == value.lower() else f"{name}={value}"

    command = r"(?P<command>drake-pose [a-z]+[^;,()]*)"
    # A value is in capitals, such as FILE or NAME=VALUE, or the word all.
    value = r"[\w.-]+=[A-Z]+\b|[A-Z]{2,}\b|N\b|all\b"
    option = rf"--(?P<name>[a-z][a-z-]*)(?: (?P<value>{value}))?"
    return re.sub(f"{command}|{option}", argument, text)
