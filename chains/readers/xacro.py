"""xacro files written out as URDF, without ROS: the xacrodoc door.

What cannot be found is left out and named, so that the chain of joints survives a missing file of
meshes, masses or plugins. A file that only defines macros is called once, by the one with joints.
"""

from __future__ import annotations

import contextlib
import io
import re
from collections.abc import Mapping
from pathlib import Path
from xml.dom import minidom

import numpy as np

from chains.errors import InputError
from chains.readers.confined import confined, read_document

_MOST_MISSING = 200  # things that may be missing
_NOWHERE = "nowhere-to-be-found"


def write_out(path: Path, packages: Mapping[str, Path]) -> tuple[str, tuple[str, ...]]:
    """The URDF text of a xacro file, and what looked odd.

    Args:
        path: the file.
        packages: ROS package -> its folder, besides those that stand above the file.

    Raises:
        InputError: xacrodoc is not installed, or the file is not xacro that can be written out.
    """
    try:
        import xacrodoc
    except ImportError:
        raise InputError(f"{path} needs xacrodoc: pip install 'rigcal[xacro]'") from None
    for name, folder in packages.items():
        if not folder.is_dir():
            raise InputError(f"--package {name}={folder}: there is no such folder")
    xacrodoc.packages.reset()
    xacrodoc.packages.walk_up_from(path)
    xacrodoc.packages.update_package_cache(dict(packages))
    document = read_document(path)
    for include in document.getElementsByTagName("xacro:include"):
        include.setAttribute("optional", "true")
    urdf, odd = _compiled(path, document)
    if "<joint" not in urdf and (macro := _macro_with_joints(document)) is not None:
        odd.append(_call(document, macro))
        urdf, more = _compiled(path, document)
        odd += [line for line in more if line not in odd]
    return urdf, tuple(f"{path.name}: {line}" for line in odd)


def _compiled(path: Path, document: minidom.Document) -> tuple[str, list[str]]:
    """Write out what can be, dropping what is missing one by one."""
    from xacrodoc import XacroDoc, packages

    missing, macros = [], []
    for _ in range(_MOST_MISSING):
        try:
            with contextlib.redirect_stderr(io.StringIO()), confined(path, _folders):
                doc = XacroDoc.from_string(
                    document.toxml(), resolve_packages=False, rootdir=path.parent
                )
            return doc.to_urdf_string(), _left_out(document, missing, macros)
        except packages.PackageNotFoundError as error:
            missing += error.args
        except Exception as error:  # xacro raises its own, and whatever an expression of it raises
            said = (str(error).splitlines() or [type(error).__name__])[0].strip()
            if gone := re.search(r"Package not found: (\S+)", said):
                missing.append(gone[1])
            elif (gone := re.search(r"unknown macro name: (\S+)", said)) and _drop(
                document, gone[1]
            ):
                macros.append(gone[1].removeprefix("xacro:"))
                continue
            elif "'M_PI' is not defined" in said:  # so do the files of constants that robots share
                _define(document, "M_PI", repr(np.pi))
                continue
            else:
                raise InputError(f"{path} cannot be written out: {said}") from None
        packages.update_package_cache({missing[-1]: path.parent / _NOWHERE / missing[-1]})
    raise InputError(f"{path} cannot be written out: more than {_MOST_MISSING} things are missing")


def _folders() -> list[str]:
    """Of the packages that were found so far."""
    from xacrodoc import packages

    return list(packages._finder.package_cache.values())


def _left_out(document: minidom.Document, missing: list[str], macros: list[str]) -> list[str]:
    odd = []
    for name in dict.fromkeys(missing):
        files = [
            include.getAttribute("filename").rpartition("/")[2]
            for include in document.getElementsByTagName("xacro:include")
            if f"find {name})" in include.getAttribute("filename")
        ]
        odd.append(
            f"there is no ROS package {name} here, so {', '.join(files) or 'its files'} are left "
            f"out; --package {name}=FOLDER names it"
        )
    if macros:
        odd.append(f"what the macros {', '.join(macros)} add is left out: nothing defines them")
    return odd


def _define(document: minidom.Document, name: str, value: str) -> None:
    constant = document.createElement("xacro:property")
    constant.setAttribute("name", name)
    constant.setAttribute("value", value)
    document.documentElement.insertBefore(constant, document.documentElement.firstChild)


def _drop(document: minidom.Document, tag: str) -> bool:
    """Remove all calls of a macro; whether there were any."""
    calls = document.getElementsByTagName(tag)
    for call in calls:
        call.parentNode.removeChild(call)
    return bool(calls)


def _macro_with_joints(document: minidom.Document) -> minidom.Element | None:
    macros = document.getElementsByTagName("xacro:macro")
    jointed = [macro for macro in macros if macro.getElementsByTagName("joint")]
    return jointed[0] if len(jointed) == 1 else None


def _call(document: minidom.Document, macro: minidom.Element) -> str:
    """Call a macro with plain values for what has no default; say which."""
    call = document.createElement(f"xacro:{macro.getAttribute('name').removeprefix('xacro:')}")
    given = {}
    for word in macro.getAttribute("params").split():
        name, default = re.match(r"(\**\w+)(:?=.*)?", word).groups()
        if default is None and name.startswith("*"):
            block = document.createElement("origin")
            block.setAttribute("xyz", "0 0 0")
            call.appendChild(block)
        elif default is None:
            given[name] = {"parent": "root", "name": "arm", "prefix": ""}.get(name, "false")
            call.setAttribute(name, given[name])
    root = document.createElement("link")
    root.setAttribute("name", given.get("parent", "root"))
    for node in (root, call):
        document.documentElement.appendChild(node)
    if not document.documentElement.getAttribute("name"):
        document.documentElement.setAttribute("name", "arm")
    words = ", ".join(f"{name} = {value or 'nothing'}" for name, value in given.items())
    return f"it only defines macros; {macro.getAttribute('name')} is called with {words}"
