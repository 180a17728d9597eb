#include "handover/costmap.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <filesystem>

#include "core/error.h"
#include "system/files.h"

namespace semfield {

namespace {

constexpr double kRounding = 1e-6;  // of an edge: cubes that end where the band begins lie outside of it

struct Upright {
  int axis = 2;
  bool negative = false;
};

Upright upright_axis(Vec3d up) {
  for (int axis = 0; axis < 3; ++axis)
    if (std::abs(std::abs(up[axis]) - 1) < 1e-9) return {axis, up[axis] < 0};
  throw Error(ErrorKind::usage, "handover.costmap.up",
              fmt::format("up is {:.3f} {:.3f} {:.3f}, which is no axis of the world, and a map lies along its axes",
                          up.x, up.y, up.z),
              "name one with --up, or turn the scene upright when it is made");
}

// Index of the layer along the axis, counted from the lowest.
std::int64_t floor_layer(const VoxelMap& map, const Upright& upright) {
  const VoxelGridPlace& place = map.place();
  const std::int64_t layers = place.count[static_cast<std::size_t>(upright.axis)];
  std::vector<std::int64_t> occupied(static_cast<std::size_t>(layers));
  for (std::int64_t z = 0; z < place.count[2]; ++z)
    for (std::int64_t y = 0; y < place.count[1]; ++y)
      for (std::int64_t x = 0; x < place.count[0]; ++x) {
        if (map.state(place.index(x, y, z)) != VoxelState::occupied) continue;
        const std::int64_t layer = std::array{x, y, z}[static_cast<std::size_t>(upright.axis)];
        ++occupied[static_cast<std::size_t>(upright.negative ? layers - 1 - layer : layer)];
      }
  const auto half = occupied.begin() + (layers + 1) / 2;
  const std::int64_t most = *std::max_element(occupied.begin(), half);
  if (most == 0)
    throw Error(ErrorKind::data, "handover.costmap.empty", "nothing lies in the lower half of the scene",
                "see `semfield mesh RUN --out map.npz`; --up names another axis");
  return std::find_if(occupied.begin(), half, [&](std::int64_t n) { return 2 * n >= most; }) - occupied.begin();
}

}  // namespace

Costmap costmap_of(const VoxelMap& map, Vec3d up, const HeightBand& band) {
  const Upright upright = upright_axis(up);
  const VoxelGridPlace& place = map.place();
  Costmap out;
  out.edge = place.edge;
  out.band = band;
  out.along = {(upright.axis + 1) % 3, (upright.axis + 2) % 3};
  if (upright.negative) std::swap(out.along[0], out.along[1]);
  const auto right = static_cast<std::size_t>(out.along[0]), ahead = static_cast<std::size_t>(out.along[1]);
  const auto axis = static_cast<std::size_t>(upright.axis);
  out.width = place.count[right];
  out.height = place.count[ahead];
  out.origin = {place.corner()[out.along[0]], place.corner()[out.along[1]]};
  const std::int64_t floor = floor_layer(map, upright);
  const std::int64_t layers = place.count[axis];
  // The floor's own cubes are not obstacles: heights count from their upper side.
  const double edge_of_floor = static_cast<double>(floor + 1) * place.edge;
  out.floor = upright.negative ? -(static_cast<double>(place.first[axis] + layers) * place.edge) + edge_of_floor
                               : static_cast<double>(place.first[axis]) * place.edge + edge_of_floor;
  out.cells.assign(static_cast<std::size_t>(out.width * out.height), VoxelState::unknown);
  for (std::int64_t row = 0; row < out.height; ++row)
    for (std::int64_t column = 0; column < out.width; ++column) {
      VoxelState& cell = out.cells[static_cast<std::size_t>(row * out.width + column)];
      for (std::int64_t layer = floor + 1; layer < layers; ++layer) {
        const double low = static_cast<double>(layer - floor - 1) * place.edge;
        if (low + (1 - kRounding) * place.edge <= band.low || low + kRounding * place.edge >= band.high) continue;
        std::array<std::int64_t, 3> at{};
        at[axis] = upright.negative ? layers - 1 - layer : layer;
        at[right] = column;
        at[ahead] = out.height - 1 - row;
        const VoxelState state = map.state(place.index(at[0], at[1], at[2]));
        if (state == VoxelState::occupied) cell = state;
        if (state == VoxelState::free && cell == VoxelState::unknown) cell = state;
      }
    }
  return out;
}

std::string write_costmap(const std::string& path, const Costmap& map) {
  std::string image = fmt::format("P5\n{} {}\n255\n", map.width, map.height);
  for (const VoxelState state : map.cells)
    image += static_cast<char>(state == VoxelState::occupied ? 0 : state == VoxelState::free ? 254 : 205);
  const std::filesystem::path file(path);
  const std::string yaml = std::filesystem::path(file).replace_extension(".yaml").string();
  constexpr std::string_view kAxes = "xyz";
  write_file_atomic(path, image);
  write_file_atomic(yaml, fmt::format("# Semfield: {} of the input to the right, {} up; {:.4g} to {:.4g} above the "
                                      "floor, which is at {:.6g}\n"
                                      "image: {}\nresolution: {:.17g}\norigin: [{:.17g}, {:.17g}, 0.0]\nnegate: 0\n"
                                      "occupied_thresh: 0.65\nfree_thresh: 0.196\nmode: trinary\n",
                                      kAxes[static_cast<std::size_t>(map.along[0])],
                                      kAxes[static_cast<std::size_t>(map.along[1])], map.band.low, map.band.high,
                                      map.floor, file.filename().string(), map.edge, map.origin[0], map.origin[1]));
  return yaml;
}

}  // namespace semfield
