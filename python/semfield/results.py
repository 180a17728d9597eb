"""What calls of a run give back: steps, views, points, scores."""

from __future__ import annotations

import dataclasses
from typing import Any, Dict, List, Optional

import numpy as np

from .scenes import Camera, _Arrays

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
        notes: what the run had to say.
    """

    run_dir: str
    report: str
    step: int
    train_s: float
    scores: Dict[str, Optional[float]]
    scored: str
    notes: List[str]


