"""Clicks and classes of a run."""

from __future__ import annotations

import json
import uuid
from typing import Any, Callable, Dict, List, Optional, Sequence, Tuple, Union

import numpy as np

from .errors import Error, UsageError
from .scenes import _floats, _number, _whole


class Labels:
    """Clicks and classes of a run; each counts from the next step on, and is stored before the call returns.

    The run must have been opened with `class_room` and `out`, or its configuration names a file of clicks.
    """

    def __init__(self, session: Any, frame: Callable[[Union[str, int]], Dict[str, Any]]) -> None:
        self._session: Any = session
        self._frame = frame

    def __repr__(self) -> str:
        return f"Labels(clicks={len(self.clicks)}, classes={self.classes})"

    def _apply(self, kind: str, **more: Any) -> str:
        if self._session.trains and not self._session.config()["scene"]["labels"]["clicks"]:
            raise UsageError("this run has no place for clicks; open it with class_room= and out=: "
                             "semfield.open(config, out=\"runs/a\", class_room=20)", code="labels.clicks.missing")
        event = {"id": uuid.uuid4().hex, "type": kind, **more}
        try:
            self._session.apply(json.dumps(event))
        except Error as error:  # the event is the caller's: its id says nothing
            name = f"event '{event['id']}': "
            findings = [f._replace(message=f.message.replace(name, "")) for f in error.findings]
            raise type(error)(str(error).replace(name, ""), findings, error.remedy, error.context, error.exit_code,
                              error.code) from None
        return str(event["id"])

    def add_class(self, name: str, color: Optional[Tuple[int, int, int]] = None) -> str:
        """Adds a class; there is room for as many as the run was opened with. Returns the id for undo."""
        more: Dict[str, Any] = {"name": name}
        if color is not None:
            more["color"] = [_whole("color", c, 0, 255) for c in color]
        return self._apply("class", **more)

    def add_click(self, frame: Union[str, int], x: float, y: float, class_: str, radius_px: float = 0.0) -> str:
        """Names a pixel of a training frame.

        Args:
            frame: its name or number.
            x, y: pixels of the loaded frame; the first pixel's centre is (0.5, 0.5).
            class_: name of a class.
            radius_px: pixels within this distance are named too.

        Returns:
            The id for undo.
        """
        return self.add_stroke(frame, [(x, y)], class_, radius_px)

    def add_stroke(self, frame: Union[str, int], points: Sequence[Tuple[float, float]], class_: str, radius_px: float = 0.0) -> str:
        """Names the pixels along a line through `points`, [N, 2] pixels x, y."""
        known = self._frame(frame)
        at = _floats("points", points)
        if at.ndim != 2 or at.shape[1] != 2 or not np.isfinite(at).all():
            raise UsageError(f"a click is at finite x and y, and a stroke at [N, 2] of them; got {points!r}",
                             code="python.value.type")
        size = [known["camera"]["width"], known["camera"]["height"]]
        return self._apply("click", frame=known["name"], size=size, radius=_number("radius_px", radius_px),
                           points=at.tolist(), **{"class": class_})

    def rename_class(self, name: str, new_name: str, color: Optional[Tuple[int, int, int]] = None) -> str:
        """Gives a class that was added another name, or with the same name another colour. Returns the id for undo."""
        more: Dict[str, Any] = {} if color is None else {"color": [_whole("color", c, 0, 255) for c in color]}
        return self._apply("rename", **{"class": name, "name": new_name, **more})

    def undo(self, event: str) -> str:
        """Takes a click, a class or an undo back."""
        return self._apply("undo", of=event)

    @property
    def clicks(self) -> List[Dict[str, Any]]:
        """Clicks in force: id, frame, points, radius_px, class_ (None: labels are taken away)."""
        return list(self._session.annotations()["clicks"])

    @property
    def classes(self) -> List[str]:
        """Names of the classes that have one."""
        return list(self._session.annotations()["named"])


