"""Where the bundled models are, and how ``package://drake_pose/...`` is found."""

from collections.abc import Mapping
from pathlib import Path

from pydrake.multibody.parsing import PackageMap

from drake_pose.errors import ModelError, UnknownNameError


def package_folder() -> Path:
    """The folder of bundled models: inside the wheel, or beside ``drake_pose`` in a checkout.

    Raises:
        ModelError: the installation holds no models.
    """
    library = Path(__file__).resolve().parents[1]
    for folder in (library / "urdf", library.parent / "urdf"):
        if (folder / "package.xml").is_file():
            return folder
    raise ModelError(
        f"the bundled models are missing: expected {library / 'urdf' / 'package.xml'}; "
        "install drake_pose again"
    )


def package_map(package_paths: Mapping[str, Path | str] | None = None) -> PackageMap:
    """Drake's PackageMap with the package ``drake_pose`` in it.

    Args:
        package_paths: further packages, name to folder.

    Raises:
        ModelError: a folder does not exist, or the bundled models are missing.
    """
    packages = PackageMap()
    packages.AddPackageXml(package_folder() / "package.xml")
    for name, folder in (package_paths or {}).items():
        if not Path(folder).is_dir():
            raise ModelError(f"package '{name}': folder {folder} does not exist")
        if packages.Contains(name):
            packages.Remove(name)
        packages.Add(name, Path(folder))
    return packages


def bundled_model(name: str) -> Path:
    """The file of a model that drake_pose ships, for example ``bundled_model("woman")``.

    Raises:
        UnknownNameError: no such model; the message lists those that exist.
    """
    folder = package_folder()
    known = {path.parent.name: path for path in sorted(folder.glob("*/*.urdf"))}
    named = {key: folder / key / f"{key}.urdf" for key in known}
    if name not in named:
        raise UnknownNameError("bundled model", name, sorted(named), "drake_pose")
    return named[name] if named[name].is_file() else known[name]
