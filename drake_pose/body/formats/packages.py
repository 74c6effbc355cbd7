"""Where the bundled models are, and how ``package://...`` and other file names are resolved."""

import itertools
import os
import re
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from urllib.parse import unquote

from pydrake.multibody.parsing import PackageMap

from drake_pose.body.formats.xml_files import read_xml
from drake_pose.errors import ModelError, UnknownNameError

_URI = re.compile(r"(?P<scheme>[A-Za-z][\w+.-]*)://(?P<rest>.*)", re.DOTALL)
_PACKAGE_NAME = re.compile(r"\w[\w.-]*")
# Folders of packages, and where in each of them packages lie.
_SEARCH_PATHS = (
    ("ROS_PACKAGE_PATH", "."),
    ("AMENT_PREFIX_PATH", "share"),
    ("GZ_SIM_RESOURCE_PATH", "."),
    ("IGN_GAZEBO_RESOURCE_PATH", "."),
    ("GAZEBO_MODEL_PATH", "."),
    ("SDF_PATH", "."),
)
# A workspace's source folder has less; in others nobody keeps repositories.
_MOST_REPOSITORIES = 1000


def package_folder() -> Path:
    """The folder of bundled models, in the wheel or checkout; ModelError where there is none."""
    library = Path(__file__).resolve().parents[2]
    for folder in (library / "urdf", library.parent / "urdf"):
        if (folder / "package.xml").is_file():
            return folder
    raise ModelError(
        f"the bundled models are missing: expected {library / 'urdf' / 'package.xml'}; "
        "install drake_pose again"
    )


def package_map(package_paths: Mapping[str, Path | str] | None = None) -> PackageMap:
    """Drake's PackageMap with ``drake_pose`` and further folders by name, and nothing to download.

    Raises ModelError where a folder or the bundled models do not exist.
    """
    packages = PackageMap()
    # Drake would fetch its own models from the net, and wait for it.
    packages.Remove("drake_models")
    packages.AddPackageXml(package_folder() / "package.xml")
    for name, folder in (package_paths or {}).items():
        if not Path(folder).is_dir():
            raise ModelError(f"package '{name}': folder {folder} does not exist")
        if packages.Contains(name):
            packages.Remove(name)
        packages.Add(name, Path(folder).absolute())
    return packages


class FileFinder:
    """The files that a model's ``package://``, ``model://``, ``file://`` and plain names mean.

    A package is, in this order, one that is given, a bundled one, a folder on the way up from the
    file that names it, or a folder of the environment's search paths. Raises ModelError where a
    folder does not exist.
    """

    def __init__(self, package_paths: Mapping[str, Path | str] | None = None) -> None:
        self._known = package_map(package_paths)

    def resolve(self, name: str, file: Path, what: str) -> Path:
        """The absolute path of a file or folder that a model file names; ``what`` is for messages.

        Raises ModelError: the package is unknown, the file does not exist, or it is not local.
        """
        uri = _URI.fullmatch(name.strip())
        if uri is None:
            paths = [file.parent / name.strip()]
        elif uri["scheme"] == "file":
            paths = [Path(uri["rest"]), Path(unquote(uri["rest"]))]
        elif uri["scheme"] in ("package", "model"):
            package, _, inside = uri["rest"].lstrip("/").partition("/")
            folders = self._package_folders(package, file)
            paths = [folder / part for folder in folders for part in (inside, unquote(inside))]
            if not paths:
                raise ModelError(
                    f"{what} '{name}': package '{package}' is not known: no package.xml or folder "
                    f"of that name on the way up from {file.parent}, nor in ROS_PACKAGE_PATH; give "
                    f"--package {package}=FOLDER (in Python package_paths)"
                )
        else:
            raise ModelError(f"{what} '{name}' is not a file; fetch it and name it by its path")
        for path in paths:
            if path.exists():
                return Path(os.path.abspath(path))
        raise ModelError(f"{what} '{name}': {os.path.abspath(paths[0])} does not exist")

    def _package_folders(self, name: str, file: Path) -> list[Path]:
        """Where a package may lie, the likeliest place first; one alone where it is known."""
        if self._known.Contains(name):
            return [Path(self._known.GetPath(name))]
        if not _PACKAGE_NAME.fullmatch(name):
            return []
        found = [place for parent in file.absolute().parents for place in _folders_at(parent, name)]
        for variable, inside in _SEARCH_PATHS:
            for text in filter(None, os.environ.get(variable, "").split(os.pathsep)):
                folder = Path(text) / inside
                found += _folders_at(folder, name)
                if not (folder / name).is_dir():
                    found += [one / name for one in _folders_in(folder) if (one / name).is_dir()]
        return found


def _folders_at(folder: Path, name: str) -> list[Path]:
    """A folder where it is the package, and the one of the package's name in it."""
    names = [folder.name]
    with suppress(ModelError, OSError):
        if (folder / "package.xml").is_file():
            names.append((read_xml(folder / "package.xml").findtext("name") or "").strip())
    own = [folder] if name in names else []
    return [*own, folder / name] if (folder / name).is_dir() else own


def _folders_in(folder: Path) -> list[Path]:
    """The folders in a folder; at most as many as a workspace has repositories."""
    with suppress(OSError), os.scandir(folder) as entries:
        few = list(itertools.islice(entries, _MOST_REPOSITORIES))
        return sorted(Path(entry.path) for entry in few if entry.is_dir())
    return []


def bundled_model(name: str) -> Path:
    """The file of a model that drake_pose ships, such as "woman"; UnknownNameError lists them."""
    folder = package_folder()
    known = {path.parent.name: path for path in sorted(folder.glob("*/*.urdf"))}
    named = {key: folder / key / f"{key}.urdf" for key in known}
    if name not in named:
        raise UnknownNameError("bundled model", name, sorted(named), "drake_pose")
    return named[name] if named[name].is_file() else known[name]
