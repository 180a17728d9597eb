"""Encoders, heads, losses and datasets in Python, for trying ideas: NumPy in, NumPy out, one batch per call.

They are held to the same laws as plugins in C++ (``semfield plugins check FILE``), and they are slow: a call takes the
interpreter's lock, so one thread at a time is in them.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import sys
import types
from typing import Any, Callable, Dict, List, Mapping, Optional, Sequence, Tuple, Type, TypeVar

import numpy as np

from . import _core
from .errors import UsageError
from .scenes import Frame, PathLike, _description, _mask


@dataclasses.dataclass(frozen=True)
class param:  # noqa: N801 - read as a word in a class body: bands = sf.param(8, "number of bands", low=1)
    """A parameter of a plugin: a class attribute, set from the configuration on every instance.

    Attributes:
        default: truth value, integer, float, text, or a list of numbers or texts; its type is the parameter's.
        help: one sentence, with the unit.
        low, high: range of a number, or of each number of a list, ends included.
        choices: texts of which one is meant.
    """

    default: Any
    help: str
    low: Optional[float] = None
    high: Optional[float] = None
    choices: Optional[Sequence[str]] = None


@dataclasses.dataclass(frozen=True)
class Tensor:
    """Learned numbers of an encoder, float32 [rows, cols]; they start uniform in [low, high)."""

    rows: int
    cols: int
    low: float = 0.0
    high: float = 0.0


class _Plugin:
    @classmethod
    def _params(cls) -> List[Dict[str, Any]]:
        found: Dict[str, param] = {}
        for base in reversed(cls.__mro__):
            found.update({k: v for k, v in vars(base).items() if isinstance(v, param)})
        return [{"name": name, **dataclasses.asdict(p)} for name, p in found.items()]

    @classmethod
    def _made(cls, values: Mapping[str, Any], **facts: Any) -> Any:
        """An instance with these parameters and facts of the run, set up."""
        made = cls.__new__(cls)
        for name, value in {**values, **facts}.items():
            setattr(made, name, value)
        if isinstance(made, (Encoder, Head)):
            made.tensors = {}
            made.setup()
        return made


class Encoder(_Plugin):
    """Coordinates to features.

    A subclass has parameters (`param`), `setup`, `forward` and `backward`. Arrays are views of the framework's memory:
    keep none of them beyond the call. Rows must not depend on each other, and the same row gives the same bits in
    any batch.

    Attributes:
        domain: what coordinates are: "metric" (any real numbers, about -1 to 1), "unit_cube" ([0, 1], clamp yourself) or
            "direction" (unit vectors).
        in_dims: D, numbers of a coordinate.
        out_dims: F, numbers of a feature; `setup` sets it.
        tensors: learned numbers by name; `setup` sets them.
        build: further facts: is_direction, extent_m, pixel_footprint_m, largest_coordinate.
    """

    domain: str = "metric"
    in_dims: int = 3
    out_dims: int = 0
    tensors: Dict[str, Tensor]
    build: Dict[str, Any]

    def setup(self) -> None:
        """Sets out_dims, and tensors where there are any."""
        raise NotImplementedError("setup")

    def forward(self, x: np.ndarray[Any, Any], params: Dict[str, np.ndarray[Any, Any]]) -> np.ndarray[Any, Any]:
        """Features of coordinates.

        Args:
            x: [N, D] float64.
            params: the tensors by name, [rows, cols] float32 or, as the oracle of the laws, float64.

        Returns:
            [N, F]
        """
        raise NotImplementedError("forward")

    def backward(
        self, x: np.ndarray[Any, Any], dy: np.ndarray[Any, Any], params: Dict[str, np.ndarray[Any, Any]],
        grads: Dict[str, np.ndarray[Any, Any]]
    ) -> Optional[np.ndarray[Any, Any]]:
        """Gradients of the loss.

        Args:
            x: [N, D] float64, as in forward.
            dy: [N, F], dL/d(features).
            params: as in forward.
            grads: by name, [rows, cols]: add dL/d(tensor) to them in place (``+=``); another array in their place is refused.

        Returns:
            [N, D], dL/dx.
        """
        raise NotImplementedError("backward")

    @classmethod
    def make(cls, in_dims: int = 3, **values: Any) -> "Encoder":
        """An instance to call by hand, as a run would make it: ``Waves.make(in_dims=3, bands=4).forward(x, {})``.

        Args:
            in_dims: numbers of a coordinate.
            values: parameters; those that are not named have their defaults. Ranges are not looked at.
        """
        known = {p["name"]: p["default"] for p in cls._params()}
        unknown = [name for name in values if name not in known]
        if unknown:
            raise UsageError(f"{cls.__name__}: no parameter is named {unknown[0]!r}; there are {', '.join(known) or 'none'}",
                             code="plugin.python.parameter")
        build = {"in_dims": in_dims, "is_direction": cls.domain == "direction", "extent_m": 1.0, "pixel_footprint_m": 0.0,
                 "largest_coordinate": 1.0}
        made: Encoder = cls._made({**known, **values}, in_dims=in_dims, build=build)
        return made


class Head(_Plugin):
    """A channel in addition to class logits: ``heads: [{type: NAME, channel: CHANNEL, branch: {...}}]``.

    A subclass has parameters (`param`), `setup` and the four calls below. Compositing stands between `hidden`, per sample,
    and `output`, per ray, so `output` is linear in (h, opacity). Arrays are views of the framework's memory, float32 or, as
    the oracle of the laws, float64: keep none of them beyond the call. On a GPU it is refused.

    Attributes:
        feature_dims: F, numbers of a feature.
        width: C, columns of the channel.
        hidden_width: H, numbers of an activation; `setup` sets it.
        tensors: learned numbers by name; `setup` sets them.
    """

    feature_dims: int = 0
    width: int = 0
    hidden_width: int = 0
    tensors: Dict[str, Tensor]

    def setup(self) -> None:
        """Sets hidden_width and tensors."""
        raise NotImplementedError("setup")

    def hidden(self, feature: np.ndarray[Any, Any], params: Dict[str, np.ndarray[Any, Any]]) -> np.ndarray[Any, Any]:
        """Activations [M, H] of features [M, F]."""
        raise NotImplementedError("hidden")

    def hidden_backward(
        self, feature: np.ndarray[Any, Any], hidden: np.ndarray[Any, Any], d_hidden: np.ndarray[Any, Any],
        params: Dict[str, np.ndarray[Any, Any]], grads: Dict[str, np.ndarray[Any, Any]]
    ) -> np.ndarray[Any, Any]:
        """dL/d(feature) [M, F] from dL/d(hidden) [M, H]; adds dL/d(tensor) to `grads` in place."""
        raise NotImplementedError("hidden_backward")

    def output(
        self, h: np.ndarray[Any, Any], opacity: Optional[np.ndarray[Any, Any]], params: Dict[str, np.ndarray[Any, Any]]
    ) -> np.ndarray[Any, Any]:
        """Rows of the channel [N, C] from h [N, H] and opacity [N, 1]; None: 1 for every row."""
        raise NotImplementedError("output")

    def output_backward(
        self, h: np.ndarray[Any, Any], opacity: Optional[np.ndarray[Any, Any]], d_rows: np.ndarray[Any, Any],
        params: Dict[str, np.ndarray[Any, Any]], grads: Dict[str, np.ndarray[Any, Any]]
    ) -> Tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        """dL/dh [N, H] and dL/d(opacity) [N, 1] from dL/d(rows) [N, C]; adds dL/d(tensor) to `grads` in place."""
        raise NotImplementedError("output_backward")


class Loss(_Plugin):
    """A term of the loss in addition to colour and cross-entropy: ``losses: [{type: NAME}]``.

    A subclass has parameters (`param`), `value` and, where not every ray counts, `counted`. Arrays are views of the
    framework's memory: keep none of them beyond the call. A ray's loss depends on that ray alone. On a GPU it is refused.

    Attributes:
        weight, from_step: of every loss; a subclass may give others: ``weight = sf.param(0.1, sf.Loss.weight.help, low=0)``.
        targets: names of the targets that it cannot do without: "color", "label", "soft_label", "depth", "alpha", or a channel
            of the dataset.
        heads: names of what heads make that it reads: "logits", or the channel of a head.
        moves: names of what it has gradients of: "color", "depth", "weight" and "sigma", or "logits" alone, or channels of
            heads alone.
    """

    weight: Any = param(1.0, "factor of the term relative to the colour loss", low=0, high=1e6)
    from_step: Any = param(0.0, "share of train.steps after which the term begins, and never before train.schedule.hold_steps",
                           low=0, high=1)
    targets: Sequence[str] = ()
    heads: Sequence[str] = ()
    moves: Sequence[str] = ()

    def counted(self, targets: Dict[str, np.ndarray[Any, Any]], rays: int) -> int:
        """How many of a whole batch's rays the mean is over; 0: there is no loss.

        Args:
            targets: as in value, of the batch.
            rays: R, all of them.
        """
        return rays

    def value(
        self, targets: Dict[str, np.ndarray[Any, Any]], values: Dict[str, np.ndarray[Any, Any]]
    ) -> Tuple[np.ndarray[Any, Any], Dict[str, np.ndarray[Any, Any]]]:
        """The loss of each ray, and the gradients of their sum.

        Args:
            targets: color [R, 3] in [0, 1], label [R, 1] class, negative: none, soft_label [R, C] probabilities, depth
                [R, 1] metres, 0: unknown, alpha [R, 1] in [0, 1], negative: unknown; those that the batch has.
            values: color [R, 3], depth and opacity [R, 1], near_far [R, 2]; t, delta, sigma and weight [M, 1] of samples,
                those of ray r from first[r, 0] to first[r + 1, 0]; logits [S, C] of the first S rays, those behind them
                have no label; unit_m [1, 1], by which losses in metres divide. float32 or, as the oracle of the laws,
                float64.

        Returns:
            [R] or [S], and by every name in `moves` an array of exactly the shape of the value. Not called for rays without
            one of `targets`: their loss is 0.
        """
        raise NotImplementedError("value")


class Dataset(_Plugin):
    """A scene of files of another kind.

    A subclass has parameters (`param`), `frames`, `pixels` and, where there are labels, `classes`. Threads ask for
    pixels one after the other.

    Attributes:
        config_dir: relative paths of parameters start here.
        bounds: [2, 3] corners of the content, or None.
        near, far: distances along rays, metres; 0: found.
        metric: False where the unit is unknown.
    """

    config_dir: str = ""
    bounds: Any = None
    near: float = 0.0
    far: float = 0.0
    metric: bool = True

    def frames(self) -> Sequence[Frame]:
        """Every frame, without pixels: name, camera, pose, split, has_labels, has_depth, source."""
        raise NotImplementedError("frames")

    def classes(self) -> Any:
        """Names in the order of their ids, {id: name}, or ClassEntry objects."""
        return []

    def pixels(self, index: int) -> Frame:
        """Frame `index` of `frames` with rgb [H, W, 3] uint8, and labels [H, W] ids and depth_m [H, W] where it has them."""
        raise NotImplementedError("pixels")

    def _opened(self) -> Dict[str, Any]:
        return _description(type(self).__name__, self.frames(), self.classes(), self.bounds, self.near, self.far, self.metric)

    def _read(self, index: int) -> Dict[str, Any]:
        f = self.pixels(index)
        return {"rgb": f.rgb, "labels": f.labels, "depth_m": f.depth_m, "mask": _mask(f.mask), "channels": dict(f.channels)}


def _default(of: str, p: Mapping[str, Any]) -> Any:
    """The default as the extension takes it. One that its own range refuses would be refused where nobody gave it."""
    def refuse(what: str, remedy: str = "") -> None:
        raise UsageError(f"{of} is {what}", remedy=remedy, code="plugin.python.default")

    value, is_list = p["default"], isinstance(p["default"], (list, tuple))
    if p["choices"] is not None:
        if str(value) not in p["choices"]:
            refuse("none of its choices")
        return str(value)
    items = list(value) if is_list else [value]
    if isinstance(value, (bool, str)) or (items and all(isinstance(v, str) for v in items)):
        return items if is_list else value
    if not all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in items):
        refuse(repr(value), "a list has numbers alone, or texts alone" if is_list else
               "a parameter is a truth value, a number, a text, or a list of numbers or texts")
    low, high = (-np.inf if p["low"] is None else p["low"]), (np.inf if p["high"] is None else p["high"])
    for number in items:
        if not low <= number <= high:
            refuse(f"{float(number)}, outside its own range")
    if any(isinstance(v, float) for v in items):
        items = [float(v) for v in items]
    return items if is_list else items[0]


C_ = TypeVar("C_", bound=Type[_Plugin])


def _plugin(base: Type[_Plugin], name: str, summary: str) -> Callable[[C_], C_]:
    """What makes a subclass of `base` a plugin. Defined again, the last one counts."""

    def add(cls: C_) -> C_:
        is_one = isinstance(cls, type) and issubclass(cls, base)
        if not is_one:
            raise UsageError(f"{cls!r}: expected a subclass of semfield.{base.__name__}", code="plugin.python.declaration")
        text = summary or (cls.__doc__ or "").strip().split("\n")[0]
        if not text:
            raise UsageError(f"{cls.__name__}: a plugin has a sentence that says what it is; give a docstring or summary=",
                             code="plugin.python.declaration")
        kind = base.__name__.lower()
        params = [{**p, "default": _default(f"{kind} {name!r}: the default of {p['name']!r}", p)} for p in cls._params()]
        _core.add_plugin({"kind": kind, "name": name, "summary": text, "class": cls, "params": params})
        return cls

    return add


def encoder(name: str, summary: str = "") -> Callable[[C_], C_]:
    """Makes a subclass of Encoder a plugin: ``position: {type: NAME}``. Defined again, the last one counts."""
    return _plugin(Encoder, name, summary)


def dataset(name: str, summary: str = "") -> Callable[[C_], C_]:
    """Makes a subclass of Dataset a plugin: ``scene: {type: NAME}``. Defined again, the last one counts."""
    return _plugin(Dataset, name, summary)


def head(name: str, summary: str = "") -> Callable[[C_], C_]:
    """Makes a subclass of Head a plugin: ``heads: [{type: NAME, ...}]``. Defined again, the last one counts."""
    return _plugin(Head, name, summary)


def loss(name: str, summary: str = "") -> Callable[[C_], C_]:
    """Makes a subclass of Loss a plugin: ``losses: [{type: NAME}]``. Defined again, the last one counts."""
    return _plugin(Loss, name, summary)


def plugins() -> List[Tuple[str, str, str, str]]:
    """Kind, name, sentence and module of every plugin that configurations can name."""
    return list(_core.plugin_names())


def load_plugin(file: PathLike) -> Optional[types.ModuleType]:
    """Loads a file of plugins, Python (idea.py) or C++ (libidea.so), as ``--plugin`` does; a second time changes nothing.

    Returns:
        The module of a file of Python; None for one of C++.

    Raises:
        UnavailableError: the file is not there, raises, or defines no plugin.
    """
    _core.load_plugin(os.fspath(file))
    return sys.modules.get(_module_name(os.fspath(file)))


def _module_name(path: str) -> str:
    return f"semfield_plugin_{abs(hash(os.path.realpath(path))):x}"


def _run_file(path: str) -> None:
    """Runs a file that defines plugins, under a name of its own."""
    name = _module_name(path)
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise UsageError(f"{path}: not a file of Python", code="plugin.python.file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
