"""MJCF files made safe for Drake: one joint a body, every include expanded, meshes as OBJ.

Drake 1.51 puts all but the last joint of a body at the parent's origin
(``multibody/parsing/detail_mujoco_parser.cc``, ParseBody), which is wrong away from the zero pose.
MuJoCo applies the joints of a body one after the other, each about its ``pos`` in the body's frame;
that is the same as nested bodies with one joint each, which Drake reads rightly.
"""

import copy
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from drake_pose.body.mesh_files import drawable_file
from drake_pose.errors import ModelError

# Elements that make bodies, joints or shapes and that Drake ignores.
_IGNORED_BY_DRAKE = ("frame", "composite", "flexcomp", "attach", "replicate")
_ORIENTATIONS = ("quat", "axisangle", "euler", "xyaxes", "zaxis")
_MAXIMUM_INCLUDE_DEPTH = 20


def is_mjcf(path: Path) -> bool:
    """True for an XML file whose outermost element is <mujoco>."""
    if path.suffix.lower() not in (".xml", ".mjcf"):
        return False
    try:
        for _, element in ElementTree.iterparse(path, events=("start",)):
            return element.tag == "mujoco"
    except ElementTree.ParseError:
        return False
    return False


def cure_mjcf(path: Path) -> str:
    """The text of an MJCF file that Drake reads with MuJoCo's kinematics.

    Asset paths in it are absolute, so it may be parsed from anywhere.

    Args:
        path: the main MJCF file.

    Raises:
        ModelError: unreadable, an include that includes itself, or an element that Drake ignores
            although it carries bodies, joints or shapes.
    """
    folder = path.resolve().parent
    root = _read_xml(path)
    _expand_includes(root, folder, (path.resolve(),))
    for tag in _IGNORED_BY_DRAKE:
        for worldbody in root.iter("worldbody"):
            if worldbody.find(f".//{tag}") is not None:
                raise ModelError(
                    f"{path}: Drake ignores <{tag}>, so bodies or shapes would be missing or "
                    "misplaced; write its content out (MuJoCo's 'compile' tool does that)"
                )
    _make_assets_absolute(root, folder, path)
    for default in root.findall("default"):
        _inherit_defaults(default)
    # With this setting Drake and MuJoCo refuse a body that states no inertia.
    needs_inertia = any(c.get("inertiafromgeom") == "false" for c in root.iter("compiler"))
    for worldbody in root.iter("worldbody"):
        for body in list(worldbody.iter("body")):
            _nest_joints(body, path, needs_inertia=needs_inertia)
    return ElementTree.tostring(root, encoding="unicode")


def _read_xml(path: Path) -> ElementTree.Element:
    """The outermost element of an XML file."""
    try:
        return ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise ModelError(f"{path} is not well-formed XML: {error}") from error
    except OSError as error:
        raise ModelError(f"{path} cannot be read: {error.strerror}") from error


def _expand_includes(element: ElementTree.Element, folder: Path, chain: tuple[Path, ...]) -> None:
    """Replace each <include> by the children of the included file's outermost element.

    Paths are relative to the main file's folder, as in MuJoCo.
    """
    for index, child in reversed(list(enumerate(element))):
        if child.tag != "include":
            _expand_includes(child, folder, chain)
            continue
        included = (folder / child.get("file", "")).resolve()
        if included in chain or len(chain) > _MAXIMUM_INCLUDE_DEPTH:
            raise ModelError(f"{chain[-1]}: <include> of {included} never ends")
        if not included.is_file():
            raise ModelError(f"{chain[-1]}: included file {included} does not exist")
        content = _read_xml(included)
        _expand_includes(content, folder, (*chain, included))
        element.remove(child)
        for offset, grandchild in enumerate(content):
            element.insert(index + offset, grandchild)


def _make_assets_absolute(root: ElementTree.Element, folder: Path, path: Path) -> None:
    """Give mesh and texture files absolute paths; convert meshes that are not OBJ."""
    mesh_folder = texture_folder = folder
    for compiler in root.iter("compiler"):
        assets = compiler.get("assetdir", "")
        mesh_folder = folder / compiler.get("meshdir", assets)
        texture_folder = folder / compiler.get("texturedir", assets)
    for asset in root.iter("asset"):
        for mesh in asset.iter("mesh"):
            if "file" not in mesh.attrib:
                continue
            file = Path(mesh.attrib["file"])
            mesh.set("name", mesh.get("name", file.stem))
            file = mesh_folder / file
            if not file.is_file():
                raise ModelError(f"{path}: mesh '{mesh.get('name')}': {file} does not exist")
            mesh.set("file", str(file if file.suffix.lower() == ".obj" else drawable_file(file)))
        for texture in asset.iter("texture"):
            if "file" in texture.attrib:
                texture.set("file", str(texture_folder / texture.attrib["file"]))


def _inherit_defaults(default: ElementTree.Element) -> None:
    """Write out what a default class inherits from the classes around it.

    Drake 1.51 forgets the inherited settings of an element that the inner class does not mention.
    """
    for inner in default.findall("default"):
        for setting in default:
            if setting.tag == "default":
                continue
            own = inner.find(setting.tag)
            if own is None:
                inner.append(copy.deepcopy(setting))
                continue
            orientation = set(_ORIENTATIONS) & set(own.attrib)
            for name, value in setting.attrib.items():
                if not (orientation and name in _ORIENTATIONS):
                    own.attrib.setdefault(name, value)
        _inherit_defaults(inner)


def _nest_joints(body: ElementTree.Element, path: Path, *, needs_inertia: bool) -> None:
    """Turn a body with joints j1 .. jn into n nested bodies with one joint each, in that order."""
    joints = body.findall("joint")
    if len(joints) < 2 and not (joints and body.find("freejoint") is not None):
        return
    name = body.get("name", "(unnamed)")
    if any(joint.get("type") == "free" for joint in joints) or body.find("freejoint") is not None:
        raise ModelError(f"{path}: body '{name}' has a free joint beside other joints")
    if "name" not in body.attrib:
        raise ModelError(
            f"{path}: a body with joints {[joint.get('name', '?') for joint in joints]} has no "
            "name; Drake 1.51 misplaces bodies with several joints, and one without a name "
            "cannot be cured: give it a name"
        )
    content = [child for child in body if child.tag != "joint"]
    for child in list(body):
        body.remove(child)
    outer = copy.deepcopy(body.attrib)
    body.set("name", f"{name}__{joints[0].get('name', '0')}")
    current = body
    for number, joint in enumerate(joints):
        if number > 0:
            inner_name = f"{name}__{joint.get('name', str(number))}"
            last = number == len(joints) - 1
            attributes = {"name": name if last else inner_name}
            if "childclass" in outer:
                attributes["childclass"] = outer["childclass"]
            current = ElementTree.SubElement(current, "body", attributes)
        current.append(joint)
        if number < len(joints) - 1 and needs_inertia:
            inertia = {"pos": "0 0 0", "mass": "1e-6", "diaginertia": "1e-9 1e-9 1e-9"}
            ElementTree.SubElement(current, "inertial", inertia)
    current.extend(content)
