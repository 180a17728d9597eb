// PLY and OBJ.
#include "surface/mesh/mesh_files.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <filesystem>

#include "surface/mesh/buffered_file.h"
#include "surface/mesh/class_groups.h"

namespace semfield {

namespace {

std::string ply_header(std::size_t vertices, std::size_t faces, bool normals, const PointAttributes& attributes) {
  std::string header = "ply\nformat binary_little_endian 1.0\ncomment Semfield: world frame and scale of the input\n";
  header += fmt::format("element vertex {}\n", vertices);
  header += "property double x\nproperty double y\nproperty double z\n";
  if (normals) header += "property float nx\nproperty float ny\nproperty float nz\n";
  header += "property uchar red\nproperty uchar green\nproperty uchar blue\n";
  if (attributes.has_labels())
    header += "property int label\nproperty float scalar_label\nproperty float quality\nproperty float entropy\n";
  if (attributes.has_instances()) header += "property int instance\nproperty float scalar_instance\n";
  if (faces > 0) header += fmt::format("element face {}\nproperty list uchar uint vertex_indices\n", faces);
  return header + "end_header\n";
}

void write_vertices(BufferedFile& file, std::span<const Vec3d> positions, std::span<const Vec3d> normals,
                    const PointAttributes& attributes, const ClassTable& classes) {
  for (std::size_t v = 0; v < positions.size(); ++v) {
    for (int axis = 0; axis < 3; ++axis) file.value(positions[v][axis]);
    for (int axis = 0; axis < 3 && !normals.empty(); ++axis) file.value(static_cast<float>(normals[v][axis]));
    for (const std::uint8_t c : attributes.color[v]) file.value(c);
    if (attributes.has_labels()) {
      const std::int32_t id = classes.id_of(attributes.label[v]);
      file.value(id);
      file.value(static_cast<float>(id));
      file.value(static_cast<float>(id));
      file.value(attributes.entropy[v]);
    }
    if (!attributes.has_instances()) continue;
    file.value(attributes.instance[v]);
    file.value(static_cast<float>(attributes.instance[v]));
  }
}

void write_mtl(const std::string& path, const std::vector<ClassGroup>& groups) {
  std::string text = "# Semfield: a material per class; Kd in linear light\n";
  for (const ClassGroup& g : groups) {
    text += fmt::format("\nnewmtl {}\n", g.name);
    if (g.id >= 0) text += fmt::format("# class id {}\n", g.id);
    text += fmt::format("Kd {:.6f} {:.6f} {:.6f}\nd 1\nillum 1\n", linear_light(g.color[0]), linear_light(g.color[1]),
                        linear_light(g.color[2]));
  }
  write_file_atomic(path, text);
}

}  // namespace

void write_ply(const std::string& path, const Surface& surface, const ClassTable& classes) {
  BufferedFile file(path);
  file.text(ply_header(surface.positions.size(), surface.triangles.size(), true, surface.attributes));
  write_vertices(file, surface.positions, surface.normals, surface.attributes, classes);
  for (const Triangle& t : surface.triangles) {
    file.value(std::uint8_t{3});
    for (const std::uint32_t v : t) file.value(v);
  }
  file.commit();
}

void write_ply(const std::string& path, const PointSet& points, const ClassTable& classes) {
  BufferedFile file(path);
  file.text(ply_header(points.positions.size(), 0, !points.normals.empty(), points.attributes));
  write_vertices(file, points.positions, points.normals, points.attributes, classes);
  file.commit();
}

void write_obj(const std::string& path, const Surface& surface, const ClassTable& classes) {
  const std::vector<ClassGroup> groups = class_groups(surface, classes);
  const std::filesystem::path mtl = std::filesystem::path(path).replace_extension(".mtl");
  write_mtl(mtl.string(), groups);
  BufferedFile file(path);
  file.text(fmt::format("# Semfield: world frame and scale of the input; colours follow the coordinates\nmtllib {}\n",
                        mtl.filename().string()));
  for (std::size_t v = 0; v < surface.positions.size(); ++v) {
    const Vec3d& p = surface.positions[v];
    const auto& c = surface.attributes.color[v];
    file.text(fmt::format("v {:.12g} {:.12g} {:.12g} {:.4f} {:.4f} {:.4f}\n", p.x, p.y, p.z, c[0] / 255.0, c[1] / 255.0,
                          c[2] / 255.0));
  }
  for (const Vec3d& n : surface.normals) file.text(fmt::format("vn {:.5f} {:.5f} {:.5f}\n", n.x, n.y, n.z));
  for (const ClassGroup& g : groups) {
    file.text(fmt::format("g {}\nusemtl {}\n", g.name, g.name));
    for (const std::uint32_t i : g.triangles) {
      const Triangle& t = surface.triangles[i];
      file.text(fmt::format("f {0}//{0} {1}//{1} {2}//{2}\n", t[0] + 1ULL, t[1] + 1ULL, t[2] + 1ULL));
    }
  }
  file.commit();
}

Box box_around(std::span<const Vec3d> positions) {
  Box box;
  for (const Vec3d& p : positions) box.include(p);
  return box;
}

Vec3d offset_of_floats(const Box& box) {
  constexpr double kFar = 1024;  // sides of the box: a step of 32 bits is then 1/8,192 of a side
  Vec3d offset;
  if (box.empty()) return offset;
  const Vec3d size = box.size();
  double largest = 0;
  for (int axis = 0; axis < 3; ++axis) largest = std::max({largest, std::abs(box.lo[axis]), std::abs(box.hi[axis])});
  if (!(largest >= kFar * std::max({size.x, size.y, size.z}))) return offset;
  const double step = 100 * decade(box);
  for (int axis = 0; axis < 3; ++axis) offset[axis] = step * std::round(box.center()[axis] / step) + 0.0;
  return offset;
}

double decade(const Box& box) {
  if (box.empty()) return 1;
  const Vec3d size = box.size();
  const double longest = std::max({size.x, size.y, size.z});
  return longest > 0 && std::isfinite(longest) ? std::pow(10.0, std::floor(std::log10(longest))) : 1;
}

}  // namespace semfield
