"""Encoders and datasets written in Python: against those in C++, in the program, and where they are wrong."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Dict, List, Type

import numpy as np
import pytest

import semfield as sf
from conftest import NETWORK, WALLS, box_arrays, config_of, png, same, tensors_of, trained


def with_position(scene: sf.Scene, **position: Any) -> Dict[str, Any]:
    config = config_of(scene)
    return {**config, "passes": [{**config["passes"][0], "position": position}], "rendering": {**config["rendering"], "scene_scale": 1.0}}


class Waves(sf.Encoder):
    """x, sin(2^k x), cos(2^k x), as frequency has them."""

    bands = sf.param(4, "number of bands", low=1, high=12)

    def setup(self) -> None:
        self.out_dims = self.in_dims * (1 + 2 * self.bands)

    def forward(self, x: np.ndarray, params: Dict[str, np.ndarray]) -> np.ndarray:
        rows = [x]
        for k in range(self.bands):
            rows += [np.sin(2.0**k * x), np.cos(2.0**k * x)]
        return np.concatenate(rows, 1)

    def backward(self, x: np.ndarray, dy: np.ndarray, params: Dict[str, np.ndarray], grads: Dict[str, np.ndarray]) -> np.ndarray:
        d = self.in_dims
        dx = dy[:, :d].astype(np.float64)
        for k in range(self.bands):
            at = d * (1 + 2 * k)
            dx += 2.0**k * (dy[:, at:at + d] * np.cos(2.0**k * x) - dy[:, at + d:at + 2 * d] * np.sin(2.0**k * x))
        return dx


class Through(sf.Encoder):
    """Coordinates as they are."""

    def setup(self) -> None:
        self.out_dims = self.in_dims

    def forward(self, x: np.ndarray, params: Dict[str, np.ndarray]) -> np.ndarray:
        return x

    def backward(self, x: np.ndarray, dy: np.ndarray, params: Dict[str, np.ndarray], grads: Dict[str, np.ndarray]) -> np.ndarray:
        return dy


class Plane(sf.Encoder):
    """A learned feature for each cell of three axes."""

    cells = sf.param(32, "cells along an axis", low=2)
    features = sf.param(4, "features of a cell", low=1)

    domain = "unit_cube"

    def setup(self) -> None:
        self.out_dims = self.in_dims * self.features
        self.tensors = {f"axis_{d}": sf.Tensor(self.cells, self.features, -0.5, 0.5) for d in range(self.in_dims)}

    def cell(self, x: np.ndarray) -> np.ndarray:
        return np.clip((x * self.cells).astype(int), 0, self.cells - 1)

    def forward(self, x: np.ndarray, params: Dict[str, np.ndarray]) -> np.ndarray:
        cell = self.cell(x)
        return np.concatenate([params[f"axis_{d}"][cell[:, d]] for d in range(self.in_dims)], 1)

    def backward(self, x: np.ndarray, dy: np.ndarray, params: Dict[str, np.ndarray], grads: Dict[str, np.ndarray]) -> np.ndarray:
        cell = self.cell(x)
        for d in range(self.in_dims):
            np.add.at(grads[f"axis_{d}"], cell[:, d], dy[:, d * self.features:(d + 1) * self.features])
        return np.zeros_like(x)


sf.encoder("py_waves")(Waves)
sf.encoder("py_through")(Through)
sf.encoder("py_plane")(Plane)

BRANCH: Dict[str, Any] = {
    "position": {"type": "frequency", "frequencies": 4}, "field": {"type": "tiny_mlp", "hidden_width": 32, "hidden_layers": 2}}

IDEA = '''
"""An idea."""
import numpy as np
import semfield as sf


@sf.encoder("squares")
class Squares(sf.Encoder):
    """Coordinates and their squares."""

    factor = sf.param(1.0, "of the squares", low=0, high=4)
    shape = sf.param("plain", "of nothing", choices=["plain", "fancy"])

    def setup(self):
        self.out_dims = 2 * self.in_dims

    def forward(self, x, params):
        return np.concatenate([x, self.factor * x * x], 1)

    def backward(self, x, dy, params, grads):
        return dy[:, :self.in_dims] + 2 * self.factor * x * dy[:, self.in_dims:]
'''


@pytest.mark.parametrize("mine, built_in", [
    ({"type": "py_through"}, {"type": "identity"}),
    ({"type": "py_waves", "bands": 4}, {"type": "frequency", "frequencies": 4}),
])
def test_as_the_built_in_one(scene: sf.Scene, mine: Dict[str, Any], built_in: Dict[str, Any]) -> None:
    a, b = sf.open(with_position(scene, **mine)), sf.open(with_position(scene, **built_in))
    there = np.random.default_rng(1).uniform(-1, 1, (400, 3))
    one, two = a.query(there), b.query(there)
    assert np.allclose(one.density, two.density, rtol=2e-6) and np.allclose(one.probability, two.probability, atol=2e-6)
    steps = [trained(run, 5)[0] for run in (a, b)]
    assert steps[0].loss == pytest.approx(steps[1].loss, rel=1e-4)
    for name, tensor in a.parameters().items():
        if not name.startswith("adam/"):
            assert np.allclose(tensor, b.parameters()[name], atol=2e-3), name


def test_a_learned_one_trains(scene: sf.Scene) -> None:
    run = sf.open(with_position(scene, type="py_plane", cells=16))
    names = [n for n in run.parameters() if n.startswith("main/position/")]
    assert len(names) == 3 and run.parameters()[names[0]].shape == (16, 4)
    first = run.parameters()[names[0]]
    assert -0.5 <= first.min() < -0.3 and 0.3 < first.max() < 0.5
    steps = list(run.train(60, every=15))
    assert steps[-1].loss < 0.6 * steps[0].loss
    assert np.abs(run.parameters()[names[0]] - first).max() > 0.05


def test_saved_and_opened_again(scene: sf.Scene, tmp_path: Path) -> None:
    run = sf.open(with_position(scene, type="py_waves", bands=3))
    trained(run, 4)
    run.save(tmp_path / "a")
    again = sf.resume(tmp_path / "a")
    trained(run, 4)
    trained(again, 4)
    assert same(run, again)


def raising(where: str) -> Type[sf.Encoder]:
    class Raises(Through):
        """Raises."""

        def setup(self) -> None:
            super().setup()
            self.tensors = {"learned": sf.Tensor(1, 1)}  # without any, nobody needs gradients
            if where == "setup":
                raise RuntimeError("setup is wrong")

        def forward(self, x: np.ndarray, params: Dict[str, np.ndarray]) -> np.ndarray:
            if where == "forward":
                raise ZeroDivisionError("forward is wrong")
            if where == "own code":
                raise sf.DataError("no bands", code="idea.bands.none")
            return x[:-1] if where == "rows" else x.tolist()[0] if where == "list" else x + 1j if where == "complex" else x

        def backward(self, x: np.ndarray, dy: np.ndarray, params: Any, grads: Any) -> Any:
            if where == "backward":
                raise KeyError("backward is wrong")
            if where == "replaced":
                grads["learned"] = np.ones((1, 1))
            if where == "unknown":
                grads["leaned"] = np.ones((1, 1))
            return None if where == "none" else dy

    return Raises


@pytest.mark.parametrize("where, code, says", [
    ("forward", "plugin.python.raised", r"encoder 'py_raises'.forward: ZeroDivisionError: forward is wrong \(.*test_plugins.py:\d+\)"),
    ("backward", "plugin.python.raised", r"encoder 'py_raises'.backward: KeyError: .*backward is wrong.*test_plugins.py:\d+\)"),
    ("setup", "plugin.python.raised", r"encoder 'py_raises': RuntimeError: setup is wrong \(.*test_plugins.py:\d+\)"),
    ("rows", "plugin.python.shape", r"py_raises'.forward: expected an array of the shape \(\d+, 3\), got \(\d+, 3\)"),
    ("list", "plugin.python.shape", r"expected an array of the shape \(\d+, 3\), got \(3,\)"),
    ("own code", "idea.bands.none", r"DataError: no bands"),
    ("replaced", "plugin.python.gradient", r"py_raises'.backward: the gradient of 'learned' was replaced"),
    ("unknown", "plugin.python.gradient", r"py_raises'.backward: grads got a name that no tensor has"),
    ("complex", "plugin.python.value", r"py_raises'.forward: expected real numbers, got complex128"),
])
def test_one_that_is_wrong(scene: sf.Scene, where: str, code: str, says: str) -> None:
    sf.encoder("py_raises")(raising(where))
    with pytest.raises(sf.Error, match=says) as caught:
        trained(sf.open(with_position(scene, type="py_raises")), 3)
    assert caught.value.code == code
    sf.encoder("py_raises")(raising("nowhere"))  # mended, as in a notebook
    assert trained(sf.open(with_position(scene, type="py_raises")), 2)[0].step == 2


def test_defined_again_the_last_counts(scene: sf.Scene) -> None:
    before = sf.open(with_position(scene, type="py_through"))

    @sf.encoder("py_again")
    class First(Through):
        """First."""

    run = sf.open(with_position(scene, type="py_again"))

    @sf.encoder("py_again", summary="Second, with words of its own.")
    class Second(Waves):
        pass

    assert [p[2] for p in sf.plugins() if p[1] == "py_again"] == ["Second, with words of its own."]
    other = sf.open(with_position(scene, type="py_again", bands=2))
    assert run.parameters()["main/field/hidden_0/weight"].shape[0] == 3  # an open run keeps what it has
    assert other.parameters()["main/field/hidden_0/weight"].shape[0] == 15
    trained(run, 1)
    trained(before, 1)


def test_parameters(scene: sf.Scene) -> None:
    class Many(Through):
        """All kinds of parameters."""

        flag = sf.param(True, "a truth value")
        count = sf.param(3, "an integer", low=1, high=5)
        size = sf.param(0.5, "a number", low=0)
        word = sf.param("a", "a text")
        kind = sf.param("plain", "one of some", choices=["plain", "fancy"])
        list_of = sf.param([1.0, 2.0], "numbers", low=0)
        seen: Dict[str, Any] = {}

        def setup(self) -> None:
            super().setup()
            Many.seen = {k: getattr(self, k) for k in ("flag", "count", "size", "word", "kind", "list_of")}

    sf.encoder("py_many")(Many)
    sf.open(with_position(scene, type="py_many"))
    assert Many.seen == {"flag": True, "count": 3, "size": 0.5, "word": "a", "kind": "plain", "list_of": [1.0, 2.0]}
    sf.open(with_position(scene, type="py_many", flag=False, count=5, size=2, word="b", kind="fancy", list_of=[3]))
    assert Many.seen == {"flag": False, "count": 5, "size": 2.0, "word": "b", "kind": "fancy", "list_of": [3.0]}
    assert type(Many.seen["size"]) is float and type(Many.seen["count"]) is int
    for wrong, says in [({"count": 6}, r"count.*\[1, 5\]"), ({"count": 1.5}, "count"), ({"kind": "other"}, "plain, fancy"),
                        ({"size": -1}, "size"), ({"list_of": [-1]}, "list_of"), ({"coutn": 3}, "did you mean 'count'"), ({"flag": "maybe"}, "flag")]:
        with pytest.raises(sf.ConfigError, match=says):
            sf.open(with_position(scene, type="py_many", **wrong))
    with pytest.raises(sf.ConfigError, match="did you mean 'py_many'"):
        sf.open(with_position(scene, type="py_mny"))


def test_parameters_of_a_subclass(scene: sf.Scene) -> None:
    @sf.encoder("py_fewer")
    class Fewer(Waves):
        """Waves, with fewer bands."""

        bands = sf.param(2, "number of bands", low=1, high=3)

    assert Fewer.make().out_dims == 15 and Waves.make().out_dims == 27 and Waves.make(in_dims=2, bands=1).out_dims == 6
    assert sf.open(with_position(scene, type="py_fewer")).parameters()["main/field/hidden_0/weight"].shape[0] == 15
    with pytest.raises(sf.ConfigError, match="bands"):
        sf.open(with_position(scene, type="py_fewer", bands=4))
    with pytest.raises(sf.UsageError, match="no parameter is named 'band'; there are bands"):
        Waves.make(band=3)


def test_declarations_that_cannot_be() -> None:
    class Nothing(sf.Encoder):
        def setup(self) -> None:
            self.out_dims = 3

    Nothing.__doc__ = ""
    with pytest.raises(sf.UsageError, match="Nothing: a plugin has a sentence"):
        sf.encoder("py_nothing")(Nothing)
    for default, more, says in [(object(), {}, "the default of 'p' is <object"), ("c", {"choices": ["a", "b"]}, "none of its choices"),
                                (9, {"low": 0, "high": 5}, "the default of 'p' is 9.0, outside its own range"),
                                (["a", 1], {}, "p")]:
        wrong = type("Wrong", (Through,), {"__doc__": "Wrong.", "p": sf.param(default, "of no use", **more)})
        with pytest.raises(sf.Error, match=says):
            sf.encoder("py_wrong")(wrong)
        assert not [p for p in sf.plugins() if p[:2] == ("encoder", "py_wrong")]
    with pytest.raises(sf.Error, match="hash_grid"):
        sf.encoder("hash_grid")(Through)
    with pytest.raises(sf.UsageError, match="Encoder"):
        sf.encoder("py_wrong")(sf.Dataset)  # type: ignore[type-var]


class Box(sf.Dataset):
    """The box of the tests."""

    width = sf.param(32, "pixels", low=8)
    wrong = sf.param("nothing", "what is wrong", choices=["nothing", "raise", "shape", "names", "open", "labels", "depth", "mask", "flat map", "no map"])

    def frames(self) -> Any:
        if self.wrong == "open":
            raise OSError("the disk is gone")
        self.arrays = box_arrays(width=self.width)
        maps = {"words": (24, 32)} if self.wrong == "flat map" else {"words": (24, 32, 2)} if self.wrong == "no map" else {}
        return [sf.Frame("same" if self.wrong == "names" else f"{i:04d}", self.arrays["cameras"], self.arrays["poses"][i],
                         "test" if i in self.arrays["test"] else "train", has_labels=True, has_depth=True, channels=maps) for i in range(10)]

    def classes(self) -> Any:
        return WALLS

    def pixels(self, index: int) -> sf.Frame:
        if self.wrong == "raise" and index == 3:
            raise ValueError("frame 3 is lost")
        rgb = self.arrays["images"][index]
        return sf.Frame("", self.arrays["cameras"], np.eye(4), rgb=rgb[1:] if self.wrong == "shape" else rgb,
                        labels=None if self.wrong == "labels" else self.arrays["labels"][index],
                        depth_m=self.arrays["depths"][index][:1] if self.wrong == "depth" else self.arrays["depths"][index],
                        mask=np.ones((1, 32), bool) if self.wrong == "mask" else None)


sf.dataset("py_box")(Box)


def test_a_dataset_has_the_bits_of_its_scene(scene: sf.Scene) -> None:
    mine, packed = sf.open({**NETWORK, "scene": {"type": "py_box"}}), sf.open(config_of(scene))
    trained(mine, 10)
    trained(packed, 10)
    one, two = mine.parameters(), packed.parameters()
    assert all(np.array_equal(one[k], two[k]) for k in two)
    assert np.array_equal(mine.pixels(3).labels, packed.pixels(3).labels)
    assert mine.classes == packed.classes


@pytest.mark.parametrize("wrong, says", [
    ("raise", r"dataset 'py_box'.*ValueError: frame 3 is lost \(.*test_plugins.py:\d+\)"),
    ("shape", r"frame '0000'.*expected the shape \[24, 32, 3\], got \[23, 32, 3\]"),
    ("names", "frame '.*': another one has its name"),
    ("open", "the disk is gone"),
    ("labels", r"frame '0000'.*labels: expected the shape \[24, 32\], got \[\]"),
    ("depth", r"frame '0000'.*depth_m: expected the shape \[24, 32\], got \[1, 32\]"),
    ("mask", r"frame '0000'.*mask: expected the shape \[24, 32\], got \[1, 32\]"),
    ("flat map", r"frame '0000': channel 'words' has the shape \(24, 32\)"),
    ("no map", r"frame '0000': words: expected an array, got none"),
])
def test_a_dataset_that_is_wrong(wrong: str, says: str) -> None:
    with pytest.raises(sf.Error, match=says):
        heads = [{"type": "feature_map", "channel": "words", "width": 2, "branch": BRANCH}] if wrong.endswith("map") else []
        losses = [{"type": "cosine_distance", "channel": "words"}] if heads else []
        sf.open({**NETWORK, "scene": {"type": "py_box", "wrong": wrong}, "heads": heads, "losses": losses})


def idea_config(scene: sf.Scene, folder: Path, **position: Any) -> Path:
    (folder / "idea.py").write_text(IDEA)
    config = folder / "idea.yaml"
    config.write_text(json.dumps({**with_position(scene, **{"type": "squares", **position}), "plugins": ["idea.py"]}))
    return config


def test_the_program_trains_it_with_the_same_bits(scene: sf.Scene, tmp_path: Path) -> None:
    config = idea_config(scene, tmp_path, factor=0.5)
    idea = tmp_path / "idea.py"
    with pytest.raises(sf.ConfigError, match="load_plugin"):
        sf.open(config)
    sf.command("train", config, "--out", tmp_path / "a", "--steps", "8", "--plugin", idea, "--quiet")
    sf.load_plugin(idea)
    run = sf.open(config, {"train.steps": 8, "train.schedule.decay_steps": 8})  # as --steps does
    list(run.train())
    run.save(tmp_path / "b")
    one, two = (tensors_of(str(next((tmp_path / f / "checkpoints").glob("*.safetensors")))) for f in "ab")
    assert one.keys() == two.keys() and all(one[k] == two[k] for k in one)
    scored = sf.command("eval", tmp_path / "b", "--plugin", idea, json_output=True)
    mine = sf.load(tmp_path / "b").evaluate("test")
    assert mine.psnr == pytest.approx(scored["values"]["psnr"], rel=1e-6) if "values" in scored else scored


def test_folders_that_are_trusted(scene: sf.Scene, tmp_path: Path) -> None:
    config = idea_config(scene, tmp_path)
    code = f"import semfield as sf; run = sf.open({str(config)!r}); list(run.train(2)); print(run.step)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60,
                          env={**os.environ, "SEMFIELD_PLUGIN_PATH": str(tmp_path)})
    assert (done.stdout, done.returncode) == ("2\n", 0), done.stderr


def test_the_program_tells_of_it(tmp_path: Path) -> None:
    (tmp_path / "idea.py").write_text(IDEA)
    shown = sf.command("plugins", "show", "squares", "--plugin", tmp_path / "idea.py")
    assert "Coordinates and their squares." in shown and "factor" in shown and "plain, fancy" in shown and "idea.py" in shown


@pytest.mark.parametrize("text, says", [
    ("x = 1\n", "defines no plugin"),
    ("import semfield\ndef f(:\n", r"idea.py:2|line 2"),
    ("import semfield\n\nraise RuntimeError('not today')\n", r"RuntimeError: not today \(.*idea.py:3\)"),
    ("import no_such_module_at_all\n", "no_such_module_at_all"),
    ("import sys\nsys.exit(3)\n", "SystemExit"),
])
def test_files_that_cannot_be_loaded(tmp_path: Path, text: str, says: str) -> None:
    file = tmp_path / "idea.py"
    file.write_text(text)
    before = sf.plugins()
    with pytest.raises(sf.UnavailableError, match=says) as caught:
        sf.load_plugin(str(file))
    assert str(file) in str(caught.value)
    assert sf.plugins() == before
    with pytest.raises(sf.CommandError, match=says) as ended:
        sf.command("plugins", "list", "--plugin", file)
    assert ended.value.exit_code == 69
    with pytest.raises(sf.Error, match="nowhere.py"):
        sf.load_plugin(str(tmp_path / "nowhere.py"))


@pytest.fixture(scope="module")
def idea(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of its own, which stays loaded."""
    file = tmp_path_factory.mktemp("idea") / "other_idea.py"
    file.write_text(IDEA.replace('"squares"', '"other_squares"'))
    return file


def test_a_run_needs_only_the_files_that_it_names(idea: Path, scene: sf.Scene, tmp_path: Path) -> None:
    sf.load_plugin(idea)
    for name, position, needed in (("with", {"type": "other_squares"}, [str(idea)]), ("without", {"type": "identity"}, [])):
        run = sf.open(with_position(scene, **position))
        trained(run, 1)
        run.save(tmp_path / name)
        assert run.config.get("plugins", []) == needed
    assert sf.command("eval", tmp_path / "without", json_output=True)["verb"] == "eval"
    with pytest.raises(sf.CommandError, match="--plugin"):
        sf.command("eval", tmp_path / "with")


def test_a_loaded_file_stays(idea: Path, scene: sf.Scene) -> None:
    module = sf.load_plugin(idea)
    assert module is not None and module.__file__ == str(idea) and module is sf.load_plugin(str(idea))  # again: nothing
    assert [p[3] for p in sf.plugins() if p[1] == "other_squares"] == ["other_idea.py"]
    assert trained(sf.open(with_position(scene, type="other_squares")), 1)[0].step == 1


def test_a_step_that_raised_is_made_again_with_the_same_bits(scene: sf.Scene) -> None:
    class Sometimes(Plane):
        """Raises once."""

        calls = 0
        raises_at = -1

        def backward(self, x: np.ndarray, dy: np.ndarray, params: Dict[str, np.ndarray], grads: Dict[str, np.ndarray]) -> np.ndarray:
            Sometimes.calls += 1
            if Sometimes.calls == Sometimes.raises_at:
                raise RuntimeError("once")
            return super().backward(x, dy, params, grads)

    sf.encoder("py_sometimes")(Sometimes)
    calm = sf.open(with_position(scene, type="py_sometimes"))
    trained(calm, 6)
    Sometimes.raises_at = Sometimes.calls + Sometimes.calls // 2
    run = sf.open(with_position(scene, type="py_sometimes"))
    with pytest.raises(sf.Error, match="once"):
        trained(run, 6)
    made = run.step
    assert 0 < made < 6
    trained(run, 6 - made)
    assert same(run, calm)


def test_a_file_of_python_is_asked_the_laws(tmp_path: Path) -> None:
    file = tmp_path / "bent.py"
    text = """
import semfield as sf

@sf.encoder("bent")
class Bent(sf.Encoder):
    \"\"\"The coordinates, with a gradient that is not theirs.\"\"\"
    def setup(self):
        self.out_dims = self.in_dims
    def forward(self, x, params):
        return x
    def backward(self, x, dy, params, grads):
        return FACTOR * dy
"""
    file.write_text(text.replace("FACTOR", "2"))
    with pytest.raises(sf.CommandError):
        sf.command("plugins", "check", file)
    file.write_text(text.replace("FACTOR", "1"))
    sf.command("plugins", "check", file)
    sf.load_plugin(file)
    assert "bent" in [name for _, name, _, _ in sf.plugins()]


# Heads beside that of class logits: from a file of Python, on feature maps of a dataset, rendered and asked.
# Of each wall, as a network might encode its word; nearly orthogonal.
WORDS = np.random.default_rng(5).normal(size=(6, 96)).astype(np.float32)

HEAD = '''
import numpy as np
import semfield as sf


@sf.head("plain")
class Plain(sf.Head):
    """One linear layer and its bias."""

    def setup(self):
        self.hidden_width = self.feature_dims
        self.tensors = {"weight": sf.Tensor(self.feature_dims, self.width, -0.5, 0.5), "bias": sf.Tensor(1, self.width)}

    def hidden(self, feature, params):
        return feature

    def hidden_backward(self, feature, hidden, d_hidden, params, grads):
        return d_hidden

    def output(self, h, opacity, params):
        share = np.ones((len(h), 1)) if opacity is None else opacity
        return np.einsum("nh,hc->nc", h, params["weight"]) + share * params["bias"]

    def output_backward(self, h, opacity, d_rows, params, grads):
        share = np.ones((len(h), 1)) if opacity is None else opacity
        grads["weight"] += h.T @ d_rows
        grads["bias"] += (share * d_rows).sum(0, keepdims=True)
        return d_rows @ params["weight"].T, d_rows @ params["bias"].T
'''


class WordBox(Box):
    """The box of the tests, and for every second pixel the word of its wall."""

    def frames(self) -> Any:
        return [dataclasses.replace(f, channels={"words": (f.camera.height // 2, f.camera.width // 2, 96)}) for f in super().frames()]

    def pixels(self, index: int) -> sf.Frame:
        f = super().pixels(index)
        return dataclasses.replace(f, channels={"words": WORDS[np.asarray(f.labels)[::2, ::2]]})


def word_config(scene: sf.Scene, **head: Any) -> Dict[str, Any]:
    sf.dataset("py_word_box")(WordBox)
    return {**config_of(scene, steps=300), "scene": {"type": "py_word_box"},
            "heads": [{"type": "feature_map", "channel": "words", "branch": BRANCH, **head}],
            "losses": [{"type": "cosine_distance", "channel": "words"}]}


def found_walls(made: np.ndarray) -> np.ndarray:
    """The word that each pixel's row [H, W, 96] is nearest to."""
    words = WORDS / np.linalg.norm(WORDS, axis=1, keepdims=True)
    return np.argmax(made @ words.T, -1)


@pytest.fixture(scope="module")
def plain_head(tmp_path_factory: pytest.TempPathFactory) -> None:
    file = tmp_path_factory.mktemp("head") / "plain_head.py"
    file.write_text(HEAD)
    sf.load_plugin(file)


@pytest.mark.parametrize("type_", ["feature_map", "plain"])
def test_feature_maps_are_learned_and_rendered(scene: sf.Scene, plain_head: None, type_: str) -> None:
    run = sf.open(word_config(scene, type=type_, width=5))
    trained(run, 300)
    axes = run.channel_axes("words")
    assert axes is not None and axes.shape == (96, 5)
    assert np.allclose(axes.T @ axes, np.eye(5), atol=1e-5)
    frame = next(f for f in run.frames if f.split == "test")
    view = run.render(frame=frame.name, channels=["words"])
    assert view.channels["words"].shape == (*view.depth_m.shape, 5)
    walls = found_walls(view.channels["words"] @ axes.T)
    truth = box_arrays()["labels"][[f.name for f in run.frames].index(frame.name)]
    assert (walls == truth).mean() > 0.8
    with pytest.raises(sf.UsageError, match="no head that makes a channel 'wrods'"):
        run.render(frame=frame.name, channels=["wrods"])


def word_files(folder: Path) -> Path:
    """The box as a transforms.json with a map of words per training frame; returns a configuration that learns them."""
    box = box_arrays(count=12)
    frames: List[Dict[str, Any]] = []
    for i, (rgb, walls, pose) in enumerate(zip(box["images"], box["labels"], box["poses"])):
        png(folder / f"{i}.png", 32, 24, 2, 8, [row.tobytes() for row in rgb])
        png(folder / f"{i}_label.png", 32, 24, 0, 8, [bytes(row.tolist()) for row in walls])
        np.save(folder / f"{i}_words.npy", WORDS[walls[::4, ::4]].astype(np.float16))
        frames.append({"file_path": f"{i}.png", "label_path": f"{i}_label.png", "words_path": f"{i}_words.npy",
                       "transform_matrix": (pose @ np.diag([1, -1, -1, 1])).tolist()})
    camera = box["cameras"]._dict()
    lens = {"w": 32, "h": 24, "fl_x": camera["fx"], "fl_y": camera["fy"], "cx": camera["cx"], "cy": camera["cy"]}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    (folder / "classes.yaml").write_text("\n".join(f"- {{id: {i}, name: {w}}}" for i, w in enumerate(box["classes"])))
    config = {**NETWORK, "scene": {"type": "transforms_json", "root": str(folder), "channels": ["words"], "test_every": 4,
                                   "load": {"bounds": [-1.1, -1.1, -1.1, 1.1, 1.1, 1.1], "near_m": 0.05, "far_m": 4}},
              "heads": [{"type": "feature_map", "channel": "words", "width": 6, "branch": BRANCH}],
              "losses": [{"type": "cosine_distance", "channel": "words"}],
              "train": {**NETWORK["train"], "steps": 200}}
    (folder / "words.yaml").write_text(json.dumps(config))
    return folder / "words.yaml"


def test_a_run_is_asked_by_words(tmp_path: Path) -> None:
    config, run = word_files(tmp_path), tmp_path / "run"
    sf.command("train", config, "--out", run)
    resolved = (run / "run.yaml").read_text()
    assert "source_width: 96" in resolved
    sf.command("render", run, "--channel", "words", "--out", tmp_path / "maps")
    maps = sorted((tmp_path / "maps").glob("*_words.npy"))
    axes = np.load(tmp_path / "maps" / "words_axes.npy")
    assert len(maps) == 3 and axes.shape == (96, 6)
    for file in maps:
        made, stem = np.load(file), file.name[:-len("_words.npy")]
        asked = made @ (axes.T @ WORDS[1]) / np.linalg.norm(made, axis=-1) / np.linalg.norm(WORDS[1])
        truth = box_arrays(count=12)["labels"][int(stem)]
        if (truth == 1).any() and (truth != 1).any():
            assert asked[truth == 1].mean() > asked[truth != 1].mean() + 0.1
    with pytest.raises(sf.Error, match="did you mean 'words'"):
        sf.command("render", run, "--channel", "word")


# Losses written in Python: against one in C++, where they are wrong, from a file, and on a channel of a dataset.
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
    ("raises", r"loss 'py_wrong'.value: ZeroDivisionError: .*test_plugins.py:\d+"),
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


@pytest.mark.parametrize("text", [HEAD, LOSS], ids=["head", "loss"])
def test_one_in_a_file_is_checked(tmp_path: Path, text: str) -> None:
    file = tmp_path / "idea.py"
    file.write_text(text)
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
