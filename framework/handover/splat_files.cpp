// 3D Gaussians as PLY and as .splat.
#include <fmt/format.h>

#include <cmath>

#include "handover/splats.h"
#include "surface/mesh/buffered_file.h"

namespace semfield {

void write_splat_ply(const std::string& path, const Splats& splats, const ClassTable& classes, Vec3d offset) {
  const double harmonic = 0.5 / std::sqrt(std::acos(-1.0));  // of degree 0
  const auto scale = static_cast<float>(std::log(splats.deviation));
  const PointSet& points = splats.points;
  const PointAttributes& known = points.attributes;
  BufferedFile file(path);
  std::string header = fmt::format(
      "ply\nformat binary_little_endian 1.0\ncomment Semfield: world frame of the input less {:.17g} {:.17g} {:.17g}\n"
      "element vertex {}\n",
      offset.x, offset.y, offset.z, points.positions.size());
  for (const char* name : {"x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0",
                           "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"})
    header += fmt::format("property float {}\n", name);
  if (known.has_labels()) header += "property int class_id\n";
  if (known.has_instances()) header += "property int instance_id\n";
  file.text(header + "end_header\n");
  for (std::size_t i = 0; i < points.positions.size(); ++i) {
    for (int axis = 0; axis < 3; ++axis) file.value(static_cast<float>(points.positions[i][axis] - offset[axis]));
    for (int axis = 0; axis < 3; ++axis) file.value(0.0F);
    for (const std::uint8_t c : known.color[i]) file.value(static_cast<float>((c / 255.0 - 0.5) / harmonic));
    file.value(std::log(splats.opacity[i] / (1 - splats.opacity[i])));
    for (int axis = 0; axis < 3; ++axis) file.value(scale);
    for (const float q : {1.0F, 0.0F, 0.0F, 0.0F}) file.value(q);
    if (known.has_labels()) file.value(std::int32_t{classes.id_of(known.label[i])});
    if (known.has_instances()) file.value(known.instance[i]);
  }
  file.commit();
}

void write_splat(const std::string& path, const Splats& splats, Vec3d offset) {
  BufferedFile file(path);
  for (std::size_t i = 0; i < splats.points.positions.size(); ++i) {
    const Vec3d place = splats.points.positions[i] - offset;
    for (int axis = 0; axis < 3; ++axis) file.value(static_cast<float>(place[axis]));
    for (int axis = 0; axis < 3; ++axis) file.value(static_cast<float>(splats.deviation));
    for (const std::uint8_t c : splats.points.attributes.color[i]) file.value(c);
    file.value(static_cast<std::uint8_t>(std::lround(255 * splats.opacity[i])));
    for (const int q : {255, 128, 128, 128}) file.value(static_cast<std::uint8_t>(q));
  }
  file.commit();
}

}  // namespace semfield
