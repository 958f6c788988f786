"""Copies the files of a user's robot: its trainings and policies then load on any machine."""

import json
import os
import re
import shutil
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import mujoco

from kslc_jax.robots import description
from kslc_jax.robots.description import RobotError

_MJCF_LINE = re.compile(r"""^\s*["']?mjcf["']?\s*=.*$""", re.MULTILINE)

_PATHS = {"file", "dir", "assetdir", "meshdir", "texturedir"}
"""Attributes of an MJCF that hold a path."""

INSIDE = "mjcf"
"""Folder of the copy that holds the MJCF and its files."""


def copy(name: str, folder: Path) -> None:
    """Copies a robot into `folder`, which it replaces.

    The copy has the description under its own file name, the MJCF, and all files that the MJCF
    names. An MJCF in an installed package is not copied: the description still points to it.

    Args:
      name: path of a description.
      folder: of the copy.

    Raises:
      RobotError: the description's mjcf does not stand in one line, or an MJCF names a file by an
        absolute path, which another machine does not have.
      OSError: a file cannot be read or written.
    """
    about = description.read(name)
    text = about.path.read_text(encoding="utf-8")
    part = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    if about.path.parent / tomllib.loads(text)["mjcf"] == about.mjcf:  # in no package
        inside = f"{INSIDE}/{_copy_mjcf(about.mjcf, part / INSIDE)}"
        line = f"mjcf = {json.dumps(inside)}"
        # A function: `sub` would read the escapes of a name like "röboter.xml" as a template.
        text = _MJCF_LINE.sub(lambda _: line, text, count=1)
        if tomllib.loads(text)["mjcf"] != inside:
            raise RobotError(f"{about.path}: write mjcf in one line")
    (part / about.path.name).write_text(text, encoding="utf-8")
    shutil.rmtree(folder, ignore_errors=True)
    part.rename(folder)


def _copy_mjcf(mjcf: Path, folder: Path) -> str:
    """Copies an MJCF and the files that it names; returns its path within the folder."""
    mjcf = Path(os.path.abspath(mjcf))
    needed = [Path(os.path.abspath(f)) for f in mujoco.mju_getXMLDependencies(str(mjcf))]
    for file in needed:
        _require_relative(file)
    root = Path(os.path.commonpath([file.parent for file in needed]))
    for file in needed:
        target = folder / file.relative_to(root)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, target)
    return mjcf.relative_to(root).as_posix()


def _require_relative(file: Path) -> None:
    """RobotError if the file is an MJCF that has an absolute path."""
    if file.suffix.lower() != ".xml":
        return
    for element in ElementTree.parse(file).iter():
        for name in _PATHS & element.attrib.keys():
            if os.path.isabs(path := element.attrib[name]):
                raise RobotError(
                    f"{file}: {name}={path!r} of <{element.tag}> is an absolute path; make it "
                    "relative, so that trainings and policies can keep a copy of the robot"
                )
