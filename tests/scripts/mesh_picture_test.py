"""scripts/release_check mesh_picture on a box of a floor, a wall and a ceiling: what it draws, in which colours, and what it leaves out."""
import os
import struct
import subprocess
import sys
import tempfile

HEADER = """ply
format binary_little_endian 1.0
element vertex {vertices}
property double x
property double y
property double z
property float nx
property float ny
property float nz
property uchar red
property uchar green
property uchar blue
property int label
property float entropy
element face {faces}
property list uchar uint vertex_indices
end_header
"""


def square(corners, normal, color, label):
    return [struct.pack("<dddfffBBBif", *corner, *normal, *color, label, 0.0) for corner in corners]


def pixels(path):
    """Rows of the RGB pixels of a PNG."""
    with open(path, "rb") as file:
        width, height = struct.unpack(">II", file.read(24)[16:])
    raw = subprocess.run(["ffmpeg", "-v", "error", "-i", path, "-f", "rawvideo", "-pix_fmt", "rgb24", "-"],
                         capture_output=True, check=True).stdout
    return [[tuple(raw[3 * (y * width + x):][:3]) for x in range(width)] for y in range(height)]


def draw(script, *words):
    size = ("--view", "270", "40", "--size", "60", "40")
    return subprocess.run([script, "mesh_picture", *words, *size], capture_output=True, text=True)


def main(script):
    vertices = square([(0, 4, 3), (4, 4, 3), (4, 0, 3), (0, 0, 3)], (0, 0, -1), (20, 200, 20), 2)  # ceiling
    vertices += square([(0, 4, 0), (4, 4, 0), (4, 4, 2), (0, 4, 2)], (0, -1, 0), (20, 20, 200), 3)  # far wall
    cells = 8  # the near part of the floor is cut off, so it has many faces
    grid = [(4 * i / cells, 4 * j / cells, 0) for j in range(cells + 1) for i in range(cells + 1)]
    first = len(vertices)
    vertices += square(grid, (0, 0, 1), (200, 20, 20), 1)
    faces = [(0, 1, 2), (0, 2, 3), (4, 5, 6), (4, 6, 7)]
    for j in range(cells):
        for i in range(cells):
            a = first + j * (cells + 1) + i
            faces += [(a, a + 1, a + cells + 2), (a, a + cells + 2, a + cells + 1)]
    with tempfile.TemporaryDirectory() as folder:
        mesh, classes, out = (os.path.join(folder, name) for name in ("mesh.ply", "classes.yaml", "out.png"))
        with open(mesh, "wb") as file:
            file.write(HEADER.format(vertices=len(vertices), faces=len(faces)).encode() + b"".join(vertices) +
                       b"".join(struct.pack("<BIII", 3, *face) for face in faces))
        with open(classes, "w") as file:
            file.write("- {id: 1, name: floor, color: [250, 250, 0]}\n- {id: 2, name: ceiling, color: [0, 250, 250]}\n")
        draw(script, mesh, out, "--classes", classes).check_returncode()
        rows = pixels(out)
        alone = os.path.join(folder, "alone.png")
        draw(script, mesh, alone).check_returncode()
        left = pixels(alone)
        # By object: half of the floor is one, the other half is none.
        without = draw(script, mesh, alone, "--objects")
        whole = struct.Struct("<dddfffBBBif")
        numbered = [vertex + struct.pack("<i", 1 if whole.unpack(vertex)[0] < 2 else 0) for vertex in vertices]
        with open(mesh, "wb") as file:
            header = HEADER.replace("property float entropy\n", "property float entropy\nproperty int instance\n")
            file.write(header.format(vertices=len(vertices), faces=len(faces)).encode() + b"".join(numbered) +
                       b"".join(struct.pack("<BIII", 3, *face) for face in faces))
        draw(script, mesh, alone, "--objects").check_returncode()
        by_object = [row[60:] for row in pixels(alone)]
        draw(script, mesh, alone, "--classes", classes, "--objects").check_returncode()
        assert [row[120:] for row in pixels(alone)] == by_object, "behind the panel of the classes"
        # The same room in a world whose y points down, without classes.
        down = struct.Struct("<dddfffBBBif")
        turned = [down.pack(x, -z, y, nx, -nz, ny, *rest) for x, y, z, nx, ny, nz, *rest in map(down.unpack, vertices)]
        header = HEADER.replace("property int label\nproperty float entropy\n", "")
        with open(mesh, "wb") as file:
            file.write(header.format(vertices=len(turned), faces=len(faces)).encode() + b"".join(v[:-8] for v in turned) +
                       b"".join(struct.pack("<BIII", 3, *face) for face in faces))
        draw(script, mesh, alone, "--classes", classes, "--up=-y").check_returncode()
        y_down = pixels(alone)
        axis = draw(script, mesh, alone, "--up", "w")
        refused = draw(script, classes, out)
    assert (len(rows[0]), len(rows)) == (120, 40), "two panels side by side"
    assert left == [row[:60] for row in rows], "without classes there is the left panel alone"
    assert y_down == left, "the world's -y is upright"
    assert axis.returncode == 2 and "--up" in axis.stderr, axis.stderr
    photo = {pixel for row in rows for pixel in row[:60]}
    by_class = {pixel for row in rows for pixel in row[60:]}
    near = lambda color, colors: any(all(abs(a - b) <= 4 for a, b in zip(color, other)) for other in colors)
    assert near((200, 20, 20), photo), "the floor has its own colour on the left"
    assert not near((20, 200, 20), photo), "the ceiling is left out"
    assert any(r > 150 and g > 150 and b < 10 for r, g, b in by_class), "the floor has its class's colour on the right"
    assert not any(r < 10 and g > 150 and b > 150 for r, g, b in by_class), "nor does its class show"
    assert without.returncode == 1 and "semfield objects" in without.stderr, without.stderr
    grey = lambda pixel: max(pixel) - min(pixel) < 8 and 120 < pixel[0] < 230
    seen = {pixel for row in by_object for pixel in row}
    assert any(map(grey, seen)), "half of the floor is no object"
    assert any(max(pixel) - min(pixel) > 100 for pixel in seen), "half of it is one"
    assert refused.returncode != 0 and "PLY" in refused.stderr and "Traceback" not in refused.stderr, refused.stderr


main(sys.argv[1])
