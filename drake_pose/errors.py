"""Exceptions of drake_pose, and helpers for their messages.

A message names the file, link, joint, camera or frame at fault, what was expected, and what to do.
"""

import math
import re
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar


class DrakePoseError(Exception):
    """Base class of all errors that drake_pose raises deliberately."""


class ModelError(DrakePoseError):
    """A model file is unusable: unreadable, without visual geometry, without limits, ..."""


class CameraError(DrakePoseError):
    """A camera file or a camera parameter is invalid."""


class MaskError(DrakePoseError):
    """A mask is unusable: unreadable, of the wrong size, empty, full, or not binary."""


class SceneError(DrakePoseError):
    """A scene folder or a recorded episode is unusable."""


class SettingsError(DrakePoseError):
    """A setting is out of its range."""


class OutputError(DrakePoseError):
    """A result cannot be written to the requested place."""


class RegistrationError(DrakePoseError):
    """No camera pose explains the silhouettes and joint positions."""


class ClusterError(DrakePoseError):
    """Worker processes cannot be started or reached, or are unfit for the task."""


class Weighted(str):
    """A warning with a weight, see `weighted`."""

    weight = "check"


def weighted(warning: str, weight: str) -> str:
    """Return a warning with a weight.

    ``weight``: "wrong" if the answer is likely wrong; "check", as that of a plain str; or "note" if
    it changes no answer.
    """
    text = Weighted(warning)
    text.weight = weight
    return text


def weight_of(warning: str) -> str:
    """Return the weight of a warning."""
    return warning.weight if isinstance(warning, Weighted) else "check"


@contextmanager
def noted_warnings() -> Iterator[list[str]]:
    """Add warnings as notes to an error that is raised in this context.

    What was assumed of the input is often why it is refused. Yields the list to which the context
    appends its warnings.
    """
    noted = list[str]()
    try:
        yield noted
    except DrakePoseError as error:
        for text in dict.fromkeys(noted):
            error.add_note(f"warning: {text}")
        raise


class UnknownNameError(DrakePoseError):
    """A link, joint, camera or frame of that name does not exist.

    Args:
        kind: kind of the name, for example ``"link"``.
        name: the name that does not exist.
        known: the existing names.
        where: where the name was looked up, for example a file's path.
    """

    def __init__(self, kind: str, name: str, known: Iterable[str], where: str) -> None:
        self.kind = kind
        self.name = name
        self.known = tuple(known)
        listing = ", ".join(self.known) if self.known else "(none)"
        super().__init__(f"{where} has no {kind} '{name}'; it has: {listing}")


def require_known(kind: str, names: Iterable[str], known: Collection[str], where: str) -> None:
    """Raise UnknownNameError for the first of ``names`` that is not in ``known``."""
    for name in names:
        if name not in known:
            raise UnknownNameError(kind, name, known, where)


def require_positive(**values: float | None) -> None:
    """Raise SettingsError, which names it, if a value is not positive and finite; None passes."""
    for name, value in values.items():
        if value is not None and not 0.0 < value < math.inf:
            raise SettingsError(f"{name} must be positive, not {value}")


def require_at_least(least: float, **values: float | None) -> None:
    """Raise SettingsError, which names it, if a value is below ``least``; None passes."""
    for name, value in values.items():
        if value is not None and not value >= least:
            raise SettingsError(f"{name} must be {least:g} or more, not {value}")


def require_choice(name: str, value: str, choices: Sequence[str]) -> None:
    """Raise SettingsError, which names it, unless a value is one of the choices."""
    if value not in choices:
        raise SettingsError(f"{name} must be one of {', '.join(choices)}, not '{value}'")


def listed(names: Sequence[str], most: int = 5) -> str:
    """Return the first ``most`` names joined by commas, and the number of further ones, if any."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


# Who reads messages: "python", "command line" or "job file".
_caller: ContextVar[str] = ContextVar("caller", default="python")


@contextmanager
def messages_for(caller: str) -> Iterator[None]:
    """Write messages for "command line" or "job file": with its options' or its keys' names."""
    token = _caller.set(caller)
    try:
        yield
    finally:
        _caller.reset(token)


def for_caller(text: str) -> str:
    """Replace option names in a message by Python argument names, unless the command line runs.

    ``--joints FILE`` becomes ``joints=FILE``, ``--camera`` becomes ``cameras``. While a batch's
    tasks run, they become keys of the job file: ``audit: FILE``, ``cameras``. Quoted commands
    (``drake-pose ...``) stay unchanged.
    """
    if _caller.get() == "command line":
        return text
    names = {"camera": "cameras", "frame": "frames", "class": "classes", "export": "exports"}
    names |= {"package": "packages", "no-track": "track=False"}
    in_job = _caller.get() == "job file"
    if in_job:
        names |= {"cameras": "camera_file", "joints": "audit", "no-track": "track: false"}

    def argument(found: re.Match[str]) -> str:
        if found["command"] or (in_job and found["name"] in ("out", "workers", "resume")):
            return found[0]
        name = names.get(found["name"], found["name"].replace("-", "_"))
        value = found["value"]
        if value is None:
            return name
        key, equals, what = value.partition("=")
        if in_job:
            return f"{name}: {{{key}: {what}}}" if equals else f"{name}: {value}"
        if equals:
            return f"{name}={{'{key}': {what}}}"
        return f"{name}='{value}'" if value == value.lower() else f"{name}={value}"

    command = r"(?P<command>drake-pose [a-z]+[^;,()]*)"
    # A value is in capitals, such as FILE or NAME=VALUE, or the word all.
    value = r"[\w.-]+=[A-Z]+\b|[A-Z]{2,}\b|N\b|all\b"
    option = rf"--(?P<name>[a-z][a-z-]*)(?: (?P<value>{value}))?"
    return re.sub(f"{command}|{option}", argument, text)
