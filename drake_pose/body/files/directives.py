"""Model directives (.dmd.yaml) whose models Drake reads in their cured form."""

from collections.abc import Callable, Iterator
from pathlib import Path

import yaml

from drake_pose.body.files.packages import FileFinder
from drake_pose.errors import ModelError

_NAMES_A_FILE = ("add_model", "add_directives")


def cure_directives(path: Path, finder: FileFinder, cure_file: Callable[[Path], Path]) -> str:
    """The text of a directives file in which every file is one that stands in for it.

    Tags and aliases stay. Raises ModelError: unreadable, no YAML, or a file that cannot be used.
    """
    try:
        node = yaml.compose(path.read_bytes(), Loader=yaml.SafeLoader)
    except OSError as error:
        raise ModelError(f"it cannot be read: {error.strerror}") from error
    except (yaml.YAMLError, ValueError) as error:
        raise ModelError(f"it is no YAML: {' '.join(str(error).split())}") from error
    except RecursionError:
        raise ModelError("it is nested too deeply") from None
    if node is None:
        raise ModelError("it is empty; expected 'directives:'")
    for what, file in list(_files(node)):
        found = finder.resolve(file.value, path, what)
        file.value = f"file://{cure_file(found)}"
    return yaml.serialize(node, Dumper=yaml.SafeDumper, allow_unicode=True)


def _files(node: yaml.Node) -> Iterator[tuple[str, yaml.ScalarNode]]:
    """The scalars that name a file, each once, and the directive they belong to."""
    waiting, seen = [node], set()
    while waiting:
        node = waiting.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        if isinstance(node, yaml.SequenceNode):
            waiting += reversed(node.value)
        if not isinstance(node, yaml.MappingNode):
            continue
        for key, value in node.value:
            waiting.append(value)
            if key.value in _NAMES_A_FILE:
                for scalar in _values_of_file(value):
                    if id(scalar) not in seen:
                        seen.add(id(scalar))
                        yield key.value, scalar


def _values_of_file(node: yaml.Node) -> Iterator[yaml.ScalarNode]:
    """The values of the key ``file`` in a mapping, those it merges (<<) among them."""
    waiting, seen = [node], set()
    while waiting:
        node = waiting.pop()
        if id(node) in seen or isinstance(node, yaml.ScalarNode):
            continue
        seen.add(id(node))
        if isinstance(node, yaml.SequenceNode):
            waiting += node.value
            continue
        for key, value in node.value:
            if key.value == "file" and isinstance(value, yaml.ScalarNode):
                yield value
            elif key.value == "<<":
                waiting.append(value)
