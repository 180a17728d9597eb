"""Training from Python: the same bits as the program's, saved, gone on with, interrupted."""

from __future__ import annotations

import glob
import json
import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import semfield as sf
from conftest import config_of, tensors_of, trained


def test_a_field_gets_better(run: sf.Run) -> None:
    steps = list(run.train(160, every=40))
    assert [s.step for s in steps] == [40, 80, 120, 160]
    assert steps[-1].loss < 0.5 * steps[0].loss
    score = run.evaluate("test")
    assert score.miou_present is not None and score.miou_present > 0.5
    assert score.confusion.sum() == 2 * 32 * 24


def test_bits_are_those_of_the_program(scene: sf.Scene, tmp_path: Path) -> None:
    config = config_of(scene, steps=25)
    file = tmp_path / "box.yaml"
    file.write_text(json.dumps(config))  # JSON is YAML
    sf.command("train", file, "--out", tmp_path / "by_program", "--quiet")
    run = sf.open(file)
    list(run.train(every=7))
    run.save(tmp_path / "by_python")
    from_dict = sf.open(config)
    trained(from_dict, 25)
    from_dict.save(tmp_path / "by_dict")
    paths = [glob.glob(str(tmp_path / f / "checkpoints" / "*.safetensors")) for f in ("by_program", "by_python", "by_dict")]
    assert all(len(p) == 1 for p in paths)
    one, two, three = (tensors_of(p[0]) for p in paths)
    assert one.keys() == two.keys() == three.keys() and len(one) > 10
    assert all(one[k] == two[k] == three[k] for k in one)


def test_saving_twice_and_going_on(run: sf.Run, scene: sf.Scene, tmp_path: Path) -> None:
    trained(run, 10)
    run.save(tmp_path / "a")
    again = sf.resume(tmp_path / "a")
    trained(run, 10)
    trained(again, 10)
    assert again.step == run.step == 20
    mine, theirs = run.parameters(), again.parameters()
    assert all(np.array_equal(mine[k], theirs[k]) for k in mine)
    with pytest.raises(sf.WriteError, match="in use"):
        run.save(tmp_path / "a")
    again.close()
    run.save(tmp_path / "a")
    assert sf.load(tmp_path / "a").step == 20
    rows = [json.loads(line) for line in (tmp_path / "a" / "metrics.jsonl").read_text().splitlines()]
    assert [r["step"] for r in rows] == [20] and run.history[0]["step"] == 20


def test_a_run_is_extended(scene: sf.Scene, tmp_path: Path) -> None:
    run = sf.open(config_of(scene, steps=6), out=tmp_path / "a")
    assert run.train(every=4).last().step == 6
    assert run.train().last() is None, "it is at its end"
    run.extend(steps=4)
    assert [s.step for s in run.train(every=3)] == [9, 10]
    leg = run.config["train"]["schedule"]["legs"][0]
    assert (leg["start"], leg["end"]) == (6, 10) and leg["rate"] >= 0.5
    run.save()
    run.close()
    again = sf.open(tmp_path / "a" / "run.yaml")
    assert again.train().last().step == 10
    again.save(tmp_path / "b")
    one, two = (tensors_of(glob.glob(str(tmp_path / f / "checkpoints" / "*10.safetensors"))[0]) for f in ("a", "b"))
    assert one == two, "by the numbers alone"
    again.extend(seconds=1e-4)
    last = again.train().last()
    assert last is not None and again.config["train"]["schedule"]["legs"][-1]["end"] == last.step > 10
    for wrong in ({}, {"steps": 0}, {"seconds": 0}, {"seconds": float("nan")}, {"steps": 3, "seconds": 1}):
        with pytest.raises(sf.UsageError, match="expected steps of 1 or more, or seconds above 0"):
            again.extend(**wrong)


def test_somebody_else_went_on(run: sf.Run, tmp_path: Path) -> None:
    trained(run, 5)
    run.save(tmp_path / "a")
    sf.command("train", "--resume", tmp_path / "a", "--steps", "8", "--quiet")
    with pytest.raises(sf.DataError, match="continued"):
        run.save(tmp_path / "a")


def test_the_program_goes_on_with_a_run_of_python(scene: sf.Scene, tmp_path: Path) -> None:
    run = sf.open(config_of(scene, steps=30), out=tmp_path / "a")
    trained(run, 10)
    run.save()
    run.close()
    sf.command("train", "--resume", tmp_path / "a", "--quiet")
    whole = sf.open(config_of(scene, steps=30))
    trained(whole, 30)
    stopped = sf.resume(tmp_path / "a")
    assert stopped.step == 30
    mine, theirs = whole.parameters(), stopped.parameters()
    assert all(np.array_equal(mine[k], theirs[k]) for k in mine)


def test_train_is_the_verb(scene: sf.Scene, tmp_path: Path) -> None:
    told = []
    done = sf.train(config_of(scene, steps=20), out=tmp_path / "a", progress=told.append)
    assert done.step == 20 and os.path.exists(done.report) and done.scores["psnr"] is not None
    assert told and told[-1]["step"] == 20
    with pytest.raises(sf.WriteError, match="holds files"):
        sf.train(config_of(scene), out=tmp_path / "a")


def test_a_progress_that_raises_ends_the_run_in_order(scene: sf.Scene, tmp_path: Path) -> None:
    def progress(now: dict) -> None:
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        sf.train(config_of(scene, steps=100000), set={"report.log_every_steps": 1}, out=tmp_path / "a", progress=progress)
    assert sf.load(tmp_path / "a").step > 0


def test_ctrl_c_ends_after_a_step(scene: sf.Scene) -> None:
    run = sf.open(config_of(scene))
    threading.Timer(0.5, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        list(run.train(10_000_000, every=10_000_000))
    stopped = run.step
    assert stopped > 0
    trained(run, 3)
    assert run.step == stopped + 3


def test_other_threads_run_meanwhile(run: sf.Run) -> None:
    counted = []
    done = threading.Event()

    def count() -> None:
        while not done.is_set():
            counted.append(time.monotonic())
            time.sleep(0.001)

    thread = threading.Thread(target=count)
    thread.start()
    list(run.train(200, every=200))
    done.set()
    thread.join()
    assert len(counted) > 20  # held for the whole call there would be one or two


def test_two_threads_take_turns(run: sf.Run) -> None:
    threads = [threading.Thread(target=trained, args=(run, 10)) for _ in range(2)]
    for t in threads:
        t.start()
    for t in threads:
        t.join()
    assert run.step == 20


def test_what_a_run_tells_can_be_read_while_it_trains(scene: sf.Scene) -> None:
    run = sf.open(config_of(scene), set={"report.log_every_steps": 1})
    rows = []
    thread = threading.Thread(target=trained, args=(run, 200))
    thread.start()
    while thread.is_alive():
        rows.append(len(run.history))
        assert len(run.notes) >= 0 and run.labels.clicks == []
    thread.join()
    assert rows == sorted(rows) and len(run.history) == 200


def test_every_wrong_key_is_a_finding(scene: sf.Scene) -> None:
    config = config_of(scene, rayss=3)
    config["runtime"] = {"threadz": 1}
    with pytest.raises(sf.ConfigError) as caught:
        sf.open(config)
    text = [f.message for f in caught.value.findings]
    assert len(text) == 2 and "rayss" in text[0] + text[1] and "threadz" in text[0] + text[1]
    assert caught.value.exit_code == 78 and isinstance(caught.value, ValueError)


def test_settings_of_python_types(scene: sf.Scene) -> None:
    seen = sf.resolved(config_of(scene), {"train.rays": np.int64(512), "train.adam.learning_rate": 1e-3, "name": "box"})
    assert seen["train"]["rays"] == 512 and seen["train"]["adam"]["learning_rate"] == 1e-3 and seen["name"] == "box"
    with pytest.raises(sf.UsageError, match="train.rays"):
        sf.resolved(config_of(scene), {"train.rays": object()})


def test_what_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        sf.open(tmp_path / "nothing.yaml")
    with pytest.raises(sf.InputError):
        sf.load(tmp_path / "nothing")

