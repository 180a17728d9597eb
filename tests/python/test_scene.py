"""Scenes made of arrays: what they may hold, and every mistake in them at once."""

from __future__ import annotations

import gc
import json
import os
from pathlib import Path
from typing import Any, Dict

import numpy as np
import pytest

import semfield as sf
from conftest import NETWORK, WALLS, box_arrays, config_of, trained


def changed(**more: Any) -> Dict[str, Any]:
    return {**box_arrays(), **more}


def findings_of(**more: Any) -> str:
    with pytest.raises(sf.DataError) as caught:
        sf.Scene(**changed(**more))
    return "\n".join(f"{f.where}: {f.message}; {f.remedy}" for f in caught.value.findings)


def test_some_labels_and_no_depth() -> None:
    arrays = box_arrays()
    arrays["labels"] = [arrays["labels"][0], None, arrays["labels"][2]] + [None] * 7
    arrays["depths"] = None
    scene = sf.Scene(**arrays)
    run = sf.open(config_of(scene))
    assert [f.has_labels for f in run.frames] == [True, False, True] + [False] * 7
    assert not any(f.has_depth for f in run.frames)
    assert run.training_labels(1) is None and np.array_equal(run.training_labels(2), arrays["labels"][2])
    assert trained(run, 2)[0].loss_semantic > 0


def test_what_goes_in_comes_out(tmp_path: Path) -> None:
    arrays = box_arrays()
    ids = np.array([0, 255, 300, 7, 40, 65535])
    arrays["labels"] = [np.where(np.arange(32) < 3, -1, ids[wall]) for wall in arrays["labels"]]
    arrays["classes"] = [sf.ClassEntry(int(i), f"wall {i}", (10, 20, int(i) % 256)) for i in ids]
    arrays["cameras"] = [sf.Camera(32, 24, 16 + i, 17, 15, 12, (0.01, 0.001)) for i in range(10)]
    arrays["names"] = [f"shot {i}" for i in range(10)]
    scene = sf.Scene(**arrays, file=tmp_path / "room.sfpack", bounds=[[-1.1] * 3, [1.1] * 3], near=0.1, far=4, metric=False)
    run = sf.open(NETWORK, scene=scene, keep="training_depth")
    for i, frame in enumerate(run.frames):
        loaded = run.pixels(frame.name)
        assert frame.name == f"shot {i}" and frame.camera == sf.Camera(32, 24, 16 + i, 17, 15, 12, (0.01, 0.001, 0, 0, 0, 0))
        assert np.array_equal(frame.pose, arrays["poses"][i])
        assert np.array_equal(loaded.rgb, arrays["images"][i]) and np.array_equal(loaded.labels, arrays["labels"][i])
    assert np.array_equal(run.pixels(9).depth_m, arrays["depths"][9])
    assert {(c.id, c.name, tuple(c.color)) for c in run.classes} == {(i, f"wall {i}", (10, 20, i % 256)) for i in ids}
    assert np.allclose(run.bounds, [[-1.1] * 3, [1.1] * 3]) and run.far_m == 4 and not run.metric
    assert "room.sfpack" in repr(scene) and "temporary" not in repr(scene)


def test_images_of_different_sizes(tmp_path: Path) -> None:
    one, two = box_arrays(), box_arrays(width=40, height=20)
    both = {k: [*one[k][:5], *two[k][5:]] for k in ("images", "labels", "depths", "poses")}
    both["cameras"] = [one["cameras"]] * 5 + [two["cameras"]] * 5
    scene = sf.Scene(**both, classes=WALLS, test=[9])
    run = sf.open(NETWORK, scene=scene)
    assert run.render(frame=0).rgb.shape == (24, 32, 3) and run.render(frame=9).rgb.shape == (20, 40, 3)


def test_arrays_of_other_kinds() -> None:
    arrays = box_arrays()
    arrays["images"] = np.stack(arrays["images"])
    arrays["poses"] = arrays["poses"][:, :3].tolist()
    arrays["labels"] = [wall.astype(np.uint16)[::-1][::-1] for wall in arrays["labels"]]
    arrays["depths"] = [depth.astype(np.float64) for depth in arrays["depths"]]
    a, b = sf.Scene(**arrays), sf.Scene(**box_arrays())
    assert Path(a.file).read_bytes() == Path(b.file).read_bytes()


def test_every_mistake_is_told_at_once(tmp_path: Path) -> None:
    arrays = box_arrays()
    arrays["images"][1] = arrays["images"][1][:5]
    arrays["images"][2] = arrays["images"][2] / 255.0
    arrays["labels"][3] = arrays["labels"][3].astype(float)
    arrays["labels"][4] = np.full((24, 32), 77)
    arrays["depths"][5] = arrays["depths"][5].T
    arrays["poses"][6, :3, :3] *= 2
    arrays["poses"][7, 0, 3] = np.nan
    arrays["names"] = [*"abcdefgh", "a", "j"]
    with pytest.raises(sf.DataError) as caught:
        sf.Scene(**arrays, file=tmp_path / "room.sfpack", bounds=[[1, -1, -1], [-1, 1, 1]])
    text = [f"{f.where}: {f.message}" for f in caught.value.findings]
    for frame, says in [("b", "[24, 32, 3], got [5, 32, 3]"), ("c", "got float64"), ("d", "got float64"), ("e", "77 is the id of no class"),
                        ("f", "[24, 32], got [32, 24]"), ("g", "not a rotation"), ("h", "not finite"), ("a", "another one has its name")]:
        assert any(f"frame '{frame}'" in t and says in t for t in text), (frame, says, text)
    assert any("bounds: axis x" in t for t in text)
    assert len(text) == 9
    assert not list(tmp_path.iterdir())


def test_what_is_wrong_with_many_frames_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(sf.DataError) as caught:
        sf.Scene(**changed(images=[image / 255.0 for image in box_arrays()["images"]]))
    assert [f.where for f in caught.value.findings] == [f"frame '{i:04d}'" for i in range(10)]
    assert str(caught.value) == ("frame '0000': rgb: expected whole numbers, got float64; give uint8 values of 0 to 255 "
                                 "(and 9 more like this: frame '0001', frame '0002', frame '0003', frame '0004', ...)")


def test_names_whose_files_would_be_one(tmp_path: Path) -> None:
    names = ["a/b", "a_b", "c\0", *"defghij"]
    said = findings_of(names=names)
    assert "frame 'a_b': its files would be called 'a_b', as those of 'a/b'" in said and "has a control character" in said


def test_labels_of_64_bits() -> None:
    arrays = box_arrays()
    for kind in (np.uint64, np.int64, np.uint8, np.int32):
        given = [wall.astype(kind) for wall in arrays["labels"]]
        assert np.array_equal(sf.open(NETWORK, scene=sf.Scene(**changed(labels=given))).training_labels(0), arrays["labels"][0])
    for kind, id_ in ((np.uint64, 2**64 - 1), (np.uint64, 2**63), (np.int64, -2**63), (np.int64, 2**32), (np.uint32, 2**32 - 1)):
        given = [wall.astype(kind) for wall in arrays["labels"]]
        given[3][5, 7] = id_
        assert f"frame '0003': labels: pixel x 7, y 5: {id_} is the id of no class" in findings_of(labels=given)


def test_a_file_that_is_there_is_not_replaced(tmp_path: Path) -> None:
    file = tmp_path / "thesis.tex"
    file.write_text("years of work")
    for more in ({}, {"overwrite": True}):
        with pytest.raises(sf.UsageError, match="thesis.tex' is (there already|not a packed scene)"):
            sf.Scene(**box_arrays(), file=file, **more)
    assert file.read_text() == "years of work"
    scene = tmp_path / "room.sfpack"
    sf.Scene(**box_arrays(), file=scene)
    before = scene.read_bytes()
    with pytest.raises(sf.UsageError, match="overwrite=True"):
        sf.Scene(**box_arrays(count=4), file=scene)
    assert scene.read_bytes() == before
    sf.Scene(**box_arrays(count=4), file=scene, overwrite=True)
    assert len(sf.open({**NETWORK, "scene": {"type": "packed", "file": str(scene)}}).frames) == 4
    with pytest.raises(sf.DataError):
        sf.Scene(**changed(names=["a"] * 10), file=scene, overwrite=True)
    assert len(sf.open({**NETWORK, "scene": {"type": "packed", "file": str(scene)}}).frames) == 4


def test_a_camera_knows_all_its_numbers() -> None:
    camera = sf.Camera.from_fov(128, 96, 90)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (pytest.approx(64), pytest.approx(64), 64, 48)
    assert camera == sf.Camera(128, 96, camera.fx, camera.fx, 64, 48) and camera.resized(64, 48).cy == 24
    assert sf.Camera(10, 8, 5, cx=3).fy == 5


@pytest.mark.parametrize("wrong, says", [
    (dict(poses="abc"), "poses: expected numbers"),
    (dict(poses=np.eye(4)), "poses: 4 for 10 images"),
    (dict(labels=[None]), "labels: 1 for 10 images"),
    (dict(names=["a"]), "names: 1 for 10 images"),
    (dict(cameras=[sf.Camera(32, 24, 16)]), "cameras: 1 for 10"),
    (dict(images=[], poses=[], labels=None, depths=None, cameras=[]), "at least one"),
    (dict(classes=None), "classes tell what their ids mean"),
    (dict(test=[-1]), r"test: \[-1\]"),
    (dict(test=[10]), r"test: \[10\]"),
    (dict(classes=[sf.ClassEntry(1, "a", (300, 0, 0))]), "red, green and blue of 0 to 255"),
    (dict(classes=[sf.ClassEntry(1, "a"), sf.ClassEntry(1, "b")]), "given twice"),
    (dict(bounds=[1, 2, 3]), r"bounds: expected the shape \[2, 3\]"),
    (dict(classes=[sf.ClassEntry(2**40, "a")]), "class 'a': id: 1099511627776 is out of range"),
    (dict(classes=[3]), "class 0: 3 is neither a name"),
    (dict(near="x"), "near: 'x' is not a number"),
    (dict(far=10**400), "far: 10+ is not a number"),
    (dict(test=[2**70]), "test: 1180591620717411303424 is out of range"),
    (dict(cameras=[3] * 10), "cameras: expected one Camera"),
    (dict(cameras=sf.Camera(40000, 24, 16)), "40000 x 24 pixels: 40000 pixels along an axis; at most 16384"),
    (dict(poses=np.full((10, 4, 4), 1j)), "poses: expected numbers"),
    (dict(labels=[np.full((24, 32), "a")] * 10), "labels: expected real numbers, got <U1"),
])
def test_what_cannot_be_a_scene(wrong: Any, says: str) -> None:
    before = set(Path(os.environ.get("TMPDIR", "/tmp")).glob("semfield_*.sfpack"))
    with pytest.raises(sf.Error, match=says):
        sf.Scene(**changed(**wrong))
    assert set(Path(os.environ.get("TMPDIR", "/tmp")).glob("semfield_*.sfpack")) <= before


def test_cameras_that_cannot_be() -> None:
    with pytest.raises(sf.UsageError, match="width 32.5"):
        sf.Camera(32.5, 24, 20)  # type: ignore[arg-type]
    with pytest.raises(sf.UsageError, match="8 numbers"):
        sf.Camera(32, 24, 20, distortion=(0.0,) * 8)
    assert "focal" in findings_of(cameras=sf.Camera(32, 24, 0))


def test_classes_in_three_ways() -> None:
    for classes in (WALLS, {i: w for i, w in enumerate(WALLS)}, [sf.ClassEntry(i, w) for i, w in enumerate(WALLS)]):
        scene = sf.Scene(**changed(classes=classes))
        assert [c.name for c in sf.open(NETWORK, scene=scene).classes] == WALLS
    ignored = [sf.ClassEntry(0, "left", ignore=True), *(sf.ClassEntry(i, WALLS[i]) for i in range(1, 6))]
    scene = sf.Scene(**changed(classes=ignored))
    run = sf.open(NETWORK, scene=scene)
    assert [c.name for c in run.classes] == WALLS[1:]
    assert set(np.unique(run.training_labels(0))) <= {-1, 1, 2, 3, 4, 5}


def test_a_temporary_file_is_gone_with_its_scene(tmp_path: Path) -> None:
    scene = sf.Scene(**box_arrays())
    file = scene.file
    assert scene.temporary and os.path.exists(file)
    run = sf.open(config_of(scene))
    del scene
    gc.collect()
    assert os.path.exists(file), "a run reads it"
    trained(run, 2)
    with pytest.raises(sf.UsageError, match="file="):
        run.save(tmp_path / "a")
    assert not (tmp_path / "a").exists()
    run.close()
    gc.collect()
    assert not os.path.exists(file)


def test_a_scene_in_place_of_a_configurations(scene: sf.Scene, tmp_path: Path) -> None:
    file = tmp_path / "box.yaml"
    file.write_text(json.dumps({**NETWORK, "scene": {"type": "obj_room", "root": "nowhere", "frames": 9, "labels": {"frames": 3}}}))
    from_file = sf.open(file, scene=scene)
    from_dict = sf.open(json.loads(file.read_text()), scene=scene)
    for run in (from_file, from_dict):
        assert run.config["scene"]["type"] == "packed" and run.config["scene"]["labels"]["frames"] in (3, "3")
        assert len(run.frames) == 10
    shipped = sf.open("quickstart", scene=scene, set={"passes.0.position.log2_entries": 10})
    assert len(shipped.frames) == 10 and shipped.name == "quickstart"


def test_the_program_reads_it(tmp_path: Path) -> None:
    scene = sf.Scene(**box_arrays(), file=tmp_path / "room.sfpack")
    config = tmp_path / "room.yaml"
    config.write_text(json.dumps({**NETWORK, "scene": scene.config()}))
    told = sf.command("inspect", config)
    assert "10 frames" in told or "frames: 10" in told or "10" in told
    assert all(wall in told for wall in WALLS)


def test_a_scene_that_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(sf.WriteError, match="cannot create"):
        sf.Scene(**box_arrays(), file=tmp_path / "no" / "room.sfpack")
    with pytest.raises(TypeError, match="pickled"):
        import pickle

        pickle.dumps(sf.Scene(**box_arrays()))


# Masks and wide lenses of scenes that are made of arrays.
def test_what_a_mask_hides_changes_no_parameter() -> None:
    mask = np.ones((24, 32), dtype=bool)
    mask[:12] = False
    arrays = {**box_arrays(count=4), "labels": None, "depths": None, "classes": None, "test": [3]}
    arrays["cameras"] = sf.Camera(32, 24, 32 / (2 * np.pi), 24 / np.pi, lens="equirectangular")

    def learned() -> Dict[str, np.ndarray]:
        scene = sf.Scene(**arrays, masks=[mask, None, mask, None], bounds=[[-1, -1, -1], [1, 1, 1]], near=0.05, far=2)
        run = sf.open(config_of(scene))
        trained(run, 3)
        assert run.frames[0].camera.lens == "equirectangular"
        return run.parameters()

    first = learned()
    arrays["images"][0][:12], arrays["images"][2][:12] = 255, 7
    second = learned()
    assert all(np.array_equal(first[name], second[name]) for name in first)
    arrays["images"][1][:12] = 7  # nothing hides this one
    third = learned()
    assert any(not np.array_equal(first[name], third[name]) for name in first)


def test_an_unknown_lens_is_refused() -> None:
    with pytest.raises(sf.UsageError, match="lens 'fish'"):
        sf.Camera(4, 3, 5, lens="fish")
