"""A trained field asked at points of space: the surfaces of a room as a point cloud with classes.

    python3 labels_to_pointcloud.py [RUN] [FILE.ply]

RUN is the folder of a run with classes; without one a small field of the shipped room is trained. The point cloud
(default points.ply) opens in MeshLab, CloudCompare and Blender: x, y, z in the scene's own frame, the colour of the
class, and the property `label` with the scene's class id, as ScanNet has it.
"""

import os
import sys

import numpy as np

import semfield as sf

STEPS = int(os.environ.get("SEMFIELD_EXAMPLE_STEPS", "1500"))


def small_room():
    """A field of the shipped room, from few and small images."""
    run = sf.open("quickstart", {"scene.frames": 40, "scene.test_frames": 4, "scene.width_px": 80, "scene.height_px": 60,
                                 "train.steps": STEPS, "train.rays": 512})
    for step in run.train(every=max(1, STEPS // 4)):
        print(f"step {step.step}: loss {step.loss:.4f}")
    return run


def surface_points(run, shrink):
    """[N, 3] places where rays of the training views end, world. `shrink`: pixels of the images for one ray."""
    places = []
    for frame in run.frames:
        if frame.split != "train":
            continue
        view = run.render(frame=frame.name, width=frame.camera.width // shrink)
        camera = view.camera
        x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
        y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
        in_camera = np.stack([*np.meshgrid(x, y), np.ones(view.depth_m.shape)], -1) * view.depth_m[..., None]
        solid = view.opacity > 0.9
        places.append((in_camera @ view.pose[:3, :3].T + view.pose[:3, 3])[solid])
    return np.concatenate(places)


def thinned(places, cell_m):
    """One place in every cell of a grid."""
    _, first = np.unique(np.floor(places / cell_m).astype(np.int64), axis=0, return_index=True)
    return places[np.sort(first)]


def write_ply(path, places, colors, labels):
    rows = np.empty(len(places), [("place", "<f4", 3), ("color", "u1", 3), ("label", "<i4")])
    rows["place"], rows["color"], rows["label"] = places, colors, labels
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [f"property uchar {color}" for color in ("red", "green", "blue")]
    header += ["property int label", "end_header", ""]
    with open(path, "wb") as file:
        file.write("\n".join(header).encode() + rows.tobytes())


def main():
    run = sf.load(sys.argv[1]) if len(sys.argv) > 1 else small_room()
    file = sys.argv[2] if len(sys.argv) > 2 else "points.ply"
    if not run.has_semantics:
        sys.exit(f"{run.name} has no classes: train it with labels")

    places = thinned(surface_points(run, shrink=2), cell_m=0.02)
    found = run.query(places)

    # Points that the field is not sure of say so in entropy (nats); leave them out.
    sure = found.entropy < 0.5 * np.log(len(run.classes))
    color_of = {c.id: c.color for c in run.classes}
    ids = found.label[sure]
    write_ply(file, places[sure], np.array([color_of[i] for i in ids.tolist()]), ids)
    print(f"{sure.sum()} of {len(places)} points are sure, in {file}:")
    for entry in run.classes:
        count = int(np.sum(ids == entry.id))
        if count > 0:
            print(f"  {count:7d}  {entry.name}")


if __name__ == "__main__":
    main()
