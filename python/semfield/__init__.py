"""Semfield: neural fields of appearance, geometry and semantics for one scene.

    import semfield as sf

    run = sf.open("quickstart", set={"train.steps": 400})
    for step in run.train(every=100):
        print(step.step, step.loss, step.psnr)
    view = run.render(frame="0007")      # view.rgb, view.label, view.depth_m, view.entropy
    print(run.evaluate("test").miou_present)
    run.save("runs/a")

Conventions: poses are [4, 4] camera-to-world matrices with OpenCV axes (x right, y down, z forward); pixels are
[row, column], top left first; lengths are metres where the scene is metric; labels are the ids of the scene's own
class table, -1 for none. Calls that compute give the GIL back and answer Ctrl-C between steps.
"""

from __future__ import annotations

import sys

try:
    import numpy  # noqa: F401 - every array is one of its
except ModuleNotFoundError as missing:
    if missing.name != "numpy":
        raise
    raise ModuleNotFoundError(f"semfield needs NumPy, and {sys.executable} has none: install it for this Python "
                              "(on Debian the package python3-numpy)", name="numpy") from None

from . import errors
from ._core import __version__
from .errors import ConfigError, DataError, Error, Finding, InputError, UnavailableError, UsageError, WriteError
from .plugins import Dataset, Encoder, Head, Loss, Tensor, dataset, encoder, head, load_plugin, loss, param, plugins
from .program import CommandError, Object, Objects, command, tune
from .runs import (Labels, Outcome, Points, Run, Score, Step, Training, View, load, open, resolved, resume, train)
from .scenes import Camera, ClassEntry, Frame, Scene

__all__ = [
    "Camera", "ClassEntry", "CommandError", "ConfigError", "DataError", "Dataset", "Encoder", "Error",
    "Finding", "Frame", "Head", "InputError", "Labels", "Loss", "Object", "Objects", "Outcome", "Points", "Run", "Scene", "Score", "Step",
    "Tensor", "Training", "UnavailableError", "UsageError", "View", "WriteError", "command", "dataset", "encoder", "errors",
    "head", "load", "load_plugin", "loss", "open", "param", "plugins", "resolved", "resume", "train", "tune",
    "__version__",
]
