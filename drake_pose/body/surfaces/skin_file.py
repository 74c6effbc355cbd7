"""The skin: bands of surface between two links that bend with the joints between them.

After Kameda, Minoh, Ikeda (section 2). A band is a closed mesh drawn at rest, all joints at zero;
each point follows the joints by its weight, from 0 at the parent's end to 1 at the child's.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.common.yaml import yaml_load_typed

from drake_pose.body.surfaces.mesh import TriangleMesh, is_watertight
from drake_pose.body.surfaces.mesh_files import read_mesh_file
from drake_pose.errors import ModelError, UnknownNameError

_LARGEST_FILE = 1 << 20
_COLOUR = (0.8, 0.8, 0.8)


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
    weights: NDArray[np.float64]
    colour: tuple[float, float, float] = _COLOUR

    def __post_init__(self) -> None:
        """Make a private read-only copy of the weights."""
        weights = np.array(self.weights, dtype=np.float64)
        weights.setflags(write=False)
        object.__setattr__(self, "weights", weights)


@dataclass
class _BandEntry:
    """A band as a skin file writes it; lists, because Drake's reader knows no tuples."""

    parent: str = ""
    child: str = ""
    mesh: str = ""
    axis: list[float] = field(default_factory=list)
    begin: float = 0.0
    end: float = 0.0
    colour: list[float] = field(default_factory=lambda: list(_COLOUR))


@dataclass
class _SkinFile:
    bands: list[_BandEntry] = field(default_factory=list)


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
    bands = [_make_band(path, entry, link_names) for entry in _read_file(path).bands]
    pairs = [(band.parent, band.child) for band in bands]
    for parent, child in pairs:
        if pairs.count((parent, child)) > 1:
            raise ModelError(f"{path}: two bands between '{parent}' and '{child}'; join them")
    return tuple(bands)


def _read_file(path: Path) -> _SkinFile:
    """The file's entries as they are written."""
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise ModelError(f"{path}: larger than {_LARGEST_FILE} bytes, which is not expected")
        text = path.read_text(encoding="utf-8")
        content = yaml_load_typed(schema=_SkinFile, data=text)
    except OSError as error:
        raise ModelError(f"{path}: cannot read it: {error.strerror}") from error
    except _reader_errors() as error:
        reason = " ".join(str(error).split())
        raise ModelError(f"{path}: not a skin file (a list 'bands'): {reason}") from error
    if not isinstance(content, _SkinFile) or not content.bands:
        raise ModelError(f"{path}: declares no band; add one under 'bands' or remove the file")
    return content


def _reader_errors() -> tuple[type[Exception], ...]:
    """What Drake's YAML reader raises for broken files."""
    from yaml import YAMLError

    return (
        YAMLError,
        AssertionError,
        AttributeError,
        RecursionError,
        RuntimeError,
        TypeError,
        ValueError,
    )


def _make_band(path: Path, entry: _BandEntry, link_names: Sequence[str]) -> SkinBand:
    """One band, after checks."""
    where = f"{path}: band '{entry.parent}' - '{entry.child}'"
    for link in (entry.parent, entry.child):
        if link not in link_names:
            raise UnknownNameError("link", link, link_names, str(path))
    if entry.parent == entry.child:
        raise ModelError(f"{where}: parent and child must be two links")
    axis = np.array(entry.axis, dtype=np.float64)
    if axis.shape != (3,) or not np.all(np.isfinite(axis)) or not axis.any():
        raise ModelError(f"{where}: axis must be three finite numbers, not all zero")
    if not (np.isfinite([entry.begin, entry.end]).all() and entry.begin < entry.end):
        raise ModelError(f"{where}: give begin and end along the axis [m], begin below end")
    colour = np.array(entry.colour, dtype=np.float64)
    if colour.shape != (3,) or not np.all((colour >= 0.0) & (colour <= 1.0)):
        raise ModelError(f"{where}: colour must be three numbers from 0 to 1")
    if not entry.mesh:
        raise ModelError(f"{where}: name its mesh")
    mesh = read_mesh_file(path.parent / entry.mesh)
    if not is_watertight(mesh):
        raise ModelError(f"{where}: {entry.mesh} is not closed; close the band's ends")
    along = mesh.vertices @ (axis / np.linalg.norm(axis))
    share = np.clip((along - entry.begin) / (entry.end - entry.begin), 0.0, 1.0)
    weights = share**2 * (3.0 - 2.0 * share)
    red, green, blue = colour.tolist()
    return SkinBand(entry.parent, entry.child, mesh, weights, (red, green, blue))
