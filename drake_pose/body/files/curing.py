"""A model file, and every file that it names in turn, in the form that Drake reads rightly."""

import re
import tempfile
from collections.abc import Mapping
from pathlib import Path

from drake_pose.body.files.directives import cure_directives
from drake_pose.body.files.mjcf import cure_mjcf
from drake_pose.body.files.packages import FileFinder
from drake_pose.body.files.sdf import Limits, cure_sdf
from drake_pose.body.files.urdf import cure_urdf
from drake_pose.body.surfaces.mesh_files import workspace
from drake_pose.errors import ModelError

# What Drake's parser calls each kind of file.
_KINDS = {
    ".urdf": "urdf",
    ".sdf": "sdf",
    ".xml": "xml",
    ".mjcf": "xml",
    ".yaml": "dmd.yaml",
    ".yml": "dmd.yaml",
}
_MAXIMUM_DEPTH = 20


class Curing:
    """One reading of a model file.

    Args:
        package_paths: packages, name to folder.

    Attributes:
        warnings: what is not read, or not enforced, each once.
        limits: limits (lower, upper) [rad] by position name that Drake's parser passes over.

    Raises:
        ModelError: a folder does not exist.
    """

    def __init__(self, package_paths: Mapping[str, Path | str]) -> None:
        self.warnings: list[str] = []
        self.limits: Limits = {}
        self._finder = FileFinder(package_paths)
        self._stand_ins: dict[Path, Path] = {}
        self._under_way: list[Path] = []

    def cure(self, path: Path) -> tuple[str, str]:
        """The text that is parsed in place of a file, and the kind of it.

        Raises:
            ModelError: the file cannot be used; the message names the file.
        """
        kind = _KINDS.get(path.suffix.lower())
        if kind is None:
            raise ModelError(_explain_kind(path))
        if path in self._under_way or len(self._under_way) > _MAXIMUM_DEPTH:
            raise ModelError(f"{path} includes itself")
        self._under_way.append(path)
        outermost = len(self._under_way) == 1
        try:
            return self._cure(path, kind, outermost), kind
        except ModelError as error:
            text = str(error)
            raise ModelError(text if str(path) in text else f"{path}: {text}") from error
        finally:
            self._under_way.pop()

    def name_originals(self, text: str, where: str) -> str:
        """A message of Drake's with the files' own names; ``where`` is the main file's."""
        for path, stand_in in self._stand_ins.items():
            text = re.sub(re.escape(str(stand_in)) + r"(:\d+)?", str(path).replace("\\", "/"), text)
        # Lines are those of the cured text, which help nobody.
        return re.sub(
            r"<(literal|data)-string>(\.[\w.]+\w)?(:\d+)?", where.replace("\\", "/"), text
        )

    def _cure(self, path: Path, kind: str, outermost: bool) -> str:
        if kind == "urdf":
            return cure_urdf(path, self._finder, self._warn)
        if kind == "xml":
            return cure_mjcf(path)
        if kind == "sdf":
            text, limits = cure_sdf(path, self._finder, self._warn, self._stand_in)
            if outermost:
                self.limits = limits
            return text
        return cure_directives(path, self._finder, self._stand_in)

    def _stand_in(self, path: Path) -> Path:
        """A file with the cured text of another one."""
        path = path.resolve()
        if path not in self._stand_ins:
            text, kind = self.cure(path)
            folder = Path(tempfile.mkdtemp(prefix="model_", dir=workspace()))
            stand_in = folder / f"{path.name.partition('.')[0]}.{kind}"
            stand_in.write_text(text, encoding="utf-8")
            self._stand_ins[path] = stand_in
        return self._stand_ins[path]

    def _warn(self, text: str) -> None:
        if text not in self.warnings:
            self.warnings.append(text)


def _explain_kind(path: Path) -> str:
    if path.suffix.lower() == ".xacro":
        what = f"expand it first: xacro {path.name} > {path.stem} (PyPI: xacro)"
    else:
        what = "use .urdf, .sdf, .xml (MJCF) or .dmd.yaml"
    return (
        f"model file {path}: '{path.suffix}' is not a kind of file that Drake's Parser reads; "
        f"{what}"
    )
