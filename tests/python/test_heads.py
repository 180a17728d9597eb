"""Heads beside that of class logits: from a file of Python, on feature maps of a dataset, rendered and asked."""

from __future__ import annotations

import dataclasses
import json
import struct
import zlib
from pathlib import Path
from typing import Any, Dict, List

import numpy as np
import pytest

import semfield as sf
from conftest import NETWORK, box_arrays, config_of, trained
from test_plugins import BRANCH, Box

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


def test_a_head_in_a_file_is_checked(tmp_path: Path) -> None:
    file = tmp_path / "idea_head.py"
    file.write_text(HEAD)
    said = sf.command("plugins", "check", file)
    assert "failed=0" in said, said


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


def write_png(path: Path, pixels: np.ndarray) -> None:
    """8-bit gray [H, W] or RGB [H, W, 3]."""
    height, width = pixels.shape[:2]
    rows = b"".join(b"\0" + row.tobytes() for row in pixels.astype(np.uint8))

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2 if pixels.ndim == 3 else 0, 0, 0, 0)
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b""))


def word_files(folder: Path) -> Path:
    """The box as a transforms.json with a map of words per training frame; returns a configuration that learns them."""
    box = box_arrays(count=12)
    frames: List[Dict[str, Any]] = []
    for i, (rgb, walls, pose) in enumerate(zip(box["images"], box["labels"], box["poses"])):
        write_png(folder / f"{i}.png", rgb)
        write_png(folder / f"{i}_label.png", walls)
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
    queries = tmp_path / "words.json"
    queries.write_text(json.dumps({"back wall": WORDS[1].tolist(), "floor": WORDS[4].tolist()}))
    sf.command("render", run, "--query", queries, "--out", tmp_path / "asked")
    sf.command("render", run, "--channel", "words", "--out", tmp_path / "maps")
    maps = sorted((tmp_path / "maps").glob("*_words.npy"))
    axes = np.load(tmp_path / "maps" / "words_axes.npy")
    assert len(maps) == 3 and axes.shape == (96, 6)
    for file in maps:
        made, stem = np.load(file), file.name[:-len("_words.npy")]
        asked = np.load(tmp_path / "asked" / f"{stem}_query_back_wall.npy")
        cosine = made @ (axes.T @ WORDS[1]) / np.linalg.norm(made, axis=-1) / np.linalg.norm(WORDS[1])
        assert np.allclose(asked, cosine, atol=1e-5)
        assert (tmp_path / "asked" / f"{stem}_query_floor.png").stat().st_size > 100
        truth = box_arrays(count=12)["labels"][int(stem)]
        if (truth == 1).any() and (truth != 1).any():
            assert asked[truth == 1].mean() > asked[truth != 1].mean() + 0.1
    queries.write_text(json.dumps({"short": [1.0, 2.0]}))
    with pytest.raises(sf.Error, match="vector 'short' has 2 numbers, and the channel 96"):
        sf.command("render", run, "--query", queries)
    with pytest.raises(sf.Error, match="did you mean 'words'"):
        sf.command("render", run, "--channel", "word")
