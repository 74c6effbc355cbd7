"""Slides without limits: where an object stands in the world, or a fault of the model."""

from collections.abc import Mapping, Sequence

import numpy as np

from drake_pose.body.parsed_model import ParsedModel
from drake_pose.errors import ModelError


def placing_slides(
    model: ParsedModel, objects: Sequence[Sequence[int]], held: Mapping[int, float]
) -> dict[int, float]:
    """Slides without limits between the world and its only object, with their default values.

    They say where the object stands, as the position of a floating joint does (planar robots in
    MJCF have two of them): they are not searched, and root_position moves the object.

    ``objects`` are the positions between the world and each object that hangs on it.

    Raises:
        ModelError: several objects stand on such slides, so where they are to each other is open.
    """
    placing = {
        position: float(model.default_positions[position])
        for positions in objects
        for position in _unlimited(model, positions)
    }
    free = [position for position in placing if position not in held]
    if len(objects) > 1 and free:
        raise ModelError(
            f"{_faults(model, free)}; of {len(objects)} objects in the world none can be left "
            "where it stands"
        )
    return placing


def refuse_unlimited_slides(
    model: ParsedModel, positions: Sequence[int], held: Mapping[int, float]
) -> None:
    """Raise ModelError where a position that is searched is a slide without limits."""
    free = [position for position in _unlimited(model, positions) if position not in held]
    if free:
        raise ModelError(_faults(model, free))


def _unlimited(model: ParsedModel, positions: Sequence[int]) -> list[int]:
    """Those that are lengths without a lower or without an upper limit."""
    limited = np.isfinite(model.lower) & np.isfinite(model.upper)
    return [i for i in positions if model.position_kinds[i] == "length" and not limited[i]]


def _faults(model: ParsedModel, positions: Sequence[int]) -> str:
    """Which joints lack limits, and what to do."""
    names = [model.position_names[position] for position in positions]
    many = len(names) > 1
    return (
        f"{model.path}: joint{'s' if many else ''} {', '.join(repr(name) for name in names)} "
        f"ha{'ve' if many else 's'} no limits, or limits too wide to be searched; give a lower and "
        f"an upper limit [m] in the model file (or to load_model: limits={{'{names[0]}': (low, "
        f"high)}}), so that values can be searched, or hold it (--hold {names[0]}=VALUE)"
    )
