"""Scenes as Python knows them: cameras, frames, classes, and whole scenes made of arrays."""

from __future__ import annotations

import dataclasses
import os
import tempfile
import weakref
from typing import Any, Dict, List, Mapping, Optional, Sequence, Tuple, Union

import numpy as np

from . import _core
from .errors import UsageError

PathLike = Union[str, "os.PathLike[str]"]


class _Arrays:
    """A short repr for what holds arrays: their types and shapes in place of their numbers."""

    def __repr__(self) -> str:
        shown = []
        for name, value in vars(self).items():
            if value is None:
                continue
            shape = getattr(value, "shape", None)
            text = repr(value) if shape is None else f"{value.dtype}{list(shape)}"
            shown.append(f"{name}={text}")
        return f"{type(self).__name__}({', '.join(shown)})"


def _floats(what: str, value: Any) -> np.ndarray[Any, Any]:
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise UsageError(f"{what}: expected numbers: {error}") from None


@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera with a lens.

    Attributes:
        width, height: pixels.
        fx, fy: focal lengths, pixels.
        cx, cy: principal point, pixels; the centre of the first pixel is (0.5, 0.5). None: the middle.
        distortion: k1, k2, p1, p2, k3, k4 of the lens [Brown66]; missing ones are 0.
    """

    width: int
    height: int
    fx: float
    fy: Optional[float] = None
    cx: Optional[float] = None
    cy: Optional[float] = None
    distortion: Tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name, side in (("width", self.width), ("height", self.height)):
            if int(side) != side:
                raise UsageError(f"camera: {name} {side!r} is no whole number of pixels")
        if len(self.distortion) > 6:
            raise UsageError(f"camera: distortion has {len(self.distortion)} numbers; k1, k2, p1, p2, k3, k4 are known")

    @staticmethod
    def from_fov(width: int, height: int, degrees: float) -> "Camera":
        """A camera with this horizontal field of view."""
        return Camera(width, height, 0.5 * width / float(np.tan(np.radians(degrees) / 2)))

    def resized(self, width: int, height: int) -> "Camera":
        """The same view at another size."""
        full = self._dict()
        x, y = width / self.width, height / self.height
        return Camera(width, height, full["fx"] * x, full["fy"] * y, full["cx"] * x, full["cy"] * y, self.distortion)

    def _dict(self) -> Dict[str, Any]:
        lens = tuple(float(v) for v in self.distortion) + (0.0,) * (6 - len(self.distortion))
        return {
            "width": int(self.width), "height": int(self.height), "fx": float(self.fx),
            "fy": float(self.fx if self.fy is None else self.fy),
            "cx": float(self.width / 2 if self.cx is None else self.cx),
            "cy": float(self.height / 2 if self.cy is None else self.cy), "distortion": lens,
        }


@dataclasses.dataclass(frozen=True)
class ClassEntry:
    """A class of a scene.

    Attributes:
        id: as label images have it.
        name: as people say it.
        color: red, green, blue, 0 to 255; None: a colour that belongs to the id.
        ignore: pixels of it count in no loss and no score.
        index: place among the classes that count, which is the last axis of probabilities; -1 where it is not known yet.
        learned: some training label had it, so the field can name it.
    """

    id: int
    name: str
    color: Optional[Tuple[int, int, int]] = None
    ignore: bool = False
    index: int = -1
    learned: bool = False


@dataclasses.dataclass(eq=False, repr=False)
class Frame(_Arrays):
    """An image of a scene with its camera, and what is known of its pixels.

    Attributes:
        name: unique in its scene.
        camera: of the image.
        pose: [4, 4] float64, camera to world, OpenCV axes.
        split: train, test or unused.
        rgb: [H, W, 3] uint8, display-referred; None where pixels stay in the program (`Run.pixels`).
        labels: [H, W] class ids, -1 for none; None without labels.
        depth_m: [H, W] float32, z-depth in metres, 0 for none; None without depth.
    """

    name: str
    camera: Camera
    pose: np.ndarray[Any, Any]
    split: str = "train"
    rgb: Optional[np.ndarray[Any, Any]] = None
    labels: Optional[np.ndarray[Any, Any]] = None
    depth_m: Optional[np.ndarray[Any, Any]] = None
    has_labels: bool = False
    has_depth: bool = False
    source: str = ""


def _class_rows(classes: Any) -> List[Tuple[int, str, Optional[Tuple[int, int, int]], bool]]:
    if classes is None:
        return []
    if isinstance(classes, Mapping):
        classes = [ClassEntry(int(k), str(v)) for k, v in classes.items()]
    rows = []
    for i, item in enumerate(classes):
        if isinstance(item, str):
            item = ClassEntry(i, item)
        color: Optional[Tuple[int, int, int]] = None
        if item.color is not None:
            if len(item.color) != 3 or not all(0 <= c <= 255 for c in item.color):
                raise UsageError(f"class {item.name!r}: color {item.color!r}: expected red, green and blue of 0 to 255")
            color = (int(item.color[0]), int(item.color[1]), int(item.color[2]))
        rows.append((int(item.id), str(item.name), color, bool(item.ignore)))
    return rows


class Scene:
    """A scene made of arrays, kept in one packed file that every verb of the program reads, too.

    Args:
        images: N arrays [H, W, 3] uint8.
        poses: [N, 4, 4] or [N, 3, 4], camera to world, OpenCV axes; metres where `metric`.
        cameras: one Camera for all images, or one for each.
        labels: N arrays [H, W] of class ids, -1 for none, or None for images without labels; None: no labels.
        classes: names in the order of their ids, {id: name}, or ClassEntry objects. Needed with labels.
        depths: N arrays [H, W], z-depth in metres, or None.
        names: of the frames; default 0000, 0001, ...
        test: indices of the frames that are held out to score with.
        bounds: [2, 3] lowest and highest corner of the content, world; None: found from cameras and depth.
        near, far: distances along rays, metres; 0: found.
        metric: False where the unit is unknown.
        file: where the packed scene is kept. None: a temporary file, which is gone with this object; a run of it can
            then not be saved.

    Raises:
        DataError: with all that is wrong in `findings`; what several frames have in common is one of them.
    """

    def __init__(
        self,
        images: Sequence[np.ndarray[Any, Any]],
        poses: Any,
        cameras: Union[Camera, Sequence[Camera]],
        labels: Optional[Sequence[Optional[np.ndarray[Any, Any]]]] = None,
        classes: Any = None,
        depths: Optional[Sequence[Optional[np.ndarray[Any, Any]]]] = None,
        names: Optional[Sequence[str]] = None,
        test: Sequence[int] = (),
        bounds: Any = None,
        near: float = 0.0,
        far: float = 0.0,
        metric: bool = True,
        name: str = "arrays",
        file: Optional[PathLike] = None,
    ) -> None:
        count = len(images)
        poses = _floats("poses", poses)
        all_cameras = [cameras] * count if isinstance(cameras, Camera) else list(cameras)
        all_labels: List[Optional[np.ndarray[Any, Any]]] = [None] * count if labels is None else list(labels)
        all_depths: List[Optional[np.ndarray[Any, Any]]] = [None] * count if depths is None else list(depths)
        all_names = [f"{i:04d}" for i in range(count)] if names is None else [str(n) for n in names]
        for what, given in (("poses", poses), ("cameras", all_cameras), ("labels", all_labels),
                            ("depths", all_depths), ("names", all_names)):
            if len(given) != count:
                raise UsageError(f"{what}: {len(given)} for {count} images")
        if count == 0:
            raise UsageError("images: a scene has at least one")
        if any(m is not None for m in all_labels) and classes is None:
            raise UsageError("labels: classes tell what their ids mean, and there are none")
        held_out = {int(i) for i in test}
        if not held_out <= set(range(count)):
            raise UsageError(f"test: {sorted(held_out - set(range(count)))} are no indices of {count} images")
        frames = []
        for i in range(count):
            frames.append({
                "name": all_names[i], "source": all_names[i], "camera": all_cameras[i]._dict(), "pose": poses[i],
                "split": "test" if i in held_out else "train", "has_depth": all_depths[i] is not None,
                "has_labels": all_labels[i] is not None,
            })
        description = {
            "name": name, "frames": frames, "classes": _class_rows(classes),
            "bounds": None if bounds is None else _floats("bounds", bounds), "near": float(near),
            "far": float(far), "metric": bool(metric),
        }

        def read(i: int) -> Dict[str, Any]:
            return {"rgb": np.asarray(images[i]), "labels": all_labels[i], "depth_m": all_depths[i]}

        self.temporary = file is None
        if file is None:
            handle, path = tempfile.mkstemp(prefix="semfield_", suffix=".sfpack")
            os.close(handle)
            self._remove = weakref.finalize(self, _remove_file, path)
            _temporary[path] = self
        else:
            path = os.fspath(file)
        #: Absolute path of the packed scene: `scene: {type: packed, file: ...}` of a configuration.
        self.file = os.path.abspath(path)
        self._text = f"{name!r}, frames={count}, file={self.file!r}"
        _core.write_pack(self.file, description, read)

    def __repr__(self) -> str:
        return f"Scene({self._text}{', temporary' if self.temporary else ''})"

    def __reduce__(self) -> Any:
        raise TypeError("a Scene cannot be pickled: name its file, Scene(..., file=\"room.sfpack\"), and send scene.config()")

    def config(self) -> Dict[str, Any]:
        """The section `scene` of a configuration that reads this scene."""
        return {"type": "packed", "file": self.file}


#: Scenes in temporary files by path, so that runs keep those that they read.
_temporary: "weakref.WeakValueDictionary[str, Scene]" = weakref.WeakValueDictionary()


def _remove_file(path: str) -> None:
    try:
        os.remove(path)
    except OSError:
        pass
