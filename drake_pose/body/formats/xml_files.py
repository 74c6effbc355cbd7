"""XML model files: read as leniently as robots' own programs do, checked before Drake sees them."""

import math
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from xml.parsers import expat

from drake_pose.errors import ModelError

OLD_XACRO_ELEMENTS = ("macro", "include")
"""Of xacro before it had a prefix, directly in <robot>."""

Warn = Callable[[str], None]
"""Takes what of a file is not read, or not enforced."""

_MACRO_MARKS = ("${", "$(")
_MIMIC = {"multiplier": "1", "offset": "0", "reference": "0"}
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_BARE_AMPERSAND = re.compile(r"&(?!(?:#\d+|#x[0-9a-fA-F]+|lt|gt|amp|quot|apos);)")
_DECLARED_ENCODING = re.compile(rb"<\?xml[^>]*?\bencoding\s*=\s*[\"']([\w.:-]+)")


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
    text = _decoded(data)
    blank_lines = text[: len(text) - len(text.lstrip())].count("\n")
    text = _COMMENT.sub(lambda comment: "\n" * comment[0].count("\n"), text.lstrip())
    if "<!ENTITY" not in text:
        text = _BARE_AMPERSAND.sub("&amp;", text)
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


def _decoded(data: bytes) -> str:
    """A file's content as text: by its byte order mark, its declaration, as UTF-8 or as Latin-1."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", "replace")
    declared = _DECLARED_ENCODING.search(data[:200])
    encodings = ["utf-8-sig"]
    # What reads as bytes is not UTF-16, whatever it says.
    if declared is not None and not declared[1].lower().startswith((b"utf-16", b"utf-32")):
        encodings.insert(0, declared[1].decode("ascii"))
    for encoding in encodings:
        with suppress(LookupError, ValueError):
            return data.decode(encoding).removeprefix("\ufeff")
    return data.decode("iso-8859-1")


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
    found = None
    for mimic in parent.findall("mimic"):
        parent.remove(mimic)
        said = {key: mimic.get(key, mimic.findtext(key)) for key in _MIMIC}
        multiplier, offset, reference = (
            read_numbers(said[key] or text, 1, f"joint '{name}': {key} of its <mimic>")[0]
            for key, text in _MIMIC.items()
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
    prefixes = {"xacro"}
    for name, value in root.attrib.items():
        if name.startswith("xmlns:") and "xacro" in value:
            prefixes.add(name.removeprefix("xmlns:"))
    left = next(_macros(root, prefixes), None)
    if left is not None:
        raise ModelError(
            f"it still holds xacro macros, such as {left}: links and joints would be missing; "
            "expand it first: xacro robot.urdf.xacro > robot.urdf (PyPI: xacro)"
        )


def _macros(root: ElementTree.Element, prefixes: Collection[str]) -> Iterator[str]:
    """The elements, attributes and texts of xacro."""
    yield from (f"<{child.tag}>" for child in root if child.tag in OLD_XACRO_ELEMENTS)
    for element in root.iter():
        if ":" in element.tag and element.tag.partition(":")[0] in prefixes:
            yield f"<{element.tag}>"
        for value in [*element.attrib.values(), element.text or ""]:
            if any(mark in value for mark in _MACRO_MARKS):
                yield f"'{value.strip()[:60]}' in <{element.tag}>"
