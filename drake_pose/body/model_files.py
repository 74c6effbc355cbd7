"""XML model files: read as leniently as robots' own programs do, checked before Drake sees them."""

import math
import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from urllib.parse import unquote
from xml.parsers import expat

from pydrake.multibody.parsing import PackageMap

from drake_pose.errors import ModelError, UnknownNameError

OLD_XACRO_ELEMENTS = ("macro", "include")
"""Of xacro before it had a prefix, directly in <robot>."""

Warn = Callable[[str], None]
"""Takes what of a file is not read, or not enforced."""


def read_xml(path: Path) -> ElementTree.Element:
    """The outermost element of an XML file; comments are left out.

    As tinyxml, with which ROS, Drake and MuJoCo read: what stands before ``<?xml`` may be blank, a
    comment may hold ``--``, a prefix is part of the name whether it is declared or not, an entity
    that nobody declares is plain text, and text in UTF-8 that is none is taken for Latin-1. Nothing
    outside the file is read.

    Raises ModelError: unreadable, or not well-formed; the message names the file and the line.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path} cannot be read: {error.strerror}") from error
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("iso-8859-1")
    blank_lines = text[: len(text) - len(text.lstrip())].count("\n")
    text = re.sub(r"(?s)<!--.*?-->", lambda one: "\n" * one[0].count("\n"), text.lstrip())
    if "<!ENTITY" not in text:
        text = re.sub(r"&(?!(?:#\d+|#x[0-9a-fA-F]+|lt|gt|amp|quot|apos);)", "&amp;", text)
    builder = ElementTree.TreeBuilder()
    try:
        # Without a separator, a prefix stays a part of the name.
        parser = expat.ParserCreate("utf-8")
        parser.buffer_text = True
        parser.StartElementHandler = builder.start
        parser.EndElementHandler = builder.end
        parser.CharacterDataHandler = builder.data
        # Zero: an error, where expat itself would pass over the entity without a word.
        parser.ExternalEntityRefHandler = lambda *_: 0
        parser.Parse(text.encode("utf-8"), True)
    except expat.ExpatError as error:
        place = f"line {error.lineno + blank_lines}, column {error.offset}"
        raise ModelError(
            f"{path} is not well-formed XML: {expat.ErrorString(error.code)}: {place}"
        ) from error
    return builder.close()


def xml_text(root: ElementTree.Element) -> str:
    """The text of an element that parse_xml made."""
    return ElementTree.tostring(root, encoding="unicode")


def read_numbers(text: str | None, count: int, where: str) -> list[float]:
    """The finite numbers in a text; else ModelError, in which ``where`` names link or joint."""
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
    """Raise ModelError for a size not above zero (or zero); ``where`` names the link."""
    for number in read_numbers(text, count, where):
        if number < 0.0 or (number == 0.0 and not zero):
            least = "must not be negative" if zero else "must be above 0"
            raise ModelError(f"{where} is '{text}'; it {least}")


def colour_text(text: str | None) -> str | None:
    """Three or four parts of a colour, brought between 0 and 1; None where it is none."""
    count = 3 if len((text or "").split()) == 3 else 4
    try:
        return " ".join(f"{min(max(part, 0.0), 1.0):g}" for part in read_numbers(text, count, ""))
    except ModelError:
        return None


def require_scale(text: str, count: int, where: str) -> None:
    """Refuse what is no scale of a mesh; ``where`` names the link and the mesh."""
    if 0.0 in read_numbers(text, count, where):
        raise ModelError(f"{where} is '{text}'; no factor may be 0")


def read_limits(
    lower_text: str | None, upper_text: str | None, name: str
) -> tuple[float | None, float | None]:
    """The limits of a joint; None: not given, or infinite. ModelError for NaN or crossed ones."""
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
            f"joint '{name}': lower limit {lower:g} is above upper limit {upper:g}; exchange them"
        )
    finite = [None if value is None or math.isinf(value) else value for value in values]
    return finite[0], finite[1]


def leave_out(
    root: ElementTree.Element,
    read: Mapping[str, Collection[str]],
    known: Collection[str],
    warn: Warn,
) -> None:
    """Remove from an element the children that are not read; those with a prefix stay.

    ``read``: by element, the children that are read, all where an element is not named; ``known``:
    elements that say nothing of kinematics and looks, of which ``warn`` is not told.
    """
    waiting = [root]
    while waiting:
        element = waiting.pop()
        kept = read.get(element.tag)
        for child in list(element):
            if kept is None or child.tag in kept or ":" in child.tag:
                waiting.append(child)
                continue
            element.remove(child)
            if child.tag not in known:
                name = f" '{element.get('name')}'" if element.get("name") else ""
                warn(f"{element.tag}{name}: the element <{child.tag}> is not known and left out")


def open_loops(
    model: ElementTree.Element,
    joints: Sequence[ElementTree.Element],
    ends: Sequence[Sequence[str]],
    warn: Warn,
) -> None:
    """Remove the joints of a model that close a loop; ``ends`` are the two links of each."""
    # First the joint that names a link as its child first: Drake cannot turn every kind over.
    children = [child for _, child in ends]
    order = sorted(range(len(joints)), key=lambda i: children[i] in children[:i])
    group: dict[str, str] = {}

    def find(link: str) -> str:
        while link in group:
            link = group[link]
        return link

    for index in order:
        one, other = map(find, ends[index])
        if one != other:
            group[other] = one
            continue
        model.remove(joints[index])
        warn(
            f"joint '{joints[index].get('name')}' closes a loop of links at '{children[index]}': "
            "not enforced, it is left out"
        )


FOLLOWING = ("revolute", "continuous", "prismatic")
"""The types of joints that can follow one another."""


def take_mimic(
    parent: ElementTree.Element, name: str, leaders: Collection[str], warn: Warn
) -> dict[str, str] | None:
    """Remove a joint's <mimic>, of attributes or elements; what Drake's has in its place.

    ``leaders``: the joints that can be followed; ``warn`` is told of others.
    """
    found, usual = None, {"multiplier": "1", "offset": "0", "reference": "0"}
    for mimic in parent.findall("mimic"):
        parent.remove(mimic)
        said = {key: mimic.get(key, mimic.findtext(key)) for key in usual}
        multiplier, offset, reference = (
            read_numbers(said[key] or text, 1, f"joint '{name}': {key} of its <mimic>")[0]
            for key, text in usual.items()
        )
        leader = mimic.get("joint", "")
        if leader in leaders and leader != name and multiplier:
            offset -= multiplier * reference
            found = {"joint": leader, "multiplier": repr(multiplier), "offset": repr(offset)}
        else:
            warn(
                f"joint '{name}' is written to follow joint '{leader}' (<mimic>): not enforced, it "
                "is searched by itself"
            )
    return found


def refuse_macros(root: ElementTree.Element) -> None:
    """Raise ModelError for a file that xacro has not expanded: links would be missing."""
    left = [f"<{child.tag}>" for child in root if child.tag in OLD_XACRO_ELEMENTS]
    for element in root.iter():
        if element.tag.startswith("xacro:"):
            left.append(f"<{element.tag}>")
        for value in [*element.attrib.values(), element.text or ""]:
            if "${" in value or "$(" in value:
                left.append(f"'{value.strip()[:60]}' in <{element.tag}>")
    if left:
        raise ModelError(
            f"it still holds xacro macros, such as {left[0]}: links and joints would be missing; "
            "expand it first: xacro robot.urdf.xacro > robot.urdf (PyPI: xacro)"
        )


def package_folder() -> Path:
    """The folder of bundled models, in the wheel or checkout; ModelError where there is none."""
    library = Path(__file__).resolve().parents[1]
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
            # Packages in the repositories of a workspace.
            packages = PackageMap.MakeEmpty()
            packages.PopulateFromRosPackagePath()
            known = [one for one in packages.GetPackageNames() if one.strip() == name]
            found = [Path(packages.GetPath(one)) for one in known]
        return found


def _folders_at(folder: Path, name: str) -> list[Path]:
    """A folder where it is the package, and the one of the package's name in it."""
    names = [folder.name]
    with suppress(ModelError, OSError):
        if (folder / "package.xml").is_file():
            names.append((read_xml(folder / "package.xml").findtext("name") or "").strip())
    own = [folder] if name in names else []
    return [*own, folder / name] if (folder / name).is_dir() else own


def bundled_model(name: str) -> Path:
    """The file of a model that drake_pose ships, such as "woman"; UnknownNameError lists them."""
    folder = package_folder()
    known = {path.parent.name: path for path in sorted(folder.glob("*/*.urdf"))}
    named = {key: folder / key / f"{key}.urdf" for key in known}
    if name not in named:
        raise UnknownNameError("bundled model", name, sorted(named), "drake_pose")
    return named[name] if named[name].is_file() else known[name]
