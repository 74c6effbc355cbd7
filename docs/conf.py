"""How `make docs` makes the API pages. A reference that cannot be resolved is an error there."""

from __future__ import annotations

import re
import sys
from importlib import import_module
from pkgutil import walk_packages
from typing import Any

import numpy as np
import numpy.typing
import yaml
from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.errors import PycodeError
from sphinx.pycode import ModuleAnalyzer
from sphinx.util.docutils import SphinxDirective


class Array:
    """Stands for NDArray, whose shape and type would be spelt out at each argument."""

    def __class_getitem__(cls, item: Any) -> type:
        """Returns the plain array."""
        return np.ndarray


# Before drake_pose is imported.
numpy.typing.NDArray = Array  # type: ignore[misc]

from drake_pose import __version__, errors  # noqa: E402

project = "drake_pose"
copyright = "the authors of drake_pose"
version = release = __version__
extensions = ["sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
html_theme = "furo"
html_title = f"drake_pose {__version__}"
html_copy_source = False

default_role = "code"
autodoc_member_order = "groupwise"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autosummary_generate = False
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_attr_annotations = False
python_maximum_signature_line_length = 80

# Other projects' pages are in the net, which a build does not need.
nitpick_ignore_regex = [
    ("py:.*", r"(np|numpy|pydrake|rich|typer|distributed|pathlib|collections|enum)\..*"),
    # Drake's classes that are imported for type checkers alone.
    ("py:class", "ColorRenderCamera|DepthRenderCamera|RenderCameraCore|CameraInfo"),
    ("py:class", "RigidTransform|Diagram|OutputPort|Meshcat"),
    # Names of types.
    ("py:class", "Array|Turning|Motions|PackedBand"),
]

# The packages that export names, and where each exported object is documented.
EXPORTING = ("drake_pose", "body", "camera", "silhouette", "matching", "filtering", "systems")
PUBLIC: dict[str, str] = {name: f"drake_pose.errors.{name}" for name in vars(errors)}
CONSTANTS: set[str] = set()
for _name in EXPORTING:
    _path = _name if _name == "drake_pose" else f"drake_pose.{_name}"
    _package = import_module(_path)
    for _public in _package.__all__:
        _object = getattr(_package, _public)
        # Names that are loaded when they are first used are not there yet.
        setattr(_package, _public, _object)
        if hasattr(_object, "__qualname__"):
            PUBLIC[f"{_object.__module__}.{_object.__qualname__}"] = f"{_path}.{_public}"
        else:
            CONSTANTS.add(_public)


class PublicNames(SphinxDirective):
    """`.. public-names:: PACKAGE`: what a package exports, as a table and one by one."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Returns the table and the entries."""
        package = import_module(self.arguments[0])
        text = [f".. automodule:: {package.__name__}", "   :no-members:", ""]
        text += [".. autosummary::", "   :nosignatures:", ""]
        text += [*(f"   {name}" for name in package.__all__), ""]
        for name in package.__all__:
            text += _documenting(name, getattr(package, name))
        return self.parse_text_to_nodes("\n".join(text))


class Modules(SphinxDirective):
    """`.. modules:: PACKAGE`: the modules of a package that exports no names, kernels left out."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Returns a section for each module."""
        package = import_module(self.arguments[0])
        found = walk_packages(package.__path__, f"{package.__name__}.")
        text = [f".. automodule:: {package.__name__}", "   :no-members:", ""]
        for module in sorted(one.name for one in found if not one.name.endswith("_kernel")):
            title = module.removeprefix("drake_pose.")
            text += [title, "-" * len(title), "", f".. automodule:: {module}", "   :members:", ""]
        return self.parse_text_to_nodes("\n".join(text), allow_section_headings=True)


class PydrakeSystem(SphinxDirective):
    """`.. pydrake_system::`: a system's ports, as Drake's own pages describe them."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Returns a list of ports."""
        ports = yaml.safe_load("\n".join(self.content))
        lines = []
        for kind in ("input_ports", "output_ports"):
            names = ", ".join(f"``{port}``" for port in ports.get(kind) or ("none",))
            lines.append(f":{kind.replace('_', ' ').capitalize()}: {names}")
        return self.parse_text_to_nodes("\n".join(lines))


def _documenting(name: str, documented: Any) -> list[str]:
    """What documents an object of the current module."""
    if isinstance(documented, type):
        bases = [] if documented.__bases__ == (object,) else ["   :show-inheritance:"]
        return [f".. autoclass:: {name}", "   :members:", *bases, ""]
    kind = "autofunction" if hasattr(documented, "__qualname__") else "autodata"
    return [f".. {kind}:: {name}", ""]


def resolve_public(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.Element
) -> nodes.Element | None:
    """Finds a name where its package exports it; what is not exported exists, but has no entry."""
    target = node.get("reftarget", "")
    if node.get("refdomain") != "py":
        return None
    if target not in PUBLIC:
        return content if target.startswith("drake_pose.") and _exists(target) else None
    python = env.get_domain("py")
    return python.resolve_xref(
        env, node["refdoc"], app.builder, "obj", PUBLIC[target], node, content
    )


def _exists(target: str) -> bool:
    """Whether there is such an object."""
    module, _, name = target.rpartition(".")
    try:
        return hasattr(import_module(module), name)
    except ImportError:
        return False


def prepare_docstring(
    app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]
) -> None:
    """Before napoleon: names that share a line are parted; constants get their docstrings."""
    if what == "data" and name.rpartition(".")[2] in CONSTANTS:
        lines[:] = _constant_docstring(name, value) or lines
    for k, line in enumerate(lines):
        # Those of errors are parted by Sphinx itself.
        if (names := re.match(r"\s+\w+(, \w+)+: ", line)) and "Error" not in names.group():
            lines[k] = names.group().replace(", ", ",") + line[names.end() :]


def shorten_signature(
    app: Sphinx, what: str, name: str, value: Any, options: Any, signature: str | None, returns: str
) -> tuple[str, str] | None:
    """Writes defaults that are no Python (`<factory>`) as `...`, so that types are read."""
    return None if signature is None else (re.sub(r"<\w[^<>]*>", "...", signature), returns)


def _constant_docstring(name: str, value: Any) -> list[str]:
    """A constant's docstring, from the module below its package that defines it."""
    package, _, constant = name.rpartition(".")
    for module in [one for one in sys.modules if one.startswith(f"{package}.")]:
        if getattr(sys.modules[module], constant, None) is value:
            try:
                documented = ModuleAnalyzer.for_module(module).find_attr_docs()
            except PycodeError:
                continue
            if ("", constant) in documented:
                return documented["", constant]
    return []


def skip_fields(
    app: Sphinx, what: str, name: str, value: Any, skip: bool, options: Any
) -> bool | None:
    """Leaves out what Python itself says of a named tuple's fields."""
    return True if str(value.__doc__).startswith("Alias for field number") else None


def setup(app: Sphinx) -> None:
    """Called by Sphinx."""
    app.add_directive("public-names", PublicNames)
    app.add_directive("modules", Modules)
    app.add_directive("pydrake_system", PydrakeSystem)
    app.connect("missing-reference", resolve_public)
    # Napoleon's own is at 500.
    app.connect("autodoc-process-docstring", prepare_docstring, priority=400)
    app.connect("autodoc-process-signature", shorten_signature)
    app.connect("autodoc-skip-member", skip_fields)
