"""What programs that nobody here wrote read in files of `semfield mesh`.

Each function gives columns by name, lists of equal length, or raises Absent with what is missing and how it is installed.
"""
import json
import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import ply

REPOSITORY = Path(__file__).resolve().parents[2]
NODE_MODULES = Path(os.environ.get("SEMFIELD_NODE_MODULES", REPOSITORY / "build" / "hand_over" / "node_modules"))
SYSTEM_PYTHON = "/usr/bin/python3"  # Debian's packages are for this one


class Absent(Exception):
    """A program that is not on this machine."""


def need(program, package):
    found = shutil.which(program)
    if not found:
        raise Absent(f"no {program} here: apt-get install {package}")
    return found


def run(words, **more):
    environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen", "LC_ALL": "C"}
    done = subprocess.run([str(w) for w in words], capture_output=True, text=True, env=environment, check=False, timeout=300, **more)
    if done.returncode != 0:
        raise RuntimeError(f"{words[0]} ended with {done.returncode}: {done.stderr[-800:] or done.stdout[-800:]}")
    return done.stdout


def columns_of(rows, names):
    return {name: [float(row[i]) for row in rows] for i, name in enumerate(names)}


def cloudcompare(path):
    """Columns X, Y, Z, R, G, B and the scalar fields, as CloudCompare names them when it saves what it loaded."""
    program = need("CloudCompare", "cloudcompare")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.asc"
        mesh = b"element face" in Path(path).read_bytes()[:2000]
        words = [program, "-SILENT", "-AUTO_SAVE", "OFF", "-C_EXPORT_FMT", "ASC", "-ADD_HEADER", "-PREC", "9", "-O", "-GLOBAL_SHIFT", "AUTO", path]
        run(words + (["-EXTRACT_VERTICES"] if mesh else []) + ["-SAVE_CLOUDS", "FILE", out], cwd=folder)
        lines = out.read_text().splitlines()
    return columns_of([line.split() for line in lines[1:]], lines[0].lstrip("/").split())


def meshlab(path):
    """Columns of a PLY that MeshLab wrote of what it loaded: x, y, z, colours and `quality`, its field per vertex."""
    program = need("meshlabserver", "meshlab")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.ply"
        words = [program, "-i", path, "-o", out, "-m", "vc", "vq", "vn"]
        if shutil.which("xvfb-run"):  # it draws nothing, and asks for a display
            words = ["xvfb-run", "-a", *words]
        run(words, cwd=folder)
        return ply.read(out)["vertex"]


def open3d(path):
    """Columns x, y, z and every attribute with one value per point that Open3D loaded."""
    script = """
import json, sys
import open3d as o3d
cloud = o3d.t.io.read_point_cloud(sys.argv[1])
out = {}
for name in cloud.point:
    values = cloud.point[name].numpy()
    if values.shape[1] == 1: out[name] = [float(v) for v in values[:, 0]]
    else:
        for k in range(values.shape[1]): out[f"{name}_{k}"] = [float(v) for v in values[:, k]]
print("\\n" + json.dumps(out))
"""
    if subprocess.run([SYSTEM_PYTHON, "-c", "import open3d"], capture_output=True, check=False).returncode != 0:
        raise Absent("no Open3D here: apt-get install python3-open3d")
    return json.loads(run([SYSTEM_PYTHON, "-c", script, path]).splitlines()[-1])


def pcl(path):
    """Columns of a PCD as the Point Cloud Library writes it as text again."""
    program = need("pcl_convert_pcd_ascii_binary", "pcl-tools")
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.pcd"
        run([program, path, out, "0", "9"])
        head, _, body = out.read_text().partition("DATA ascii\n")
    names = next(line.split()[1:] for line in head.splitlines() if line.startswith("FIELDS"))
    return columns_of([line.split() for line in body.splitlines()], names)


BLENDER = """
import bpy, json, numpy, sys
numpy.bool = bool  # which Blender 3.4 expects, and NumPy 1.24 next to it in Debian 12 has not
for one in list(bpy.data.objects): bpy.data.objects.remove(one)
path = sys.argv[-1]
if path.endswith(".glb"): bpy.ops.import_scene.gltf(filepath=path)
elif bpy.app.version >= (3, 6): bpy.ops.wm.ply_import(filepath=path)
else: bpy.ops.import_mesh.ply(filepath=path)
corners, faces = [], 0
for one in [o for o in bpy.data.objects if o.type == "MESH"]:
    mesh, colors = one.data, one.data.color_attributes[0]
    faces += len(mesh.polygons)
    for k, loop in enumerate(mesh.loops):
        color = colors.data[k if colors.domain == "CORNER" else loop.vertex_index].color_srgb
        corners.append([*(one.matrix_world @ mesh.vertices[loop.vertex_index].co), *color])
print("\\n" + json.dumps({"corners": corners, "faces": faces}))
"""


def blender(path):
    """What Blender imports: corners of its faces as x, y, z, r, g, b, a with colours of 0 to 1, and how many faces."""
    program = need("blender", "blender")
    # Its Python is that of the first python3 on the path.
    out = run(["env", "PATH=/usr/bin", program, "--background", "--factory-startup", "--python-exit-code", "1", "--python-expr",
               BLENDER, "--", path])
    return next(json.loads(line) for line in out.splitlines() if line.startswith('{"corners"'))


def node(script, path, module):
    program = need("node", "nodejs")
    if not (NODE_MODULES / module).is_dir():
        raise Absent(f"no npm package {module} here: scripts/release_check hand_over installs it")
    return json.loads(run([program, "-e", script, path], cwd=NODE_MODULES.parent))


def las(path):
    """Columns X, Y, Z, Classification, Red and extra bytes, by the npm package copc."""
    return node("""
const {Las} = require('copc'), fs = require('fs');
const bytes = fs.readFileSync(process.argv[1]), header = Las.Header.parse(bytes);
const get = async (begin, end) => bytes.subarray(begin, end);
(async () => {
  const vlrs = await Las.Vlr.walk(get, header);
  const extra = vlrs.find(v => v.userId === 'LASF_Spec' && v.recordId === 4);
  const fields = extra ? Las.ExtraBytes.parse(await Las.Vlr.fetch(get, extra)) : [];
  const points = bytes.subarray(header.pointDataOffset, header.pointDataOffset + header.pointCount * header.pointDataRecordLength);
  const view = Las.View.create(points, header, fields), out = {};
  for (const name of Object.keys(view.dimensions)) {
    const value = view.getter(name);
    out[name] = Array.from({length: header.pointCount}, (_, i) => value(i));
  }
  console.log(JSON.stringify(out));
})();
""", path, "copc")


def gltf(path):
    """The Khronos validator's issues: numErrors, numWarnings, messages."""
    return node("""
const validator = require('gltf-validator'), fs = require('fs');
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])), {maxIssues: 20}).then(r => console.log(JSON.stringify(r.issues)));
""", path, "gltf-validator")


OCTOMAP = r"""
#include <octomap/ColorOcTree.h>
#include <octomap/octomap.h>
#include <cstdio>
#include <memory>
#include <string>
template <class Tree> void print(Tree& tree) {
  tree.expand();
  for (auto it = tree.begin_leafs(); it != tree.end_leafs(); ++it) {
    const auto key = it.getKey();
    std::printf("%d %d %d %d\n", key[0] - 32768, key[1] - 32768, key[2] - 32768, tree.isNodeOccupied(*it) ? 1 : 0);
  }
}
int main(int, char** words) {
  const std::string path = words[1];
  if (path.ends_with(".bt")) {
    octomap::OcTree tree(0.1);
    if (!tree.readBinary(path)) return 1;
    print(tree);
    return 0;
  }
  std::unique_ptr<octomap::AbstractOcTree> any(octomap::AbstractOcTree::read(path));
  auto* tree = dynamic_cast<octomap::ColorOcTree*>(any.get());
  if (tree == nullptr) return 1;
  print(*tree);
  return 0;
}
"""


def octomap(path):
    """State by the key of a cube, counted from 0: {(x, y, z): occupied}."""
    compiler = need("g++", "g++")
    if not Path("/usr/include/octomap/octomap.h").exists():
        raise Absent("no OctoMap here: apt-get install liboctomap-dev")
    with tempfile.TemporaryDirectory() as folder:
        source, program = Path(folder) / "read.cpp", Path(folder) / "read"
        source.write_text(OCTOMAP)
        run([compiler, "-std=c++20", source, "-o", program, "-loctomap", "-loctomath"])
        rows = [tuple(map(int, line.split())) for line in run([program, path]).splitlines()]
    return {row[:3]: row[3] for row in rows}
