"""Losses written in Python: against one in C++, where they are wrong, from a file, and on a channel of a dataset."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any, Dict

import numpy as np
import pytest

import semfield as sf
from conftest import config_of, trained
from test_plugins import Box


class Doubt(sf.Loss):
    """1 - p of the label's class, as generalised_cross_entropy has it with q = 1."""

    weight = sf.param(0.04, sf.Loss.weight.help, low=0, high=1e6)
    targets = ["label"]
    heads = ["logits"]
    moves = ["logits"]

    def counted(self, targets: Dict[str, np.ndarray], rays: int) -> int:
        return int((targets["label"] >= 0).sum()) if "label" in targets else 0

    def value(self, targets: Dict[str, np.ndarray], values: Dict[str, np.ndarray]) -> Any:
        logits = values["logits"].astype(np.float64)
        p = np.exp(logits - logits.max(1, keepdims=True))
        p /= p.sum(1, keepdims=True)
        label = targets["label"][:len(p), 0]
        known = (label >= 0).astype(float)
        truth = np.zeros_like(p)
        truth[np.arange(len(p)), np.maximum(label, 0)] = known
        of_label = (truth * p).sum(1)
        return known * (1 - of_label), {"logits": of_label[:, None] * (known[:, None] * p - truth)}


sf.loss("py_doubt")(Doubt)


def with_loss(scene: sf.Scene, **loss: Any) -> Dict[str, Any]:
    return {**config_of(scene), "losses": [loss], "semantics": {"weight": 0}}


def test_a_loss_is_as_the_built_in_one(scene: sf.Scene) -> None:
    a = sf.open(with_loss(scene, type="py_doubt", weight=0.5))
    b = sf.open(with_loss(scene, type="generalised_cross_entropy", q=1.0, weight=0.5))
    steps = [trained(run, 5)[0] for run in (a, b)]
    assert steps[0].loss == pytest.approx(steps[1].loss, rel=1e-5)
    assert steps[0].terms["py_doubt"] == pytest.approx(steps[1].terms["generalised_cross_entropy"], rel=1e-5)
    moved = [name for name in a.parameters() if "/semantic/" in name and not name.startswith("adam/")]
    assert moved
    for name in moved:
        assert np.allclose(a.parameters()[name], b.parameters()[name], atol=2e-3), name


@pytest.mark.parametrize("what, says", [
    ("columns", r"loss 'py_wrong'.value: gradient of 'logits': expected an array of the shape \((\d+), 6\), got \(\1, 5\)"),
    ("rows", r"loss 'py_wrong'.value: gradient of 'logits': expected an array of the shape \(\d+, 6\), got \(\d+, 6\)"),
    ("one row", r"loss 'py_wrong'.value: gradient of 'logits': expected an array of the shape \(\d+, 6\), got \(1, 6\)"),
    ("flat", r"loss 'py_wrong'.value: gradient of 'logits': expected an array of the shape \(\d+, 6\), got \(\d+,\)"),
    ("complex", r"loss 'py_wrong'.value: gradient of 'logits': expected real numbers, got complex128"),
    ("missing", r"loss 'py_wrong'.value: gradient of 'logits' is missing, and `moves` names it"),
    ("sum", r"loss 'py_wrong'.value: expected an array of the shape \(\d+,\)( or \(\d+,\))?, got \(\)"),
    ("short", r"loss 'py_wrong'.value: expected an array of the shape \(\d+,\)( or \(\d+,\))?, got \(\d+,\)"),
    ("column", r"loss 'py_wrong'.value: expected an array of the shape \(\d+,\)( or \(\d+,\))?, got \(\d+, 1\)"),
    ("alone", r"loss 'py_wrong'.value: expected a loss and a dict of gradients"),
    ("counted", r"loss 'py_wrong'.counted: -1 of \d+ rays"),
    ("name", r"loss 'py_wrong'.value: gradient of 'color', which `moves` does not name"),
    ("raises", r"loss 'py_wrong'.value: ZeroDivisionError: .*test_losses.py:\d+"),
])
def test_a_loss_that_is_wrong(scene: sf.Scene, what: str, says: str) -> None:
    class Wrong(Doubt):
        """Wrong."""

        def counted(self, targets: Dict[str, np.ndarray], rays: int) -> int:
            return -1 if what == "counted" else super().counted(targets, rays)

        def value(self, targets: Dict[str, np.ndarray], values: Dict[str, np.ndarray]) -> Any:
            if what == "raises":
                raise ZeroDivisionError("value is wrong")
            loss, gradients = super().value(targets, values)
            d = gradients["logits"]
            return {"columns": (loss, {"logits": d[:, :-1]}), "rows": (loss, {"logits": d[:-1]}), "one row": (loss, {"logits": d[:1]}),
                    "flat": (loss, {"logits": d.ravel()}), "complex": (loss, {"logits": d * 1j}), "missing": (loss, {}),
                    "sum": (loss.sum(), gradients), "short": (loss[1:], gradients), "column": (loss[:, None], gradients),
                    "alone": loss, "name": (loss, {**gradients, "color": d})}[what]

    sf.loss("py_wrong")(Wrong)
    with pytest.raises(sf.Error, match=says):
        trained(sf.open(with_loss(scene, type="py_wrong")), 2)


def test_what_a_loss_moves_is_there(scene: sf.Scene) -> None:
    class Misspelt(Doubt):
        """Moves what no head makes."""

        moves = ["logit"]

    sf.loss("py_misspelt")(Misspelt)
    with pytest.raises(sf.Error, match="'py_misspelt' reads the channel 'logit', which no head makes"):
        sf.open(with_loss(scene, type="py_misspelt"))


LOSS = '''
import numpy as np
import semfield as sf


@sf.loss("opaque")
class Opaque(sf.Loss):
    """Light of a ray that meets nothing costs."""

    moves = ["weight"]

    def value(self, targets, values):
        missing = 1 - values["opacity"].astype(np.float64)[:, 0]
        missing[values["first"][1:, 0] == values["first"][:-1, 0]] = 0
        d = np.zeros_like(values["weight"], dtype=np.float64)
        for ray, m in enumerate(missing):
            d[values["first"][ray, 0]:values["first"][ray + 1, 0]] = -2 * m
        return missing**2, {"weight": d}
'''


def test_a_loss_in_a_file_is_checked(tmp_path: Path) -> None:
    file = tmp_path / "idea_loss.py"
    file.write_text(LOSS)
    said = sf.command("plugins", "check", file)
    assert "failed=0" in said, said


def test_a_channel_of_a_dataset_reaches_a_loss(scene: sf.Scene) -> None:
    seen: Dict[str, Any] = {}

    class Bright(sf.Loss):
        """The error of the brightness."""

        targets = ["brightness"]
        moves = ["color"]

        def value(self, targets: Dict[str, np.ndarray], values: Dict[str, np.ndarray]) -> Any:
            seen["close"] = np.abs(targets["color"].mean(1, keepdims=True) - targets["brightness"]).max()
            error = values["color"].mean(1, keepdims=True) - targets["brightness"]
            return error[:, 0]**2, {"color": np.repeat(2 * error / 3, 3, 1)}

    class BrightBox(Box):
        """The box of the tests, and the brightness of its pixels."""

        def frames(self) -> Any:
            return [dataclasses.replace(f, channels={"brightness": (f.camera.height, f.camera.width, 1)}) for f in super().frames()]

        def pixels(self, index: int) -> sf.Frame:
            f = super().pixels(index)
            return dataclasses.replace(f, channels={"brightness": f.rgb.mean(2, keepdims=True) / 255})

    sf.loss("py_bright")(Bright)
    sf.dataset("py_bright_box")(BrightBox)
    run = sf.open({**config_of(scene), "scene": {"type": "py_bright_box"}, "losses": [{"type": "py_bright"}]})
    assert trained(run, 3)[0].terms["py_bright"] > 0
    assert seen["close"] < 1e-6
