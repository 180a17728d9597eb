"""Small scenes for the commands of pages: page_scenes.py --program FILE FOLDER. The shipped room as the folders that pages name, and an object."""
import argparse
import json
import math
import os
import pathlib
import shutil
import subprocess
import sys

REPOSITORY = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
sys.path.insert(0, os.path.join(REPOSITORY, "tests"))
from program import png  # noqa: E402

FRAMES, WIDTH, HEIGHT = 16, 80, 60


def write(folder, name, text):
    path = os.path.join(folder, name)
    os.makedirs(os.path.dirname(path), exist_ok=True)
    with open(path, "w", encoding="utf-8") as file:
        file.write(text)


def rows(pose):
    return "".join(" ".join(repr(v) for v in row) + "\n" for row in pose)


def poses_of(folder):
    """Camera to world, OpenCV axes."""
    with open(os.path.join(folder, "traj_w_c.txt"), encoding="utf-8") as file:
        words = [[float(word) for word in line.split()] for line in file]
    return [[row[4 * i:4 * i + 4] for i in range(4)] for row in words]


def inverse(pose):
    turned = [[pose[c][r] for c in range(3)] for r in range(3)]
    return [turned[r] + [-sum(turned[r][c] * pose[c][3] for c in range(3))] for r in range(3)]


def quaternion(r):
    """w, x, y, z of a rotation, by its largest component."""
    trace = r[0][0] + r[1][1] + r[2][2]
    k = max(range(4), key=lambda i: trace if i == 0 else r[i - 1][i - 1])
    if k == 0:
        s = 2 * math.sqrt(1 + trace)
        return [s / 4, (r[2][1] - r[1][2]) / s, (r[0][2] - r[2][0]) / s, (r[1][0] - r[0][1]) / s]
    i, j, m = k - 1, k % 3, (k + 1) % 3
    s = 2 * math.sqrt(1 + r[i][i] - r[j][j] - r[m][m])
    out = [(r[m][j] - r[j][m]) / s, 0, 0, 0]
    out[1 + i], out[1 + j], out[1 + m] = s / 4, (r[j][i] + r[i][j]) / s, (r[m][i] + r[i][m]) / s
    return out


def photos(source, folder):
    """Photographs without labels, with a transforms.json and a COLMAP model of the same cameras."""
    poses = poses_of(source)
    shutil.copytree(os.path.join(source, "rgb"), os.path.join(folder, "images"))
    frames, images = [], ""
    for i, pose in enumerate(poses):
        frames.append({"file_path": f"images/rgb_{i}.png", "transform_matrix": [[x, -y, -z, t] for x, y, z, t in pose[:3]] + [pose[3]]})
        moved = inverse(pose)
        images += f"{i + 1} {' '.join(map(repr, quaternion(moved) + [row[3] for row in moved]))} 1 rgb_{i}.png\n\n"
    write(folder, "transforms.json", json.dumps({"camera_angle_x": math.pi / 2, "depth_unit_m": 0.001, "frames": frames}))
    write(folder, "sparse/0/cameras.txt", f"1 PINHOLE {WIDTH} {HEIGHT} {WIDTH / 2} {WIDTH / 2} {WIDTH / 2} {HEIGHT / 2}\n")
    write(folder, "sparse/0/images.txt", images)
    write(folder, "sparse/0/points3D.txt", "")


def scannet(source, folder):
    poses = poses_of(source)
    for old, new in (("rgb", "color"), ("depth", "depth"), ("semantic_class", "label-filt")):
        os.makedirs(os.path.join(folder, new))
        for i in range(len(poses)):
            shutil.copyfile(os.path.join(source, old, f"{old}_{i}.png"), os.path.join(folder, new, f"{i}.png"))
    for i, pose in enumerate(poses):
        write(folder, f"pose/{i}.txt", rows(pose))
    camera = [[WIDTH / 2, 0, (WIDTH - 1) / 2, 0], [0, WIDTH / 2, (HEIGHT - 1) / 2, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    for name in ("color", "depth"):
        write(folder, f"intrinsic/intrinsic_{name}.txt", rows(camera))
    table = "id\traw_category\tcategory\tnyu40id\teigen13id\tnyu40class\teigen13class\n"
    for i in range(1, 40):
        table += f"{i}\traw {i}\traw {i}\t{i}\t{1 + i % 13}\tclass {i}\tkind {1 + i % 13}\n"
    write(folder, "scannetv2-labels.combined.tsv", table)


def ball(folder, splits):
    """A red ball before white, seen from a ring of cameras, in Blender's form."""
    size, frames = 80, 12
    centre = (size - 1) / 2
    inside = [[(x - centre) ** 2 + (y - centre) ** 2 < 400 for x in range(size)] for y in range(size)]
    picture = [b"".join(bytes((200, 30 + y, 30)) if within else b"\xff\xff\xff" for within in inside[y]) for y in range(size)]
    for split in splits:
        listed = []
        os.makedirs(os.path.join(folder, split), exist_ok=True)
        for i in range(frames):
            a = 2 * math.pi * i / frames + (0.2 if split == "test" else 0)
            pose = [[-math.sin(a), 0, math.cos(a), 3 * math.cos(a)], [math.cos(a), 0, math.sin(a), 3 * math.sin(a)], [0, 1, 0, 0], [0, 0, 0, 1]]
            png(pathlib.Path(folder, split, f"r_{i}.png"), size, size, 2, 8, picture)
            listed.append({"file_path": f"{split}/r_{i}.png", "transform_matrix": pose})
        name = f"transforms_{split}.json" if len(splits) > 1 else "transforms.json"
        write(folder, name, json.dumps({"camera_angle_x": 0.7, "frames": listed}))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--program", required=True)
    parser.add_argument("folder")
    options = parser.parse_args()
    shutil.rmtree(options.folder, ignore_errors=True)
    room = os.path.join(options.folder, "room_0")
    settings = [f"scene.frames={FRAMES}", "scene.test_frames=4", f"scene.width_px={WIDTH}", f"scene.height_px={HEIGHT}", "scene.hfov_deg=90"]
    subprocess.run([options.program, "-q", "pack", os.path.join(REPOSITORY, "configs", "quickstart.yaml"), "--format", "replica", "--out", room] +
                   [word for setting in settings for word in ("--set", setting)], check=True)
    photos(room, os.path.join(options.folder, "my_photos"))
    scannet(room, os.path.join(options.folder, "scene0000_00"))
    os.symlink("room_0", os.path.join(options.folder, "replica_apartment0"))
    os.symlink(os.path.join(REPOSITORY, "scenes", "room"), os.path.join(options.folder, "obj_living_room"))
    ball(os.path.join(options.folder, "lego"), ("train", "test"))
    ball(os.path.join(options.folder, "garden"), ("train",))


if __name__ == "__main__":
    main()
