"""Runs: opened, trained step by step, labelled, looked at, asked, saved; and what their calls give back."""

from __future__ import annotations

import dataclasses
import difflib
import json
import os
import uuid
import warnings
from typing import Any, Callable, Dict, Iterator, List, Mapping, Optional, Sequence, Tuple, Union

import numpy as np

from . import _core
from .errors import Error, UsageError
from .program import Array, Objects, find_objects
from .scenes import Camera, ClassEntry, Frame, PathLike, Scene, _Arrays, _floats, _number, _pixels, _temporary, _whole

Config = Union[str, "os.PathLike[str]", Mapping[str, Any]]
FrameId = Union[str, int]  #: name of a frame, or its number in `Run.frames`


@dataclasses.dataclass(frozen=True)
class Step:
    """Where a training is.

    Attributes:
        step: steps made.
        train_s: seconds of training.
        loss: total, mean over the steps since the last report; as are the next ones.
        loss_color, loss_semantic: parts of it, before their weights; semantic in nats.
        psnr: of the training rays, dB.
        terms: value of each further term of the loss that has begun.
        steps_per_s: speed since the last report.
    """

    step: int
    train_s: float
    loss: float
    loss_color: float
    loss_semantic: float
    psnr: float
    terms: Dict[str, float]
    steps_per_s: float


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class View(_Arrays):
    """What a camera sees.

    Attributes:
        rgb: [H, W, 3] float32 in [0, 1], display-referred.
        depth_m: [H, W] float32, z-depth in metres, expected value, not divided by opacity.
        opacity: [H, W] float32 in [0, 1].
        label: [H, W] int32, class ids of the scene; None without semantics, as are the next three.
        entropy: [H, W] float32, nats.
        confidence: [H, W] float32, probability of the label.
        probability: [H, W, C] float32, in the order of `Run.classes`; None where it was not asked for.
        camera: what was rendered; with `stride` n the maps have every n-th of its pixels.
        pose: [4, 4] float64, camera to world.
        channels: [H, W, C] float32 each, by name: those of heads that were asked for.
    """

    rgb: Array
    depth_m: Array
    opacity: Array
    label: Optional[Array]
    entropy: Optional[Array]
    confidence: Optional[Array]
    probability: Optional[Array]
    camera: Camera
    pose: np.ndarray[Any, Any]
    channels: Dict[str, Array] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Points(_Arrays):
    """The field at N points.

    Attributes:
        density: [N] float32, 1/m; 0 outside the bounds that rays are clipped to.
        rgb: [N, 3] float32 in [0, 1]; None where no directions were given.
        label: [N] int32, class ids; None without semantics, as are the next two.
        probability: [N, C] float32, in the order of `Run.classes`.
        entropy: [N] float32, nats.
    """

    density: np.ndarray[Any, Any]
    rgb: Optional[np.ndarray[Any, Any]]
    label: Optional[np.ndarray[Any, Any]]
    probability: Optional[np.ndarray[Any, Any]]
    entropy: Optional[np.ndarray[Any, Any]]


class Score:
    """Scores of frames, pooled over all their pixels.

    Every name of `values` is an attribute too: ``score.miou_present``. A figure without data is None.

    Attributes:
        values: name to figure: psnr (dB), ssim, miou, miou_present, total_accuracy, absrel, ece, ...
        detail: what final_eval.json holds: classes, confusion, reliability, entropy, per_frame.
    """

    def __init__(self, values: Dict[str, Optional[float]], detail: Dict[str, Any]) -> None:
        self.values = values
        self.detail = detail

    def __getattr__(self, name: str) -> Optional[float]:
        values: Dict[str, Optional[float]] = self.__dict__.get("values", {})
        if name in values:
            return values[name]
        raise AttributeError(f"no score named {name!r}; there are {', '.join(values)}")

    def __dir__(self) -> List[str]:
        return [*super().__dir__(), *self.values]

    @property
    def confusion(self) -> np.ndarray[Any, Any]:
        """[K, K] int64 pixels, row = truth, column = prediction, in the order of detail["classes"]."""
        return np.asarray(self.detail["confusion"]["pixels"], dtype=np.int64)

    def __repr__(self) -> str:
        shown = ", ".join(f"{k}={'none' if v is None else f'{v:.4g}'}" for k, v in self.values.items())
        return f"Score({shown})"


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What `train` left.

    Attributes:
        run_dir: the run's folder.
        report: path of report.html; "" where none was asked for.
        step: steps made.
        train_s: seconds of training.
        scores: figures of the test frames; empty without any.
        scored: which part of them was scored.
        notes: messages of the run.
    """

    run_dir: str
    report: str
    step: int
    train_s: float
    scores: Dict[str, Optional[float]]
    scored: str
    notes: List[str]


def _color(color: Optional[Tuple[int, int, int]]) -> Dict[str, Any]:
    return {} if color is None else {"color": [_whole("color", c, 0, 255) for c in color]}


class Labels:
    """Clicks and classes of a run; each counts from the next step on, and is stored before the call returns.

    The run must have been opened with `class_room` and `out`, or its configuration names a file of clicks.
    """

    def __init__(self, run: "Run") -> None:
        self._run = run

    def __repr__(self) -> str:
        return f"Labels(clicks={len(self.clicks)}, classes={self.classes})"

    def _apply(self, kind: str, **more: Any) -> str:
        if self._run._trains and not self._run.config["scene"]["labels"]["clicks"]:
            raise UsageError("this run has no place for clicks; open it with class_room= and out=: "
                             "semfield.open(config, out=\"runs/a\", class_room=20)", code="labels.clicks.missing")
        event = {"id": uuid.uuid4().hex, "type": kind, **more}
        try:
            self._run._apply(json.dumps(event))
        except Error as error:  # the event is the caller's: its id says nothing
            name = f"event '{event['id']}': "
            findings = [f._replace(message=f.message.replace(name, "")) for f in error.findings]
            raise type(error)(str(error).replace(name, ""), findings, error.remedy, error.context, error.exit_code,
                              error.code) from None
        return str(event["id"])

    def add_class(self, name: str, color: Optional[Tuple[int, int, int]] = None) -> str:
        """Adds a class; there is room for as many as the run was opened with. Returns the id for undo."""
        return self._apply("class", name=name, **_color(color))

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
        known = self._run._frame(frame)
        at = _floats("points", points)
        if at.ndim != 2 or at.shape[1] != 2 or not np.isfinite(at).all():
            raise UsageError(f"a click is at finite x and y, and a stroke at [N, 2] of them; got {points!r}",
                             code="python.value.type")
        return self._apply("click", frame=known.name, size=[known.camera.width, known.camera.height],
                           radius=_number("radius_px", radius_px), points=at.tolist(), **{"class": class_})

    def rename_class(self, name: str, new_name: str, color: Optional[Tuple[int, int, int]] = None) -> str:
        """Gives a class that was added another name, or with the same name another colour. Returns the id for undo."""
        return self._apply("rename", **{"class": name, "name": new_name, **_color(color)})

    def undo(self, event: str) -> str:
        """Takes a click, a class or an undo back."""
        return self._apply("undo", of=event)

    @property
    def clicks(self) -> List[Dict[str, Any]]:
        """Clicks in force: id, frame, points, radius_px, class_ (None: labels are taken away)."""
        return list(self._run._annotations()[0])

    @property
    def classes(self) -> List[str]:
        """Names of the classes that have one."""
        return list(self._run._annotations()[1])


class Training(Iterator[Step]):
    """Steps that are made while somebody asks for them: ``for step in run.train(3000)``, or ``run.train(3000).last()``."""

    def __init__(self, run: "Run", steps: Optional[int], every: int) -> None:
        self._run = run
        self._left = steps  # None: to the end of the run's length
        self._every = every
        self._asked = steps == 0

    def __next__(self) -> Step:
        self._asked = True
        run = self._run
        left = run._steps_left if self._left is None else self._left
        if left == 0:
            raise StopIteration
        made = run._train(self._every if left < 0 else min(self._every, left), self._left is None)
        if self._left is not None:
            self._left -= made["steps"]
        mse = max(made["mse"], 1e-300)
        return Step(run.step, run.train_s, made["loss"], made["color"], made["semantic"], -10 * float(np.log10(mse)),
                    made["terms"], made["steps"] / max(made["seconds"], 1e-9))

    def last(self) -> Optional[Step]:
        """Makes all steps that are left. Returns the last report; None where no step was left."""
        step = None
        for step in self:
            pass
        return step

    def __repr__(self) -> str:
        return f"Training(steps left: {'to the end of the run' if self._left is None else self._left})"

    def __del__(self) -> None:
        if not getattr(self, "_asked", True):
            warnings.warn("run.train(...) trained nothing, as nobody asked for its steps: "
                          "write `for step in run.train(...)`, or `run.train(...).last()`", RuntimeWarning, stacklevel=2)


class Run(_core.Run):
    """A scene and its field. Made by `open`, `resume` or `load`; ends with `close`, or ``with``.

    Attributes:
        name: of the configuration.
        bounds: [2, 3] float64, lowest and highest corner of the content, world.
        near_m: least distance along rays that is looked at, metres.
        far_m: the largest one.
        metric: whether lengths are metres.
        device: where steps and rendering run.
        left_out: what the scene does not need, and so was not built: component, rule, evidence, saving.
        has_semantics: whether the field has classes.
    """

    name: str
    bounds: np.ndarray[Any, Any]
    near_m: float
    far_m: float
    metric: bool
    device: str
    left_out: List[Tuple[str, str, str, str]]
    has_semantics: bool

    def __init__(self, how: str, config: Any, set: Optional[Mapping[str, Any]], run_dir: PathLike, keep: Sequence[str],
                 scene: Optional[Scene] = None) -> None:
        super().__init__(how, config, dict(set or {}), os.fspath(run_dir), [keep] if isinstance(keep, str) else list(keep),
                         None if scene is None else scene.config())
        self._frames = [Frame(camera=Camera(**row.pop("camera")), **row) for row in self._frame_rows()]
        vars(self).update(self._facts())
        # A temporary file lives as long as a run of it.
        self._scene: Optional[Scene] = _temporary.get(str(self.config["scene"].get("file", "")))

    def close(self) -> None:
        """Gives back memory and the folder's lock; the run cannot be used afterwards. Also at the end of ``with``."""
        self._close()
        self._scene = None

    def __enter__(self) -> "Run":
        return self

    def __exit__(self, *raised: Any) -> None:
        self.close()

    def __repr__(self) -> str:
        if self._closed:
            return f"Run({self.name!r}, closed)"
        where = f", run_dir={self.run_dir!r}" if self.run_dir else ""
        return f"Run({self.name!r}, step={self.step}, frames={len(self._frames)}, device={self.device!r}{where})"

    def __reduce__(self) -> Any:
        raise TypeError("a Run cannot be pickled: save it, run.save(folder), and semfield.load(folder) in the other process")

    @property
    def labels(self) -> Labels:
        """Clicks and classes."""
        return Labels(self)

    @property
    def frames(self) -> List[Frame]:
        """Frames of the scene, without pixels."""
        return [dataclasses.replace(f, pose=f.pose.copy()) for f in self._frames]

    @property
    def classes(self) -> List[ClassEntry]:
        """The classes that count, in the order of the last axis of probabilities."""
        return [ClassEntry(**row) for row in self._class_rows()]

    def _index(self, frame: FrameId) -> int:
        if isinstance(frame, (int, np.integer)):
            if 0 <= frame < len(self._frames):
                return int(frame)
            raise UsageError(f"frame {frame}: there are {len(self._frames)}, from 0 on", code="python.frame.range")
        for i, f in enumerate(self._frames):
            if f.name == frame:
                return i
        near = difflib.get_close_matches(str(frame), [f.name for f in self._frames], 1)
        raise UsageError(f"the scene has no frame named {frame!r}; " +
                         (f"did you mean {near[0]!r}?" if near else "run.frames has their names"), code="scene.frame.unknown")

    def _frame(self, frame: FrameId) -> Frame:
        return self._frames[self._index(frame)]

    def pixels(self, frame: FrameId) -> Frame:
        """A frame as it was loaded, by name or number: rgb [H, W, 3] uint8, labels [H, W] ids (the scene's own), depth_m.

        Depth of training frames is not kept in memory by training.
        """
        index = self._index(frame)
        found = self._pixels(index)
        found.pop("training_labels", None)
        return dataclasses.replace(self.frames[index], **found)

    def training_labels(self, frame: FrameId) -> Optional[np.ndarray[Any, Any]]:
        """[H, W] int32 class ids that train in this frame, -1 for none; None where it has none at all."""
        found = self._pixels(self._index(frame)).get("training_labels")
        return None if found is None else np.asarray(found)

    def set_labels(self, frame: FrameId, labels: np.ndarray[Any, Any]) -> None:
        """From the next step on a training frame has these labels: [H, W] class ids, -1 for none.

        A class must have been in some label when the run was opened, or the run was opened with
        ``keep=["semantics", "absent_classes"]``.
        """
        known = self._frame(frame)
        if known.split != "train":
            raise UsageError(f"frame {known.name!r} does not train, as its split is {known.split}: "
                             "labels of it would change nothing", code="labels.frame.untrained")
        self._set_labels(self._index(frame), np.asarray(labels))

    def train(self, steps: Optional[int] = None, every: int = 100) -> Training:
        """Trains, and reports how it goes: ``for step in run.train(3000, every=100): ...``.

        Steps are made while the loop asks for them: ``run.train(3000)`` alone does nothing, and warns;
        ``run.train(3000).last()`` makes all of them.

        Args:
            steps: to make, also beyond the end of the run's length; None: to that end, which `extend` moves.
            every: steps between reports.

        Yields:
            A Step after every `every` steps, and after the last.

        Raises:
            KeyboardInterrupt: after the step under way; the run can continue from there.
        """
        of_length = self._steps_left
        left = None if steps is None else _whole("train: steps", steps, 0, 2**62)
        if left is None and of_length == 0:
            left = 0
        return Training(self, left, _whole("train: every", every, 1, 2**62))

    def extend(self, steps: Optional[int] = None, seconds: Optional[float] = None) -> None:
        """Lets the run train that much more from its present step on, with a learning rate that falls to its end.

        ``run.extend(seconds=60)`` and then ``run.train().last()``. Before the first step it sets the run's length. The number of
        steps that fit into a time is settled by the rate of the first of them.

        Args:
            steps: steps more, 1 or more.
            seconds: or seconds of training more, above 0.
        """
        more = 0 if steps is None else _whole("extend: steps", steps, 0, 10**9)
        time_s = 0.0 if seconds is None else _number("extend: seconds", seconds)
        if (steps is None) == (seconds is None) or not (more or 0 < time_s <= 1e8):
            raise UsageError(f"extend(steps={steps}, seconds={seconds}): expected steps of 1 or more, or seconds above 0",
                             code="python.value.range")
        self._train_more(more, time_s)

    def render(
        self,
        pose: Optional[Any] = None,
        width: Optional[int] = None,
        height: Optional[int] = None,
        camera: Optional[Camera] = None,
        frame: Optional[FrameId] = None,
        stride: int = 1,
        probability: bool = False,
        channels: Sequence[str] = (),
    ) -> View:
        """What a camera sees.

        Args:
            pose: [4, 4] or [3, 4] camera to world, OpenCV axes; None: that of `frame`.
            width, height: pixels; the camera is resized to them. One alone keeps the shape.
            camera: None: that of `frame`, or of the first frame.
            frame: name or number of a frame whose camera and pose are meant.
            stride: every n-th pixel and row.
            probability: also the probability of every class.
            channels: of heads in addition to that of class logits, by name.
        """
        if frame is None and pose is None:
            raise UsageError("render: give a pose, or the frame that is meant", code="python.value.missing")
        known = self._frames[0] if frame is None else self._frame(frame)
        at = _floats("pose", known.pose if pose is None else pose)
        if camera is None:
            camera = known.camera
        if width is not None or height is not None:
            if width is None:
                width = max(1, round(camera.width * _pixels("render: height", height) / camera.height))
            if height is None:
                height = max(1, round(camera.height * _pixels("render: width", width) / camera.width))
            camera = camera.resized(width, height)
        maps = self._render(camera._dict(), at, _whole("stride", stride), bool(probability), list(channels))
        whole = np.eye(4)
        whole[:3] = at[:3]
        return View(camera=camera, pose=whole, **maps)

    def channel_axes(self, channel: str) -> Optional[np.ndarray[Any, Any]]:
        """The principal axes [D, C] of a dataset's channel of D columns that a head learns in C; None: it learns all of them.

        A vector of D numbers, such as a word that the channel's model encoded, lies at ``vector @ run.channel_axes(name)``.
        """
        axes: Optional[np.ndarray[Any, Any]] = self._channel_axes(channel)
        return axes

    def evaluate(self, split: str = "test", frames: Optional[Sequence[FrameId]] = None) -> Score:
        """Scores of a split, or of some frames, against what the scene knows."""
        if frames is not None:
            chosen = [self._index(f) for f in ([frames] if isinstance(frames, str) else frames)]
            if not chosen:
                raise UsageError("evaluate: frames is empty; None means all of the split", code="python.value.missing")
        elif split in ("train", "test"):
            chosen = [i for i, f in enumerate(self._frames) if f.split == split]
        else:
            raise UsageError(f"split {split!r}: expected train or test", code="scene.split.unknown")
        values, detail = self._evaluate(split, chosen)
        return Score(values, json.loads(detail))

    def query(self, positions: Any, directions: Optional[Any] = None) -> Points:
        """The field at points.

        Args:
            positions: [N, 3], world.
            directions: [N, 3] unit vectors from the eye to the points; needed for colours.
        """
        return Points(**self._query(_floats("positions", positions),
                                    None if directions is None else _floats("directions", directions)))

    def objects(self, segments: Optional[PathLike] = None, *, set: Optional[Mapping[str, Any]] = None,  # noqa: A002
                out: Optional[PathLike] = None, score: bool = False) -> Objects:
        """Separates the things of the scene by segments of its images, from the last checkpoint in the run's folder.

        Args:
            segments: a file or a folder of them; None: the scene's own instances.
            set: settings, such as {"objects.reach": 0.3}.
            out: folder of the images and tables; None: ``objects`` in the run's folder.
            score: also compare with the true objects of the scene.

        Raises:
            CommandError: there is no checkpoint, or the segments cannot be used.
        """
        return find_objects(self.run_dir, segments, set, out, score)

    def save(self, run_dir: PathLike = "") -> str:
        """Writes a checkpoint. Every verb of the program works on the folder, and `resume` continues it.

        Args:
            run_dir: a new folder, or the one of the save before. A run opened with `out` has its folder.

        Returns:
            Path of the checkpoint.
        """
        if self._scene is not None:
            raise UsageError("the scene is in a temporary file, which is gone when this process ends: "
                             "give it a place, Scene(..., file=\"room.sfpack\"), and open the run with that",
                             code="python.scene.temporary")
        return str(self._save(os.fspath(run_dir)))


def _config(config: Config) -> Union[str, Dict[str, Any]]:
    return dict(config) if isinstance(config, Mapping) else os.fspath(config)


def open(  # noqa: A001 - semfield.open, as the program's verbs are words of every day
    config: Config,
    set: Optional[Mapping[str, Any]] = None,  # noqa: A002 - the program's --set
    *,
    out: PathLike = "",
    scene: Optional[Scene] = None,
    class_room: int = 0,
    keep: Sequence[str] = (),
) -> Run:
    """Opens a configuration to train it step by step.

    Args:
        config: a YAML file, the name of a shipped one ("quickstart"), or a dict.
        set: settings by key: ``{"train.rays": 2048}``.
        out: folder of the run, which must be new; "": none until `Run.save`.
        scene: a scene of arrays instead of the one that `config` names; its `scene.labels` and `scene.load` stay.
        class_room: most classes there can be once clicks have named new ones; with it clicks can be added.
        keep: components that a scene would be built without.

    Raises:
        ConfigError: every wrong key is in `findings`.
        DataError: the scene is wrong.
        InputError: something is not there.
    """
    settings = dict(set or {})
    if class_room:
        settings.setdefault("scene.labels.class_room", _whole("class_room", class_room))
    return Run("open", _config(config), settings, out, keep, scene)


def resume(run_dir: PathLike, set: Optional[Mapping[str, Any]] = None, *, keep: Sequence[str] = ()) -> Run:  # noqa: A002
    """Opens a run's folder to continue it; the next steps have the bits of a run that never stopped."""
    return Run("resume", None, set, run_dir, keep)


def load(run_dir: PathLike, set: Optional[Mapping[str, Any]] = None) -> Run:  # noqa: A002
    """Opens a run's folder to render, score and ask it; nothing in it changes."""
    return Run("load", None, set, run_dir, ())


def train(
    config: Config,
    set: Optional[Mapping[str, Any]] = None,  # noqa: A002
    *,
    out: PathLike,
    resume: bool = False,
    progress: Optional[Callable[[Dict[str, Any]], None]] = None,
) -> Outcome:
    """`semfield train` as a call: a whole run with logs, checkpoints, scores and report.

    Args:
        config: as for `open`; of a run that continues it is not read.
        set: settings by key.
        out: the run's folder.
        resume: continue in `out` from its newest checkpoint.
        progress: called now and then with step, steps, loss, psnr, miou_present, rays_per_s, train_s, remaining_s.

    Raises:
        KeyboardInterrupt: after the checkpoint that Ctrl-C leads to.
    """
    return Outcome(**_core.train_run(_config(config), dict(set or {}), os.fspath(out), bool(resume), progress))


def resolved(config: Config, set: Optional[Mapping[str, Any]] = None) -> Dict[str, Any]:  # noqa: A002
    """Every parameter that a configuration stands for; no scene is read.

    Raises:
        ConfigError: every wrong key is in `findings`.
    """
    return dict(_core.resolved(_config(config), dict(set or {})))
