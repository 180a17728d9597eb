"""A reference renderer of 3D Gaussians, and how far it stays below the field: splat_render.py RUN SPLATS [EVERY]

Draws the splats of a PLY [Kerbl23] at every EVERY-th held-out view of a run, by elliptical weighted averages [Zwicker01] from front to back, and prints the
PSNR of the splats and of the field against the images of the scene as one JSON object. Runs where the module `semfield` and NumPy are.
"""
import json
import sys

import numpy as np

LOW_PASS = 0.3  # square pixels that every footprint is widened by [Kerbl23]
LEAST_ALPHA = 1 / 255
NEAR = 0.05
HARMONIC = 0.28209479177387814


def read_splats(path):
    head, _, body = open(path, "rb").read().partition(b"end_header\n")
    kinds = {"float": "<f4", "int": "<i4"}
    fields = [(line.split()[2], kinds[line.split()[1]]) for line in head.decode().splitlines() if line.startswith("property")]
    rows = np.frombuffer(body, dtype=fields)
    stack = lambda *names: np.stack([rows[name].astype(np.float64) for name in names], 1)
    comment = next(line for line in head.decode().splitlines() if line.startswith("comment"))
    return {
        "place": stack("x", "y", "z") + np.array([float(word) for word in comment.split()[-3:]]),
        "color": np.clip(0.5 + HARMONIC * stack("f_dc_0", "f_dc_1", "f_dc_2"), 0, 1),
        "opacity": 1 / (1 + np.exp(-rows["opacity"].astype(np.float64))),
        "deviation": np.exp(stack("scale_0", "scale_1", "scale_2")),
        "turn": stack("rot_0", "rot_1", "rot_2", "rot_3"),
    }


def rotations(q):
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    return np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                     2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1).reshape(-1, 3, 3)


def footprints(splats, camera, pose):
    """What lies before the camera, the nearest first: pixels of the middle, inverse covariances, radii, opacities, colours."""
    world_to_camera = pose[:3, :3].T
    place = (splats["place"] - pose[:3, 3]) @ pose[:3, :3]
    z = place[:, 2]
    u, v = camera.fx * place[:, 0] / np.where(z > NEAR, z, 1) + camera.cx, camera.fy * place[:, 1] / np.where(z > NEAR, z, 1) + camera.cy
    margin = 0.3 * max(camera.width, camera.height)
    kept = np.flatnonzero((z > NEAR) & (u > -margin) & (v > -margin) & (u < camera.width + margin) & (v < camera.height + margin))
    kept = kept[np.argsort(z[kept], kind="stable")]
    axes = world_to_camera @ rotations(splats["turn"][kept]) * splats["deviation"][kept][:, None, :]
    x, y, z = place[kept].T
    zero = np.zeros_like(z)
    slope = np.stack([camera.fx / z, zero, -camera.fx * x / z**2, zero, camera.fy / z, -camera.fy * y / z**2], 1).reshape(-1, 2, 3)
    flat = slope @ axes
    cover = flat @ flat.transpose(0, 2, 1)
    a, b, c = cover[:, 0, 0] + LOW_PASS, cover[:, 0, 1], cover[:, 1, 1] + LOW_PASS
    det = a * c - b * b
    largest = 0.5 * (a + c) + np.sqrt(np.maximum(0.25 * (a - c) ** 2 + b * b, 0))
    radius = np.ceil(3 * np.sqrt(largest)).astype(int)
    return u[kept], v[kept], (c / det, -b / det, a / det), radius, splats["opacity"][kept], splats["color"][kept]


def draw(splats, camera, pose):
    """[H, W, 3], what is left of the light being black."""
    u, v, (ia, ib, ic), radius, opacity, color = footprints(splats, camera, pose)
    width, height = camera.width, camera.height
    pixels, ranks, alphas = [], [], []
    for r in np.unique(radius):
        of = np.flatnonzero(radius == r)
        for some in np.array_split(of, max(1, len(of) * (2 * r + 1) ** 2 // 4_000_000)):
            steps = np.arange(-r, r + 1)
            px = np.floor(u[some]).astype(int)[:, None, None] + steps[None, None, :]
            py = np.floor(v[some]).astype(int)[:, None, None] + steps[None, :, None]
            dx, dy = px + 0.5 - u[some][:, None, None], py + 0.5 - v[some][:, None, None]
            power = ia[some][:, None, None] * dx**2 + 2 * ib[some][:, None, None] * dx * dy + ic[some][:, None, None] * dy**2
            alpha = np.minimum(opacity[some][:, None, None] * np.exp(-0.5 * power), 0.99)
            inside = (alpha >= LEAST_ALPHA) & (px >= 0) & (px < width) & (py >= 0) & (py < height)
            which = np.nonzero(inside)
            pixels.append((py * width + px)[which].astype(np.int32))
            ranks.append(some[which[0]].astype(np.int32))
            alphas.append(alpha[which])
    pixel, rank, alpha = np.concatenate(pixels), np.concatenate(ranks), np.concatenate(alphas)
    order = np.lexsort((rank, pixel))
    pixel, rank, alpha = pixel[order], rank[order], alpha[order]
    through = np.concatenate([[0.0], np.cumsum(np.log1p(-alpha))])[:-1]  # what lies before, of all pixels so far
    first = np.flatnonzero(np.concatenate([[True], pixel[1:] != pixel[:-1]]))
    start = np.repeat(through[first], np.diff(np.concatenate([first, [len(pixel)]])))
    weight = alpha * np.exp(through - start)
    return np.stack([np.bincount(pixel, weight * color[rank, k], width * height) for k in range(3)], 1).reshape(height, width, 3)


def main():
    import semfield

    run, splats = semfield.load(sys.argv[1]), read_splats(sys.argv[2])
    every = int(sys.argv[3]) if len(sys.argv) > 3 else 1
    frames = [frame for frame in run.frames if frame.split == "test"][::every]
    squared = {"field": [], "splats": []}
    for frame in frames:
        truth = run.pixels(frame.name).rgb / 255
        drawn = {"field": run.render(frame=frame.name).rgb, "splats": draw(splats, frame.camera, np.asarray(frame.pose))}
        for what, image in drawn.items():
            squared[what].append(np.mean((np.asarray(image, dtype=np.float64) - truth) ** 2))
    psnr = {what: -10 * np.log10(np.mean(values)) for what, values in squared.items()}
    print(json.dumps({**psnr, "frames": len(frames), "splats_count": len(splats["place"])}))


if __name__ == "__main__":
    main()
