"""The scene of scripts/drill: the shipped room in two formats, what breaks in it, and pictures by the standard library."""
import json
import math
import os
import re
import shutil
import struct
import zlib


def unfiltered(kind, row, above, channels):
    """The row of a PNG before its filter: none, by the left, by the row above, by their mean, by Paeth's choice."""
    out = bytearray(row)
    for i, value in enumerate(row):
        left, up, corner = (out[i - channels], above[i], above[i - channels]) if i >= channels else (0, above[i], 0)
        nearest = min((left, up, corner), key=lambda v: abs(left + up - corner - v))
        out[i] = (value + (0, left, up, (left + up) // 2, nearest)[kind]) % 256
    return bytes(out)


def read_png(path, channels):
    """Width, height and bytes of an 8-bit PNG that is not interlaced, as Semfield writes images."""
    with open(path, "rb") as file:
        data = file.read()
    width, height = struct.unpack(">II", data[16:24])
    at, packed = 8, b""
    while at < len(data):
        length, kind = struct.unpack(">I4s", data[at:at + 8])
        if kind == b"IDAT":
            packed += data[at + 8:at + 8 + length]
        at += length + 12
    raw = zlib.decompress(packed)
    stride = width * channels + 1
    above, rows = bytes(stride - 1), []
    for y in range(height):
        above = unfiltered(raw[y * stride], raw[y * stride + 1:(y + 1) * stride], above, channels)
        rows.append(above)
    return width, height, b"".join(rows)


def read_gray(path):
    return read_png(path, 1)


def read_rgb(path):
    return read_png(path, 3)[2]


def turned(width, height, rgb):
    """The picture turned by a quarter clockwise: its width, height and bytes."""
    return height, width, b"".join(rgb[3 * (y * width + x):3 * (y * width + x) + 3]
                                   for x in range(width) for y in range(height - 1, -1, -1))


def write_tiff(path, width, height, rgb, orientation):
    """8-bit RGB in one strip, with an orientation as EXIF has it."""
    entries = [(256, 3, 1, width), (257, 3, 1, height), (258, 3, 3, 0), (259, 3, 1, 1), (262, 3, 1, 2), (273, 4, 1, 0),
               (274, 3, 1, orientation), (277, 3, 1, 3), (278, 3, 1, height), (279, 4, 1, len(rgb))]
    bits_at = 8 + 2 + 12 * len(entries) + 4
    places = {258: bits_at, 273: bits_at + 6}
    directory = b"".join(struct.pack("<HHII", tag, kind, count, places.get(tag, value)) for tag, kind, count, value in entries)
    with open(path, "wb") as file:
        file.write(struct.pack("<2sHIH", b"II", 42, 8, len(entries)) + directory + struct.pack("<I", 0) +
                   struct.pack("<3H", 8, 8, 8) + rgb)


def write_png(path, width, height, channels, pixels):
    """8 bits, 1 or 3 channels."""
    raw = b"".join(b"\0" + pixels[y * width * channels:(y + 1) * width * channels] for y in range(height))
    chunk = lambda kind, data: struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    with open(path, "wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n" +
                   chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0 if channels == 1 else 2, 0, 0, 0)) +
                   chunk(b"IDAT", zlib.compress(raw)) + chunk(b"IEND", b""))


def other_axes(pose):
    """OpenCV to OpenGL camera axes, and back."""
    return [[row[0], -row[1], -row[2], row[3]] for row in pose[:3]] + [pose[3]]


def inverse(pose):
    turned = [[pose[c][r] for c in range(3)] for r in range(3)]
    moved = [-sum(turned[r][c] * pose[c][3] for c in range(3)) for r in range(3)]
    return [turned[r] + [moved[r]] for r in range(3)] + [[0.0, 0.0, 0.0, 1.0]]


def scaled(pose, factor):
    return [row[:3] + [row[3] * factor] for row in pose[:3]] + [pose[3]]


def quaternion(pose):
    """x, y, z, w of a rotation, by its largest component [Shepperd 1978]."""
    r = pose
    candidates = [1 + r[0][0] - r[1][1] - r[2][2], 1 - r[0][0] + r[1][1] - r[2][2], 1 - r[0][0] - r[1][1] + r[2][2],
                  1 + r[0][0] + r[1][1] + r[2][2]]
    k = max(range(4), key=lambda i: candidates[i])
    s = 2 * math.sqrt(candidates[k])
    if k == 3:
        return [(r[2][1] - r[1][2]) / s, (r[0][2] - r[2][0]) / s, (r[1][0] - r[0][1]) / s, s / 4]
    i, j, l = k, (k + 1) % 3, (k + 2) % 3
    out = [0.0] * 4
    out[i], out[j], out[l] = s / 4, (r[j][i] + r[i][j]) / s, (r[l][i] + r[i][l]) / s
    out[3] = (r[l][j] - r[j][l]) / s
    return out


class Scene:
    """One format of the room in a folder of its own. Poses are OpenCV camera-to-world until they are written."""

    def __init__(self, source, folder, preset):
        self.folder, self.preset = folder, preset
        shutil.copytree(source, folder)
        with open(os.path.join(folder, "traj_w_c.txt")) as file:
            rows = [[float(word) for word in line.split()] for line in file]
        self.poses = [[row[4 * i:4 * i + 4] for i in range(4)] for row in rows]
        self.label_setting = ""

    @property
    def frames(self):
        return range(len(self.poses))

    def image(self, i):
        return os.path.join(self.folder, "rgb", f"rgb_{i}.png")

    def label(self, i):
        return os.path.join(self.folder, "semantic_class", f"semantic_class_{i}.png")

    def colors(self):
        with open(os.path.join(self.folder, "classes.yaml")) as file:
            return {int(i): bytes(int(v) for v in (r, g, b)) for i, r, g, b in
                    re.findall(r"id: (\d+),.*color: \[(\d+), (\d+), (\d+)\]", file.read())}

    def config(self):
        return self.folder + ".yaml"

    def write_config(self, kind, more=""):
        with open(self.config(), "w") as file:
            file.write(f"include: {json.dumps(self.preset)}\nscene:\n  type: {kind}\n  root: {json.dumps(self.folder)}\n{more}")


class Replica(Scene):
    kind = "replica"

    def write(self, poses=None, kept=None):
        poses = self.poses if poses is None else poses
        with open(os.path.join(self.folder, "traj_w_c.txt"), "w") as file:
            for pose in poses[:kept]:
                file.write(" ".join(repr(v) for row in pose for v in row) + "\n")
        for i in range(len(poses) if kept is None else kept, len(poses)):
            os.remove(self.image(i))
        self.write_config(self.kind, self.label_setting)

    def write_quaternions(self):
        self.write()
        with open(os.path.join(self.folder, "traj_w_c.txt"), "w") as file:
            for pose in self.poses:
                file.write(" ".join(repr(v) for v in [row[3] for row in pose[:3]] + quaternion(pose)) + "\n")

    def misname_key(self):
        self.label_setting = "  lable_dir: semantic_class\n"
        self.write()

    def rename_key(self, wrong, right):
        self.label_setting = self.label_setting.replace(wrong, right)
        self.write()

    in_own_axes = staticmethod(lambda pose: pose)


class TransformsJson(Scene):
    kind = "transforms_json"
    label_key = "label_path"
    image_ending = ".png"
    intrinsics = {"camera_angle_x": math.pi / 2}

    def file_of(self, i):
        return os.path.splitext(self.image(i))[0] + self.image_ending

    in_own_axes = staticmethod(other_axes)

    def write(self, poses=None, kept=None, without_matrix=False):
        """`poses` in the format's own OpenGL axes."""
        poses = [other_axes(pose) for pose in self.poses] if poses is None else poses
        frames = []
        for i, pose in enumerate(poses[:kept]):
            frame = {"file_path": f"rgb/rgb_{i}{self.image_ending}", "depth_path": f"depth/depth_{i}.png",
                     self.label_key: f"semantic_class/semantic_class_{i}.png"}
            if without_matrix:
                x, y, z, w = quaternion(pose)
                frame.update(translation=[row[3] for row in pose[:3]], rotation=[w, x, y, z])
            else:
                frame["transform_matrix"] = pose
            frames.append(frame)
        with open(os.path.join(self.folder, "transforms.json"), "w") as file:
            json.dump({**self.intrinsics, "depth_unit_m": 0.001, "frames": frames}, file, indent=1)
        self.write_config(self.kind)

    def write_quaternions(self):
        self.write(without_matrix=True)

    def misname_key(self):
        self.label_key = "label"
        self.write()

    def rename_key(self, wrong, right):
        raise AssertionError("the remedy is a setting")
