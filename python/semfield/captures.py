"""Scenes out of photographs and videos."""

from __future__ import annotations

import dataclasses
import os
from typing import Any, List, Optional, Tuple, Union

from .program import command

PathLike = Union[str, "os.PathLike[str]"]


@dataclasses.dataclass(frozen=True)
class Prepared:
    """A scene that `prepare` made: `sf.open` takes {"scene": prepared.config()}.

    Attributes:
        folder: of the scene.
        photographs: how many there are, or how many frames of a video were kept.
        registered: how many of them have a pose.
        error_px: mean reprojection error, pixels.
        points: that tell where the scene is.
        attempts: that finding the poses took.
        missing: a sentence for each run of photographs without a pose, with what to do.
    """

    folder: str
    photographs: int
    registered: int
    error_px: float
    points: int
    attempts: int
    missing: Tuple[str, ...]

    def config(self) -> dict[str, Any]:
        """The section `scene` of a configuration that reads this scene."""
        return {"type": "colmap", "root": os.path.abspath(self.folder)}


def prepare(source: PathLike, out: PathLike, frames: int = 0, attempts: int = 0, threads: Optional[int] = None, lens: str = "auto") -> Prepared:
    """Makes a scene of a video or of photographs: finds their camera poses with COLMAP. One that was stopped continues.

    Args:
        source: a video, or a folder of photographs; it is never written to.
        out: the scene's folder.
        frames: of a video, at most; 0: three a second, 30 to 300.
        attempts: to give every photograph a pose, at most 4. 0: 4, or as many as a finished scene was given.
        threads: of COLMAP; None: every core.
        lens: "auto", "fisheye", or "equirectangular" for panoramas, each of which becomes eight views.

    Raises:
        CommandError: a program is missing or failed, the source cannot be used, or no poses were found.
    """
    words: List[Any] = ["prepare", source, "--out", out, "--frames", frames, "--attempts", attempts, "--lens", lens, "--quiet"]
    if threads is not None:
        words += ["--threads", threads]
    told = command(*words, json_output=True)
    return Prepared(**{f.name: told[f.name] for f in dataclasses.fields(Prepared) if f.name != "missing"},
                    missing=tuple(told["missing"]))
