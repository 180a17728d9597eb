"""The module as a whole: names, docstrings, types, and what it does to the process that imports it."""

from __future__ import annotations

import ast
import copy
import gc
import inspect
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
import warnings
from pathlib import Path
from typing import Any, Dict, List

import numpy as np
import pytest

import semfield as sf
from conftest import NETWORK, box_arrays, config_of, trained
from semfield import _core

PACKAGE = Path(sf.__file__).parent


def in_a_process(code: str, **more: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120,
                          env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p), **more})


def test_the_stub_names_what_the_extension_has() -> None:
    members = {node.name: {f.name for f in node.body if isinstance(f, ast.FunctionDef)}
               for node in ast.parse((PACKAGE / "_core.pyi").read_text()).body if isinstance(node, ast.ClassDef)}
    assert members.keys() <= vars(_core).keys()
    assert {name for name in vars(_core.Run) if not name.startswith("_")} <= members["Run"]


def public() -> Dict[str, Any]:
    """Name to object: what `import semfield` gives, and the public methods of its classes."""
    found: Dict[str, Any] = {}
    for name in sf.__all__:
        thing = getattr(sf, name)
        if name in ("errors", "__version__"):
            continue
        found[name] = thing
        if inspect.isclass(thing):
            for method, value in vars(thing).items():
                if not method.startswith("_") and (callable(value) or isinstance(value, (property, staticmethod, classmethod))):
                    found[f"{name}.{method}"] = value
    return found


def test_every_name_says_what_it_is() -> None:
    """A docstring has words, names each parameter where it has Args and none that is not there, and has a shape like [N, 3] for arrays."""
    wrong, arrays = [], 0
    for name, thing in public().items():
        doc = inspect.getdoc(thing) or inspect.getdoc(getattr(thing, "__func__", None)) or ""
        if len(doc.split()) < 3 or (inspect.isclass(thing) and doc.startswith(thing.__name__ + "(")):
            wrong.append((name, "no words"))
        function = thing.__init__ if inspect.isclass(thing) else thing
        if inspect.isfunction(function) and "Args:" in doc:
            told = {n.strip() for line in re.findall(r"^    (\w[\w, ]*):", doc.split("Args:")[1].split("\n\n")[0], re.M) for n in line.split(",")}
            there = {p for p in inspect.signature(function).parameters if p not in ("self", "name")}
            if told - {"name"} != there:
                wrong.append((name, f"tells {told}, has {there}"))
        if inspect.isclass(thing):
            shapes = [rf"\b{field}: .*\[[\w, ]+\]" for field, hint in vars(thing).get("__annotations__", {}).items() if re.search("ndarray|Array", str(hint))]
        else:
            returns = str(inspect.signature(thing).return_annotation) if inspect.isfunction(thing) else ""
            shapes = [r"\[[A-Z0-9][\w, ]*\]"] if "ndarray" in returns and "Dict" not in returns else []
        arrays += len(shapes)
        wrong += [(name, "no shape") for shape in shapes if not re.search(shape, doc)]
    assert wrong == [] and arrays > 15


def test_names_of_the_guide_are_there() -> None:
    """Every name `sf.NAME` and `run.NAME` of the guide, whose code docs_commands_of_docs/guide/python.md runs, is there."""
    guide = Path(__file__).resolve().parents[2] / "docs" / "guide" / "python.md"
    if not guide.is_file():
        pytest.skip(f"there is no {guide}: its names are not tested")
    text = guide.read_text()
    assert all(hasattr(sf, name) for name in re.findall(r"\bsf\.(\w+)", text))
    attributes = {*dir(sf.Run), "name", "bounds", "near_m", "far_m", "metric", "device", "left_out", "has_semantics"}
    assert set(re.findall(r"\brun\.(\w+)", text)) <= attributes


def test_types_hold() -> None:
    """mypy --strict on the package (Debian's package mypy)."""
    try:
        version = subprocess.run([sys.executable, "-m", "mypy", "--version"], capture_output=True, check=False)
    except OSError:
        version = None
    if version is None or version.returncode != 0:
        pytest.skip("mypy is not installed for this Python (package mypy): the types of the package are not checked")
    # mypy finds an installed package by itself, and refuses a path that Python has anyway.
    installed = PACKAGE.parent.name in ("dist-packages", "site-packages")
    done = subprocess.run([sys.executable, "-m", "mypy", "--strict", "--cache-dir", os.devnull, "-p", "semfield"], capture_output=True, text=True,
                          env=dict(os.environ) if installed else {**os.environ, "MYPYPATH": str(PACKAGE.parent)},
                          cwd="/" if installed else PACKAGE.parent, check=False)
    assert done.returncode == 0, done.stdout
    assert (PACKAGE / "py.typed").exists()


def test_import_brings_no_strangers_and_leaves_the_process_as_it_is() -> None:
    done = in_a_process("import os, signal, sys, threading; state = lambda: (signal.getsignal(signal.SIGINT), os.getcwd(), dict(os.environ))\n"
                        "before = state(); import semfield; assert before == state() and threading.active_count() == 1\n"
                        "print(sorted({m.split('.')[0] for m in sys.modules} & {'torch', 'pandas', 'matplotlib', 'scipy', 'PIL', 'jax'}), "
                        "len(semfield.plugins()) > 8)")
    assert done.stdout == "[] True\n", done.stderr


def test_a_process_ends_with_runs_that_are_open(tmp_path: Path) -> None:
    sf.Scene(**box_arrays(), file=tmp_path / "box.sfpack")
    code = f"""
import json, threading, numpy as np, semfield as sf
@sf.encoder("ends")
class Ends(sf.Encoder):
    "Coordinates as they are."
    def setup(self): self.out_dims = self.in_dims
    def forward(self, x, params): return x
    def backward(self, x, dy, params, grads): return dy
config = json.loads({__import__("json").dumps(config_of(_Box(tmp_path)))!r})
config["passes"][0]["position"] = {{"type": "ends"}}
run = sf.open(config)
steps = run.train(10**9, every=10)
next(steps)
threading.Thread(target=lambda: [None for _ in steps], daemon=True).start()
import time; time.sleep(0.2)
print("ends")
"""
    done = in_a_process(code)
    # A thread that prints while Python ends may abort the process, so it prints nothing.
    assert (done.stdout, done.stderr, done.returncode) == ("ends\n", "", 0), done.stderr[-2000:]


class _Box:
    """Scene.config() of a file that is there."""

    def __init__(self, folder: Path) -> None:
        self.file = folder / "box.sfpack"

    def config(self) -> Dict[str, Any]:
        return {"type": "packed", "file": str(self.file)}


def in_a_fork(work: Any) -> str:
    """What `work` returns, or the sf.Error that it raises, in a forked process that ends as Python ends."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        code = 1
        try:
            try:
                words = str(work())
            except sf.Error as error:
                words = f"{type(error).__name__}: {error}"
            os.write(writer, words.encode())
            gc.collect()
            import weakref

            weakref.finalize._exitfunc()  # type: ignore[attr-defined]  # what an end without os._exit does
            code = 0
        finally:
            os._exit(code)
    os.close(writer)
    alarm = threading.Timer(60, lambda: os.kill(child, signal.SIGKILL))
    alarm.start()
    _, status = os.waitpid(child, 0)
    alarm.cancel()
    words = os.read(reader, 1000).decode()
    os.close(reader)
    assert status == 0, (status, words)
    return words


def test_a_forked_process_is_told(run: sf.Run, tmp_path: Path) -> None:
    trained(run, 2)
    for use in (lambda: trained(run, 1), lambda: run.render(frame=0, width=4), lambda: run.save(tmp_path / "a"), lambda: run.evaluate(),
                lambda: run.query([[0, 0, 0]]), lambda: run.parameters(), lambda: run.set_labels(0, np.zeros((24, 32), int))):
        said = in_a_fork(use)
        assert said.startswith(f"UsageError: this run was opened by process {os.getpid()}, and this is a fork of it"), said
        assert "save the run before the fork and semfield.load" in said
    assert not (tmp_path / "a").exists()
    trained(run, 1)


def test_a_fork_leaves_the_files_of_its_parent(tmp_path: Path) -> None:
    held: List[Any] = [sf.Scene(**box_arrays())]
    held.append(sf.open(config_of(held[0]), out=tmp_path / "run"))
    trained(held[1], 1)
    file = held[0].file
    assert in_a_fork(held.clear) == "None"
    assert os.path.exists(file)
    with pytest.raises(sf.WriteError, match="in use"):
        sf.resume(tmp_path / "run")
    trained(held[1], 1)


def test_numbers_beyond_their_types_are_told(run: sf.Run) -> None:
    big = 2**63
    calls: List[Any] = [
        lambda: sf.Camera(2**40, 24, 16), lambda: sf.Camera(float("inf"), 24, 16), lambda: sf.Camera("a", 24, 16),  # type: ignore[arg-type]
        lambda: sf.Camera(32, 24, 10**400), lambda: sf.Camera(32, 24, 16, distortion=("a",)), lambda: sf.Camera.from_fov(32, 24, 0),  # type: ignore[arg-type]
        lambda: sf.Camera.from_fov(32, 24, 180), lambda: sf.Camera(32, 24, 16).resized(2**40, 24), lambda: run.render(frame=0, stride=big),
        lambda: run.render(frame=0, stride=2**31), lambda: run.render(frame=0, width=big), lambda: run.render(frame=0, height="a"),  # type: ignore[arg-type]
        lambda: run.render(frame=0, width=2**31 - 1), lambda: run.train(big * 2),
        lambda: run.train(3, every=big * 2), lambda: run.extend(seconds=10**400), lambda: run.extend(steps=big),
        lambda: run.render(frame=big), lambda: run.pixels(big), lambda: run.evaluate(frames=[big]),
        lambda: run.query([[10**400, 0, 0]]), lambda: run.set_labels(0, np.full((24, 32), 2**64 - 1, np.uint64)),
        lambda: run.render(pose=np.full((4, 4), 10**400, object)), lambda: sf.open(config_of(_Box(Path("."))), class_room=big),
        lambda: sf.open(NETWORK, {"train.rays": 2**70}), lambda: sf.resolved(NETWORK, {"train.steps": big * 2}),
        lambda: run.labels.add_click(0, 10**400, 1, "a"), lambda: run.labels.add_class("a", (big, 0, 0)),
    ]
    for i, call in enumerate(calls):
        with pytest.raises(sf.Error) as caught:
            call()
        assert str(caught.value), i
    assert run.step == 0


def test_a_python_without_numpy_is_told(tmp_path: Path) -> None:
    (tmp_path / "numpy.py").write_text("raise ModuleNotFoundError(\"No module named 'numpy'\", name='numpy')")
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); import semfield"
    done = in_a_process(code)
    assert done.returncode == 1 and "semfield needs NumPy, and " in done.stderr.splitlines()[-1], done.stderr


def test_a_closed_run_says_so(scene: sf.Scene) -> None:
    with sf.open(config_of(scene)) as run:
        steps = run.train(10, every=1)
        next(steps)
    assert "closed" in repr(run)
    run.close()
    for use in (lambda: run.step, lambda: run.classes, lambda: run.config, lambda: run.render(frame=0), lambda: run.query([[0, 0, 0]]),
                lambda: run.evaluate(), lambda: run.save("x"), lambda: run.train(1), lambda: run.labels.clicks, lambda: run.notes,
                lambda: run.labels.add_class("x"), lambda: run.pixels(0), lambda: run.parameters(), lambda: run.history, lambda: next(steps)):
        with pytest.raises(sf.UsageError, match="'run' is closed; open it again"):
            use()
    assert run.frames[0].name == "0000" and run.bounds.shape == (2, 3)


def test_a_run_with_a_name_is_told_by_it(scene: sf.Scene) -> None:
    run = sf.open({**config_of(scene), "name": "attic"})
    assert repr(run) == "Run('attic', step=0, frames=10, device='cpu')"
    for thing in (run.labels, run.train(0), run.frames[0], run.render(frame=0, width=4), run.query([[0, 0, 0]]), run.evaluate(), run.classes[0]):
        assert type(thing).__name__ in repr(thing) and len(repr(thing)) < 600


def test_steps_that_nobody_asks_for_warn(run: sf.Run) -> None:
    with pytest.warns(RuntimeWarning, match=r"run.train\(...\).last\(\)"):
        run.train(5)
        gc.collect()
    assert run.step == 0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        last = run.train(5, every=2).last()
        assert last is not None and last.step == 5 == run.step
        assert run.train(0).last() is None
        list(run.train(1))
        half = run.train(10, every=2)
        next(half)
        del half
        gc.collect()
    assert run.step == 8
    for wrong in (dict(steps=-1), dict(steps=2.5), dict(every=0), dict(steps="ten")):
        with pytest.raises(sf.UsageError):
            run.train(**wrong)  # type: ignore[arg-type]


def test_what_can_be_pickled_and_what_cannot(run: sf.Run, scene: sf.Scene, tmp_path: Path) -> None:
    view = pickle.loads(pickle.dumps(run.render(frame=0, width=8)))
    assert view.rgb.shape == (6, 8, 3)
    score = copy.deepcopy(run.evaluate(frames=[0]))
    assert score.psnr == score.values["psnr"] and "psnr" in dir(score) and not hasattr(score, "psnrr")
    with pytest.raises(sf.ConfigError) as caught:
        sf.resolved({**config_of(scene), "tarin": {}})
    again = pickle.loads(pickle.dumps(caught.value))
    assert str(again) == str(caught.value) and again.findings == caught.value.findings and again.exit_code == 78
    assert again.code == "config.key.unknown" and [f.code for f in again.findings] == ["config.key.unknown"]
    with pytest.raises(sf.InputError) as missing:
        sf.load(tmp_path / "nothing")
    assert str(pickle.loads(pickle.dumps(missing.value))) == str(missing.value)
    for thing in (run, scene):
        with pytest.raises(TypeError, match="cannot be pickled"):
            pickle.dumps(thing)


def test_memory_of_closed_runs_comes_back(tmp_path: Path) -> None:
    def resident() -> int:
        gc.collect()
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    scene = sf.Scene(**box_arrays(), file=tmp_path / "box.sfpack")
    config: Any = config_of(scene)
    config["passes"] = [{**config["passes"][0], "position": {"type": "hash_grid", "levels": 8, "log2_entries": 17}}]

    def once() -> None:
        with sf.open(config) as run:
            trained(run, 1)
            run.render(frame=0, width=16)

    once()
    before = resident()
    one_run = 8 * 2**17 * 2 * 4 * 3  # values and two moments
    for _ in range(8):
        once()
    assert resident() - before < 2 * one_run


def test_errors_are_those_that_python_has(scene: sf.Scene, tmp_path: Path) -> None:
    assert issubclass(sf.ConfigError, ValueError) and issubclass(sf.InputError, FileNotFoundError) and issubclass(sf.WriteError, OSError)
    assert all(issubclass(getattr(sf, n), sf.Error) for n in sf.__all__ if n.endswith("Error"))
    with pytest.raises(sf.Error) as caught:
        sf.open("quikstart")
    assert "did you mean 'quickstart'" in str(caught.value) and caught.value.exit_code in (66, 78)
    assert caught.value.code == "config.file.missing" and caught.value.findings[0].code == caught.value.code
    with pytest.raises(sf.CommandError, match="did you mean") as ended:
        sf.command("trian")
    assert ended.value.exit_code == 2 and "trian" in ended.value.stderr and ended.value.code == "usage.verb.unknown"
    with pytest.raises(sf.UsageError) as own:
        sf.Camera(4, 4, 2.0, lens="round")
    assert own.value.code == "python.value.range"


def test_configurations_of_other_mappings_and_arrays(scene: sf.Scene) -> None:
    import types

    config = types.MappingProxyType({**config_of(scene), "train": types.MappingProxyType({"rays": np.int32(64)})})
    seen = sf.resolved(config, {"scene.load.bounds": np.array([-1.0, -1, -1, 1, 1, 1]), "rendering.background": np.float32([0.25, 0.5, 1])})
    assert seen["train"]["rays"] == 64 and seen["scene"]["load"]["bounds"] == [-1, -1, -1, 1, 1, 1]
    assert seen["rendering"]["background"] == [0.25, 0.5, 1]
    assert sf.resolved(config_of(scene), {"train": {"rays": 32}})["train"]["adam"]["learning_rate"] == 0.02


def test_ctrl_c_ends_the_opening_of_a_scene() -> None:
    class Slow(sf.Dataset):
        """A box whose images come slowly."""

        seen: List[int] = []

        def frames(self) -> Any:
            return [sf.Frame(f"{i:04d}", sf.Camera(8, 6, 5), np.eye(4)) for i in range(4000)]

        def pixels(self, index: int) -> sf.Frame:
            Slow.seen.append(index)
            threading.Event().wait(0.01)
            return sf.Frame("", sf.Camera(8, 6, 5), np.eye(4), rgb=np.zeros((6, 8, 3), np.uint8))

    sf.dataset("py_slow")(Slow)
    timer = threading.Timer(0.5, lambda: os.kill(os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        sf.open({"scene": {"type": "py_slow"}, "passes": [{"name": "main", "sampler": {"type": "stratified"}, "position": {"type": "identity"},
                                                          "field": {"type": "tiny_mlp"}}]})
    timer.join()
    assert 0 < len(Slow.seen) < 2000  # of 4000


def test_ctrl_c_ends_an_encoder_and_the_run_goes_on(scene: sf.Scene) -> None:
    class Lazy(sf.Encoder):
        """Coordinates, after a while."""

        def setup(self) -> None:
            self.out_dims = self.in_dims

        def forward(self, x: Any, params: Any) -> Any:
            threading.Event().wait(0.002)
            return x

        def backward(self, x: Any, dy: Any, params: Any, grads: Any) -> Any:
            return dy

    sf.encoder("py_lazy")(Lazy)
    config: Any = config_of(scene)
    config["passes"] = [{**config["passes"][0], "position": {"type": "py_lazy"}}]
    run = sf.open(config)
    timer = threading.Timer(0.4, lambda: os.kill(os.getpid(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        run.train(10**7, every=10**7).last()
    timer.join()
    made = run.step
    trained(run, 2)
    assert run.step == made + 2


def test_ctrl_c_lets_a_verb_end_in_order(scene: sf.Scene, tmp_path: Path) -> None:
    import json

    (tmp_path / "box.yaml").write_text(json.dumps(config_of(scene, steps=10**6)))

    def press() -> None:
        while not list((tmp_path / "a").glob("metrics.jsonl")):
            threading.Event().wait(0.05)
        threading.Event().wait(0.3)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=press)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        sf.command("train", tmp_path / "box.yaml", "--out", tmp_path / "a", "--quiet")
    thread.join()
    assert sf.load(tmp_path / "a").step > 0


def test_tune_says_what_it_would_do(tmp_path: Path) -> None:
    planned = sf.tune("quickstart", "10m", "--steps", 64, "--dry-run", "--out", tmp_path / "tuned")
    assert planned["verb"] == "tune" and planned["cells"] > 10
    with pytest.raises(sf.CommandError, match="--time never"):
        sf.tune("quickstart", "never")


def test_many_threads_look_at_a_run(run: sf.Run) -> None:
    trained(run, 5)
    alone = run.render(frame=0, width=16)
    seen: List[Any] = []

    def look_at_it() -> None:
        for _ in range(3):
            seen.append(run.render(frame=0, width=16).rgb)
            run.query([[0.0, 0.1, 0.2]])

    threads = [threading.Thread(target=look_at_it) for _ in range(4)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert len(seen) == 12 and all(np.array_equal(s, alone.rgb) for s in seen)
