"""What a model file in XML must not hold: values that end Drake or are read wrongly by it."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence

from drake_pose.errors import ModelError

OLD_XACRO_ELEMENTS = ("macro", "include")
"""Of xacro before it had a prefix, directly in <robot>."""

_MACRO_MARKS = ("${", "$(")


def read_numbers(text: str | None, count: int, where: str) -> list[float]:
    """The finite numbers in a text.

    Raises:
        ModelError: it holds something else; ``where`` names link or joint and the value.
    """
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
    """Refuse a size that is not above zero (or, where allowed, zero).

    Raises:
        ModelError: it is not; ``where`` names the link and the size.
    """
    for number in read_numbers(text, count, where):
        if number < 0.0 or (number == 0.0 and not zero):
            least = "must not be negative" if zero else "must be above 0"
            raise ModelError(f"{where} is '{text}'; it {least}")


def read_limits(
    lower_text: str | None, upper_text: str | None, name: str
) -> tuple[float | None, float | None]:
    """The limits of a joint; None: not given, or infinite.

    Raises:
        ModelError: not a number, NaN, or crossed.
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
            f"joint '{name}': lower limit {lower:g} is above upper limit {upper:g}; exchange them"
        )
    finite = [None if value is None or math.isinf(value) else value for value in values]
    return finite[0], finite[1]


def leave_out(
    root: ElementTree.Element,
    read: Mapping[str, Collection[str]],
    known: Collection[str],
    warn: Callable[[str], None],
) -> None:
    """Remove the children that are not read; those with a prefix stay.

    Args:
        root: the outermost element; it is changed.
        read: by element, the children that are read; all are where an element is not named.
        known: elements that say nothing of kinematics and looks; no word is lost on them.
        warn: hears of all others.
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


def close_loops(
    joints: Sequence[ElementTree.Element],
    ends: Sequence[Sequence[str]],
    warn: Callable[[str], None],
) -> list[ElementTree.Element]:
    """The joints that close a loop of links, without which there is a tree.

    Args:
        joints: all joints of a model.
        ends: the two links of each.
        warn: hears of each that closes a loop.
    """
    group: dict[str, str] = {}

    def find(link: str) -> str:
        while link in group:
            link = group[link]
        return link

    # First the joint that names a link as its child first: Drake cannot turn every kind over.
    children: set[str] = set()
    first: list[tuple[ElementTree.Element, str, str]] = []
    later: list[tuple[ElementTree.Element, str, str]] = []
    for joint, (parent, child) in zip(joints, ends, strict=True):
        (later if child in children else first).append((joint, parent, child))
        children.add(child)
    closing = []
    for joint, parent, child in first + later:
        one, other = find(parent), find(child)
        if one != other:
            group[other] = one
            continue
        closing.append(joint)
        warn(
            f"joint '{joint.get('name')}' closes a loop of links at '{child}': not enforced, it is "
            "left out"
        )
    return closing


def refuse_macros(root: ElementTree.Element) -> None:
    """Refuse a file that xacro has not expanded: links and joints would be missing.

    A prefix that is declared, but not used, does no harm.

    Raises:
        ModelError: says what is left and how to expand it.
    """
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
