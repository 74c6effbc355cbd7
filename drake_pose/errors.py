"""Exceptions of drake_pose.

Every message names the file, link, joint, camera or frame at fault, says what was expected, and
what to do about it.
"""

from collections.abc import Iterable, Sequence


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
