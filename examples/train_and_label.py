"""Own images, few labels, one field: the classes of every pixel of every view.

    python3 train_and_label.py [FOLDER]        the results' folder, new; default runs/train_and_label

The images here are made on the spot: photographs of a small room with six walls, a blue box and an orange ball. With
your own, `take_photos` gives your images, their poses and a camera; nothing else changes.
"""

import os
import pathlib
import sys

import numpy as np

import semfield as sf

STEPS = int(os.environ.get("SEMFIELD_EXAMPLE_STEPS", "1500"))
SHORT = STEPS < 500  # a look at whether everything works: small photographs, a small network
CLASSES = ["wall", "floor", "ceiling", "box", "ball"]


def pose_of(place, target):
    """[4, 4] camera to world for a camera at `place` that looks at `target`; z is up. Axes: x right, y down, z forward."""
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(forward, right), forward, place], axis=1)
    return pose


def photo(camera, pose):
    """What the camera sees: colours [H, W, 3] uint8 and classes [H, W]."""
    rows, cols = np.mgrid[: camera.height, : camera.width]
    x = (cols + 0.5 - camera.width / 2) / camera.fx
    y = (rows + 0.5 - camera.height / 2) / camera.fx
    rays = np.stack([x, y, np.ones_like(x)], -1) @ pose[:3, :3].T
    eye = pose[:3, 3]

    def into_box(low, high, inside):
        with np.errstate(divide="ignore", invalid="ignore"):
            ends = np.stack([(low - eye) / rays, (high - eye) / rays])
        enter, leave = ends.min(0).max(-1), ends.max(0).min(-1)
        return leave if inside else np.where((enter < leave) & (enter > 0), enter, np.inf)

    room = into_box(np.array([-2.0, -2, 0]), np.array([2.0, 2, 2.4]), inside=True)
    box = into_box(np.array([0.5, 0.3, 0]), np.array([1.3, 1.1, 0.7]), inside=False)
    centre, radius = np.array([-0.8, 0.6, 0.35]), 0.35
    a, b = (rays**2).sum(-1), ((eye - centre) * rays).sum(-1)
    root = b**2 - a * (((eye - centre) ** 2).sum() - radius**2)
    ball = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
    what = np.argmin([room, box, ball], 0)
    hit = eye + np.minimum(np.minimum(room, box), ball)[..., None] * rays
    label = np.select([what == 1, what == 2, hit[..., 2] < 1e-6, hit[..., 2] > 2.4 - 1e-6], [3, 4, 1, 2], 0)
    colors = np.array([[205, 190, 170], [120, 85, 60], [240, 240, 235], [60, 90, 200], [235, 130, 40]])
    tiles = 0.85 + 0.15 * np.sign(np.sin(5 * hit)).prod(-1)  # something to see on every surface
    return (colors[label] * tiles[..., None]).astype(np.uint8), label


def take_photos(count):
    camera = sf.Camera.from_fov(40, 30, 80) if SHORT else sf.Camera.from_fov(128, 96, 80)
    poses = []
    for i in range(count):
        around = 2 * np.pi * i / count
        place = np.array([1.2 * np.cos(around), 1.2 * np.sin(around), 1.3 + 0.3 * np.sin(3 * around)])
        poses.append(pose_of(place, np.array([-0.5 * np.cos(around), 0.4, 0.8])))
    photos = [photo(camera, pose) for pose in poses]
    return [p[0] for p in photos], [p[1] for p in photos], np.stack(poses), camera


def main():
    folder = pathlib.Path(sys.argv[1] if len(sys.argv) > 1 else "runs/train_and_label")
    folder.mkdir(parents=True)

    # 1. Images, poses and a camera. Somebody has labelled two of the images; the others have None.
    images, truth, poses, camera = take_photos(24)
    labels = [truth[i] if i in (2, 14) else None for i in range(len(images))]
    scene = sf.Scene(images, poses, camera, labels=labels, classes=CLASSES, file=folder / "room.sfpack")

    # 2. The field. "quickstart" is a shipped configuration; `set` changes what is different here.
    settings = {"scene.labels.frames": "all", "train.steps": STEPS}
    if SHORT:
        settings.update({"train.rays": 256, "passes.0.position.log2_entries": 12, "passes.0.sampler.max_samples": 16})
    run = sf.open("quickstart", settings, scene=scene, out=folder / "run")
    for step in run.train(every=max(1, STEPS // 5)):
        print(f"step {step.step}: loss {step.loss:.4f}, PSNR of the training rays {step.psnr:.1f} dB")
    run.save()

    # 3. The classes of every view, also of those that nobody labelled.
    views = [run.render(frame=frame.name) for frame in run.frames]
    found = np.stack([view.label for view in views])
    np.savez_compressed(folder / "labels.npz", names=[f.name for f in run.frames], labels=found,
                        entropy=np.stack([view.entropy for view in views]))
    given = [i for i, label in enumerate(labels) if label is not None]
    others = [i for i in range(len(images)) if i not in given]
    right = np.mean(found[others] == np.stack(truth)[others])
    print(f"{len(given)} labelled images; in the other {len(others)}, {100 * right:.1f} % of the pixels have the right class")

    # 4. Label images with the ids and colours of the classes, as every verb of the program writes them.
    sf.command("render", folder / "run", "--split", "train", "--out", folder / "pictures")
    print(f"labels as arrays: {folder / 'labels.npz'}; as images: {folder / 'pictures'}; the run: {folder / 'run'}")


if __name__ == "__main__":
    main()
