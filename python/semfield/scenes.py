"""Scenes as Python knows them: cameras, frames, classes, and whole scenes made of arrays."""

from __future__ import annotations

import dataclasses
import operator
import os
import tempfile
import weakref
from typing import Any, Dict, List, Mapping, Optional, Sequence, Tuple, Union

import numpy as np

from . import _core
from .errors import DataError, UsageError

PathLike = Union[str, "os.PathLike[str]"]


class _Arrays:
    """A short repr for what holds arrays: their types and shapes instead of their numbers."""

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
        if np.iscomplexobj(np.asarray(value)):
            raise TypeError("complex ones are none")
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise UsageError(f"{what}: expected numbers: {error}", code="python.value.type") from None


def _number(what: str, value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise UsageError(f"{what}: {value!r} is not a number", code="python.value.type") from None


def _whole(what: str, value: Any, low: int = 0, high: int = 2**31 - 1) -> int:
    try:
        number = operator.index(value)
    except TypeError:
        raise UsageError(f"{what}: {value!r} is not a whole number", code="python.value.type") from None
    if not low <= number <= high:
        raise UsageError(f"{what}: {number} is out of range; expected {low} to {high}", code="python.value.range")
    return number


def _pixels(what: str, value: Any) -> int:
    number = _number(what, value)
    if not number.is_integer():
        raise UsageError(f"{what} {value!r} is not a whole number of pixels", code="python.value.type")
    return _whole(what, int(number), -2**31)


@dataclasses.dataclass(frozen=True)
class Camera:
    """A camera and its lens.

    Attributes:
        width, height: pixels.
        fx, fy: focal lengths, pixels; fy that is not given is fx. Of a wide lens pixels per radian: a whole panorama has
            width / (2 pi) and height / pi.
        cx, cy: principal point, pixels; the centre of the first pixel is (0.5, 0.5). Not given: the middle.
        distortion: k1, k2, p1, p2, k3, k4 of the lens [Brown66]; missing ones are 0. A fisheye has k1 to k4 [Kannala06].
        lens: "perspective", "fisheye" or "equirectangular"; depth of the latter two is the distance along the ray.
    """

    width: int
    height: int
    fx: float
    fy: float = None  # type: ignore[assignment]  # a number once it is made
    cx: float = None  # type: ignore[assignment]
    cy: float = None  # type: ignore[assignment]
    distortion: Tuple[float, ...] = ()
    lens: str = "perspective"

    def __post_init__(self) -> None:
        width, height = _pixels("camera: width", self.width), _pixels("camera: height", self.height)
        lens = tuple(_floats("camera: distortion", self.distortion).ravel().tolist())
        if len(lens) > 6:
            raise UsageError(f"camera: distortion has {len(lens)} numbers; k1, k2, p1, p2, k3, k4 are known",
                             code="python.value.length")
        if self.lens not in ("perspective", "fisheye", "equirectangular"):
            raise UsageError(f"camera: lens {self.lens!r}; perspective, fisheye and equirectangular are known",
                             code="python.value.range")
        made: Dict[str, Any] = {"width": width, "height": height, "distortion": lens}
        for name, otherwise in (("fx", None), ("fy", self.fx), ("cx", width / 2), ("cy", height / 2)):
            given = getattr(self, name)
            made[name] = _number(f"camera: {name}", otherwise if given is None else given)
        for name, value in made.items():
            object.__setattr__(self, name, value)  # the class is frozen

    @staticmethod
    def from_fov(width: int, height: int, degrees: float) -> "Camera":
        """A camera with this horizontal field of view, above 0 and below 180 degrees."""
        angle = _number("from_fov: degrees", degrees)
        if not 0 < angle < 180:
            raise UsageError(f"from_fov: degrees {degrees!r}: a lens sees more than 0 and less than 180 degrees",
                             code="python.value.range")
        return Camera(width, height, 0.5 * _pixels("camera: width", width) / float(np.tan(np.radians(angle) / 2)))

    def resized(self, width: int, height: int) -> "Camera":
        """The same view at another size."""
        x, y = (_pixels(what, side) / own for what, side, own in
                (("camera: width", width, self.width), ("camera: height", height, self.height)))
        return Camera(width, height, self.fx * x, self.fy * y, self.cx * x, self.cy * y, self.distortion, self.lens)

    def _dict(self) -> Dict[str, Any]:
        return {**vars(self), "distortion": self.distortion + (0.0,) * (6 - len(self.distortion))}


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
        mask: [H, W], 0 where a pixel is masked: it draws no ray and is in no score; None: every pixel counts.
        channels: further numbers by name, [h, w, k] float32 on grids of their own that cover the image, for losses that
            name them in `targets`; of a dataset's `frames`, their shapes alone.
    """

    name: str
    camera: Camera
    pose: np.ndarray[Any, Any]
    split: str = "train"
    rgb: Optional[np.ndarray[Any, Any]] = None
    labels: Optional[np.ndarray[Any, Any]] = None
    depth_m: Optional[np.ndarray[Any, Any]] = None
    mask: Optional[np.ndarray[Any, Any]] = None
    has_labels: bool = False
    has_depth: bool = False
    source: str = ""
    channels: Mapping[str, Any] = dataclasses.field(default_factory=dict)


def _mask(mask: Optional[np.ndarray[Any, Any]]) -> Optional[np.ndarray[Any, Any]]:
    return None if mask is None else (np.asarray(mask) != 0).astype(np.uint8)


def _class_rows(classes: Any) -> List[Tuple[int, str, Optional[Tuple[int, int, int]], bool]]:
    if classes is None:
        return []
    if isinstance(classes, Mapping):
        classes = [ClassEntry(k, str(v)) for k, v in classes.items()]
    rows = []
    for i, item in enumerate(classes):
        if isinstance(item, str):
            item = ClassEntry(i, item)
        if not isinstance(item, ClassEntry):
            raise UsageError(f"class {i}: {item!r} is neither a name nor a ClassEntry", code="python.value.type")
        color: Optional[Tuple[int, int, int]] = None
        if item.color is not None:
            if len(item.color) != 3 or not all(0 <= c <= 255 for c in item.color):
                raise UsageError(f"class {item.name!r}: color {item.color!r}: expected red, green and blue of 0 to 255",
                                 code="python.value.range")
            color = (int(item.color[0]), int(item.color[1]), int(item.color[2]))
        rows.append((_whole(f"class {item.name!r}: id", item.id, -2**31), str(item.name), color, bool(item.ignore)))
    return rows


def _description(name: str, frames: Sequence[Frame], classes: Any, bounds: Any, near: float, far: float, metric: bool) -> Dict[str, Any]:
    """What the extension reads of a scene whose pixels come one by one."""
    for f in frames:
        for channel, c in f.channels.items():
            shape = tuple(getattr(c, "shape", c))
            if len(shape) != 3 or min(shape) < 1:
                raise DataError(f"frame {f.name!r}: channel {channel!r} has the shape {shape}", code="python.array.shape",
                                remedy="give rows, columns and numbers of a pixel, each above 0")
    return {
        "name": name, "classes": _class_rows(classes), "bounds": None if bounds is None else _floats("bounds", bounds),
        "near": _number("near", near), "far": _number("far", far), "metric": bool(metric),
        "frames": [{
            "name": f.name, "source": f.source or f.name, "camera": f.camera._dict(), "pose": f.pose, "split": f.split,
            "has_depth": bool(f.has_depth), "has_labels": bool(f.has_labels),
            "channels": {channel: tuple(int(n) for n in getattr(c, "shape", c)) for channel, c in f.channels.items()},
        } for f in frames],
    }


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
        overwrite: a packed scene that `file` names already may be replaced; any other file never is.
        masks: N arrays [H, W], 0 where a pixel is masked, or None.

    Raises:
        DataError: with everything that is wrong with every frame in `findings`.
        UsageError: there is such a file.
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
        overwrite: bool = False,
        masks: Optional[Sequence[Optional[np.ndarray[Any, Any]]]] = None,
    ) -> None:
        if file is not None:
            _refuse_to_replace(os.fspath(file), overwrite)
        try:
            count = len(images)
        except TypeError:
            raise UsageError(f"images: {type(images).__name__} has no length; give a list of arrays",
                             code="python.value.type") from None
        poses = _floats("poses", poses)
        all_cameras = [cameras] * count if isinstance(cameras, Camera) else list(cameras)
        all_labels: List[Optional[np.ndarray[Any, Any]]] = [None] * count if labels is None else list(labels)
        all_depths: List[Optional[np.ndarray[Any, Any]]] = [None] * count if depths is None else list(depths)
        all_masks: List[Optional[np.ndarray[Any, Any]]] = [None] * count if masks is None else list(masks)
        all_names = [f"{i:04d}" for i in range(count)] if names is None else [str(n) for n in names]
        for what, given in (("poses", poses), ("cameras", all_cameras), ("labels", all_labels),
                            ("depths", all_depths), ("masks", all_masks), ("names", all_names)):
            if len(given) != count:
                raise UsageError(f"{what}: {len(given)} for {count} images", code="python.value.length")
        if count == 0:
            raise UsageError("images: a scene has at least one", code="scene.frames.none")
        if any(m is not None for m in all_labels) and classes is None:
            raise UsageError("labels: classes tell what their ids mean, and there are none", code="labels.classes.none")
        if not all(isinstance(c, Camera) for c in all_cameras):
            raise UsageError("cameras: expected one Camera for all images, or one for each", code="python.value.length")
        held_out = {_whole("test", i, -2**31) for i in test}
        if not held_out <= set(range(count)):
            raise UsageError(f"test: {sorted(held_out - set(range(count)))} are not indices of {count} images",
                             code="python.frame.range")
        frames = [Frame(all_names[i], all_cameras[i], poses[i], "test" if i in held_out else "train",
                        has_labels=all_labels[i] is not None, has_depth=all_depths[i] is not None) for i in range(count)]
        description = _description(name, frames, classes, bounds, near, far, metric)

        def read(i: int) -> Dict[str, Any]:
            return {"rgb": np.asarray(images[i]), "labels": all_labels[i], "depth_m": all_depths[i], "mask": _mask(all_masks[i])}

        self.temporary = file is None
        if file is None:
            handle, path = tempfile.mkstemp(prefix="semfield_", suffix=".sfpack")
            os.close(handle)
            self._remove = weakref.finalize(self, _remove_file, path, os.getpid())
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


def _refuse_to_replace(path: str, overwrite: bool) -> None:
    if not os.path.lexists(path):
        return
    if not overwrite:
        raise UsageError(f"{path!r} is there already; name another file, or give overwrite=True to replace that scene",
                         code="files.output.exists")
    if not (os.path.isfile(path) and _core.is_pack(path)):
        raise UsageError(f"{path!r} is not a packed scene, so it is not replaced; name another file", code="files.output.foreign")


def _remove_file(path: str, owner: int) -> None:
    if os.getpid() != owner:  # a fork: the file is its parent's
        return
    try:
        os.remove(path)
    except OSError:
        pass
