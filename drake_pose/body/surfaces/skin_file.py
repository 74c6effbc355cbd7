"""The skin: bands of surface between two links that bend with the joints between them.

After Kameda, Minoh, Ikeda (section 2). A band is a closed mesh drawn at rest, all joints at zero;
each point follows the joints by its weight, from 0 at the parent's end to 1 at the child's.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drake_pose.arrays import Array
from drake_pose.body.surfaces.meshes import TriangleMesh, is_watertight, read_mesh_file
from drake_pose.errors import ModelError, UnknownNameError
from drake_pose.yaml_files import read_yaml

_FIELDS = ("parent", "child", "mesh", "axis", "begin", "end", "colour")
_COLOUR = (0.8, 0.8, 0.8)
# Weights that differ less do so by the rounding of the vertices alone.
_DIGITS = 6


@dataclass(frozen=True, eq=False)
class SkinBand:
    """A band of surface between two links; the parent is nearer to the world.

    Attributes:
        mesh: the closed band at rest (all joints at zero), in the child's frame.
        weights: (n,) float64 read-only in 0..1: 0 stays with the parent, 1 goes with the child.
        colour: (r, g, b) in 0..1.
    """

    parent: str
    child: str
    mesh: TriangleMesh
    weights: Array
    colour: tuple[float, float, float] = _COLOUR

    def __post_init__(self) -> None:
        """Make a private read-only copy of the weights, rounded."""
        weights = np.asarray(self.weights, dtype=np.float64).round(_DIGITS)
        weights.setflags(write=False)
        object.__setattr__(self, "weights", weights)


def skin_file(model_path: Path) -> Path:
    """Where a model's skin is declared: ``woman.skin.yaml`` beside ``woman.urdf``."""
    return model_path.with_suffix(".skin.yaml")


def load_skin(model_path: Path, link_names: Sequence[str]) -> tuple[SkinBand, ...]:
    """Read the skin declared beside a model file; none where there is no such file.

    Each entry of ``bands`` has ``parent`` and ``child``, names of links; ``mesh``, a closed mesh in
    the child's frame at rest, its path relative to the file; ``axis`` (3 numbers, in the child's
    frame), ``begin`` and ``end`` [m]: along the axis, measured from the child's origin, a vertex's
    weight rises smoothly from 0 at ``begin`` to 1 at ``end``; and ``colour`` (r, g, b; optional).

    Raises:
        ModelError: the file or a mesh cannot be used.
        UnknownNameError: a band names a link that does not exist.
    """
    path = skin_file(model_path)
    if not path.is_file():
        return ()
    content = read_yaml(path, ModelError)
    entries = content.get("bands") if isinstance(content, dict) and len(content) == 1 else None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ModelError(f"{path}: not a skin file (a list 'bands')")
    if not entries:
        raise ModelError(f"{path}: declares no band; add one under 'bands' or remove the file")
    bands = [_make_band(path, entry, link_names) for entry in entries]
    pairs = [(band.parent, band.child) for band in bands]
    for parent, child in pairs:
        if pairs.count((parent, child)) > 1:
            raise ModelError(f"{path}: two bands between '{parent}' and '{child}'; join them")
    return tuple(bands)


def _make_band(path: Path, entry: dict[str, Any], link_names: Sequence[str]) -> SkinBand:
    """One band, after checks."""
    given = {"parent": "", "child": "", "mesh": "", "colour": _COLOUR, "begin": 0.0, "end": 0.0}
    given |= {"axis": (), **entry}
    parent, child, mesh_name = (str(given[name]) for name in ("parent", "child", "mesh"))
    where = f"{path}: band '{parent}' - '{child}'"
    unknown = [str(name)[:40] for name in entry if name not in _FIELDS]
    if unknown:
        raise ModelError(f"{where}: unknown field {unknown[0]}; a band has {', '.join(_FIELDS)}")
    for link in (parent, child):
        if link not in link_names:
            raise UnknownNameError("link", link, link_names, str(path))
    if parent == child:
        raise ModelError(f"{where}: parent and child must be two links")
    axis, colour = _numbers(given["axis"]), _numbers(given["colour"])
    if axis.shape != (3,) or not axis.any():
        raise ModelError(f"{where}: axis must be three finite numbers, not all zero")
    reach = _numbers([given["begin"], given["end"]])
    if len(reach) != 2 or not reach[0] < reach[1]:
        raise ModelError(f"{where}: give begin and end along the axis [m], begin below end")
    if colour.shape != (3,) or not np.all((colour >= 0.0) & (colour <= 1.0)):
        raise ModelError(f"{where}: colour must be three numbers from 0 to 1")
    if not mesh_name:
        raise ModelError(f"{where}: name its mesh")
    mesh = read_mesh_file(path.parent / mesh_name)
    if not is_watertight(mesh):
        raise ModelError(f"{where}: {mesh_name} is not closed; close the band's ends")
    along = mesh.vertices @ (axis / np.linalg.norm(axis))
    share = np.clip((along - reach[0]) / (reach[1] - reach[0]), 0.0, 1.0)
    red, green, blue = colour.tolist()
    return SkinBand(parent, child, mesh, share**2 * (3.0 - 2.0 * share), (red, green, blue))


def _numbers(value: Any) -> Array:
    """Finite numbers as an array; an empty one for anything else."""
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return np.zeros(0)
    return numbers if np.all(np.isfinite(numbers)) else np.zeros(0)
