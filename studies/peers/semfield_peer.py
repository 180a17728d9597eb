#!/usr/bin/env python3
"""The two training steps that `semfield bench step` times, written in PyTorch: the peer to be measured against.

Nets: `paper` is Semantic-NeRF's [Zhi21]: frequency encoding with 10 and 4 bands, two 8 x 256 networks with density,
view-dependent colour and class logits, 64 stratified and 128 resampled distances per ray, compositing, mean squared
error and cross-entropy, Adam. `hash` is a hash grid [Mueller22] with a 64-wide network and 30 samples per ray.
Both are written from the papers. What is computed a step is what semfield computes, without its exact savings: the
class layer runs on every sample and the feature layer is a product of its own, as implementations of the method do.

Prints one JSON object. See README.md beside it.
"""
import argparse
import ctypes.util
import json
import os
import statistics
import sys
import time


def tune_environment():
    """Restarts the script once with the environment that makes PyTorch fastest on a CPU."""
    if os.environ.get("SEMFIELD_PEER_TUNED") == "1":
        return
    env = dict(os.environ, SEMFIELD_PEER_TUNED="1")
    # The allocator that comes with the C library gives large blocks back to the system and faults them in again, every
    # operation; tcmalloc keeps them.
    library = ctypes.util.find_library("tcmalloc_minimal") or ctypes.util.find_library("tcmalloc")
    if library:
        env["LD_PRELOAD"] = " ".join(filter(None, [library, env.get("LD_PRELOAD")]))
        env["TCMALLOC_LARGE_ALLOC_REPORT_THRESHOLD"] = str(1 << 40)
    try:
        with open("/proc/cpuinfo", encoding="ascii", errors="replace") as f:
            if "avx512f" in f.read():
                env["ATEN_CPU_CAPABILITY"] = "avx512"  # not chosen by itself on every processor
    except OSError:
        pass
    env.pop("ONEDNN_MAX_CPU_ISA", None)
    # Threads that wait spin for some ten microseconds, enough between two operations of a step, and then sleep: longer
    # spins take the cores from whatever else runs, which may be the thread that is waited for.
    env.setdefault("GOMP_SPINCOUNT", "20000")
    os.execve(sys.executable, [sys.executable] + sys.argv, env)


def parse_arguments():
    p = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    p.add_argument("--net", choices=["paper", "hash"], default="paper")
    p.add_argument("--mode", choices=["fp32", "tf32", "bf16", "bf16_compile"], default="fp32")
    p.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    p.add_argument("--rays", type=int, default=1024)
    p.add_argument("--classes", type=int, default=29)
    p.add_argument("--log2-entries", type=int, default=15, help="hash: log2 of the entries of a level")
    p.add_argument("--chunk", type=int, default=0, help="rays whose activations are live at once; 0: the fastest known")
    p.add_argument("--plain", action="store_true", help="hash: leave the backward of the lookup to autograd")
    p.add_argument("--repeats", type=int, default=5)
    p.add_argument("--threads", type=int, default=0, help="CPU threads; 0: PyTorch's own choice")
    p.add_argument("--tuned", action="store_true", help="restart with the environment that makes PyTorch fastest")
    return p.parse_args()


if __name__ == "__main__":
    ARGS = parse_arguments()
    if ARGS.tuned:
        tune_environment()
    if ARGS.threads > 0:
        os.environ["OMP_NUM_THREADS"] = str(ARGS.threads)

import torch  # noqa: E402  (after the environment)
import torch.nn.functional as F  # noqa: E402
from torch import nn  # noqa: E402

SEMANTIC_WEIGHT = 0.04


def bands(x, count):
    """[x, sin 2^k x, cos 2^k x] for k < count; x [N, 3] -> [N, 3 + 6 count]."""
    scaled = (x.unsqueeze(1) * (2.0 ** torch.arange(count, device=x.device)).view(-1, 1)).flatten(1)
    return torch.cat([x, torch.sin(scaled), torch.cos(scaled)], 1)


class PaperNet(nn.Module):
    def __init__(self, classes):
        super().__init__()
        self.trunk = nn.ModuleList(
            nn.Linear(63 if i == 0 else 319 if i == 5 else 256, 256) for i in range(8))
        self.density = nn.Linear(256, 1)
        self.semantic_hidden = nn.Linear(256, 128)
        self.semantic_class = nn.Linear(128, classes)
        self.feature = nn.Linear(256, 256)
        self.view = nn.Linear(283, 128)
        self.color = nn.Linear(128, 3)

    def forward(self, x, d):
        """x [N, 63], d [N, 27] -> raw density [N], colour before the sigmoid [N, 3], logits [N, C]."""
        h = x
        for i, layer in enumerate(self.trunk):
            if i == 5:
                h = torch.cat([x, h], 1)
            h = F.relu_(layer(h))
        v = F.relu_(self.view(torch.cat([self.feature(h), d], 1)))
        s = F.relu_(self.semantic_hidden(h))
        return self.density(h).squeeze(1), self.color(v), self.semantic_class(s)


class Interpolate(torch.autograd.Function):
    """Sum of 8 table rows per sample with constant weights. Autograd's own backward of a lookup sorts its indices or adds
    rows one by one; counting with weights is 1.6 times as fast a step on a CPU, adding with atomics is best on a GPU."""

    @staticmethod
    def forward(ctx, table, index, weight):
        ctx.save_for_backward(index, weight)
        ctx.entries = table.shape[0]
        rows = table.index_select(0, index.view(-1)).view(-1, 8, 2)
        return torch.bmm(weight.unsqueeze(1), rows).squeeze(1)

    @staticmethod
    def backward(ctx, dy):
        index, weight = ctx.saved_tensors
        index = index.view(-1)
        d = (weight.unsqueeze(2) * dy.float().unsqueeze(1)).view(-1, 2)
        if d.is_cuda:
            return torch.zeros(ctx.entries, 2, device=d.device).index_add_(0, index, d), None, None
        columns = [torch.bincount(index, d[:, i], ctx.entries) for i in (0, 1)]
        return torch.stack(columns, 1), None, None


class HashNet(nn.Module):
    """16 levels of 2 features, vertices shared by hashing above T entries; one hidden layer to density and 15 features,
    two to colour; a semantic hidden layer on the shared hidden one."""

    PRIMES = (1, 2654435761, 805459861)

    def __init__(self, classes, log2_entries, plain, levels=16, base=16, finest=512):
        super().__init__()
        growth = (finest / base) ** (1.0 / (levels - 1))
        offset, resolutions, sizes, offsets = 0, [], [], []
        for level in range(levels):
            n = int(base * growth ** level + 1e-9)
            size = min((n + 1) ** 3, 1 << log2_entries)
            resolutions.append(n)
            sizes.append(size)
            offsets.append(offset)
            offset += size
        self.log2_entries, self.plain = log2_entries, plain
        self.resolutions, self.sizes, self.offsets = resolutions, sizes, offsets
        self.table = nn.Parameter(torch.empty(offset, 2).uniform_(-1e-4, 1e-4))
        self.register_buffer("corner", torch.tensor([[c & 1, c >> 1 & 1, c >> 2] for c in range(8)]))
        self.hidden = nn.Linear(2 * levels, 64)
        self.geometry = nn.Linear(64, 16)
        self.color_0 = nn.Linear(15 + 16, 64)
        self.color_1 = nn.Linear(64, 64)
        self.rgb = nn.Linear(64, 3)
        self.semantic_hidden = nn.Linear(64, 64)
        self.semantic_class = nn.Linear(64, classes)

    def encode(self, x):
        """x [N, 3] in [0, 1] -> [N, 2 * levels]. Level by level: one level's table is live at a time."""
        mask = (1 << self.log2_entries) - 1
        out = []
        for n, size, offset in zip(self.resolutions, self.sizes, self.offsets):
            with torch.no_grad():
                scaled = x * n
                cell = scaled.floor().clamp_(0, n - 1)
                w = scaled - cell
                cell = cell.long()
                both = torch.stack([1 - w, w], 2)  # [N, 3, 2]
                weight = (both[:, 2, :, None, None] * both[:, 1, None, :, None] * both[:, 0, None, None, :]).flatten(1)
                edge = torch.stack([cell, cell + 1], 2)
                if (n + 1) ** 3 == size:
                    a, b, c = edge[:, 0], edge[:, 1] * (n + 1), edge[:, 2] * (n + 1) ** 2
                    index = (c[:, :, None, None] + b[:, None, :, None] + a[:, None, None, :]).flatten(1)
                else:
                    a, b, c = edge[:, 0], edge[:, 1] * self.PRIMES[1], edge[:, 2] * self.PRIMES[2]
                    index = (c[:, :, None, None] ^ b[:, None, :, None] ^ a[:, None, None, :]).flatten(1) & mask
            level = self.table[offset:offset + size]
            if self.plain:
                out.append(torch.bmm(weight.unsqueeze(1), F.embedding(index, level)).squeeze(1))
            else:
                out.append(Interpolate.apply(level, index, weight))
        return torch.cat(out, 1)

    def forward(self, x, d):
        h = F.relu_(self.hidden(self.encode(x)))
        g = self.geometry(h)
        c = F.relu_(self.color_1(F.relu_(self.color_0(torch.cat([g[:, 1:], d], 1)))))
        s = F.relu_(self.semantic_hidden(h))
        return g[:, 0], self.rgb(c), self.semantic_class(s)


def stratified(near, far, count):
    """One random distance in each of `count` equal intervals. near, far [R, 1] -> [R, count]."""
    u = (torch.arange(count, device=near.device) + torch.rand(near.shape[0], count, device=near.device)) / count
    return near + (far - near) * u


def resample(t, weight, count):
    """`count` distances per ray by the inverse of the piecewise constant distribution of `weight` [R, K], K sorted t."""
    mid = 0.5 * (t[:, 1:] + t[:, :-1])
    w = weight[:, 1:-1] + 1e-5
    cdf = F.pad(torch.cumsum(w / w.sum(1, keepdim=True), 1), (1, 0))
    u = torch.rand(t.shape[0], count, device=t.device)
    above = torch.searchsorted(cdf, u, right=True).clamp_(1, cdf.shape[1] - 1)
    below = above - 1
    c0, c1 = cdf.gather(1, below), cdf.gather(1, above)
    t0, t1 = mid.gather(1, below), mid.gather(1, above)
    return t0 + (t1 - t0) * ((u - c0) / (c1 - c0).clamp_min(1e-5)).clamp_(0, 1)


def composite(t, raw_density, raw_color, logits, soft):
    """Colours [R, 3], logits [R, C] and weights [R, K] of K samples per ray; the last one takes the rest."""
    rays, count = t.shape
    delta = torch.cat([t[:, 1:] - t[:, :-1], torch.full_like(t[:, :1], 1e10)], 1)
    raw = raw_density.float().view(rays, count)
    density = F.softplus(raw) if soft else F.relu(raw + torch.randn_like(raw))
    tau = density * delta
    through = torch.exp(-F.pad(torch.cumsum(tau[:, :-1], 1), (1, 0)))
    weight = through * -torch.expm1(-tau)
    row = weight.unsqueeze(1)
    color = torch.bmm(row, torch.sigmoid(raw_color.float()).view(rays, count, 3)).squeeze(1)
    return color, torch.bmm(row, logits.float().view(rays, count, -1)).squeeze(1), weight


def harmonics(d):
    """Real spherical harmonics of degree 0..3 without the constants, 16 numbers of a unit direction [R, 3]."""
    x, y, z = d.unbind(1)
    one = torch.ones_like(x)
    return torch.stack([one, y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y, y * (3 * x * x - y * y),
                        x * y * z, y * (5 * z * z - 1), z * (5 * z * z - 3), x * (5 * z * z - 1),
                        z * (x * x - y * y), x * (x * x - 3 * y * y)], 1)


class Step:
    """One net with its optimiser and a pool of random rays inside a unit box."""

    POOL = 16384

    def __init__(self, net, mode, device, rays, classes, log2_entries, chunk, plain):
        torch.manual_seed(1)
        self.net, self.mode, self.rays = net, mode, rays
        self.device = torch.device(device)
        if mode == "tf32" and device == "cpu":
            raise ValueError("tf32 is a mode of CUDA devices")
        if mode == "bf16_compile" and not hasattr(torch, "compile"):
            raise ValueError("torch.compile needs PyTorch 2 or later, this is " + torch.__version__)
        self.autocast = mode.startswith("bf16")
        # Activations of a chunk; on a GPU everything at once, on a CPU few enough to stay near the caches.
        self.chunk = chunk or (rays if device == "cuda" or net == "hash" else 128)
        if net == "paper":
            self.models = [PaperNet(classes), PaperNet(classes)]
        else:
            self.models = [HashNet(classes, log2_entries, plain)]
        self.models = [m.to(self.device) for m in self.models]
        parameters = [p for m in self.models for p in m.parameters()]
        rate = 5e-4 if net == "paper" else 1e-2
        # Few large updates beat one loop over all parameters on a GPU; on a CPU `foreach` saves the overhead of calls.
        self.optimiser = torch.optim.Adam(parameters, lr=rate, foreach=True)
        # Each net sees one shape: kernels for just that shape are the fastest.
        self.run = [torch.compile(m, dynamic=False) if mode == "bf16_compile" else m for m in self.models]
        direction = F.normalize(torch.randn(self.POOL, 3), dim=1)
        origin = torch.rand(self.POOL, 3) * 0.5 - 0.25
        to_wall = ((torch.sign(direction) * 0.5 - origin) / direction).amin(1, keepdim=True)
        self.pool = [v.to(self.device) for v in (origin, direction, to_wall, torch.rand(self.POOL, 3))]
        self.label = torch.randint(classes, (self.POOL,)).to(self.device)
        self.samples = rays * ((64 + 192) if net == "paper" else 30)

    def query(self, model, origin, direction, encoded_direction, t):
        points = (origin.unsqueeze(1) + direction.unsqueeze(1) * t.unsqueeze(2)).view(-1, 3)
        count = t.shape[1]
        x = bands(points, 10) if self.net == "paper" else points + 0.5
        if self.autocast and self.net == "paper":
            x = x.bfloat16()  # once, and not again where the skip reads it
        d = encoded_direction.unsqueeze(1).expand(-1, count, -1).reshape(t.numel(), -1)
        return model(x, d)

    def losses(self, origin, direction, far, target, label):
        """The chunk's sum of squares and of cross-entropies over all passes."""
        near = torch.full_like(far, 0.05)
        if self.net == "paper":
            d = bands(direction, 4)
            t = stratified(near, far, 64)
        else:
            d = harmonics(direction)
            t = stratified(near, far, 30)
        if self.autocast:
            d = d.bfloat16()
        squares = entropy = 0
        for number, model in enumerate(self.run):
            if number > 0:
                with torch.no_grad():
                    t = torch.sort(torch.cat([t, resample(t, weight, 128)], 1), 1)[0]
            color, logits, weight = composite(t, *self.query(model, origin, direction, d, t), self.net == "hash")
            squares = squares + F.mse_loss(color, target, reduction="sum")
            entropy = entropy + F.cross_entropy(logits, label, reduction="sum")
        return squares, entropy

    def step(self):
        chosen = torch.randint(self.POOL, (self.rays,), device=self.device)
        batch = [v.index_select(0, chosen) for v in self.pool] + [self.label.index_select(0, chosen)]
        self.optimiser.zero_grad(set_to_none=True)
        with torch.autocast(self.device.type, dtype=torch.bfloat16, enabled=self.autocast):
            for begin in range(0, self.rays, self.chunk):
                squares, entropy = self.losses(*(v[begin:begin + self.chunk] for v in batch))
                loss = squares / (3 * self.rays) + entropy * (SEMANTIC_WEIGHT / self.rays)
                loss.backward()
        self.optimiser.step()
        return loss

    def seconds(self, steps=1):
        """Mean seconds of `steps` steps."""
        torch.backends.cuda.matmul.allow_tf32 = self.mode == "tf32"  # of the process: cases take turns
        if self.device.type == "cuda":
            torch.cuda.synchronize()
        begin = time.perf_counter()
        for _ in range(steps):
            last = self.step()
        if self.device.type == "cuda":
            torch.cuda.synchronize()
        elapsed = time.perf_counter() - begin
        value = float(last)
        if value != value:
            raise ValueError("the loss is not a number")
        return elapsed / steps


def blas():
    """Which library multiplies matrices: Debian's own is the reference one unless another is installed."""
    try:
        with open("/proc/self/maps", encoding="utf-8") as f:
            maps = f.read().lower()
    except OSError:
        return "unknown"
    for name in ("openblas", "mkl", "blis", "atlas"):
        if name in maps:
            return name
    return "reference" if "libblas.so" in maps else "built in"


def describe():
    return {"torch": torch.__version__, "threads": torch.get_num_threads(), "blas": blas(),
            "tuned": "SEMFIELD_PEER_TUNED" in os.environ,
            "preload": os.environ.get("LD_PRELOAD", ""), "capability": os.environ.get("ATEN_CPU_CAPABILITY", "default")}


def main(args):
    if args.threads > 0:
        torch.set_num_threads(args.threads)
    torch.set_flush_denormal(True)
    case = Step(args.net, args.mode, args.device, args.rays, args.classes, args.log2_entries, args.chunk, args.plain)
    steps = 1 if args.device == "cpu" and args.net == "paper" else 3 if args.device == "cpu" else 20
    case.seconds(max(1, steps // 2))
    processor = time.process_time()
    times = [case.seconds(steps) for _ in range(args.repeats)]
    processor = (time.process_time() - processor) / (args.repeats * steps)
    middle = statistics.median(times)
    out = dict(describe(), net=args.net, mode=args.mode, device=args.device, rays=args.rays, chunk=case.chunk,
               seconds=middle, seconds_min=min(times), seconds_max=max(times),
               processor_seconds=processor, samples_per_second=case.samples / middle)
    print(json.dumps(out))


if __name__ == "__main__":
    main(ARGS)
