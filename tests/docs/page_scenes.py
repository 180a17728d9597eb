"""Small scenes for the commands of pages: page_scenes.py --program FILE FOLDER. The shipped room as the folders that pages name, and an object."""
import argparse
import json
import math
import os
import shutil
import subprocess
import sys

sys.dont_write_bytecode = True
REPOSITORY = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
sys.path.insert(0, os.path.join(REPOSITORY, "scripts"))
from drill_scene import Replica, TransformsJson, inverse, quaternion, write_png  # noqa: E402

FRAMES, WIDTH, HEIGHT = 16, 80, 60


def write(folder, name, text):
    path = os.path.join(folder, name)
    os.makedirs(os.path.dirname(path), exist_ok=True)
    with open(path, "w", encoding="utf-8") as file:
        file.write(text)


def rows(pose):
    return "".join(" ".join(repr(v) for v in row) + "\n" for row in pose)


def photos(source, folder):
    """Photographs without labels, with a transforms.json and a COLMAP model of the same cameras; and labels beside, not named."""
    scene = TransformsJson(source, folder, "none")
    scene.write()
    path = os.path.join(folder, "transforms.json")
    with open(path) as file:
        index = json.load(file)
    index["frames"] = [{key: frame[key] for key in ("file_path", "transform_matrix")} for frame in index["frames"]]
    write(folder, "transforms.json", json.dumps(index))
    for name in ("depth", "semantic_class", "classes.yaml", "traj_w_c.txt"):
        path = os.path.join(folder, name)
        shutil.rmtree(path) if os.path.isdir(path) else os.remove(path)
    os.rename(os.path.join(folder, "rgb"), os.path.join(folder, "images"))
    write(folder, "transforms.json", json.dumps(index).replace("rgb/", "images/"))
    images = ""
    for i in scene.frames:
        q, moved = quaternion(inverse(scene.poses[i])), inverse(scene.poses[i])
        images += f"{i + 1} {q[3]} {q[0]} {q[1]} {q[2]} {moved[0][3]} {moved[1][3]} {moved[2][3]} 1 rgb_{i}.png\n\n"
    write(folder, "sparse/0/cameras.txt", f"1 PINHOLE {WIDTH} {HEIGHT} {WIDTH / 2} {WIDTH / 2} {WIDTH / 2} {HEIGHT / 2}\n")
    write(folder, "sparse/0/images.txt", images)
    write(folder, "sparse/0/points3D.txt", "")


def scannet(source, folder):
    scene = Replica(source, folder, "none")
    for old, new in (("rgb", "color"), ("depth", "depth"), ("semantic_class", "label-filt")):
        for i in scene.frames:
            os.renames(os.path.join(folder, old, f"{old}_{i}.png"), os.path.join(folder, new, f"{i}.png"))
    for i in scene.frames:
        write(folder, f"pose/{i}.txt", rows(scene.poses[i]))
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
    pixels = b"".join(bytes((200, 30 + y, 30)) if inside[y][x] else b"\xff\xff\xff" for y in range(size) for x in range(size))
    for split in splits:
        listed = []
        os.makedirs(os.path.join(folder, split), exist_ok=True)
        for i in range(frames):
            a = 2 * math.pi * i / frames + (0.2 if split == "test" else 0)
            pose = [[-math.sin(a), 0, math.cos(a), 3 * math.cos(a)], [math.cos(a), 0, math.sin(a), 3 * math.sin(a)], [0, 1, 0, 0], [0, 0, 0, 1]]
            write_png(os.path.join(folder, split, f"r_{i}.png"), size, size, 3, pixels)
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
    subprocess.run([options.program, "-q", "capture", os.path.join(REPOSITORY, "configs", "quickstart.yaml"), "--out", room] +
                   [word for setting in settings for word in ("--set", setting)], check=True)
    photos(room, os.path.join(options.folder, "my_photos"))
    scannet(room, os.path.join(options.folder, "scene0000_00"))
    os.remove(os.path.join(options.folder, "my_photos.yaml"))
    os.symlink("room_0", os.path.join(options.folder, "replica_apartment0"))
    os.symlink(os.path.join(REPOSITORY, "scenes", "room"), os.path.join(options.folder, "obj_living_room"))
    ball(os.path.join(options.folder, "lego"), ("train", "test"))
    ball(os.path.join(options.folder, "garden"), ("train",))


if __name__ == "__main__":
    main()
