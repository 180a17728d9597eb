"""Rendered views: cameras and poses, depth and labels against the box, probabilities, arrays without copies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import semfield as sf
from conftest import box_arrays, cast, config_of, look, trained


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


def test_probability_is_a_distribution(box: sf.Run) -> None:
    view = box.render(frame=0, probability=True)
    assert view.probability.shape == (24, 32, len(box.classes)) and view.probability.dtype == np.float32
    assert np.allclose(view.probability.sum(-1), 1, atol=1e-5)
    assert np.allclose(view.probability.max(-1), view.confidence, atol=1e-5)
    p = view.probability.astype(np.float64)
    assert np.allclose(-(p * np.log(np.maximum(p, 1e-30))).sum(-1), view.entropy, atol=1e-4)
    assert box.render(frame=0).probability is None


def test_poses_of_three_rows_and_of_four(box: sf.Run) -> None:
    pose = look(0.4, 0.1)
    whole, short, listed = box.render(pose), box.render(pose[:3]), box.render(pose.tolist())
    assert np.array_equal(whole.rgb, short.rgb) and np.array_equal(whole.rgb, listed.rgb)
    assert short.pose.shape == (4, 4) and np.array_equal(short.pose, pose)
    frame = box.frames[3]
    assert np.array_equal(box.render(frame=3).rgb, box.render(frame.pose, camera=frame.camera).rgb)
    assert np.array_equal(box.render(frame=frame.name).rgb, box.render(frame=3).rgb)


def test_a_pose_sees_what_is_before_it(box: sf.Run) -> None:
    camera = sf.Camera.from_fov(32, 24, 60)
    for yaw in (0.0, 1.6, 3.1, 4.7):
        _, wall, _ = cast(camera, look(yaw))
        assert np.mean(box.render(look(yaw), camera=camera).label == wall) > 0.8


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
    (dict(frame=0, device="gpu"), "expected cpu, cuda"),
])
def test_what_is_wrong_is_named(box: sf.Run, wrong: Any, says: str) -> None:
    with pytest.raises(sf.Error, match=says):
        box.render(**wrong)


def test_a_device_that_is_not_there(box: sf.Run) -> None:
    with pytest.raises(sf.UnavailableError, match="CUDA"):
        box.render(frame=0, device="cuda:99")
    with pytest.raises(sf.UnavailableError, match="CUDA"):
        sf.to_device(np.zeros((2, 3), np.float32), "cuda:99")
    with pytest.raises(sf.UsageError, match="cuda:N"):
        sf.to_device(np.zeros(3), "cpu")


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
