#!/usr/bin/env python3
"""Trains an object in PyTorch for a while and scores it: what `scripts/benchmark --peer` sets beside semfield.

A hash grid of 16 levels, two small networks and an occupancy grid, as in [Mueller22] and written from that paper, of
PyTorch's own operations: no kernel is fused. It reads what `semfield pack` wrote, of pinhole cameras, and prints one
JSON object per time, with the PSNR of each held-out view averaged as publications do.
"""
import argparse
import json
import math
import time

import torch
import torch.nn.functional as F
from torch import nn

from packed_scene import TEST, TRAIN, PackedScene
from semfield_peer import HashNet, harmonics

STEPS_PER_RAY = 1024
CELLS = 128
LIVE_SAMPLES = 1 << 18  # per step; the number of rays follows
SCORED_STRIDE = 4  # of pixels of held-out views: rendering by single operations is slow
DECAY, THRESHOLD = 0.95, 0.01  # of the occupancy grid, opacity per step


class Exponential(torch.autograd.Function):
    """exp(x), whose gradient is cut where it would blow up."""

    @staticmethod
    def forward(ctx, x):
        ctx.save_for_backward(x)
        return x.clamp(max=15).exp()

    @staticmethod
    def backward(ctx, dy):
        return dy * ctx.saved_tensors[0].clamp(-15, 15).exp()


class Network(HashNet):
    """Density and colour alone."""

    def __init__(self):
        super().__init__(1, 19, False, finest=2048)
        # No biases: one number that lowers all density at once empties the scene before white.
        for name in ("hidden", "geometry", "color_0", "color_1", "rgb"):
            layer = getattr(self, name)
            setattr(self, name, nn.Linear(layer.in_features, layer.out_features, bias=False))

    def density(self, x):
        """x [N, 3] in [0, 1] -> density [N], geometry [N, 16]."""
        encoded = self.encode(x)
        with torch.autocast(x.device.type, dtype=torch.bfloat16):
            geometry = self.geometry(F.relu_(self.hidden(encoded)))
        return Exponential.apply(geometry[:, 0].float()), geometry

    def forward(self, x, direction):
        density, geometry = self.density(x)
        with torch.autocast(x.device.type, dtype=torch.bfloat16):
            color = F.relu_(self.color_0(torch.cat([geometry[:, 1:], direction], 1)))
            color = self.rgb(F.relu_(self.color_1(color)))
        return density, torch.sigmoid(color.float())


class Images:
    """Pixels and cameras of a split, on the device."""

    def __init__(self, scene, split, device):
        frames = scene.of(split)
        if not frames:
            raise SystemExit("object_peer: the packed scene has no frames to " + ("train on" if split == TRAIN else "score"))
        sizes = {(frame.width, frame.height) for frame in frames}
        if len(sizes) > 1:
            raise SystemExit("object_peer: photographs have different sizes; give a scene whose photographs have one")
        self.width, self.height = sizes.pop()
        self.count = len(frames)
        self.color = torch.stack([torch.from_numpy(scene.pixels(frame)) for frame in frames]).to(device)
        self.pose = torch.tensor([frame.pose.tolist() for frame in frames], dtype=torch.float32, device=device)
        self.lens = torch.tensor([[f.fx, f.fy, f.cx, f.cy] for f in frames], dtype=torch.float32, device=device)

    def rays(self, frame, x, y):
        """Origins and unit directions [N, 3] through the middles of pixels."""
        fx, fy, cx, cy = self.lens[frame].unbind(1)
        local = torch.stack([(x + 0.5 - cx) / fx, (y + 0.5 - cy) / fy, torch.ones_like(fx)], 1)
        pose = self.pose[frame]
        return pose[:, :, 3], F.normalize((pose[:, :, :3] @ local.unsqueeze(2)).squeeze(2), dim=1)

    def some(self, rays):
        """Random rays, with colours before black and alpha; the photographs stand before white."""
        device = self.color.device
        frame = torch.randint(self.count, (rays,), device=device)
        x, y = (torch.randint(size, (rays,), device=device) for size in (self.width, self.height))
        pixel = self.color[frame, y, x].float() / 255
        return *self.rays(frame, x, y), pixel[:, :3] - (1 - pixel[:, 3:]), pixel[:, 3:]

    def view(self, frame, stride):
        """Every pixel whose column and row are multiples of the stride: origins, directions and colours."""
        device = self.color.device
        y, x = torch.meshgrid(torch.arange(0, self.height, stride, device=device),
                              torch.arange(0, self.width, stride, device=device), indexing="ij")
        x, y = x.flatten(), y.flatten()
        return *self.rays(torch.full_like(x, frame), x, y), self.color[frame, y, x, :3].float() / 255


class Field:
    """Network and occupancy grid in a cube of `size` metres about the origin."""

    def __init__(self, size, device):
        self.net = Network().to(device)
        self.size, self.device = size, device
        self.step_length = size * math.sqrt(3) / STEPS_PER_RAY
        self.grid = torch.zeros(CELLS ** 3, device=device)

    def cell(self, x):
        index = (x * CELLS).long().clamp_(0, CELLS - 1)
        return (index[:, 2] * CELLS + index[:, 1]) * CELLS + index[:, 0]

    @torch.no_grad()
    def observe(self, whole):
        cells = torch.arange(CELLS ** 3, device=self.device)
        if not whole:
            cells = torch.randint(CELLS ** 3, (CELLS ** 3 // 4,), device=self.device)
        corner = torch.stack([cells % CELLS, cells // CELLS % CELLS, cells // CELLS ** 2], 1)
        x = (corner + torch.rand(len(cells), 3, device=self.device)) / CELLS
        density = torch.cat([self.net.density(part)[0] for part in x.split(1 << 19)])
        self.grid *= DECAY
        self.grid[cells] = torch.maximum(self.grid[cells], density)

    @torch.no_grad()
    def march(self, origin, direction, jitter):
        """Samples in occupied cells: their rays [M], positions [M, 3] in [0, 1]."""
        half = self.size / 2
        safe = torch.where(direction.abs() < 1e-9, torch.full_like(direction, 1e-9), direction)
        a, b = (-half - origin) / safe, (half - origin) / safe
        near = torch.minimum(a, b).amax(1).clamp_min(0.05)
        far = torch.maximum(a, b).amin(1)
        start = near + self.step_length * (torch.rand_like(near) if jitter else 0.5)
        t = start.unsqueeze(1) + self.step_length * torch.arange(STEPS_PER_RAY, device=self.device)
        x = (origin.unsqueeze(1) + direction.unsqueeze(1) * t.unsqueeze(2)) / self.size + 0.5
        least = min(THRESHOLD / self.step_length, float(self.grid.mean()))
        live = (t < far.unsqueeze(1)) & (self.grid[self.cell(x.view(-1, 3))] > least).view_as(t)
        return live.nonzero()[:, 0], x[live]

    def color(self, origin, direction, jitter=False):
        """Colours [R, 3] before black, opacity [R, 1], and how many samples it took."""
        ray, x = self.march(origin, direction, jitter)
        density, rgb = self.net(x, harmonics(direction)[ray])
        tau = density * self.step_length
        # Sums along rays: those over all samples, less what lies before a ray.
        before = torch.cumsum(tau.double(), 0) - tau
        count = torch.bincount(ray, minlength=len(origin))
        first = torch.cumsum(count, 0) - count
        through = torch.exp((before[first[ray]] - before).float())
        weight = through * -torch.expm1(-tau)
        out = torch.zeros(len(origin), 4, device=self.device)
        out = out.index_add(0, ray, weight.unsqueeze(1) * torch.cat([rgb, torch.ones_like(rgb[:, :1])], 1))
        return out[:, :3], out[:, 3:], len(ray)


@torch.no_grad()
def psnr_of_views(field, images):
    values = []
    for frame in range(images.count):
        origin, direction, wanted = images.view(frame, SCORED_STRIDE)
        parts = [field.color(o, d) for o, d in zip(origin.split(2048), direction.split(2048))]
        made = torch.cat([color + 1 - opacity for color, opacity, _ in parts])
        error = (made.clamp(0, 1) - wanted).square().mean()
        values.append(-10 * math.log10(float(error)))
    return sum(values) / len(values)


def train(field, images, seconds, device):
    """Trains for that long, with a rate that falls to a thirtieth by then. Returns steps and seconds."""
    optimiser = torch.optim.Adam(field.net.parameters(), lr=1e-2, betas=(0.9, 0.99), eps=1e-15, foreach=True)
    rays, step, begin = 256, 0, time.perf_counter()  # few while every cell counts as occupied
    while True:
        spent = time.perf_counter() - begin
        if spent >= seconds:
            return step, spent
        for group in optimiser.param_groups:
            group["lr"] = 1e-2 * (1 / 30) ** (spent / seconds)
        if step % 16 == 0:
            field.observe(step < 256)
        origin, direction, target, alpha = images.some(rays)
        color, opacity, samples = field.color(origin, direction, jitter=True)
        behind = torch.rand_like(target)  # before one colour a field without density is an easy way out
        loss = F.smooth_l1_loss(color + (1 - opacity) * behind, target + (1 - alpha) * behind, beta=0.1)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        rays = max(256, min(8192, int(rays * LIVE_SAMPLES / max(samples, 1))))
        step += 1
        if device == "cuda":
            torch.cuda.synchronize()


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("scene", metavar="FILE", help="an object, packed by `semfield pack`")
    parser.add_argument("--times", default="5,60", help="seconds of training, with commas (default: %(default)s)")
    parser.add_argument("--size", type=float, default=3.0, help="edge of the cube about the origin, metres (default: %(default)s)")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cuda")
    options = parser.parse_args()
    scene = PackedScene(options.scene)
    images, held_out = (Images(scene, split, options.device) for split in (TRAIN, TEST))
    train(Field(options.size, options.device), images, 3, options.device)  # kernels are loaded
    for seconds in (float(text) for text in options.times.split(",")):
        torch.manual_seed(1)
        field = Field(options.size, options.device)
        steps, spent = train(field, images, seconds, options.device)
        print(json.dumps({"seconds": seconds, "train_s": spent, "steps": steps, "frames": held_out.count,
                          "psnr_of_views": psnr_of_views(field, held_out), "torch": torch.__version__}), flush=True)


if __name__ == "__main__":
    main()
