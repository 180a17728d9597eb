"""The program `semfield` of this installation: verbs, and what those give back that Python has calls for."""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib
import re
import shutil
import signal
import subprocess
from typing import Any, Dict, List, Mapping, Optional, Tuple

import numpy as np

from . import _core
from .errors import Error, UnavailableError
from .scenes import PathLike

Array = np.ndarray[Any, Any]


class CommandError(Error):
    """A verb failed; `stderr` has its messages."""

    stderr: str = ""


def program() -> str:
    """Path of the program: SEMFIELD_PROGRAM, else the one of this build or installation, else that of PATH."""
    named = os.environ.get("SEMFIELD_PROGRAM")
    if named:
        return named
    here = pathlib.Path(_core.__file__).resolve()
    for above in list(here.parents)[:6]:
        found = above / "bin" / "semfield"
        if found.is_file() and os.access(found, os.X_OK):
            return str(found)
    on_path = shutil.which("semfield")
    if on_path is None:
        raise UnavailableError("the program semfield is neither next to the module nor in PATH",
                               remedy="install the package semfield, or set SEMFIELD_PROGRAM", exit_code=69,
                               code="python.program.missing")
    return on_path


def command(*words: Any, json_output: bool = False) -> Any:
    """Runs a verb, as in a terminal: ``command("mesh", "runs/a", "--format", "ply")``.

    Returns what it prints, as text; with `json_output` the object that ``--json`` makes it print.

    Raises:
        CommandError: it ended with another code than 0.
        KeyboardInterrupt: once the verb has ended in order, as it does after Ctrl-C in a terminal.
    """
    line: List[str] = [program(), *(os.fspath(w) if hasattr(w, "__fspath__") else str(w) for w in words)]
    if json_output:
        line.append("--json")
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, encoding="utf-8") as running:
        try:
            out, told = running.communicate()
        except KeyboardInterrupt:
            running.send_signal(signal.SIGINT)  # it ends in order: a training writes its checkpoint
            running.communicate()
            raise
    if running.returncode != 0:
        named = re.search(r"\[(\w+(?:\.\w+){1,3})\]\s*$", told)  # behind the sentence of the error
        error = CommandError(f"semfield {' '.join(line[1:])}: {told.strip() or out.strip()}", exit_code=running.returncode,
                             code=named.group(1) if named else "python.program.failed")
        error.stderr = told
        raise error
    return json.loads(out) if json_output else out


def tune(config: PathLike, time: str = "2m", *words: Any) -> Dict[str, Any]:
    """Finds the settings that a scene's own held-out training views ask for, as ``semfield tune``, and returns what its
    ``--json`` prints: ``sf.open(sf.tune("room.yaml", "5m", "--length", "30s")["config"])``. Errors are those of `command`."""
    told: Dict[str, Any] = command("tune", config, "--time", time, "--quiet", *words, json_output=True)
    return told


@dataclasses.dataclass(frozen=True)
class Object:
    """One thing of the scene. Lengths and areas are in the unit of the input, metres in a metric scene.

    Attributes:
        id: from 1; its value in the images of ids.
        name: "chair 3", or the name that a person gave it.
        class_name: "" if it is not known.
        class_probability: share of the votes for the class.
        agreement: mean share of what a view sees of it that is in one segment.
        views: training views that see it.
        points: of the surface, one per cell.
        area: of the surface that is seen.
        centroid: [3], world.
        box_center: [3] of a turned box around it.
        box_axes: [3, 3], a unit vector in each row.
        box_size: [3], edges along the axes.
    """

    id: int
    name: str
    class_name: str
    class_probability: float
    agreement: float
    views: int
    points: int
    area: float
    centroid: Array
    box_center: Array
    box_axes: Array
    box_size: Array


@dataclasses.dataclass(frozen=True)
class Objects:
    """What was found.

    Attributes:
        folder: of the images and tables (docs/guide/objects.md).
        objects: in the order of their ids.
        seconds: of each part of the work.
        score: figures against the true objects of the scene, None unless asked for.
    """

    folder: str
    objects: Tuple[Object, ...]
    seconds: Dict[str, float]
    score: Optional[Dict[str, float]]

    def count(self) -> Dict[str, int]:
        """How many objects each class has."""
        found: Dict[str, int] = {}
        for one in self.objects:
            found[one.class_name] = found.get(one.class_name, 0) + 1
        return found


def _object(row: Dict[str, Any]) -> Object:
    box = row["box"]
    plain = {name: row[name] for name in ("id", "name", "class_probability", "agreement", "views", "points", "area")}
    return Object(**plain, class_name=row["class"] or "", centroid=np.array(row["centroid"], float), box_center=np.array(box["center"], float),
                  box_axes=np.array(box["axes"], float), box_size=np.array(box["size"], float))


def find_objects(run_dir: PathLike, segments: Optional[PathLike], set: Optional[Mapping[str, Any]],  # noqa: A002 - as in open()
                 out: Optional[PathLike], score: bool) -> Objects:
    words: List[Any] = ["objects", run_dir, "--quiet"]
    for option, given in (("--segments", segments), ("--out", out)):
        words += [] if given is None else [option, given]
    if score:
        words.append("--score")
    for key, value in (set or {}).items():
        words += ["--set", f"{key}={value if isinstance(value, str) else json.dumps(value)}"]
    told = command(*words, json_output=True)
    table = json.loads((pathlib.Path(told["folder"]) / "objects.json").read_text(encoding="utf-8"))
    return Objects(told["folder"], tuple(_object(row) for row in table["objects"]), told["seconds"], told.get("score"))
