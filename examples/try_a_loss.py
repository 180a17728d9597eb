"""A loss in Python: labels of which half are wrong, with the cross-entropy and with a loss that doubts them.

    python3 try_a_loss.py

Two small fields of the shipped room train on labels of which half the pixels have a random class. One has the
cross-entropy alone. In the other, the cross-entropy has weight 0 and the loss of this file has its place. Its slope is
that of the cross-entropy times the root of the label's probability, so it pulls least where the network is sure of
something else.
"""

import os

import numpy as np

import semfield as sf

STEPS = int(os.environ.get("SEMFIELD_EXAMPLE_STEPS", "1500"))
SMALL = {"scene.frames": 40, "scene.test_frames": 4, "scene.width_px": 80, "scene.height_px": 60, "train.steps": STEPS,
         "train.rays": 512, "runtime.device": "cpu",
         "scene.labels": {"frames": "all", "degrade": [{"type": "pixel_noise", "ratio": 0.5}]}}


@sf.loss("doubt")
class Doubt(sf.Loss):
    """2 (1 - sqrt p) of the label's class."""

    weight = sf.param(0.1, sf.Loss.weight.help, low=0, high=1e6)
    targets = ["label"]
    heads = ["logits"]
    moves = ["logits"]

    def counted(self, targets, rays):
        return int((targets["label"] >= 0).sum()) if "label" in targets else 0

    def value(self, targets, values):
        logits = values["logits"].astype(np.float64)
        p = np.exp(logits - logits.max(1, keepdims=True))
        p /= p.sum(1, keepdims=True)
        if "label" not in targets:
            return np.zeros(len(p)), {}
        label = targets["label"][:len(p), 0]
        known = (label >= 0).astype(float)
        truth = np.zeros_like(p)
        truth[np.arange(len(p)), np.maximum(label, 0)] = known
        root = np.sqrt((truth * p).sum(1))
        return known * 2 * (1 - root), {"logits": root[:, None] * (known[:, None] * p - truth)}


def miou(settings):
    """Mean IoU of the held-out views against the true labels."""
    run = sf.open("quickstart", {**SMALL, **settings})
    for step in run.train(every=max(1, STEPS // 4)):
        print(f"step {step.step}: loss {step.loss:.4f}")
    return run.evaluate("test").miou_present


if __name__ == "__main__":
    plain = miou({})
    doubting = miou({"semantics.weight": 0, "losses": [{"type": "doubt"}]})
    print(f"mIoU with half of the labels wrong: cross-entropy {plain:.3f}, doubt {doubting:.3f}")
