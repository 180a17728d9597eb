"""check_files.py FOLDER PROGRAM: compares what a program reads in the files of FOLDER with FOLDER/expected.json; 77: no such program."""
import ast
import json
import struct
import sys
import zipfile
from pathlib import Path

import other_programs

folder = Path(sys.argv[1])
want = json.loads((folder / "expected.json").read_text())
offset = want["offset"]


def check(ok, what):
    if not ok:
        sys.exit("hand over: " + what)


def near(found, meant, tolerance, what):
    check(len(found) == len(meant), f"{what}: {len(found)} values for {len(meant)}")
    for i, (a, b) in enumerate(zip(found, meant)):
        check(abs(a - b) <= tolerance, f"{what} {i}: {a} for {b}")


def axis(k, moved=False):
    return [p[k] - (offset[k] if moved else 0) for p in want["positions"]]


def color(k):
    return [c[k] for c in want["colors"]]


def header_of(path, end):
    head, mark, body = path.read_bytes().partition(end)
    check(mark, f"{path.name}: no end of the header")
    return head.decode("ascii").splitlines(), body


def rows_of(layout, body):
    check(len(body) == struct.calcsize(layout) * len(want["positions"]), "bytes of the points")
    return list(zip(*struct.iter_unpack(layout, body)))


def own_pcd():
    lines, body = header_of(folder / "points.pcd", b"DATA binary\n")
    said = {line.split()[0]: line.split()[1:] for line in lines if not line.startswith("#")}
    check(said["FIELDS"] == "x y z normal_x normal_y normal_z rgb label entropy instance".split(), "fields")
    check(said["SIZE"] == ["4"] * 10 and said["COUNT"] == ["1"] * 10 and said["TYPE"] == list("FFFFFFUUFU"), "types")
    check([float(w) for w in lines[0].split()[-3:]] == offset, "the offset is told")
    columns = rows_of("<6fIIfI", body)
    for k in range(3):
        near(columns[k], axis(k, True), 1e-4, "axis")
        near(columns[3 + k], [n[k] for n in want["normals"]], 1e-6, "normal")
        near([c >> (16 - 8 * k) & 255 for c in columns[6]], color(k), 0, "colour")
    near(columns[7], want["ids"], 0, "label")
    near(columns[9], want["instances"], 0, "instance")


def own_las():
    data = (folder / "points.las").read_bytes()
    check(data[:4] == b"LASF" and data[24:26] == b"\1\4" and data[104] == 7, "LAS 1.4, format 7")
    at, records = struct.unpack_from("<II", data, 96)
    stride = struct.unpack_from("<H", data, 105)[0]
    steps, middle = struct.unpack_from("<3d", data, 131), struct.unpack_from("<3d", data, 155)
    check(struct.unpack_from("<Q", data, 247)[0] == len(want["positions"]) and records == 2, "counts")
    rows = list(zip(*struct.iter_unpack("<3iHBBBBhHd3HHfI", data[at:])))
    check(stride == 46 and len(rows[0]) == len(want["positions"]), "points")
    for k in range(3):
        near([v * steps[k] + middle[k] for v in rows[k]], axis(k), 5.1e-5, "axis")
        near(rows[11 + k], [257 * c for c in color(k)], 0, "colour")
    near(rows[6], [min(i, 255) for i in want["ids"]], 0, "classification")
    near(rows[14], want["ids"], 0, "label")
    near(rows[16], want["instances"], 0, "instance")
    check(b"dining table" in data[:at], "names of classes")


def own_voxels():
    with zipfile.ZipFile(folder / "map.npz") as archive:
        arrays = {}
        for name in archive.namelist():
            data = archive.read(name)
            size = struct.unpack_from("<H", data, 8)[0]
            arrays[name[:-4]] = (ast.literal_eval(data[10 : 10 + size].decode("latin-1")), data[10 + size :])
    shape = tuple(want["cells"]["count"])
    head, body = arrays["occupancy"]
    check(head["shape"] == shape and head["descr"] == "|i1", "occupancy")
    check(list(struct.unpack(f"<{len(body)}b", body)) == want["cells"]["occupancy"], "states")
    head, body = arrays["class_id"]
    check(list(struct.unpack(f"<{len(body) // 4}i", body)) == want["cells"]["class_id"], "classes")
    check(struct.unpack("<d", arrays["edge"][1])[0] == want["cells"]["edge"], "edge")
    near(struct.unpack("<3d", arrays["origin"][1]), [f * want["cells"]["edge"] for f in want["cells"]["first"]], 1e-12, "origin")


def wanted_cells():
    count, first = want["cells"]["count"], want["cells"]["first"]
    states = iter(want["cells"]["occupancy"])
    keys = ((first[0] + x, first[1] + y, first[2] + z) for x in range(count[0]) for y in range(count[1]) for z in range(count[2]))
    return {key: int(state == 100) for key, state in zip(keys, states) if state >= 0}


def own_octomap():
    lines, body = header_of(folder / "map.bt", b"data\n")
    check(lines[0] == "# Octomap OcTree binary file" and "id OcTree" in lines, "header")
    found, at = {}, 0

    def walk(key, level):
        nonlocal at
        bits = struct.unpack_from("<H", body, at)[0]
        at += 2
        inner = []
        for i in range(8):
            child = tuple(key[k] | (i >> k & 1) << level for k in range(3))
            state = bits >> (2 * i) & 3
            if state == 3:
                inner.append(child)
            elif state:
                check(level == 0, "leaves lie at the lowest level")
                found[tuple(c - 32768 for c in child)] = state - 1
        for child in inner:
            walk(child, level - 1)

    walk((0, 0, 0), 15)
    check(at == len(body), "bytes behind the tree")
    check(found == wanted_cells(), "cells of the tree")


def own():
    own_pcd()
    own_las()
    own_voxels()
    own_octomap()


def cloudcompare():
    for name in ("points.ply", "mesh.ply"):
        found = other_programs.cloudcompare(folder / name)
        near(found["label"], want["ids"], 0, f"label of {name} in CloudCompare")
        near(found["instance"], want["instances"], 0, f"instance of {name} in CloudCompare")
        near(found["R"], color(0), 0, "red")
        near(found["X"], axis(0), 1e-3, "x")


def meshlab():
    for name in ("points.ply", "mesh.ply"):
        found = other_programs.meshlab(folder / name)
        near(found["quality"], want["ids"], 0, f"quality of {name} in MeshLab")
        near(found["red"], color(0), 0, "red")


def blender():
    for name in ("mesh.ply", "mesh.glb"):
        found = other_programs.blender(folder / name)
        check(found["faces"] == len(want["positions"]) - 2, f"faces of {name} in Blender")
        for place, rgb in zip(want["positions"], want["colors"]):  # of 32 bits, at 4,000 km
            near_by = [c for c in found["corners"] if all(abs(a - b) <= 0.25 for a, b in zip(c, place))]
            check(any(all(abs(255 * c[3 + k] - rgb[k]) <= 1 for k in range(3)) for c in near_by), f"{place} of {name} in Blender")


def open3d():
    found = other_programs.open3d(folder / "points.ply")
    near(found["label"], want["ids"], 0, "label in Open3D")
    near(found["instance"], want["instances"], 0, "instance in Open3D")


def pcl():
    found = other_programs.pcl(folder / "points.pcd")
    near(found["label"], want["ids"], 0, "label in PCL")
    near(found["x"], axis(0, True), 1e-4, "x in PCL")


def las():
    found = other_programs.las(folder / "points.las")
    for k in range(3):
        near(found["XYZ"[k]], axis(k), 5.1e-5, "axis in copc")
    near(found["label"], want["ids"], 0, "label in copc")
    near(found["instance"], want["instances"], 0, "instance in copc")
    near(found["Classification"], [min(i, 255) for i in want["ids"]], 0, "classification in copc")


def octomap():
    for name in ("map.bt", "map.ot"):
        check(other_programs.octomap(folder / name) == wanted_cells(), f"cells of {name} in OctoMap")


def gltf():
    issues = other_programs.gltf(folder / "mesh.glb")
    check(issues["numErrors"] == 0 and issues["numWarnings"] == 0, f"mesh.glb: {issues['messages']}")


try:
    globals()[sys.argv[2]]()
except other_programs.Absent as absent:
    print(absent)
    sys.exit(77)
