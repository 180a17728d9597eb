"""Labels from Python: whole label images, and clicks that are on the disk before the call returns."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Dict, List

import numpy as np
import pytest

import semfield as sf
from conftest import WALLS, config_of, trained


def same(a: sf.Run, b: sf.Run) -> bool:
    mine, theirs = a.parameters(), b.parameters()
    return mine.keys() == theirs.keys() and all(np.array_equal(mine[k], theirs[k]) for k in mine)


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


def test_a_class_without_a_logit_is_refused(scene: sf.Scene) -> None:
    run = sf.open({**config_of(scene), "scene": {**scene.config(), "labels": {"frames": 1}}})
    absent = [c for c in run.classes if not c.learned]
    if not absent:  # one frame saw every wall: nothing to refuse
        pytest.fail("the box's first frame shows all six walls")
    with pytest.raises(sf.DataError, match="absent_classes"):
        run.set_labels(0, np.full((24, 32), absent[0].id))
    kept = sf.open({**config_of(scene), "scene": {**scene.config(), "labels": {"frames": 1}}},
                   keep=["semantics", "absent_classes"])
    kept.set_labels(0, np.full((24, 32), absent[0].id))
    assert kept.training_labels(0)[0, 0] == absent[0].id


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


def test_new_classes(unlabelled: sf.Run) -> None:
    labels = unlabelled.labels
    assert labels.classes == WALLS
    added = labels.add_class("lamp", color=(250, 240, 30))
    assert labels.classes == [*WALLS, "lamp"]
    lamp = next(c for c in unlabelled.classes if c.name == "lamp")
    assert lamp.color == (250, 240, 30) and lamp.id == 6
    labels.add_click("0002", 9, 9, "lamp")
    assert unlabelled.training_labels("0002")[9, 9] == lamp.id
    with pytest.raises(sf.DataError, match="has 1 clicks"):
        labels.undo(added)
    labels.rename_class("lamp", "lantern")
    assert labels.clicks[0]["class_"] == "lantern" and labels.classes[-1] == "lantern"
    labels.add_class("door")
    with pytest.raises(sf.DataError, match="room for 8 classes"):
        labels.add_class("window")


def test_undo_and_undo_of_undo(unlabelled: sf.Run) -> None:
    labels = unlabelled.labels
    click = labels.add_click("0000", 3, 4, "left")
    undone = labels.undo(click)
    assert labels.clicks == [] and unlabelled.training_labels("0000") is None
    labels.undo(undone)
    assert [c["id"] for c in labels.clicks] == [click]
    assert len(lines_of(unlabelled)) == 3
    with pytest.raises(sf.DataError, match="nothing"):
        labels.undo("nothing")


@pytest.mark.parametrize("x, y, frame, class_, says", [
    (32.5, 3, "0000", "left", "outside"),
    (3, -1, "0000", "left", "outside"),
    (3, 3, "0000", "lefft", "did you mean 'left'"),
    (3, 3, "0000", "elephant", "elephant"),
    (3, 3, "0008", "left", "^frame '0008' is not a training frame"),
    (3, 3, "000", "left", "did you mean '000"),
    (float("nan"), 3, "0000", "left", "finite x and y"),
])
def test_a_click_that_cannot_be(unlabelled: sf.Run, x: float, y: float, frame: str, class_: str, says: str) -> None:
    with pytest.raises(sf.Error, match=says):
        unlabelled.labels.add_click(frame, x, y, class_)
    assert unlabelled.labels.clicks == [] and lines_of(unlabelled) == []


def test_a_run_with_clicks_goes_on_with_the_same_bits(unlabelled: sf.Run, scene: sf.Scene, tmp_path: Path) -> None:
    config = {**config_of(scene), "scene": {**scene.config(), "labels": {"frames": 0}}}
    whole = sf.open(config, out=tmp_path / "whole", class_room=8)
    for run in (unlabelled, whole):
        run.labels.add_click("0000", 3.5, 4.5, "left", radius_px=3)
        run.labels.add_class("lamp")
        trained(run, 6)
        run.labels.add_click("0001", 20, 10, "lamp", radius_px=2)
    trained(whole, 9)
    trained(unlabelled, 4)
    unlabelled.save()
    unlabelled.close()
    again = sf.resume(tmp_path / "run")
    assert again.labels.classes[-1] == "lamp" and len(again.labels.clicks) == 2
    trained(again, 5)
    assert again.step == whole.step == 15
    assert same(again, whole)


def test_what_to_do_without_a_file_of_clicks(run: sf.Run, scene: sf.Scene, tmp_path: Path) -> None:
    with pytest.raises(sf.UsageError, match="class_room") as caught:
        run.labels.add_click("0000", 3, 3, "left")
    assert "out=" in str(caught.value)
    assert run.labels.clicks == []
    trained(run, 1)
    run.save(tmp_path / "a")
    with pytest.raises(sf.UsageError, match="resume"):
        sf.load(tmp_path / "a").labels.add_click("0000", 3, 3, "left")
