"""Training and arrays on a CUDA device; skipped, and said so, where there is none."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Dict

import numpy as np
import pytest

import semfield as sf
from conftest import config_of, trained


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


def test_maps_are_dlpack(cuda_run: sf.Run) -> None:
    host = cuda_run.render(frame=9, probability=True)
    there = cuda_run.render(frame=9, probability=True, device="cuda")
    for name in ("rgb", "depth_m", "opacity", "label", "entropy", "confidence", "probability"):
        array = getattr(there, name)
        assert isinstance(array, sf.DeviceArray) and array.__dlpack_device__() == (2, 0)
        assert array.shape == getattr(host, name).shape and array.dtype == getattr(host, name).dtype
        assert np.array_equal(array.numpy(), getattr(host, name))


def test_torch_takes_them(cuda_run: sf.Run) -> None:
    torch = pytest.importorskip("torch")
    host = cuda_run.render(frame=9, probability=True)
    there = cuda_run.render(frame=9, probability=True, device="cuda")
    tensors = {n: torch.from_dlpack(getattr(there, n)) for n in ("rgb", "label", "probability")}
    del there  # the tensors keep their memory
    for name, tensor in tensors.items():
        assert tensor.is_cuda
        assert np.array_equal(tensor.cpu().numpy(), getattr(host, name))
    assert torch.allclose(tensors["probability"].sum(-1).cpu(), torch.ones(24, 32), atol=1e-5)


def test_a_capsule_that_nobody_takes_is_given_back(cuda_run: sf.Run) -> None:
    array = sf.to_device(np.arange(12, dtype=np.float32).reshape(3, 4))
    for _ in range(3):
        array.__dlpack__()
    assert np.array_equal(np.asarray(array), np.arange(12, dtype=np.float32).reshape(3, 4))


def test_points_know_what_the_device_learned(cuda_run: sf.Run, scene: sf.Scene, tmp_path: Path) -> None:
    cuda_run.save(tmp_path / "a")
    with sf.load(tmp_path / "a", set={"runtime.device": "cpu"}) as other:
        places = np.random.default_rng(1).uniform(-0.9, 0.9, (200, 3))
        mine, theirs = cuda_run.query(places), other.query(places)
        assert mine.density is not None and float(np.abs(mine.density).max()) > 0
        assert np.array_equal(mine.density, theirs.density)
        assert np.array_equal(mine.probability, theirs.probability)


def test_bits_are_those_of_the_program(cuda_run: sf.Run, scene: sf.Scene, tmp_path: Path) -> None:
    import glob
    import json

    from conftest import tensors_of

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
