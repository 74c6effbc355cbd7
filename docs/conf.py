"""How `make docs` builds the pages and the API reference; a broken reference is an error there.

The source folder is the repository's root, so that the pages' relative links hold.
"""

from __future__ import annotations

import re
import shutil
from importlib import import_module
from pathlib import Path
from pkgutil import walk_packages
from typing import Any

import numpy as np
import numpy.typing
import yaml
from docutils import nodes
from sphinx.addnodes import pending_xref
from sphinx.application import Sphinx
from sphinx.environment import BuildEnvironment
from sphinx.util.docutils import SphinxDirective


class Array:
    """Replaces NDArray, whose parameters would be written out at each argument."""

    def __class_getitem__(cls, item: Any) -> type:
        """Return the plain array."""
        return np.ndarray


# Set before drake_pose is imported.
numpy.typing.NDArray = Array  # type: ignore[misc]

from drake_pose import __version__  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]

project = "drake_pose"
copyright = "the authors of drake_pose"
version = release = __version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "sphinx.ext.napoleon"]
root_doc = "README"
include_patterns = ["*.md", "docs/**.md", "docs/*.rst", "tutorials/*.md", "urdf/*/*.md"]
exclude_patterns = [".*", "build", "results"]
myst_heading_anchors = 4
html_theme = "furo"
html_theme_options = {"light_css_variables": {"code-font-size": "75%"}}
html_title = f"drake_pose {__version__}"
html_copy_source = False

default_role = "code"
autodoc_member_order = "groupwise"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autosummary_generate = False
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
napoleon_custom_sections = [("Input ports", "params_style"), ("Output ports", "params_style")]
# Two modules may define a type of the same name.
suppress_warnings = ["ref.python"]
napoleon_attr_annotations = False
python_maximum_signature_line_length = 80

# Names of other projects, whose references would need the network.
nitpick_ignore_regex = [
    ("py:.*", r"(np|numpy|pydrake|rich|distributed|pathlib|collections|enum|jinja2|numba)\..*"),
    ("py:.*", r"(cv2|scipy|trimesh|asyncio|http|socketserver|PIL|xml|types|typing)\..*"),
    ("py:.*", r"(functools|markupsafe|matplotlib|socket)\..*"),
    ("py:.*", r"cyclopts\..*"),
    # An argument that is raised, type variables, and names imported for type checkers only.
    ("py:exc", "error_type"),
    ("py:class", r"[A-Z]\w*|threading\.Event|contextlib\.ExitStack"),
]


class PublicNames(SphinxDirective):
    """`.. public-names:: PACKAGE`: the names of a package, linked to their modules."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return a list."""
        package = import_module(self.arguments[0])
        text = []
        for name in package.__all__:
            public = getattr(package, name)
            sentence = str(public.__doc__).strip().split("\n\n")[0].replace("\n", " ")
            home = f"{public.__module__}.{public.__qualname__}"
            text += [f":py:obj:`{name} <{home}>`", f"   {' '.join(sentence.split())}", ""]
        return self.parse_text_to_nodes("\n".join(text))


class Modules(SphinxDirective):
    """`.. modules:: PACKAGE`: the modules of a package, kernels left out."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Return a section for each module."""
        package = import_module(self.arguments[0])
        found = walk_packages(package.__path__, f"{package.__name__}.")
        text = [f".. automodule:: {package.__name__}", "   :no-members:", ""]
        for module in sorted(one.name for one in found if not one.name.endswith("kernel")):
            title = module.removeprefix("drake_pose.")
            text += [title, "-" * len(title), "", f".. automodule:: {module}", "   :members:", ""]
        return self.parse_text_to_nodes("\n".join(text), allow_section_headings=True)


class PydrakeSystem(SphinxDirective):
    """`.. pydrake_system::`: a system's ports, as Drake's own pages describe them."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Return a list of ports."""
        ports = yaml.safe_load("\n".join(self.content))
        lines = []
        for kind in ("input_ports", "output_ports"):
            names = ", ".join(f"``{port}``" for port in ports.get(kind) or ("none",))
            lines.append(f":{kind.replace('_', ' ').capitalize()}: {names}")
        return self.parse_text_to_nodes("\n".join(lines))


def resolve_known(
    app: Sphinx, env: BuildEnvironment, node: pending_xref, content: nodes.Element
) -> nodes.Element | None:
    """Accept a name that exists but has no entry; a name that does not exist is an error."""
    target = node.get("reftarget", "")
    if node.get("refdomain") != "py" or not target.startswith("drake_pose."):
        return None
    return content if _exists(target) else None


def _exists(target: str) -> bool:
    """Return whether the object can be imported."""
    module, _, name = target.rpartition(".")
    try:
        return hasattr(import_module(module), name)
    except ImportError:
        return False


def prepare_docstring(
    app: Sphinx, what: str, name: str, value: Any, options: Any, lines: list[str]
) -> None:
    """Prepare a docstring for napoleon: attributes begin without a type; `a, b:` is split."""
    if what in ("attribute", "data", "property"):
        lines[:0] = ["..", ""]
    for k, line in enumerate(lines):
        # Sphinx itself splits names of errors.
        if (names := re.match(r"\s+\w+(, \w+)+: ", line)) and "Error" not in names.group():
            lines[k] = names.group().replace(", ", ",") + line[names.end() :]


def shorten_signature(
    app: Sphinx, what: str, name: str, value: Any, options: Any, signature: str | None, returns: str
) -> tuple[str, str] | None:
    """Write defaults that are not Python (`<factory>`) as `...`: Sphinx parses signatures."""
    return None if signature is None else (re.sub(r"<\w[^<>]*>", "...", signature), returns)


def skip_fields(
    app: Sphinx, what: str, name: str, value: Any, skip: bool, options: Any
) -> bool | None:
    """Skip the default docstrings of named tuples' fields, and modules' constants."""
    constant = what == "module" and not hasattr(value, "__qualname__")
    return True if constant or str(value.__doc__).startswith("Alias for field number") else None


def add_contents(app: Sphinx, name: str, source: list[str]) -> None:
    """Append the tables of contents to the first page, which has none on GitHub."""
    if name != root_doc:
        return
    overview = (ROOT / "tutorials" / "README.md").read_text(encoding="utf-8")
    pages = re.findall(r"^\| \[\w+\]\((\w+)\.md\)", overview, flags=re.MULTILINE)
    pages = [f"tutorials/{page}" for page in ("README", *pages)]
    bodies = sorted(f"urdf/{path.parent.name}/README" for path in ROOT.glob("urdf/*/README.md"))
    for caption, names in (
        ("Tutorials", pages),
        ("Reference", ["docs/index"]),
        ("Bundled bodies", bodies),
        ("Project", ["CONTRIBUTING", "docs/design_notes", "CHANGELOG"]),
    ):
        listed = "\n".join(names)
        source[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{listed}\n```\n"


def copy_first_page(app: Sphinx, exception: Exception | None) -> None:
    """Write index.html, which browsers and servers open first."""
    if exception is None:
        shutil.copyfile(app.outdir / f"{root_doc}.html", app.outdir / "index.html")


def setup(app: Sphinx) -> None:
    """Connect the functions above."""
    app.connect("source-read", add_contents)
    app.connect("build-finished", copy_first_page)
    app.add_directive("public-names", PublicNames)
    app.add_directive("modules", Modules)
    app.add_directive("pydrake_system", PydrakeSystem)
    app.connect("missing-reference", resolve_known)
    # Napoleon's handler has priority 500.
    app.connect("autodoc-process-docstring", prepare_docstring, priority=400)
    app.connect("autodoc-process-signature", shorten_signature)
    app.connect("autodoc-skip-member", skip_fields)
