"""What the tests of the Python module share: a room of six coloured walls as arrays, and a small network."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any, Dict, List, Tuple

import numpy as np
import pytest

import semfield as sf

sys.path.insert(1, str(Path(__file__).resolve().parents[1]))
from program import png, sound_tensors  # noqa: E402, F401

WALLS = ["left", "right", "back", "front", "floor", "ceiling"]


def look(yaw: float, pitch: float = 0.0, at: Tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    """[4, 4] camera to world at `at`, in a world with z up; yaw 0 looks along +y."""
    forward = np.array([np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.cos(yaw), -np.sin(yaw), 0.0])
    down = np.cross(forward, right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, down, forward, at
    return pose


def cast(camera: sf.Camera, pose: np.ndarray) -> Tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What a camera in the box [-1, 1]^3 sees: rgb [H, W, 3] uint8, wall [H, W], z-depth [H, W]."""
    c = camera._dict()
    x = (np.arange(camera.width) + 0.5 - c["cx"]) / c["fx"]
    y = (np.arange(camera.height) + 0.5 - c["cy"]) / c["fy"]
    rays = np.stack([*np.meshgrid(x, y), np.ones((camera.height, camera.width))], -1) @ pose[:3, :3].T
    with np.errstate(divide="ignore"):
        distance = (np.sign(rays) - pose[:3, 3]) / rays
    axis = np.argmin(distance, -1)
    depth = np.take_along_axis(distance, axis[..., None], -1)[..., 0]
    wall = 2 * axis + (np.take_along_axis(rays, axis[..., None], -1)[..., 0] > 0)
    hit = pose[:3, 3] + rays * depth[..., None]
    base = np.array([[200, 60, 60], [60, 200, 60], [60, 60, 200], [200, 200, 60], [60, 200, 200], [200, 60, 200]])
    rgb = np.clip(base[wall] * (0.8 + 0.2 * np.sin(4 * hit.sum(-1)))[..., None], 0, 255).astype(np.uint8)
    return rgb, wall.astype(np.int32), depth.astype(np.float32)


def box_arrays(count: int = 10, width: int = 32, height: int = 24, apart: float = 0.1) -> Dict[str, Any]:
    """Arguments of sf.Scene: `count` views from around the middle of the box, `apart` off it, the last two held out."""
    camera = sf.Camera.from_fov(width, height, 90)
    poses = [look(2 * np.pi * i / count, 0.5 * np.sin(3.0 * i), (apart * np.cos(i), apart * np.sin(i), 0)) for i in range(count)]
    seen = [cast(camera, pose) for pose in poses]
    return {
        "images": [s[0] for s in seen], "labels": [s[1] for s in seen], "depths": [s[2] for s in seen],
        "poses": np.stack(poses), "cameras": camera, "classes": WALLS, "test": [count - 2, count - 1],
    }


NETWORK: Dict[str, Any] = {
    "rendering": {"density_activation": "softplus", "far": "background"},
    "semantics": {"hidden_width": 16},
    "passes": [{
        "name": "main", "sampler": {"type": "stratified", "samples": 24},
        "position": {"type": "hash_grid", "levels": 6, "log2_entries": 12, "finest_resolution": 64},
        "direction": {"type": "spherical_harmonics", "degree": 2},
        "field": {"type": "tiny_mlp", "hidden_width": 32, "color_width": 32},
    }],
    "train": {"rays": 256, "steps": 60, "adam": {"learning_rate": 0.02}},
    "runtime": {"threads": 2, "device": "cpu"},
}


def config_of(scene: sf.Scene, **train: Any) -> Dict[str, Any]:
    """NETWORK for a scene, with some settings of `train` changed."""
    return {**NETWORK, "scene": scene.config(), "train": {**NETWORK["train"], **train}}


@pytest.fixture(scope="session")
def scene(tmp_path_factory: pytest.TempPathFactory) -> sf.Scene:
    """The box, in a file."""
    return sf.Scene(**box_arrays(), file=tmp_path_factory.mktemp("scene") / "box.sfpack")


@pytest.fixture()
def run(scene: sf.Scene) -> sf.Run:
    """A fresh run of the box."""
    return sf.open(config_of(scene))


@pytest.fixture(scope="session")
def box(tmp_path_factory: pytest.TempPathFactory) -> sf.Run:
    """A box seen from places that lie far apart, trained until its walls stand."""
    scene = sf.Scene(**box_arrays(count=20, apart=0.5), bounds=[[-1.3] * 3, [1.3] * 3], near=0.05, far=4,
                     file=tmp_path_factory.mktemp("box") / "box.sfpack")
    config = {**config_of(scene), "losses": [{"type": "depth", "weight": 0.5}],
              "rendering": {"density_activation": "softplus", "far": "closed"}}
    run = sf.open(config, {"train.rays": 512, "passes.0.sampler.samples": 48})
    trained(run, 200)
    return run


def tensors_of(checkpoint: str) -> Dict[str, bytes]:
    """Bytes of every tensor of a checkpoint."""
    return sound_tensors(Path(checkpoint), os.stat(checkpoint).st_mtime_ns)


def trained(run: sf.Run, steps: int) -> List[sf.Step]:
    return list(run.train(steps, every=max(steps, 1)))


def same(a: sf.Run, b: sf.Run) -> bool:
    """Whether two runs have the same bits."""
    mine, theirs = a.parameters(), b.parameters()
    return mine.keys() == theirs.keys() and all(np.array_equal(mine[k], theirs[k]) for k in mine)


def program_that(folder: Path, script: str, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Stands for the program; writes its words into `words`."""
    file = folder / "semfield"
    file.write_text(f"#!/bin/sh\nfor word; do echo \"$word\"; done > {folder}/words\n{script}\n")
    file.chmod(0o755)
    monkeypatch.setenv("SEMFIELD_PROGRAM", str(file))
    return folder / "words"
