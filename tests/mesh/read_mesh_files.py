"""Reads mesh files with nothing but the standard library, and compares them with expected.json; any difference ends it."""
import json
import struct
import sys
from pathlib import Path

sys.path.insert(1, str(Path(__file__).resolve().parents[1] / "handover"))
import ply  # noqa: E402

folder = sys.argv[1]
with open(folder + "/expected.json") as file:
    want = json.load(file)


def check(ok, what):
    if not ok:
        sys.exit("mesh file: " + what)


def near(a, b, tolerance):
    return len(a) == len(b) and all(abs(x - y) <= tolerance for x, y in zip(a, b))


def float32(value):
    return struct.unpack("<f", struct.pack("<f", value))[0]


def turned(quaternion, v):
    """v turned by x, y, z, w, as glTF has them."""
    *u, w = quaternion
    check(abs(sum(c * c for c in quaternion) - 1) < 1e-12, "unit quaternion")
    cross = lambda a, b: [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    t = [2 * c for c in cross(u, v)]
    return [a + w * b + c for a, b, c in zip(v, t, cross(u, t))]


def rows_of(columns):
    return [dict(zip(columns, row)) for row in zip(*columns.values())]


def check_vertices(rows, normals):
    check(len(rows) == len(want["positions"]), "number of vertices")
    for i, row in enumerate(rows):
        check([row["x"], row["y"], row["z"]] == want["positions"][i], "position %d, all 64 bits" % i)
        check([row["red"], row["green"], row["blue"]] == want["colors"][i], "colour %d" % i)
        check(("nx" in row) == normals, "normals")
        if normals:
            check(near([row["nx"], row["ny"], row["nz"]], want["normals"][i], 1e-6), "normal %d" % i)
        check(("label" in row) == bool(want["ids"]), "label property")
        if want["ids"]:
            check(row["label"] == want["ids"][i], "label %d: %r" % (i, row["label"]))
            check(row["scalar_label"] == want["ids"][i], "scalar_label %d: %r" % (i, row["scalar_label"]))
            check(row["quality"] == want["ids"][i], "quality %d: %r" % (i, row["quality"]))
            check(row["entropy"] == float32(want["entropy"][i]), "entropy %d" % i)
        check(("instance" in row) == bool(want["instances"]), "instance property")
        if want["instances"]:
            check(row["instance"] == row["scalar_instance"] == want["instances"][i], "instance %d" % i)


def check_ply():
    mesh = ply.read(folder + "/mesh.ply")
    check_vertices(rows_of(mesh["vertex"]), True)
    check(mesh["face"]["vertex_indices"] == want["triangles"], "faces")
    points = ply.read(folder + "/points.ply")
    check(list(points) == ["vertex"], "a point cloud has vertices only")
    check_vertices(rows_of(points["vertex"]), False)


def check_obj():
    materials, name = {}, None
    with open(folder + "/mesh.mtl") as file:
        for line in file:
            words = line.split()
            if words[:1] == ["newmtl"]:
                check(len(words) == 2, "a material's name is one word: " + line)
                name = words[1]
                check(name not in materials, "material %s twice" % name)
            elif words[:1] == ["Kd"]:
                materials[name] = [float(w) for w in words[1:]]
    positions, normals, faces, used, library = [], [], {}, None, None
    with open(folder + "/mesh.obj") as file:
        for line in file:
            words = line.split()
            if words[:1] == ["v"]:
                positions.append([float(w) for w in words[1:]])
            elif words[:1] == ["vn"]:
                normals.append([float(w) for w in words[1:]])
            elif words[:1] == ["mtllib"]:
                library = words[1]
            elif words[:1] == ["usemtl"]:
                used = words[1]
                check(used in materials, "material %s is not in the MTL file" % used)
            elif words[:1] == ["f"]:
                corners = [w.split("/") for w in words[1:]]
                check(all(c[0] == c[2] for c in corners), "normals are numbered as vertices")
                faces.setdefault(used, []).append([int(c[0]) - 1 for c in corners])
    check(library == "mesh.mtl", "mtllib names the file beside it")
    check(near([c for p in positions for c in p[:3]], [c for p in want["positions"] for c in p], 1e-6), "positions")
    check(near([c for p in positions for c in p[3:]], [c / 255 for p in want["colors"] for c in p], 1e-4), "colours")
    check(near([c for n in normals for c in n], [c for n in want["normals"] for c in n], 1e-5), "normals")
    check(sorted(faces) == sorted(g["name"] for g in want["groups"]), "materials in use: %r" % sorted(faces))
    for group in want["groups"]:
        check(faces[group["name"]] == group["triangles"], "faces of " + group["name"])
        check(near(materials[group["name"]], group["linear"], 1e-5), "Kd of " + group["name"])


def check_glb():
    with open(folder + "/mesh.glb", "rb") as file:
        data = file.read()
    magic, version, total = struct.unpack_from("<4sII", data)
    check(magic == b"glTF" and version == 2 and total == len(data), "GLB header")
    size, kind = struct.unpack_from("<I4s", data, 12)
    check(kind == b"JSON" and size % 4 == 0, "JSON chunk")
    root = json.loads(data[20 : 20 + size])
    binary_at = 20 + size
    binary_size, kind = struct.unpack_from("<I4s", data, binary_at)
    binary = data[binary_at + 8 :]
    check(kind == b"BIN\0" and binary_size % 4 == 0 and binary_size == len(binary), "binary chunk")
    check(root["asset"]["version"] == "2.0", "version")
    check([b["byteLength"] for b in root["buffers"]] == [len(binary)], "byteLength of the buffer")
    views = sorted(root["bufferViews"], key=lambda v: v["byteOffset"])
    at = 0
    for view in views:
        check(view["byteOffset"] == at and at % 4 == 0, "views lie side by side, aligned")
        at += view["byteLength"]
    check(at == len(binary), "views fill the buffer")

    def read(number):
        accessor = root["accessors"][number]
        view = root["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        letter = {5123: "H", 5125: "I", 5126: "f"}[accessor["componentType"]]
        packed = struct.calcsize("<%d%s" % (width, letter))
        stride = view.get("byteStride", packed)
        check(stride % 4 == 0 and stride >= packed or "byteStride" not in view, "stride")
        first = accessor.get("byteOffset", 0)
        check(first % 4 == 0 and first + stride * (accessor["count"] - 1) + packed <= view["byteLength"], "accessor inside its view")
        rows = [
            list(struct.unpack_from("<%d%s" % (width, letter), binary, view["byteOffset"] + first + i * stride))
            for i in range(accessor["count"])
        ]
        return accessor, view, rows

    node = root["nodes"][root["scenes"][root["scene"]]["nodes"][0]]
    nodes = [node] + [root["nodes"][child] for child in node.get("children", [])]
    check(len(nodes) == len(root["nodes"]), "every object hangs on the root")
    primitives = []
    for one in nodes:
        mesh = root["meshes"][one["mesh"]]
        check(mesh["name"] == one["name"], "a mesh has its node's name")
        object_id = one.get("extras", {}).get("object_id", 0)
        check(one is node or one["name"] == want["objects"][str(object_id)], "name of a node: " + one["name"])
        primitives += [(object_id, primitive) for primitive in mesh["primitives"]]
    check(not {"matrix", "scale", "translation"} & set(node), "the node turns and does nothing else")
    check(near(turned(node["rotation"], want["up"]), [0, 1, 0], 1e-7), "up is shown as +y")
    check(near(root["asset"]["extras"]["up"], want["up"], 1e-15), "up is told")
    check(root.get("extensionsUsed", []) == (["KHR_materials_unlit"] if want["unlit"] else []), "extensions")
    check(root["asset"]["extras"]["offset"] == [0, 0, 0], "coordinates of 32 bits are exact enough")
    check(len(primitives) == len(want["primitives"]), "a primitive per object and class")
    check(len(root["materials"]) == len(want["groups"]), "a material per class")
    counted = 0
    for (object_id, primitive), group in zip(primitives, want["primitives"]):
        check(object_id == group["object"], "the object of a primitive")
        # Vertices of a class in the order in which its triangles first use them, and no others.
        own = list(dict.fromkeys(v for triangle in group["triangles"] for v in triangle))
        attributes = primitive["attributes"]
        accessor, view, positions = read(attributes["POSITION"])
        check(positions == [[float32(c) for c in want["positions"][v]] for v in own], "positions as 32-bit floats")
        counted += accessor["count"]
        check(accessor["min"] == [min(p[k] for p in positions) for k in range(3)], "min")
        check(accessor["max"] == [max(p[k] for p in positions) for k in range(3)], "max")
        check(view["target"] == 34962 and accessor["componentType"] == 5126, "POSITION")
        normals = read(attributes["NORMAL"])[2]
        check(all(near(n, want["normals"][v], 1e-5) for n, v in zip(normals, own)), "normals")
        accessor, view, colors = read(attributes["COLOR_0"])
        check(accessor["normalized"] is True, "COLOR_0 is normalised")
        for color, v in zip(colors, own):
            check(near([c / 65535 for c in color], want["linear_colors"][v] + [1], 1e-5), "COLOR_0 in linear light")
        check(("_LABEL" in attributes) == bool(want["ids"]), "_LABEL")
        if want["ids"]:
            check([r[0] for r in read(attributes["_LABEL"])[2]] == [want["ids"][v] for v in own], "_LABEL")
            entropy = [float32(want["entropy"][v]) for v in own]
            check([r[0] for r in read(attributes["_ENTROPY"])[2]] == entropy, "_ENTROPY")
        accessor, view, indices = read(primitive["indices"])
        indices = [own[i[0]] for i in indices]
        check(view["target"] == 34963 and "byteStride" not in view, "indices")
        check(primitive["mode"] == 4, "mode")
        check([indices[i : i + 3] for i in range(0, len(indices), 3)] == group["triangles"], "triangles of a class")
        material = root["materials"][primitive["material"]]
        check(material["name"] == group["name"], "material " + material["name"])
        check(material["doubleSided"] is False, "a room seen from outside is open")
        check(("KHR_materials_unlit" in material.get("extensions", {})) == want["unlit"], "unlit")
        if group["id"] >= 0:
            check(material["extras"]["class_id"] == group["id"], "class_id")
    check(counted < 3 * len(want["positions"]), "%d vertices for %d" % (counted, len(want["positions"])))


check_ply()
check_obj()
check_glb()
print("read")
