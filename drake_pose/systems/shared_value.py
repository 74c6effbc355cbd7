"""State that copies of a Context share."""

from __future__ import annotations

from typing import Any

from pydrake.systems.framework import Context, LeafSystem

from drake_pose.errors import SettingsError


class SharedValue:
    """A value that nobody changes: Drake would copy abstract state twice in every update."""

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        return self


def require_time_forward(system: LeafSystem, context: Context, last: float) -> None:
    """Refuse (SettingsError) an update before the last one, whose filter knows the future."""
    now = context.get_time()
    if now < last:
        raise SettingsError(
            f"{system.get_name()}: time ran backwards, from {last:g} s to {now:g} s; to begin "
            "anew, set the context to its defaults (SetDefaultContext)"
        )
