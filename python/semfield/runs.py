"""Runs: opened, trained step by step, looked at, asked, saved."""

from __future__ import annotations

import dataclasses
import json
import os
import uuid
from typing import Any, Callable, Dict, Iterator, List, Mapping, Optional, Sequence, Tuple, Union

import numpy as np

from . import _core
from .errors import UsageError
from .scenes import Camera, ClassEntry, Frame, PathLike, Scene

Config = Union[str, "os.PathLike[str]", Mapping[str, Any]]
Array = Any  #: numpy.ndarray, or a DeviceArray where a device was asked for


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


@dataclasses.dataclass(frozen=True)
class View:
    """What a camera sees.

    Attributes:
        rgb: [H, W, 3] float32 in [0, 1], display-referred.
        depth_m: [H, W] float32, z-depth in metres, expected value, not divided by opacity.
        opacity: [H, W] float32 in [0, 1].
        label: [H, W] int32, class ids of the scene; None without semantics, as are the next three.
        entropy: [H, W] float32, nats.
        confidence: [H, W] float32, probability of the label.
        probability: [H, W, C] float32, in the order of `Run.classes`; None where it was not asked for.
        camera: of this size.
        pose: [4, 4] float64, camera to world.
    """

    rgb: Array
    depth_m: Array
    opacity: Array
    label: Optional[Array]
    entropy: Optional[Array]
    confidence: Optional[Array]
    probability: Optional[Array]
    camera: Camera
    pose: np.ndarray


@dataclasses.dataclass(frozen=True)
class Points:
    """The field at N points.

    Attributes:
        density: [N] float32, 1/m; 0 outside the bounds that rays are clipped to.
        rgb: [N, 3] float32 in [0, 1]; None where no directions were given.
        label: [N] int32, class ids; None without semantics, as are the next two.
        probability: [N, C] float32, in the order of `Run.classes`.
        entropy: [N] float32, nats.
    """

    density: np.ndarray
    rgb: Optional[np.ndarray]
    label: Optional[np.ndarray]
    probability: Optional[np.ndarray]
    entropy: Optional[np.ndarray]


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
        values = self.__dict__.get("values", {})
        if name in values:
            return values[name]
        raise AttributeError(f"no score named {name!r}; there are {', '.join(values)}")

    @property
    def confusion(self) -> np.ndarray:
        """[K, K] int64 pixels, row = truth, column = prediction, in the order of detail["classes"]."""
        return np.asarray(self.detail["confusion"]["pixels"], dtype=np.int64)

    def __repr__(self) -> str:
        shown = ", ".join(f"{k}={'none' if v is None else f'{v:.4g}'}" for k, v in self.values.items())
        return f"Score({shown})"


class Labels:
    """Clicks and classes of a run; each counts from the next step on, and is stored before the call returns.

    The run must have been opened with `class_room` and `out`, or its configuration names a file of clicks.
    """

    def __init__(self, session: Any) -> None:
        self._session: Any = session

    def _apply(self, kind: str, **more: Any) -> str:
        event = {"id": uuid.uuid4().hex, "kind": kind, **more}
        self._session.apply(json.dumps(event))
        return event["id"]

    def _camera(self, frame: str) -> Dict[str, Any]:
        for f in self._session.frames():
            if f["name"] == frame:
                return f["camera"]
        raise UsageError(f"the scene has no frame named {frame!r}; see run.frames")

    def add_class(self, name: str, color: Optional[Tuple[int, int, int]] = None) -> str:
        """Adds a class; there is room for as many as the run was opened with. Returns the id for undo."""
        more: Dict[str, Any] = {"name": name}
        if color is not None:
            more["color"] = [int(c) for c in color]
        return self._apply("add_class", **more)

    def add_click(self, frame: str, x: float, y: float, class_: str, radius_px: float = 0.0) -> str:
        """Names a pixel of a training frame.

        Args:
            frame: its name.
            x, y: pixels of the loaded frame; the first pixel's centre is (0.5, 0.5).
            class_: name of a class.
            radius_px: pixels within this distance are named too.

        Returns:
            The id for undo.
        """
        return self.add_stroke(frame, [(x, y)], class_, radius_px)

    def add_stroke(self, frame: str, points: Sequence[Tuple[float, float]], class_: str, radius_px: float = 0.0) -> str:
        """Names the pixels along a line through `points`, [N, 2] pixels x, y."""
        camera = self._camera(frame)
        return self._apply("click", frame=frame, width=camera["width"], height=camera["height"],
                           points=[[float(x), float(y)] for x, y in points], radius=float(radius_px), **{"class": class_})

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


class Run:
    """A scene and its field. Made by `open`, `resume` or `load`."""

    def __init__(self, session: Any, scene: Optional[Scene] = None) -> None:
        self._session: Any = session
        self._scene = scene  # its file lives as long as the run
        #: Clicks and classes.
        self.labels = Labels(session)
        facts = session.facts()
        #: Name of the configuration.
        self.name: str = facts["name"]
        #: [2, 3] float64, lowest and highest corner of the content, world.
        self.bounds: np.ndarray = facts["bounds"]
        #: Distances along rays that are looked at, metres.
        self.near_m: float = facts["near_m"]
        self.far_m: float = facts["far_m"]
        #: Whether lengths are metres.
        self.metric: bool = facts["metric"]
        #: Where steps and rendering run.
        self.device: str = facts["device"]
        #: What the scene does not need, and so was not built: component, rule, evidence, saving.
        self.left_out: List[Tuple[str, str, str, str]] = facts["left_out"]
        #: Whether the field has classes.
        self.has_semantics: bool = facts["has_semantics"]
        self._steps: int = facts["steps"]

    def close(self) -> None:
        """Gives back memory and the folder's lock; the run is of no use afterwards. Also at the end of ``with``."""
        self._session = None
        self.labels._session = None

    def __enter__(self) -> "Run":
        return self

    def __exit__(self, *raised: Any) -> None:
        self.close()

    def __repr__(self) -> str:
        if self._session is None:
            return f"Run({self.name!r}, closed)"
        where = f", run_dir={self.run_dir!r}" if self.run_dir else ""
        return f"Run({self.name!r}, step={self.step}, frames={len(self.frames)}, device={self.device!r}{where})"

    @property
    def step(self) -> int:
        """Steps made."""
        return int(self._session.step)

    @property
    def train_s(self) -> float:
        """Seconds of training; rendering and scoring do not count."""
        return float(self._session.train_s)

    @property
    def run_dir(self) -> str:
        """The run's folder, or the one it was saved in last; "" for neither."""
        return str(self._session.run_dir)

    @property
    def notes(self) -> List[str]:
        """What opening and training had to say: findings, and what was chosen from the scene."""
        return list(self._session.notes())

    @property
    def history(self) -> List[Dict[str, Any]]:
        """Rows of training as metrics.jsonl has them, those of this object's steps."""
        return list(self._session.rows())

    @property
    def config(self) -> Dict[str, Any]:
        """The resolved configuration: every parameter."""
        return dict(self._session.config())

    @property
    def frames(self) -> List[Frame]:
        """Frames of the scene, without pixels."""
        return [
            Frame(name=f["name"], camera=Camera(**f["camera"]), pose=f["pose"], split=f["split"],
                  has_labels=f["has_labels"], has_depth=f["has_depth"], source=f["source"])
            for f in self._session.frames()
        ]

    @property
    def classes(self) -> List[ClassEntry]:
        """The classes that count, in the order of the last axis of probabilities."""
        return [ClassEntry(id_, name, tuple(color), False, index, learned)
                for index, id_, name, color, learned in self._session.classes()]

    def _index(self, frame: Union[str, int]) -> int:
        if isinstance(frame, (int, np.integer)):
            return int(frame)
        for i, f in enumerate(self._session.frames()):
            if f["name"] == frame:
                return i
        raise UsageError(f"the scene has no frame named {frame!r}; see run.frames")

    def pixels(self, frame: Union[str, int]) -> Frame:
        """A frame as it was loaded, by name or number: rgb [H, W, 3] uint8, labels [H, W] ids (the scene's own), depth_m.

        Depth of training frames is not kept in memory by training.
        """
        index = self._index(frame)
        known = self.frames[index] if 0 <= index < len(self.frames) else None
        found = self._session.pixels(index)
        assert known is not None
        known.rgb, known.labels, known.depth_m = found.get("rgb"), found.get("labels"), found.get("depth_m")
        return known

    def training_labels(self, frame: Union[str, int]) -> Optional[np.ndarray]:
        """[H, W] int32 class ids that train in this frame, -1 for none; None where it has none at all."""
        found = self._session.pixels(self._index(frame)).get("training_labels")
        return None if found is None else np.asarray(found)

    def set_labels(self, frame: Union[str, int], labels: np.ndarray) -> None:
        """From the next step on a training frame has these labels: [H, W] class ids, -1 for none.

        A class must have been in some label when the run was opened, or the run was opened with
        ``keep=["semantics", "absent_classes"]``.
        """
        self._session.set_labels(self._index(frame), np.asarray(labels))

    def train(self, steps: Optional[int] = None, every: int = 100) -> Iterator[Step]:
        """Trains, and tells how it goes: ``for step in run.train(3000, every=100): ...``.

        Args:
            steps: to make; None: as many as train.steps of the configuration leaves.
            every: steps between reports.

        Yields:
            A Step after every `every` steps, and after the last.

        Raises:
            KeyboardInterrupt: after the step under way; the run can go on from there.
        """
        left = max(0, self._steps - self.step) if steps is None else int(steps)
        if left < 0 or every < 1:
            raise UsageError(f"train({steps}, every={every}): expected steps of 0 or more, and every of 1 or more")
        while left > 0:
            made = self._session.train(min(every, left))
            left -= made["steps"]
            mse = max(made["mse"], 1e-300)
            yield Step(self.step, self.train_s, made["loss"], made["color"], made["semantic"], -10 * float(np.log10(mse)),
                       made["terms"], made["steps"] / max(made["seconds"], 1e-9))

    def render(
        self,
        pose: Optional[Any] = None,
        width: Optional[int] = None,
        height: Optional[int] = None,
        camera: Optional[Camera] = None,
        frame: Optional[Union[str, int]] = None,
        stride: int = 1,
        probability: bool = False,
        device: str = "cpu",
    ) -> View:
        """What a camera sees.

        Args:
            pose: [4, 4] or [3, 4] camera to world, OpenCV axes; None: that of `frame`.
            width, height: pixels; the camera is resized to them. One alone keeps the shape.
            camera: None: that of `frame`, or of the first frame.
            frame: name or number of a frame whose camera and pose are meant.
            stride: every n-th pixel and row.
            probability: also the probability of every class.
            device: "cpu": NumPy arrays; "cuda" or "cuda:1": arrays for DLPack on that device.
        """
        at = None if frame is None else self._index(frame)
        frames = self._session.frames()
        if at is not None and not 0 <= at < len(frames):
            raise UsageError(f"frame {at}: there are {len(frames)}")
        if pose is None:
            if at is None:
                raise UsageError("render: give a pose, or the frame that is meant")
            pose = frames[at]["pose"]
        if camera is None:
            camera = Camera(**frames[at or 0]["camera"])
        if width is not None or height is not None:
            if width is None:
                width = max(1, round(camera.width * int(height or 0) / camera.height))
            if height is None:
                height = max(1, round(camera.height * int(width) / camera.width))
            camera = camera.resized(int(width), int(height))
        ordinal = _ordinal(device)
        maps = self._session.render(camera._dict(), np.asarray(pose, dtype=np.float64), int(stride), bool(probability), ordinal)
        return View(maps["rgb"], maps["depth_m"], maps["opacity"], maps.get("label"), maps.get("entropy"),
                    maps.get("confidence"), maps.get("probability"), camera, np.asarray(pose, dtype=np.float64))

    def evaluate(self, split: str = "test", frames: Optional[Sequence[Union[str, int]]] = None) -> Score:
        """Scores of a split, or of some frames, against what the scene knows."""
        if frames is None:
            if split not in ("train", "test"):
                raise UsageError(f"split {split!r}: expected train or test")
            chosen = [i for i, f in enumerate(self._session.frames()) if f["split"] == split]
        else:
            chosen = [self._index(f) for f in frames]
            count = len(self._session.frames())
            if any(not 0 <= i < count for i in chosen):
                raise UsageError(f"frames {chosen}: there are {count}")
        values, detail = self._session.evaluate(split, chosen)
        return Score(values, json.loads(detail))

    def query(self, positions: Any, directions: Optional[Any] = None) -> Points:
        """The field at points.

        Args:
            positions: [N, 3], world.
            directions: [N, 3] unit vectors from the eye to the points; needed for colours.
        """
        found = self._session.query(np.asarray(positions, dtype=np.float64),
                                    None if directions is None else np.asarray(directions, dtype=np.float64))
        return Points(found["sigma"], found.get("rgb"), found.get("label"), found.get("probability"), found.get("entropy"))

    def parameters(self) -> Dict[str, np.ndarray]:
        """Every tensor of a checkpoint by name, float32 copies: values, moments and states."""
        return dict(self._session.parameters())

    def save(self, run_dir: PathLike = "") -> str:
        """Writes a checkpoint. Every verb of the program works on the folder, and `resume` goes on with it.

        Args:
            run_dir: a new folder, or the one of the save before. A run opened with `out` has its folder.

        Returns:
            Path of the checkpoint.
        """
        if self._scene is not None and self._scene.temporary:
            raise UsageError("the scene is in a temporary file, which is gone when this process ends: "
                             "give it a place, Scene(..., file=\"room.sfpack\"), and open the run with that")
        return str(self._session.save(os.fspath(run_dir)))


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
        notes: what the run had to say.
    """

    run_dir: str
    report: str
    step: int
    train_s: float
    scores: Dict[str, Optional[float]]
    scored: str
    notes: List[str]


def _ordinal(device: str) -> int:
    if device == "cpu":
        return -1
    if device == "cuda":
        return 0
    if device.startswith("cuda:") and device[5:].isdigit():
        return int(device[5:])
    raise UsageError(f"device {device!r}: expected cpu, cuda or cuda:N")


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
        scene: a scene of arrays in place of the section `scene`.
        class_room: most classes there can be once clicks have named new ones; with it clicks can be added.
        keep: components that a scene would be built without.

    Raises:
        ConfigError: every wrong key is in `findings`.
        DataError: the scene is wrong.
        InputError: something is not there.
    """
    settings = dict(set or {})
    if class_room:
        settings.setdefault("scene.labels.class_room", int(class_room))
    source = _config(config)
    if scene is not None:
        if isinstance(source, dict):
            source = {**source, "scene": {**{k: v for k, v in source.get("scene", {}).items() if k in ("labels", "load")},
                                          **scene.config()}}
        else:
            settings = {"scene": scene.config(), **settings}
    return Run(_core.open(source, settings, os.fspath(out), list(keep)), scene)


def resume(run_dir: PathLike, set: Optional[Mapping[str, Any]] = None, *, keep: Sequence[str] = ()) -> Run:  # noqa: A002
    """Opens a run's folder to go on with it; the next steps have the bits of a run that was never stopped."""
    return Run(_core.resume(os.fspath(run_dir), dict(set or {}), list(keep)))


def load(run_dir: PathLike, set: Optional[Mapping[str, Any]] = None) -> Run:  # noqa: A002
    """Opens a run's folder to render, score and ask it; nothing in it changes."""
    return Run(_core.load(os.fspath(run_dir), dict(set or {})))


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
        config: as for `open`; of a run that goes on it is not read.
        set: settings by key.
        out: the run's folder.
        resume: go on in `out` from its newest checkpoint.
        progress: called now and then with step, steps, loss, psnr, miou_present, rays_per_s, train_s, remaining_s.

    Raises:
        KeyboardInterrupt: after the checkpoint that Ctrl-C leads to.
    """
    done = _core.train_run(_config(config), dict(set or {}), os.fspath(out), bool(resume), progress)
    return Outcome(done["run_dir"], done["report"], done["step"], done["train_s"], done["scores"], done["scored"], done["notes"])


def resolved(config: Config, set: Optional[Mapping[str, Any]] = None) -> Dict[str, Any]:  # noqa: A002
    """Every parameter that a configuration stands for; no scene is read.

    Raises:
        ConfigError: every wrong key is in `findings`.
    """
    return dict(_core.resolved(_config(config), dict(set or {})))
