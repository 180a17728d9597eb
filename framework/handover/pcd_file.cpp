// PCD, the format of the Point Cloud Library.
#include <fmt/format.h>

#include "handover/point_files.h"
#include "surface/mesh/buffered_file.h"

namespace semfield {

void write_pcd(const std::string& path, const PointSet& points, const ClassTable& classes, Vec3d offset) {
  const PointAttributes& known = points.attributes;
  std::string names = "x y z", kinds = "F F F";
  const auto add = [&](const char* name, const char* kind) {
    names += std::string(" ") + name;
    kinds += std::string(" ") + kind;
  };
  const bool normals = !points.normals.empty();
  if (normals)
    for (const char* name : {"normal_x", "normal_y", "normal_z"}) add(name, "F");
  add("rgb", "U");
  if (known.has_labels()) {
    add("label", "U");
    add("entropy", "F");
  }
  if (known.has_instances()) add("instance", "U");
  std::string sizes, counts;
  for (const char c : kinds)
    if (c == ' ') {
      sizes += "4 ";
      counts += "1 ";
    }
  const std::size_t count = points.positions.size();
  BufferedFile file(path);
  file.text(
      fmt::format("# .PCD v0.7 - world frame of the input less {:.17g} {:.17g} {:.17g}\n"
                  "VERSION 0.7\nFIELDS {}\nSIZE {}4\nTYPE {}\nCOUNT {}1\nWIDTH {}\nHEIGHT 1\n"
                  "VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {}\nDATA binary\n",
                  offset.x, offset.y, offset.z, names, sizes, kinds, counts, count, count));
  for (std::size_t i = 0; i < count; ++i) {
    for (int axis = 0; axis < 3; ++axis) file.value(static_cast<float>(points.positions[i][axis] - offset[axis]));
    for (int axis = 0; axis < 3 && normals; ++axis) file.value(static_cast<float>(points.normals[i][axis]));
    const auto& c = known.color[i];
    file.value(std::uint32_t{c[0]} << 16 | std::uint32_t{c[1]} << 8 | std::uint32_t{c[2]});
    if (known.has_labels()) {
      file.value(static_cast<std::uint32_t>(classes.id_of(known.label[i])));
      file.value(known.entropy[i]);
    }
    if (known.has_instances()) file.value(static_cast<std::uint32_t>(known.instance[i]));
  }
  file.commit();
}

}  // namespace semfield
