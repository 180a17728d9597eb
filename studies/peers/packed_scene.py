"""Reads a packed scene (`semfield pack`) into arrays: what peers train on."""
import struct
import zlib

import numpy as np

COLOR, ALPHA = 0, 5
DEFLATED = 1
TRAIN, TEST = 0, 1


class Manifest:
    """Numbers and texts one after the other, little-endian, as framework/loading/packed_scene.cpp writes them."""

    def __init__(self, data):
        self.data, self.at = data, 0

    def take(self, form):
        values = struct.unpack_from("<" + form, self.data, self.at)
        self.at += struct.calcsize("<" + form)
        return values if len(values) > 1 else values[0]

    def text(self):
        size = self.take("I")
        self.at += size
        return self.data[self.at - size:self.at].decode()


class Frame:
    """Camera and chunks of one photograph; pose [3, 4] takes OpenCV's camera axes to the world."""

    def __init__(self, manifest, version):
        self.name, _ = manifest.text(), manifest.text()
        self.width, self.height = manifest.take("ii")
        self.fx, self.fy, self.cx, self.cy = manifest.take("4d")
        if any(manifest.take("6d")):
            raise ValueError(f"frame '{self.name}' has a lens with distortion: undistort the scene first")
        if version > 1 and manifest.take("B") != 0:
            raise ValueError(f"frame '{self.name}' is a fisheye or a panorama: peers read pinholes")
        if version > 2:
            manifest.take("B")  # how viewers turn the photograph; camera, pixels and labels are as stored
        rotation = np.array(manifest.take("9d")).reshape(3, 3)
        self.pose = np.concatenate([rotation, np.array(manifest.take("3d")).reshape(3, 1)], 1)
        self.split = manifest.take("B")
        self.chunks = [manifest.take("QQQII") for _ in range(6 if version > 1 else 4)]


class PackedScene:
    """frames, and bounds [2, 3] in metres."""

    def __init__(self, path):
        with open(path, "rb") as file:
            self.data = file.read()
        magic, version, _, _, offset, size = struct.unpack_from("<8sIIQQQ", self.data)
        if magic != b"SEMFPACK" or version not in (1, 2, 3):
            raise ValueError(f"{path} is not a packed scene of version 1 to 3: write it with `semfield pack`")
        manifest = Manifest(self.data[offset:offset + size])
        manifest.text()
        manifest.take("Bdd")
        self.bounds = np.array(manifest.take("6d")).reshape(2, 3)
        for _ in range(manifest.take("I")):  # classes
            manifest.take("i")
            manifest.text()
            manifest.take("3BB")
        self.frames = [Frame(manifest, version) for _ in range(manifest.take("I"))]

    def of(self, split):
        return [frame for frame in self.frames if frame.split == split]

    def chunk(self, frame, channel):
        offset, stored, raw, _, form = frame.chunks[channel] if channel < len(frame.chunks) else (0, 0, 0, 0, 0)
        data = self.data[offset:offset + stored]
        return np.frombuffer(zlib.decompress(data) if raw and form & DEFLATED else data, np.uint8)

    def pixels(self, frame):
        """uint8 [height, width, 4]: colour before the scene's background, and alpha, 255 where there is none."""
        color = self.chunk(frame, COLOR).reshape(frame.height, frame.width, 3)
        alpha = self.chunk(frame, ALPHA)
        alpha = alpha.reshape(frame.height, frame.width, 1) if alpha.size else np.full_like(color[:, :, :1], 255)
        return np.concatenate([color, alpha], 2)
