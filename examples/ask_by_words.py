"""Feature maps that disagree from view to view, learned as one channel of the scene, and the scene asked by a vector.

    python3 ask_by_words.py

The maps here are made on the spot, from the true classes of the shipped room: each class has a random vector of 512
numbers, as a network might encode its word, and every cell of every training view has the vector of its class and as much
noise again. With a network of your own, `maps_of` gives its maps; nothing else changes. The held-out views, which have no
map, are then asked by the vectors, and a pixel belongs to the one that it agrees with most.
"""

import dataclasses
import os

import numpy as np

import semfield as sf

STEPS = int(os.environ.get("SEMFIELD_EXAMPLE_STEPS", "1500"))
ROOM = {"scene.frames": 40, "scene.test_frames": 4, "scene.width_px": 80, "scene.height_px": 60, "train.steps": STEPS,
        "train.rays": 512, "runtime.device": "cpu"}
CELL = 4  # pixels along the side of a cell of the maps
BRANCH = {"position": {"type": "frequency", "frequencies": 6}, "field": {"type": "tiny_mlp", "hidden_width": 64, "hidden_layers": 2}}

room = sf.open("quickstart", ROOM, keep=["training_depth"])
ids = np.array([entry.id for entry in room.classes])
words = np.random.default_rng(1).normal(size=(len(ids), 512)).astype(np.float32)
words /= np.linalg.norm(words, axis=1, keepdims=True)


def classes_of(labels):
    """Places in `ids` of class ids."""
    return np.searchsorted(ids, np.clip(labels, ids[0], ids[-1]))


def maps_of(labels, seed):
    """[rows, columns, 512]: the word of the middle of each cell, and noise of the same length."""
    clean = words[classes_of(labels[CELL // 2::CELL, CELL // 2::CELL])]
    return clean + np.random.default_rng(seed).normal(size=clean.shape).astype(np.float32) / np.sqrt(512)


@sf.dataset("room_with_maps")
class RoomWithMaps(sf.Dataset):
    """The shipped room, with a map of its training views."""

    def frames(self):
        shape = (60 // CELL, 80 // CELL, 512)
        return [dataclasses.replace(f, channels={"words": shape} if f.split == "train" else {}) for f in room.frames]

    def classes(self):
        return room.classes

    def pixels(self, index):
        frame = room.pixels(index)
        return dataclasses.replace(frame, channels={"words": maps_of(frame.labels, index)} if frame.split == "train" else {})


def agreement(rows):
    """[H, W, N] cosines between rows [H, W, 512] and the words."""
    return rows @ words.T / np.maximum(np.linalg.norm(rows, axis=-1, keepdims=True), 1e-9)


if __name__ == "__main__":
    run = sf.open("quickstart", {
        **ROOM, "scene": {"type": "room_with_maps"}, "losses": [{"type": "cosine_distance", "channel": "words"}],
        "heads": [{"type": "feature_map", "channel": "words", "width": 32, "branch": BRANCH}]})
    for step in run.train(every=max(1, STEPS // 4)):
        print(f"step {step.step}: angle of the maps {step.terms['cosine_distance']:.3f}")
    axes = run.channel_axes("words")
    right, of_maps, seen = 0, 0, 0
    for index, frame in enumerate(run.frames):
        if frame.split != "test":
            continue
        truth = classes_of(room.pixels(index).labels)
        found = run.render(frame=frame.name, channels=["words"]).channels["words"] @ axes.T
        right += (agreement(found).argmax(-1) == truth).sum()
        noisy = np.repeat(np.repeat(maps_of(room.pixels(index).labels, index), CELL, 0), CELL, 1)
        of_maps += (agreement(noisy).argmax(-1) == truth).sum()
        seen += truth.size
    print(f"pixels of the held-out views whose word is right: {right / seen:.3f}; a map of their own would have {of_maps / seen:.3f}")
