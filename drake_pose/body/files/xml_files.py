"""XML files as the robots' own programs read them: more leniently than a strict reader."""

import re
import xml.etree.ElementTree as ElementTree
from contextlib import suppress
from pathlib import Path
from xml.parsers import expat

from drake_pose.errors import ModelError

_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
_BARE_AMPERSAND = re.compile(r"&(?!(?:#\d+|#x[0-9a-fA-F]+|lt|gt|amp|quot|apos);)")
_DECLARED_ENCODING = re.compile(rb"<\?xml[^>]*?\bencoding\s*=\s*[\"']([\w.:-]+)")


def read_xml(path: Path) -> ElementTree.Element:
    """The outermost element of an XML file; comments are left out.

    As tinyxml, with which ROS, Drake and MuJoCo read: what stands before ``<?xml`` may be blank, a
    comment may hold ``--``, a prefix is part of the name whether it is declared or not, an entity
    that nobody declares is plain text, and text in UTF-8 that is none is taken for Latin-1. Nothing
    outside the file is read.

    Raises:
        ModelError: unreadable, or not well-formed; the message names the file and the line.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path} cannot be read: {error.strerror}") from error
    return parse_xml(data, str(path))


def parse_xml(data: bytes, where: str) -> ElementTree.Element:
    """As read_xml, for a file's content; ``where`` is its name in messages."""
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
            f"{where} is not well-formed XML: {expat.ErrorString(error.code)}: {place}"
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
