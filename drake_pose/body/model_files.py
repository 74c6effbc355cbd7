"""Lenient reading of XML model files, checks of their values, and search for named files."""

import math
import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from urllib.parse import unquote
from xml.parsers import expat

import numpy as np
from numpy.typing import ArrayLike
from pydrake.multibody.parsing import PackageMap

from drake_pose.body.plant_source import told_multiplier
from drake_pose.errors import ModelError, require_known, weighted

OLD_XACRO_ELEMENTS = ("macro", "include")
"""Elements directly in <robot> of old xacro files, which have no ``xacro:`` prefix."""

Warn = Callable[[str], None]
"""Receives a message about a part of a file that is not read or not enforced."""


def read_xml(path: Path) -> ElementTree.Element:
    """Return the root element of an XML file, without comments.

    The file is read as leniently as by tinyxml, which ROS, Drake and MuJoCo use: blank space may
    precede ``<?xml``, a comment may contain ``--``, a prefix is part of a name whether or not it is
    declared, an undeclared entity is plain text, and text that is not valid UTF-8 is read as
    Latin-1. External entities are refused.

    Raises ModelError: the file cannot be read or is not well-formed; the message names the file and
    the line.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path} cannot be read: {error.strerror}") from error
    text = _decoded(data)
    blank_lines = text[: len(text) - len(text.lstrip())].count("\n")
    text = _uncommented(text.lstrip())
    if "<!ENTITY" not in text:
        text = re.sub(r"&(?!(?:#\d+|#x[0-9a-fA-F]+|lt|gt|amp|quot|apos);)", "&amp;", text)
    try:
        return xml_element(text)
    except expat.ExpatError as error:
        place = f"line {error.lineno + blank_lines}, column {error.offset}"
        raise ModelError(
            f"{path} is not well-formed XML: {expat.ErrorString(error.code)}: {place}"
        ) from error


def xml_element(text: str) -> ElementTree.Element:
    """Return the root element of an XML text, without comments; prefixes are parts of names.

    Raises ExpatError: the text is not well-formed, or has an external entity.
    """
    builder = ElementTree.TreeBuilder()
    # Without a namespace separator, a prefix stays part of the name.
    parser = expat.ParserCreate("utf-8")
    parser.buffer_text = True
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    # Zero makes an external entity an error; expat's default ignores it silently.
    parser.ExternalEntityRefHandler = lambda *_: 0
    parser.Parse(text.encode("utf-8"), True)
    return builder.close()


def _decoded(data: bytes) -> str:
    """Return a file's text; text that is not valid UTF-8 is read as Latin-1."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("iso-8859-1")


def _uncommented(text: str) -> str:
    """Return an XML file's text without comments, on the same lines."""
    return re.sub(r"(?s)<!--.*?-->", lambda comment: "\n" * comment[0].count("\n"), text)


def xml_text(root: ElementTree.Element) -> str:
    """Return the text of an element tree from ``read_xml`` or ``xml_element``."""
    return ElementTree.tostring(root, encoding="unicode")


def number_text(values: ArrayLike) -> str:
    """Return numbers as attribute text without loss of precision."""
    return " ".join(repr(float(value)) for value in np.ravel(values))


def read_numbers(text: str | None, count: int, where: str) -> list[float]:
    """Return the ``count`` finite numbers in a text; ModelError, begun by ``where``, otherwise."""
    words = (text or "").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != count or not all(math.isfinite(number) for number in numbers):
        what = "a finite number" if count == 1 else f"{count} finite numbers"
        raise ModelError(f"{where} is '{text or ''}'; expected {what}")
    return numbers


def require_size(text: str | None, count: int, where: str, *, zero: bool = False) -> None:
    """Raise ModelError unless a text holds ``count`` positive numbers; ``zero`` allows zero.

    The message begins with ``where``.
    """
    for number in read_numbers(text, count, where):
        if number < 0.0 or (number == 0.0 and not zero):
            bound = "must not be negative" if zero else "must be above 0"
            raise ModelError(f"{where} is '{text}'; it {bound}")


def colour_text(text: str | None) -> str | None:
    """Return a text of 3 or 4 colour components, clamped to [0, 1]; None for an invalid colour."""
    count = 3 if len((text or "").split()) == 3 else 4
    try:
        return " ".join(f"{min(max(part, 0.0), 1.0):g}" for part in read_numbers(text, count, ""))
    except ModelError:
        return None


def require_scale(text: str, count: int, where: str) -> None:
    """Raise ModelError (it begins with ``where``) unless a text is ``count`` non-zero numbers."""
    if 0.0 in read_numbers(text, count, where):
        raise ModelError(f"{where} is '{text}'; no factor may be 0")


def read_limits(
    lower_text: str | None, upper_text: str | None, name: str
) -> tuple[float | None, float | None]:
    """Return a joint's lower and upper limit; None for a limit that is missing or infinite.

    ``lower_text``, ``upper_text``: the limits as the file has them; None: missing. ``name``: the
    joint's name, for messages. Raises ModelError: a limit is no number or NaN, or the lower one is
    above the upper one.
    """
    texts = (lower_text, upper_text)
    try:
        values = [None if text is None else float(text) for text in texts]
    except ValueError:
        given = ", ".join(f"'{text}'" for text in texts if text is not None)
        raise ModelError(f"joint '{name}': limits {given} are not numbers") from None
    if any(value is not None and math.isnan(value) for value in values):
        raise ModelError(f"joint '{name}': a limit is NaN; give numbers, lower first")
    lower, upper = values
    if lower is not None and upper is not None and lower > upper:
        raise ModelError(
            f"joint '{name}': lower limit {lower:g} is above upper limit {upper:g}; swap them"
        )
    finite = [None if value is None or math.isinf(value) else value for value in values]
    return finite[0], finite[1]


def leave_out(
    root: ElementTree.Element,
    read: Mapping[str, Collection[str]],
    known: Collection[str],
    warn: Warn,
) -> None:
    """Remove child elements that are not read; those with a namespace prefix stay.

    Args:
        root: the element whose descendants are filtered.
        read: names of the child elements to keep, by the name of their parent element; a parent
            that is not listed keeps all.
        known: names of child elements that are removed without a warning.
        warn: receives a message for each other removed element.
    """
    stack = [root]
    while stack:
        element = stack.pop()
        kept = read.get(element.tag)
        for child in list(element):
            if kept is None or child.tag in kept or ":" in child.tag:
                stack.append(child)
                continue
            element.remove(child)
            if child.tag not in known:
                name = f" '{element.get('name')}'" if element.get("name") else ""
                text = f"{element.tag}{name}: the element <{child.tag}> is unknown and left out"
                warn(weighted(text, "note"))


def open_loops(
    model: ElementTree.Element,
    joints: Sequence[ElementTree.Element],
    ends: Sequence[Sequence[str]],
    warn: Warn,
) -> None:
    """Remove the joints of a model that close a loop of links.

    Joints that are the first to name their child link are kept in preference to later ones.

    Args:
        model: the element that contains the joints; changed in place.
        joints: the elements of the joints.
        ends: the names of each joint's parent and child link.
        warn: receives a message for each removed joint.
    """
    # Keep the first joint that names a link as its child: Drake cannot invert every joint type.
    children = [child for _, child in ends]
    order = sorted(range(len(joints)), key=lambda i: children[i] in children[:i])
    parent_of: dict[str, str] = {}

    def find(link: str) -> str:
        """Return the representative of a link's connected component."""
        while link in parent_of:
            link = parent_of[link]
        return link

    for index in order:
        first, second = map(find, ends[index])
        if first != second:
            parent_of[second] = first
            continue
        model.remove(joints[index])
        warn(
            f"joint '{joints[index].get('name')}' closes a loop of links at '{children[index]}': "
            "not enforced, it is left out"
        )


FOLLOWING = ("revolute", "continuous", "prismatic")
"""The joint types that can follow another joint."""


def take_mimic(
    parent: ElementTree.Element, name: str, leaders: Collection[str], warn: Warn
) -> dict[str, str] | None:
    """Remove each <mimic> of a joint, and return the last one that Drake enforces.

    Args:
        parent: the element that contains <mimic>, with its values as attributes or elements.
        name: the joint's name.
        leaders: names of the joints that can be followed.
        warn: receives a message for a <mimic> that is not enforced.

    Returns the attributes joint, multiplier and offset of a <mimic>; None: none can be enforced.
    """
    found, defaults = None, {"multiplier": "1", "offset": "0", "reference": "0"}
    for mimic in parent.findall("mimic"):
        parent.remove(mimic)
        given = {key: mimic.get(key, mimic.findtext(key)) for key in defaults}
        multiplier, offset, reference = (
            read_numbers(given[key] or text, 1, f"joint '{name}': {key} of its <mimic>")[0]
            for key, text in defaults.items()
        )
        leader = mimic.get("joint", "")
        if leader in leaders and leader != name and multiplier:
            offset -= multiplier * reference
            text = repr(told_multiplier(multiplier))
            found = {"joint": leader, "multiplier": text, "offset": repr(offset)}
        else:
            warn(
                f"joint '{name}' is written to follow joint '{leader}' (<mimic>): not enforced, "
                "the joint is searched independently"
            )
    return found


def refuse_macros(root: ElementTree.Element, path: Path) -> None:
    """Raise ModelError for a file with unexpanded xacro macros; remove properties and arguments.

    Nothing is missing where a file only declares these. ``path``: the file, for the line.
    """
    for parent in list(root.iter()):
        for child in [one for one in parent if one.tag in ("xacro:property", "xacro:arg")]:
            parent.remove(child)
    macros = [f"<{child.tag}" for child in root if child.tag in OLD_XACRO_ELEMENTS]
    for element in root.iter():
        if element.tag.startswith("xacro:"):
            macros.append(f"<{element.tag}")
        for value in [*element.attrib.values(), element.text or ""]:
            if "${" in value or "$(" in value:
                macros.append(value.strip().partition("\n")[0][:60])
    if macros:
        lines = re.split("\n", _uncommented(_decoded(path.read_bytes())))
        line = next((k for k, one in enumerate(lines, 1) if macros[0] in one), None)
        what = f"{macros[0]}>" if macros[0].startswith("<") else f"'{macros[0]}'"
        raise ModelError(
            f"it has unexpanded xacro macros, such as {what}{f' in line {line}' if line else ''}: "
            "links and joints would be missing; expand it first: xacro robot.urdf.xacro > "
            "robot.urdf (PyPI: xacro)"
        )


def package_folder() -> Path:
    """Return the folder of bundled models in the wheel or checkout; ModelError if it is missing."""
    library = Path(__file__).resolve().parents[1]
    for folder in (library / "urdf", library.parent / "urdf"):
        if (folder / "package.xml").is_file():
            return folder
    raise ModelError(
        f"the bundled models are missing: expected {library / 'urdf' / 'package.xml'}; "
        "install drake_pose again"
    )


def package_map(package_paths: Mapping[str, Path | str] | None = None) -> PackageMap:
    """Return Drake's PackageMap with ``drake_pose`` and the given folders.

    ``package_paths``: folders by package name, which precede the package's own; None: none.
    ``drake_models`` is removed, so that nothing is downloaded. Raises ModelError: a folder does not
    exist.
    """
    packages = PackageMap()
    # Drake would download its own models.
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
    """Resolves the ``package://``, ``model://``, ``file://`` and plain file names in a model file.

    A package is searched for, in this order, among the given packages, the bundled one, the folders
    above the file that names it, and the folders of the search-path environment variables.

    ``package_paths``: folders by package name; None: none.

    Raises ModelError: a given package folder does not exist.
    """

    def __init__(self, package_paths: Mapping[str, Path | str] | None = None) -> None:
        self._known = package_map(package_paths)

    def resolve(self, name: str, file: Path, what: str) -> Path:
        """Return the absolute path of a file or folder that a model file names.

        ``name``: the URI or path, as the model file has it. ``file``: the model file; other names
        than URIs are relative to its folder. ``what``: what the name stands for, for messages.
        Raises ModelError: the package is unknown, or the file does not exist or is not local.
        """
        uri = re.fullmatch(r"(?s)(?P<scheme>[A-Za-z][\w+.-]*)://(?P<rest>.*)", name.strip())
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
                    f"of that name in or above {file.parent}, nor in ROS_PACKAGE_PATH; give "
                    f"--package {package}=FOLDER (in Python package_paths)"
                )
        else:
            raise ModelError(f"{what} '{name}' is not a local file; download it and give its path")
        for path in paths:
            if path.exists():
                return Path(os.path.abspath(path))
        raise ModelError(f"{what} '{name}': {os.path.abspath(paths[0])} does not exist")

    def _package_folders(self, name: str, file: Path) -> list[Path]:
        """Return the existing folders of the package ``name``, in order of precedence.

        ``file``: the model file that names the package; the folders above it are searched.
        """
        if self._known.Contains(name):
            return [Path(self._known.GetPath(name))]
        if not re.fullmatch(r"\w[\w.-]*", name):
            return []
        found = [place for parent in file.absolute().parents for place in _folders_at(parent, name)]
        for variable, inside in (
            ("ROS_PACKAGE_PATH", "."),
            ("AMENT_PREFIX_PATH", "share"),
            ("GZ_SIM_RESOURCE_PATH", "."),
            ("IGN_GAZEBO_RESOURCE_PATH", "."),
            ("GAZEBO_MODEL_PATH", "."),
            ("SDF_PATH", "."),
        ):
            for text in filter(None, os.environ.get(variable, "").split(os.pathsep)):
                found += _folders_at(Path(text) / inside, name)
        if not found:
            # Packages in repositories of a ROS workspace.
            packages = PackageMap.MakeEmpty()
            packages.PopulateFromRosPackagePath()
            known = [package for package in packages.GetPackageNames() if package.strip() == name]
            found = [Path(packages.GetPath(package)) for package in known]
        return found


def _folders_at(folder: Path, name: str) -> list[Path]:
    """Return a folder if it is the package ``name``, and its subfolder ``name`` if that exists."""
    names = [folder.name]
    with suppress(ModelError, OSError):
        if (folder / "package.xml").is_file():
            names.append((read_xml(folder / "package.xml").findtext("name") or "").strip())
    own = [folder] if name in names else []
    return [*own, folder / name] if (folder / name).is_dir() else own


def bundled_model(name: str) -> Path:
    """Return the file of a bundled model, for example "woman"; UnknownNameError lists all."""
    folder = package_folder()
    known = {path.parent.name: path for path in sorted(folder.glob("*/*.urdf"))}
    named = {key: folder / key / f"{key}.urdf" for key in known}
    require_known("bundled model", (name,), sorted(named), "drake_pose")
    return named[name] if named[name].is_file() else known[name]
