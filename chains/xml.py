"""XML as files of other people hold it: elements and attributes, and nothing that acts.

A document may define entities that stand for a file of this machine, or for each other until they
fill its memory. No URDF, SRDF or E57 file needs these, so a document that defines one is refused;
an entity that stands for a few words is text.
"""

from __future__ import annotations

from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

from chains.errors import InputError

LONGEST_ENTITY = 1000  # characters; what a person writes instead of writing it twice
DEEPEST_XML = 100  # elements within each other; a URDF has about 6, an E57 file about 15


def parse_xml(text: str | bytes, where: object, wanted: str) -> Element:
    """The root of an XML document.

    Args:
        text: the document.
        where: its file, for messages.
        wanted: what it should be, "a URDF file" say.

    Raises:
        InputError: it is no XML, defines an entity that is not plain words, or is nested deeper
            than any such file is.
    """
    try:
        _look_through(text, where)
        return ElementTree.fromstring(text)
    except (ElementTree.ParseError, expat.ExpatError) as error:
        raise InputError(f"{where} is not XML ({error}); {wanted} is wanted") from None
    except (ValueError, LookupError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{where} is not XML ({error}); {wanted} is wanted") from None


def _look_through(text: str | bytes, where: object) -> None:
    """Refuse what no tree should be made of, before one is."""
    parser, depths = expat.ParserCreate(), [0]

    def entity(name: str, parameter: bool, value: str | None, *_: object) -> None:
        if parameter or value is None or "&" in value or len(value) > LONGEST_ENTITY:
            raise InputError(
                f"{where} defines the entity {name}, which stands for more than a few words; "
                f"remove it, as no such file needs one"
            )

    def start(tag: str, _: dict[str, str]) -> None:
        depths.append(depths[-1] + 1)
        if depths[-1] > DEEPEST_XML:
            raise InputError(f"{where} has elements nested more than {DEEPEST_XML} deep")

    parser.EntityDeclHandler = entity
    parser.StartElementHandler = start
    parser.EndElementHandler = lambda tag: depths.pop()
    parser.Parse(text, True)
