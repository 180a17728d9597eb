"""The field evaluated at points: bounds, grouping, and against what the network's parts say by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Tuple

import numpy as np
import pytest

import semfield as sf
from conftest import WALLS, cast, config_of, trained


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


def test_summed_along_rays_it_is_the_rendered_view(box: sf.Run) -> None:
    frame = box.frames[0]
    view, c = box.render(frame=0), frame.camera
    rows, cols = np.mgrid[2:24:5, 2:32:6].reshape(2, -1)
    in_camera = np.stack([(cols + 0.5 - c.cx) / c.fx, (rows + 0.5 - c.cy) / c.fy, np.ones(len(rows))], 1)
    z = np.linspace(box.near_m, 3.5, 1200)[:, None, None]  # z-depth, behind the box at its end
    places = frame.pose[:3, 3] + z * (in_camera @ frame.pose[:3, :3].T)
    density = box.query(places.reshape(-1, 3)).density.reshape(places.shape[:2]).astype(np.float64)
    crossed = density * np.diff(z[:2, 0, 0]) * np.linalg.norm(in_camera, axis=1)
    weight = -np.diff(np.exp(-np.cumsum(crossed, 0)), axis=0, prepend=1)
    assert np.median(np.abs(weight.sum(0) - view.opacity[rows, cols])) < 0.03
    depth = (weight * z[:, :, 0]).sum(0)
    solid = view.opacity[rows, cols] > 0.95
    assert solid.sum() > 15 and np.median(np.abs(depth - view.depth_m[rows, cols])[solid]) < 0.06


def test_classes_of_surfaces(box: sf.Run) -> None:
    _, wall, depth = cast(box.frames[0].camera, box.frames[0].pose)
    c, pose = box.frames[0].camera, box.frames[0].pose
    rows, cols = np.mgrid[0:24, 0:32].reshape(2, -1)
    at = depth[rows, cols, None] * np.stack([(cols + 0.5 - c.cx) / c.fx, (rows + 0.5 - c.cy) / c.fy, np.ones(len(rows))], 1)
    found = box.query(pose[:3, 3] + at @ pose[:3, :3].T)
    assert np.mean(found.label == wall[rows, cols]) > 0.85


def test_outside_the_bounds_is_nothing(box: sf.Run) -> None:
    low, high = box.bounds
    outside = np.array([high + 0.01, low - 0.01, [high[0] + 0.01, 0, 0], [100, 0, 0], [0, 0, -1e6]])
    assert np.all(box.query(outside).density == 0)
    assert np.all(box.query((0.999 * outside[:1] - 0.0)).density >= 0)
    assert box.query([[0.5 * (low[0] + high[0]), 0.0, 0.0]]).density[0] > 0


def test_the_same_bits_for_any_grouping(box: sf.Run) -> None:
    places, along = points(3000)
    whole = box.query(places, along)
    parts = [box.query(places[a:b], along[a:b]) for a, b in ((0, 1), (1, 64), (64, 129), (129, 2999), (2999, 3000))]
    for name in ("density", "rgb", "label", "probability", "entropy"):
        assert np.array_equal(np.concatenate([getattr(p, name) for p in parts]), getattr(whole, name)), name


def test_more_points_than_are_asked_at_once(box: sf.Run) -> None:
    places, _ = points(70_000)
    found = box.query(places)
    assert found.density.shape == (70_000,) and found.probability.shape == (70_000, 6)
    last = box.query(places[-10:])
    assert np.array_equal(found.density[-10:], last.density) and np.array_equal(found.label[-10:], last.label)


def test_probability_class_and_entropy_agree(box: sf.Run) -> None:
    found = box.query(points(500)[0])
    p = found.probability.astype(np.float64)
    assert np.allclose(p.sum(1), 1, atol=1e-5)
    ids = np.array([c.id for c in box.classes])
    assert np.array_equal(ids[p.argmax(1)], found.label)
    assert np.allclose(-(p * np.log(np.maximum(p, 1e-30))).sum(1), found.entropy, atol=1e-4)


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


def test_colours_need_directions_and_depend_on_them(box: sf.Run) -> None:
    places, along = points(50)
    there, back = box.query(places, along), box.query(places, -along)
    assert there.rgb.min() >= 0 and there.rgb.max() <= 1
    assert not np.array_equal(there.rgb, back.rgb)
    assert np.array_equal(there.density, back.density)


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
    words = tmp_path / "words"
    program = tmp_path / "semfield"
    program.write_text(f"#!/bin/sh\nfor word; do echo \"$word\"; done > {words}\necho '{json.dumps(told)}'\n")
    program.chmod(0o755)
    monkeypatch.setenv("SEMFIELD_PROGRAM", str(program))
    found = box.objects("masks", set={"objects.reach": 0.3, "objects.method": {"type": "assignment"}}, out="there", score=True)
    said = words.read_text().split("\n")
    assert said[:7] == ["objects", str(box.run_dir), "--quiet", "--segments", "masks", "--out", "there"] and "--score" in said and "--json" in said
    assert "objects.reach=0.3" in said and 'objects.method={"type": "assignment"}' in said
    assert [one.class_name for one in found.objects] == ["chair", ""] and found.count() == {"chair": 1, "": 1}
    assert found.objects[0].box_axes.shape == (3, 3) and found.seconds["all"] == 2.5 and found.score == {"pq": 0.9}
