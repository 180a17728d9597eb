#!/usr/bin/env python3
"""Objects of a packed scene by a contrastive embedding in PyTorch's own operations [Bhalgat23]: studies/peers/grouping_peer.py SCENE.sfpack

The scene holds depth, labels and instances (`semfield pack`). A network reads the points that true depth gives for the
training images and learns an embedding from the instances of each image alone, whose numbers mean nothing across images; a slow copy is
what points are compared with. Embeddings of a sample are clustered by density [Ester96], and each held-out pixel is of the nearest
cluster. Things alone are grouped: which pixels are stuff is taken from the true labels. So the peer has true depth and true classes,
where semfield renders both.

--damage makes the segments worse as framework/objects/damage.h does with 20 % split, 20 % joined, 20 % missing and borders
moved by up to 2 pixels; its random numbers are others.

Prints one JSON object: panoptic quality of the scene by the protocol of framework/objects/object_score.h, and seconds of all but reading."""
import argparse
import collections
import json
import time

import numpy as np
import torch

from packed_scene import TEST, TRAIN, PackedScene

FREQUENCIES, WIDTH, DIMS = 9, 64, 16
VIEWS, POINTS, STEPS, RATE, SLOW, GATHER = 8, 256, 1500, 1e-2, 0.9, 0.5
SAMPLE, REACH, NEIGHBOURS, LEAST_SHARE = 16384, 0.35, 8, 0.0005
LEAST_PX = 300
RAYS = 1_500_000
DAMAGE, PATCH_PX, BORDER_PX = 0.2, 16, 2


def damaged(ids, rng):
    """ids [H, W] of one image, 0: none, made worse."""
    height, width = ids.shape
    rows, columns = np.mgrid[0:height, 0:width]
    shift = rng.integers(-BORDER_PX, BORDER_PX + 1, (2, height // PATCH_PX + 1, width // PATCH_PX + 1))
    dy, dx = shift[:, rows // PATCH_PX, columns // PATCH_PX]
    ids = ids[(rows + dy).clip(0, height - 1), (columns + dx).clip(0, width - 1)].astype(np.int64)

    def drawn():
        present = np.unique(ids[ids > 0])
        return rng.permutation(present)[:int(DAMAGE * len(present) + 0.5)].tolist()

    pairs = np.concatenate([np.stack([ids[:, :-1], ids[:, 1:]], -1).reshape(-1, 2), np.stack([ids[:-1], ids[1:]], -1).reshape(-1, 2)])
    pairs = np.unique(pairs[(pairs > 0).all(1) & (pairs[:, 0] != pairs[:, 1])], axis=0)
    becomes = {}
    for one in drawn():
        others = np.unique(pairs[(pairs == one).any(1)])
        if len(others := others[others != one]):
            becomes[one] = rng.choice(others)
    before = ids.copy()
    for one, other in becomes.items():
        ids[before == one] = other
    for number, one in enumerate(drawn()):
        y, x = np.nonzero(ids == one)
        angle = rng.uniform(0, 2 * np.pi)
        half = (x - x.mean()) * np.cos(angle) + (y - y.mean()) * np.sin(angle) > 0
        ids[y[half], x[half]] = 1_000_000 + number
    ids[np.isin(ids, drawn())] = 0
    return ids


def points_of(scene, frame, stride, rng=None):
    """Positions [N, 3], labels and instances, made worse with `rng`, of every stride-th pixel that has depth."""
    rows, columns = np.mgrid[0:frame.height:stride, 0:frame.width:stride]
    z = scene.depth_m(frame)[rows, columns]
    here = np.stack([(columns + 0.5 - frame.cx) / frame.fx * z, (rows + 0.5 - frame.cy) / frame.fy * z, z], -1)
    world = here @ frame.pose[:, :3].T + frame.pose[:, 3]
    known = z > 0
    instances = scene.instances(frame)
    if rng is not None:
        instances = damaged(instances, rng)
    return world[known].astype(np.float32), scene.labels(frame)[rows, columns][known], instances[rows, columns][known]


class Network(torch.nn.Module):
    def __init__(self, low, high):
        super().__init__()
        self.register_buffer("middle", (low + high) / 2)
        self.half = float((high - low).max()) / 2
        self.layers = torch.nn.Sequential(torch.nn.Linear(3 + 6 * FREQUENCIES, WIDTH), torch.nn.ReLU(), torch.nn.Linear(WIDTH, WIDTH), torch.nn.ReLU(),
                                          torch.nn.Linear(WIDTH, DIMS))

    def forward(self, x):
        x = (x - self.middle) / self.half
        angles = torch.cat([x * (2**i * np.pi / 2) for i in range(FREQUENCIES)], -1)
        return self.layers(torch.cat([x, angles.sin(), angles.cos()], -1))


def loss_of(rows, slow, segment):
    """rows, slow [views, points, dims], segment [views, points]: points at even places ask, those at odd ones are compared with [Bhalgat23 Eq. 3-5]."""
    q, k = rows[:, 0::2], slow[:, 1::2]
    score = -torch.cdist(q, k).square()
    same = segment[:, 0::2, None] == segment[:, None, 1::2]
    counts = same.any(-1)
    own = torch.logsumexp(score.masked_fill(~same, -torch.inf), -1)
    pushed = torch.where(counts, torch.logsumexp(score, -1) - own, 0.0)
    mean = (same.float() @ k) / same.sum(-1, keepdim=True).clamp(min=1)
    pulled = torch.where(counts, (q - mean).square().sum(-1), 0.0)
    return (pushed + GATHER * pulled).sum() / segment.numel()


def learn(views, net, device, generator):
    slow = Network(net.middle - net.half, net.middle + net.half).to(device)
    slow.load_state_dict(net.state_dict())
    adam = torch.optim.Adam(net.parameters(), RATE, eps=1e-12)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(adam, STEPS, RATE / 100)
    for _ in range(STEPS):
        chosen = torch.randint(len(views), (VIEWS,), generator=generator).tolist()
        drawn = [torch.randint(len(views[v][0]), (POINTS,), generator=generator).to(device) for v in chosen]
        x = torch.stack([views[v][0][i] for v, i in zip(chosen, drawn)])
        segment = torch.stack([views[v][1][i] for v, i in zip(chosen, drawn)])
        with torch.no_grad():
            keys = slow(x)
        adam.zero_grad(set_to_none=True)
        loss_of(net(x), keys, segment).backward()
        adam.step()
        falling.step()
        with torch.no_grad():
            for kept, value in zip(slow.parameters(), net.parameters()):
                kept.lerp_(value, 1 - SLOW)


def clusters_of(places):
    """Centres [C, dims] of places that have enough neighbours, and are connected by them [Ester96]."""
    near = torch.cdist(places, places) < REACH
    core = near.sum(-1) > NEIGHBOURS
    near &= core[:, None] & core[None]
    label = torch.arange(len(places), device=places.device)
    while True:
        least = torch.where(near, label[None], len(places)).amin(-1)
        least = torch.where(core, torch.minimum(least, label), label)
        least = least[least]
        if torch.equal(least, label):
            break
        label = least
    found, sizes = torch.unique(label[core], return_counts=True)
    return torch.stack([places[core & (label == one)].mean(0) for one in found[sizes >= LEAST_SHARE * len(places)]])


def quality(pixels, class_of_cluster, stuff):
    """pixels: (label, instance, cluster from 1 on, 0: none) of every scored image. As framework/objects/object_score.cpp."""
    both, found, hidden, truth = (collections.Counter() for _ in range(4))
    true_class = collections.defaultdict(collections.Counter)
    for label, instance, cluster in pixels:
        is_stuff = np.isin(label, list(stuff))
        of_truth = np.where(label < 0, 0, np.where(is_stuff, -1 - label.astype(np.int64), instance))
        of_found = np.where(is_stuff, -1 - label.astype(np.int64), cluster)  # stuff is given
        pairs, sizes = np.unique(np.stack([of_truth.ravel(), of_found.ravel(), label.ravel()]), axis=1, return_counts=True)
        for (t, f, c), n in zip(pairs.T.tolist(), sizes.tolist()):
            if f:
                found[f] += n
            if not t:
                hidden[f] += n if f else 0
                continue
            truth[t] += n
            true_class[t][c] += n
            if f:
                both[t, f] += n
    small = {t for t, n in truth.items() if t > 0 and n < LEAST_PX}
    for (t, f), n in both.items():
        if t in small:
            hidden[f] += n
    visible = {f: n - hidden[f] for f, n in found.items()}
    class_of = {t: counts.most_common(1)[0][0] for t, counts in true_class.items()}
    of_found = {f: -1 - f if f < 0 else class_of_cluster.get(f, -1) for f in found}
    iou, matched, missed, wrong, true_things, found_things = (collections.Counter() for _ in range(6))
    hit_truth, hit_found = set(), set()
    for (t, f), n in both.items():
        if t in small or (t < 0) != (f < 0) or of_found[f] not in (class_of[t], -1):
            continue
        value = n / (truth[t] + visible[f] - n)
        if value <= 0.5:
            continue
        iou[class_of[t]] += value
        matched[class_of[t]] += 1
        hit_truth.add(t)
        hit_found.add(f)
    for t in set(truth) - small:
        true_things[class_of[t]] += t > 0
        missed[class_of[t]] += t not in hit_truth
    for f, n in found.items():
        counts = visible[f] >= LEAST_PX and 2 * visible[f] > n
        if f in hit_found or counts:
            found_things[of_found[f]] += f > 0
            wrong[of_found[f]] += f not in hit_found
    classes = set(missed) | set(wrong)
    sq = {c: iou[c] / matched[c] if matched[c] else 0.0 for c in classes}
    rq = {c: matched[c] / max(matched[c] + (wrong[c] + missed[c]) / 2, 1e-9) for c in classes}
    objects = sum(true_things.values())
    return {"pq": sum(sq[c] * rq[c] for c in classes) / len(classes), "sq": sum(sq.values()) / len(classes), "rq": sum(rq.values()) / len(classes),
            "count_error": sum(abs(found_things[c] - true_things[c]) for c in classes) / max(objects, 1), "true_objects": objects,
            "found_objects": sum(found_things.values())}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", metavar="SCENE.sfpack")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--damage", action="store_true", help="learn from segments that are made worse")
    parser.add_argument("--stuff", default="wall,floor,ceiling", help="names of classes without objects (default: %(default)s)")
    options = parser.parse_args()
    torch.manual_seed(options.seed)
    generator = torch.Generator().manual_seed(options.seed)
    device = torch.device(options.device)
    scene = PackedScene(options.scene)
    stuff = {scene.classes.index(name) for name in options.stuff.split(",") if name in scene.classes}
    frames = scene.of(TRAIN)
    stride = max(1, int(np.ceil(np.sqrt(sum(frame.width * frame.height for frame in frames) / RAYS))))
    rng = np.random.default_rng(options.seed) if options.damage else None
    taught = [points_of(scene, frame, stride, rng) for frame in frames]
    held_out = [(points_of(scene, frame, 1), scene.depth_m(frame) > 0, frame) for frame in scene.of(TEST)]
    started = time.monotonic()

    def sent(array):
        return torch.from_numpy(np.ascontiguousarray(array)).to(device)

    things = [(x[keep], label[keep], instance[keep]) for x, label, instance in taught for keep in [(instance > 0) & ~np.isin(label, list(stuff))]]
    things = [one for one in things if len(one[0])]
    views = [(sent(x), sent(instance)) for x, _, instance in things]
    everything = torch.cat([x for x, _ in views])
    net = Network(everything.amin(0), everything.amax(0)).to(device)
    learn(views, net, device, generator)
    with torch.no_grad():
        classes = np.concatenate([label for _, label, _ in things])
        chosen = torch.randperm(len(everything), generator=generator)[:SAMPLE]
        places = net(everything[chosen.to(device)])
        centres = clusters_of(places)
        nearest = torch.cdist(places, centres).argmin(-1).cpu().numpy() + 1
        votes = {}
        for cluster in range(1, len(centres) + 1):
            of = classes[chosen.numpy()[nearest == cluster]]
            if len(of):
                votes[cluster] = int(np.bincount(of[of >= 0]).argmax()) if (of >= 0).any() else -1
        pixels = []
        for (x, _, _), known, frame in held_out:
            cluster = np.zeros((frame.height, frame.width), np.int64)
            cluster[known] = torch.cdist(net(sent(x)), centres).argmin(-1).cpu().numpy() + 1
            pixels.append((scene.labels(frame), scene.instances(frame), cluster))
    if device.type == "cuda":
        torch.cuda.synchronize()
    seconds = time.monotonic() - started
    print(json.dumps({**quality(pixels, votes, stuff), "clusters": len(centres), "seconds": seconds, "torch": torch.__version__}))


if __name__ == "__main__":
    main()
