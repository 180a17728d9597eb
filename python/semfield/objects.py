"""Objects of a run: what `semfield objects` finds."""

from __future__ import annotations

import dataclasses
import json
import os
import pathlib
from typing import Any, Dict, List, Mapping, Optional, Tuple, Union

import numpy as np

from .program import command

PathLike = Union[str, "os.PathLike[str]"]
Array = np.ndarray[Any, Any]


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
    if segments is not None:
        words += ["--segments", segments]
    if out is not None:
        words += ["--out", out]
    if score:
        words.append("--score")
    for key, value in (set or {}).items():
        words += ["--set", f"{key}={value if isinstance(value, str) else json.dumps(value)}"]
    told = command(*words, json_output=True)
    table = json.loads((pathlib.Path(told["folder"]) / "objects.json").read_text(encoding="utf-8"))
    return Objects(told["folder"], tuple(_object(row) for row in table["objects"]), told["seconds"], told.get("score"))
