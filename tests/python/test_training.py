"""Training from Python: the same bits as the program's, saved, gone on with, interrupted."""

from __future__ import annotations

import glob
import json
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any, Dict, List, Tuple

import numpy as np
import pytest

import semfield as sf
from conftest import WALLS, box_arrays, cast, config_of, look, program_that, same, tensors_of, trained


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
    assert same(run, again)
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


def test_a_run_that_is_closed_out_of_its_own_call_ends_in_order(scene: sf.Scene) -> None:
    run = sf.open(config_of(scene))
    before = signal.signal(signal.SIGALRM, lambda *_: run.close())
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.02)
        with pytest.raises(sf.UsageError, match="is closed"):
            trained(run, 100_000)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def test_closing_waits_for_the_call_of_another_thread(scene: sf.Scene) -> None:
    run = sf.open(config_of(scene))
    made: List[int] = []
    thread = threading.Thread(target=lambda: made.append(run._train(200, False)["steps"]))
    thread.start()
    while run.step == 0 and thread.is_alive():
        time.sleep(0.001)
    run.close()
    thread.join(60)
    assert made == [200]
    with pytest.raises(sf.UsageError, match="is closed"):
        run.step


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


# Labels from Python: whole label images, and clicks that are on the disk before the call returns.
def lines_of(run: sf.Run) -> List[Dict[str, Any]]:
    file = Path(run.run_dir) / "clicks.jsonl"  # made by the first click
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


@pytest.fixture()
def unlabelled(scene: sf.Scene, tmp_path: Path) -> sf.Run:
    """The box without labels that train, with room for eight classes."""
    config = {**config_of(scene), "scene": {**scene.config(), "labels": {"frames": 0}}}
    return sf.open(config, out=tmp_path / "run", class_room=8)


def test_set_labels_train(scene: sf.Scene) -> None:
    run, other = sf.open(config_of(scene)), sf.open(config_of(scene))
    one = np.full((24, 32), 3)
    one[:, :16] = -1
    run.set_labels("0000", one)
    assert np.array_equal(run.training_labels(0), one)
    assert np.array_equal(other.training_labels(0), other.pixels(0).labels)
    trained(run, 5)
    trained(other, 5)
    assert not same(run, other)
    for frame in range(8):
        run.set_labels(frame, np.full((24, 32), 3, np.uint8))
    trained(run, 60)
    assert np.mean(run.render(frame=0).label == 3) > 0.95


def test_labels_that_cannot_be_set(run: sf.Run) -> None:
    for frame, labels, says in [
        (0, np.zeros((32, 24), int), r"frame '0000': expected the shape \[24, 32\], got \[32, 24\]"),
        (0, np.zeros((24, 32)), "expected whole numbers, got float64"),
        (0, np.full((24, 32), 77), "x 0, y 0: 77 is the id of no class"),
        (0, np.full((24, 32), -2), "-2 is the id of no class"),
        (0, None, "expected"),
        (9, np.zeros((24, 32), int), "'0009' does not train"),
        ("nine", np.zeros((24, 32), int), "no frame named 'nine'"),
        (10, np.zeros((24, 32), int), "there are 10"),
    ]:
        before = run.training_labels(0)
        with pytest.raises(sf.Error, match=says):
            run.set_labels(frame, labels)
        assert np.array_equal(run.training_labels(0), before)


def test_clicks_are_stored_and_count(unlabelled: sf.Run) -> None:
    labels = unlabelled.labels
    click = labels.add_click("0000", 3.5, 4.5, "left")
    assert [e["id"] for e in lines_of(unlabelled)] == [click]
    stroke = labels.add_stroke(1, [(2, 2), (12, 2)], "floor", radius_px=1.5)
    assert [e["id"] for e in lines_of(unlabelled)] == [click, stroke]
    assert [(c["frame"], c["class_"], c["radius_px"]) for c in labels.clicks] == [("0000", "left", 0.0), ("0001", "floor", 1.5)]
    assert labels.clicks[1]["points"] == [(2.0, 2.0), (12.0, 2.0)]
    painted = unlabelled.training_labels("0000")
    assert painted[4, 3] == WALLS.index("left") and np.sum(painted >= 0) == 1
    line = unlabelled.training_labels(1)
    assert np.all(line[1:3, 2:12] == WALLS.index("floor")) and np.all(line[6:] == -1)
    trained(unlabelled, 3)
    assert unlabelled.has_semantics


def test_classes_and_what_is_undone(unlabelled: sf.Run) -> None:
    """What clicks and classes may be: tests/label_loop. Here: that each call reaches them, and nothing is stored of one that is refused."""
    labels = unlabelled.labels
    added = labels.add_class("lamp", color=(250, 240, 30))
    lamp = next(c for c in unlabelled.classes if c.name == "lamp")
    assert labels.classes == [*WALLS, "lamp"] and lamp.color == (250, 240, 30) and lamp.id == 6
    click = labels.add_click("0002", 9, 9, "lamp")
    assert unlabelled.training_labels("0002")[9, 9] == lamp.id
    labels.rename_class("lamp", "lantern")
    assert labels.clicks[0]["class_"] == "lantern" and labels.classes[-1] == "lantern"
    stored = len(lines_of(unlabelled))
    for refused, says in [(lambda: labels.undo(added), "has 1 clicks"), (lambda: labels.add_click("0000", 3, 3, "lefft"), "did you mean 'left'"),
                          (lambda: labels.add_click("0000", float("nan"), 3, "left"), "finite x and y"), (lambda: labels.undo("nothing"), "nothing")]:
        with pytest.raises(sf.Error, match=says):
            refused()
    assert len(lines_of(unlabelled)) == stored
    undone = labels.undo(click)
    assert labels.clicks == [] and unlabelled.training_labels("0002") is None
    labels.undo(undone)
    assert [c["id"] for c in labels.clicks] == [click]


def test_what_to_do_without_a_file_of_clicks(run: sf.Run, scene: sf.Scene, tmp_path: Path) -> None:
    with pytest.raises(sf.UsageError, match="class_room") as caught:
        run.labels.add_click("0000", 3, 3, "left")
    assert "out=" in str(caught.value)
    assert run.labels.clicks == []
    trained(run, 1)
    run.save(tmp_path / "a")
    with pytest.raises(sf.UsageError, match="resume"):
        sf.load(tmp_path / "a").labels.add_click("0000", 3, 3, "left")


# Rendered views: cameras and poses, depth and labels against the box, probabilities, arrays without copies.
def test_depth_is_z_depth_of_the_box(box: sf.Run) -> None:
    held_out = next(f for f in box.frames if f.split == "test")
    view = box.render(frame=held_out.name)
    _, _, depth = cast(held_out.camera, held_out.pose)
    wrong = np.abs(view.depth_m - depth)
    assert np.median(wrong) < 0.05 and np.quantile(wrong, 0.9) < 0.2
    along_rays = depth * np.linalg.norm(np.stack(np.meshgrid(
        (np.arange(32) + 0.5 - 16) / 16, (np.arange(24) + 0.5 - 12) / 16)), axis=0)
    assert np.median(wrong) < np.median(np.abs(view.depth_m - along_rays))


def test_labels_are_ids_of_the_scene(tmp_path: Path) -> None:
    arrays = box_arrays()
    ids = np.array([7, 40, 300, 1, 255, 65535])
    arrays["labels"] = [ids[wall] for wall in arrays["labels"]]
    arrays["classes"] = {int(i): f"wall {i}" for i in ids}
    scene = sf.Scene(**arrays)
    run = sf.open(config_of(scene))
    trained(run, 80)
    view = run.render(frame=0, probability=True)
    assert view.label.dtype == np.int32
    assert np.mean(view.label == arrays["labels"][0]) > 0.8
    assert [c.index for c in run.classes] == list(range(6)) and {c.id for c in run.classes} == set(ids)
    by_index = np.array([c.id for c in run.classes])
    assert np.array_equal(by_index[view.probability.argmax(-1)], view.label)
    found = run.query(points(500)[0])
    assert np.array_equal(by_index[found.probability.argmax(-1)], found.label)


def test_poses_of_three_rows_and_of_four(box: sf.Run) -> None:
    pose = look(0.4, 0.1)
    whole, short, listed = box.render(pose), box.render(pose[:3]), box.render(pose.tolist())
    assert np.array_equal(whole.rgb, short.rgb) and np.array_equal(whole.rgb, listed.rgb)
    assert short.pose.shape == (4, 4) and np.array_equal(short.pose, pose)
    frame = box.frames[3]
    assert np.array_equal(box.render(frame=3).rgb, box.render(frame.pose, camera=frame.camera).rgb)
    assert np.array_equal(box.render(frame=frame.name).rgb, box.render(frame=3).rgb)


def test_sizes(box: sf.Run) -> None:
    assert box.render(frame=0, width=16).rgb.shape == (12, 16, 3)
    assert box.render(frame=0, height=48).rgb.shape == (48, 64, 3)
    assert box.render(frame=0, width=10, height=10).depth_m.shape == (10, 10)
    small = box.render(frame=0, width=16)
    assert (small.camera.width, small.camera.height) == (16, 12) and small.camera.fx == pytest.approx(8)
    camera = sf.Camera(20, 10, 12.0)
    assert box.render(np.eye(4), camera=camera).rgb.shape == (10, 20, 3)
    whole, sparse = box.render(frame=0), box.render(frame=0, stride=4)
    assert sparse.rgb.shape == (6, 8, 3) and sparse.label.shape == (6, 8)
    assert any(np.array_equal(sparse.rgb, whole.rgb[a::4, a::4]) for a in range(4))


@pytest.mark.parametrize("wrong, says", [
    (dict(pose=np.eye(3)), r"pose: expected the shape \[3, 4\], got \[3, 3\]"),
    (dict(pose=np.zeros((2, 4, 4))), r"got \[2, 4, 4\]"),
    (dict(pose=np.full((4, 4), np.nan)), "not finite"),
    (dict(pose=2 * np.eye(4)), "0 0 0 1"),
    (dict(pose=np.diag([1.0, 1, -1, 1])), "mirrors"),
    (dict(pose="front"), "pose: expected numbers"),
    (dict(), "give a pose, or the frame"),
    (dict(frame="0001.png"), "did you mean '0001'"),
    (dict(frame=20), "there are 20"),
    (dict(frame=-1), "there are 20"),
    (dict(frame=0, width=0), "0 x"),
    (dict(frame=0, width=-4), "-4 x"),
    (dict(frame=0, stride=0), "stride 0"),
    (dict(frame=0, stride=25), "stride 25"),
    (dict(frame=0, stride=1.5), "stride: 1.5"),
    (dict(frame=0, camera=sf.Camera(4, 4, -1.0)), "focal"),
])
def test_what_is_wrong_is_named(box: sf.Run, wrong: Any, says: str) -> None:
    with pytest.raises(sf.Error, match=says):
        box.render(**wrong)


def test_maps_are_no_copies(box: sf.Run) -> None:
    view = box.render(frame=0, probability=True)
    for name in ("rgb", "depth_m", "opacity", "label", "entropy", "confidence", "probability"):
        array = getattr(view, name)
        assert type(array.base).__name__ == "PyCapsule", name
        assert array.flags.c_contiguous and array.flags.writeable, name


def test_without_semantics(scene: sf.Scene) -> None:
    run = sf.open({**config_of(scene), "scene": {**scene.config(), "labels": {"frames": 0}}})
    view = run.render(frame=0)
    assert not run.has_semantics and view.label is None and view.entropy is None and view.confidence is None
    assert view.rgb.shape == (24, 32, 3)
    assert run.query([[0, 0, 0]]).label is None
    assert any("semantics" in part[0] for part in run.left_out)


def test_maps_live_longer_than_the_run(scene: sf.Scene) -> None:
    run = sf.open(config_of(scene))
    view = run.render(frame=0)
    before = view.rgb.copy()
    run.close()
    assert np.array_equal(view.rgb, before)
    assert "float32[24, 32, 3]" in repr(view) and len(repr(view)) < 500


def test_frames_of_the_run(box: sf.Run) -> None:
    arrays = box_arrays(count=20, apart=0.5)
    frames = box.frames
    assert [f.split for f in frames] == ["train"] * 18 + ["test"] * 2
    assert np.allclose(frames[4].pose, arrays["poses"][4]) and frames[4].camera.fx == pytest.approx(16)
    frames[4].pose[:] = 0  # one's own copy
    assert np.allclose(box.frames[4].pose, arrays["poses"][4])
    loaded = box.pixels("0018")
    assert np.array_equal(loaded.rgb, arrays["images"][18]) and np.array_equal(loaded.labels, arrays["labels"][18])
    assert np.allclose(loaded.depth_m, arrays["depths"][18], atol=1e-6)


# The field evaluated at points: bounds, grouping, and against what the network's parts say by hand.
def points(count: int, low: float = -0.9, high: float = 0.9) -> Tuple[np.ndarray, np.ndarray]:
    """[N, 3] positions and unit directions."""
    random = np.random.default_rng(4)
    along = random.normal(size=(count, 3))
    return random.uniform(low, high, (count, 3)), along / np.linalg.norm(along, axis=1, keepdims=True)


def test_shapes_and_types(box: sf.Run) -> None:
    places, along = points(7)
    found = box.query(places, along)
    assert found.density.shape == (7,) and found.rgb.shape == (7, 3) and found.label.shape == (7,)
    assert found.probability.shape == (7, len(WALLS)) and found.entropy.shape == (7,)
    assert found.label.dtype == np.int32 and found.density.dtype == np.float32
    assert box.query(places).rgb is None
    assert box.query(np.zeros((0, 3))).probability.shape == (0, len(WALLS))
    assert type(found.density.base).__name__ == "PyCapsule"


def test_all_of_it_by_hand(scene: sf.Scene) -> None:
    """The whole way from a place to density, classes and colour in float64, with the tensors of the checkpoint."""
    config: Any = {**config_of(scene), "rendering": {"density_activation": "softplus", "density_bias": -0.5, "scene_scale": 0.7, "unit_m": 1}}
    config["passes"] = [{**config["passes"][0], "position": {"type": "identity"}}]
    run = sf.open(config)
    trained(run, 20)
    t = {k[len("main/"):]: v.astype(np.float64) for k, v in run.parameters().items() if k.startswith("main/")}

    def layer(x: np.ndarray, name: str) -> np.ndarray:
        return x @ t[name + "/weight"] + t[name + "/bias"]

    places, along = points(200)
    found = run.query(places, along)
    hidden = np.maximum(layer(0.7 * places, "field/hidden_0"), 0)
    geometry = layer(hidden, "field/geometry")
    assert np.allclose(found.density, np.log1p(np.exp(geometry[:, 0] - 0.5)), rtol=1e-5)
    logits = layer(np.maximum(layer(hidden, "semantic/hidden"), 0), "semantic/class")
    p = np.exp(logits - logits.max(1, keepdims=True))
    assert np.allclose(found.probability, p / p.sum(1, keepdims=True), atol=1e-5)
    seen = np.concatenate([np.full((200, 1), 0.28209479177387814), 0.4886025119029199 * along[:, [1, 2, 0]]], 1)
    color = np.maximum(layer(np.concatenate([geometry[:, 1:], seen], 1), "field/color_0"), 0)
    color = layer(np.maximum(layer(color, "field/color_1"), 0), "field/rgb")
    assert np.allclose(found.rgb, 1 / (1 + np.exp(-color)), atol=1e-5)


@pytest.mark.parametrize("places, along, says", [
    ([0, 0, 0], None, r"positions: expected numbers of the shape \[N, 3\]"),
    ([[0, 0]], None, r"\[N, 3\]"),
    ([["a", "b", "c"]], None, "positions: expected numbers"),
    ([[0, 0, 0], [0, np.nan, 0]], None, "position 1: .*not finite"),
    ([[np.inf, 0, 0]], None, "not finite"),
    ([[0, 0, 0]], [[1, 0, 0], [1, 0, 0]], "one for each of 1 positions, got 2"),
    ([[0, 0, 0]], [[0, 0, 0]], "unit vector"),
    ([[0, 0, 0]], [[0, 0, np.nan]], "not finite"),
])
def test_what_cannot_be_asked(box: sf.Run, places: Any, along: Any, says: str) -> None:
    with pytest.raises(sf.Error, match=says):
        box.query(places, along)


def test_objects_are_a_table(box: sf.Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = {"id": 1, "name": "chair 1", "class": "chair", "class_probability": 0.9, "agreement": 0.8, "views": 12, "points": 300, "area": 0.5,
           "centroid": [1, 2, 3], "box": {"center": [1, 2, 3], "axes": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "size": [0.5, 1, 0.5]}}
    (tmp_path / "objects.json").write_text(json.dumps({"objects": [row, {**row, "id": 2, "name": "2", "class": None}]}))
    told = {"folder": str(tmp_path), "seconds": {"all": 2.5}, "score": {"pq": 0.9}}
    words = program_that(tmp_path, f"echo '{json.dumps(told)}'", monkeypatch)
    found = box.objects("masks", set={"objects.reach": 0.3, "objects.method": {"type": "contrastive"}}, out="there", score=True)
    said = words.read_text().split("\n")
    assert said[:7] == ["objects", str(box.run_dir), "--quiet", "--segments", "masks", "--out", "there"] and "--score" in said and "--json" in said
    assert "objects.reach=0.3" in said and 'objects.method={"type": "contrastive"}' in said
    assert [one.class_name for one in found.objects] == ["chair", ""] and found.count() == {"chair": 1, "": 1}
    assert found.objects[0].box_axes.shape == (3, 3) and found.seconds["all"] == 2.5 and found.score == {"pq": 0.9}


# Training and arrays on a CUDA device; skipped, and said so, where there is none.
def on_cuda(scene: sf.Scene, **train: Any) -> Dict[str, Any]:
    config = config_of(scene, **train)
    return {**config, "runtime": {**config["runtime"], "device": "cuda"}}


@pytest.fixture(scope="module")
def cuda_run(scene: sf.Scene) -> sf.Run:
    try:
        run = sf.open(on_cuda(scene))
    except sf.UnavailableError as error:
        pytest.skip(f"no CUDA device: {error}")
    trained(run, 60)
    return run


def test_trains_on_the_device(cuda_run: sf.Run) -> None:
    assert "cpu" not in cuda_run.device
    score = cuda_run.evaluate("test")
    assert score.miou_present is not None and score.miou_present > 0.5


def test_points_know_what_the_device_learned(cuda_run: sf.Run, scene: sf.Scene, tmp_path: Path) -> None:
    cuda_run.save(tmp_path / "a")
    with sf.load(tmp_path / "a", set={"runtime.device": "cpu"}) as other:
        places = np.random.default_rng(1).uniform(-0.9, 0.9, (200, 3))
        mine, theirs = cuda_run.query(places), other.query(places)
        assert mine.density is not None and float(np.abs(mine.density).max()) > 0
        assert np.array_equal(mine.density, theirs.density)
        assert np.array_equal(mine.probability, theirs.probability)


def test_bits_of_a_device_are_those_of_the_program(cuda_run: sf.Run, scene: sf.Scene, tmp_path: Path) -> None:
    config = on_cuda(scene, steps=20)
    config["runtime"]["deterministic"] = True
    file = tmp_path / "box.yaml"
    file.write_text(json.dumps(config))
    sf.command("train", file, "--out", tmp_path / "by_program", "--quiet")
    run = sf.open(config)
    list(run.train(every=6))
    run.save(tmp_path / "by_python")
    one, two = (tensors_of(glob.glob(str(tmp_path / f / "checkpoints" / "*.safetensors"))[0])
                for f in ("by_program", "by_python"))
    assert one.keys() == two.keys() and all(one[k] == two[k] for k in one)
