"""What MJCF leaves to default classes and several <compiler> elements, written out at each element.

Drake 1.51 forgets inherited settings of an element that an inner class does not mention, ignores
unknown classes, and starts again with ``autolimits`` at every <compiler>. Where every element says
all of itself, there is nothing left to read differently. Source: MuJoCo's XML reference,
sections "default" and "compiler", tried with MuJoCo 4.0.
"""

import xml.etree.ElementTree as ElementTree

from drake_pose.errors import ModelError

ORIENTATIONS = ("quat", "axisangle", "euler", "xyaxes", "zaxis")
_Settings = dict[str, dict[str, str]]


def merge_compilers(root: ElementTree.Element) -> dict[str, str]:
    """Leave one <compiler> with what all of them say, the last one winning; returns it."""
    settings: dict[str, str] = {}
    for compiler in root.findall("compiler"):
        if "assetdir" in compiler.attrib:
            settings |= dict.fromkeys(("meshdir", "texturedir"), compiler.attrib["assetdir"])
        settings |= compiler.attrib
        root.remove(compiler)
    root.insert(0, ElementTree.Element("compiler", settings))
    return settings


def write_out_defaults(root: ElementTree.Element) -> None:
    """Give every element what its class says and it does not; remove the classes.

    Raises:
        ModelError: a class that no <default> defines.
    """
    classes: dict[str, _Settings] = {"main": {}}
    for default in root.findall("default"):
        _read_class(default, classes["main"], classes)
        root.remove(default)
    _apply(root, "main", classes)


def _read_class(
    default: ElementTree.Element, settings: _Settings, classes: dict[str, _Settings]
) -> None:
    """Add what a <default> says to its class's settings, and the classes inside it."""
    for element in default:
        if element.tag != "default":
            outer = settings.get(element.tag, {})
            settings[element.tag] = _completed(element.attrib, outer)
    for inner in default.findall("default"):
        copy = {tag: dict(attributes) for tag, attributes in settings.items()}
        _read_class(inner, copy, classes)
        classes[inner.get("class", "")] = copy


def _apply(element: ElementTree.Element, childclass: str, classes: dict[str, _Settings]) -> None:
    """Complete an element and everything inside it."""
    childclass = element.attrib.pop("childclass", "") or childclass
    name = element.attrib.pop("class", "") or childclass
    for class_name in {name, childclass} - classes.keys():
        raise ModelError(
            f"<{element.tag}> '{element.get('name', '(unnamed)')}': no <default> defines "
            f"class '{class_name}'"
        )
    if element.tag in classes[name]:
        completed = _completed(element.attrib, classes[name][element.tag])
        element.attrib.clear()
        element.attrib.update(completed)
    for child in element:
        _apply(child, childclass, classes)


def _completed(own: dict[str, str], outer: dict[str, str]) -> dict[str, str]:
    """An element's attributes with those of its class that it does not say itself."""
    oriented = not own.keys().isdisjoint(ORIENTATIONS)
    inherited = {
        name: value for name, value in outer.items() if not (oriented and name in ORIENTATIONS)
    }
    completed = inherited | own
    if "size" in own and "size" in inherited:
        # Sizes of fewer numbers take the further ones from the class.
        numbers = own["size"].split()
        completed["size"] = " ".join(numbers + inherited["size"].split()[len(numbers) :])
    return completed
