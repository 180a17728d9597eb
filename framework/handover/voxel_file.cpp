// Voxels as NumPy arrays.
#include <bit>
#include <cstring>

#include "formats/npz.h"
#include "formats/zip_archive.h"
#include "handover/voxel_map.h"

namespace semfield {

namespace {

// [x, y, z] in C order: z runs fastest.
template <class T, class Value>
std::string grid_bytes(const VoxelGridPlace& place, const Value& value) {
  static_assert(std::endian::native == std::endian::little);
  std::string out;
  out.reserve(place.cells() * sizeof(T));
  for (std::int64_t x = 0; x < place.count[0]; ++x)
    for (std::int64_t y = 0; y < place.count[1]; ++y)
      for (std::int64_t z = 0; z < place.count[2]; ++z) {
        const T number = value(place.index(x, y, z));
        out.append(reinterpret_cast<const char*>(&number), sizeof number);
      }
  return out;
}

}  // namespace

void write_voxels(const std::string& path, const VoxelMap& map, const ClassTable& classes) {
  const VoxelGridPlace& place = map.place();
  const std::vector<std::int64_t> shape(place.count.begin(), place.count.end());
  ZipWriter archive(path);
  const auto add = [&](const char* key, const char* type, const std::vector<std::int64_t>& of,
                       const std::string& bytes) {
    archive.add(std::string(key) + ".npy", npy_header(type, of) + bytes);
  };
  add("occupancy", "|i1", shape, grid_bytes<std::int8_t>(place, [&](std::size_t cell) {
        const VoxelState state = map.state(cell);
        return static_cast<std::int8_t>(state == VoxelState::occupied ? 100 : state == VoxelState::free ? 0 : -1);
      }));
  add("log_odds", "<f4", shape, grid_bytes<float>(place, [&](std::size_t cell) { return map.log_odds(cell); }));
  if (map.has_labels())
    add("class_id", "<i4", shape, grid_bytes<std::int32_t>(place, [&](std::size_t cell) {
          const std::int16_t label = map.label(cell);
          return label == kVoid ? -1 : classes.id_of(label);
        }));
  const Vec3d corner = place.corner();
  std::string origin;
  for (int axis = 0; axis < 3; ++axis) origin.append(reinterpret_cast<const char*>(&corner[axis]), sizeof(double));
  add("origin", "<f8", {3}, origin);
  add("edge", "<f8", {}, std::string(reinterpret_cast<const char*>(&place.edge), sizeof place.edge));
  archive.write();
}

}  // namespace semfield
