#include "surface/mesh/voxel_map.h"

#include <fmt/format.h>

#include <algorithm>
#include <bit>
#include <cmath>
#include <limits>
#include <memory>

#include "core/error.h"
#include "core/files.h"
#include "formats/npz.h"
#include "formats/zip_archive.h"

namespace semfield {

namespace {

constexpr float kHit = 0.85F, kMiss = -0.4F, kLeast = -2.0F, kMost = 3.5F;  // [Hornung13, Sec. 5.3]
constexpr std::int64_t kMostAlong = 4095;
constexpr std::size_t kMostCells = std::size_t{1} << 28;

}  // namespace

VoxelGridPlace VoxelGridPlace::covering(const Box& box, double edge) {
  VoxelGridPlace place;
  place.edge = edge;
  double cells = 1;
  bool fits = edge > 0 && std::isfinite(edge) && !box.empty();
  for (int axis = 0; axis < 3 && fits; ++axis) {
    const double first = std::floor(box.lo[axis] / edge), last = std::floor(box.hi[axis] / edge);
    fits = last - first < static_cast<double>(kMostAlong) && std::abs(first) < 1e15;
    if (!fits) break;
    const auto k = static_cast<std::size_t>(axis);
    place.first[k] = static_cast<std::int64_t>(first);
    place.count[k] = static_cast<std::int64_t>(last - first) + 1;
    cells *= static_cast<double>(place.count[k]);
  }
  if (!fits || cells > static_cast<double>(kMostCells))
    throw Error(ErrorKind::usage, "handover.voxels.many",
                fmt::format("cubes of {:.4g} make more than {} along an axis, or more than {} in all", edge, kMostAlong,
                            kMostCells),
                "choose a larger --voxel");
  return place;
}

std::optional<std::size_t> VoxelGridPlace::cell_of(Vec3d point) const {
  std::array<std::int64_t, 3> at{};
  for (int axis = 0; axis < 3; ++axis) {
    const auto k = static_cast<std::size_t>(axis);
    const double cell = std::floor(point[axis] / edge) - static_cast<double>(first[k]);
    if (!(cell >= 0 && cell < static_cast<double>(count[k]))) return std::nullopt;
    at[k] = static_cast<std::int64_t>(cell);
  }
  return index(at[0], at[1], at[2]);
}

VoxelMap::VoxelMap(VoxelGridPlace place)
    : place_(place),
      odds_(place.cells()),
      known_(place.cells()),
      hit_by_(place.cells()),
      crossed_by_(place.cells()),
      label_(place.cells(), kVoid),
      lead_(place.cells()) {}

// The cubes between two points in the order in which the line meets them [Amanatides87], up to the one before the last.
void VoxelMap::cross(Vec3d from, Vec3d to) {
  const Vec3d way = to - from;
  std::array<std::int64_t, 3> at{}, end{};
  std::array<int, 3> step{};
  std::array<double, 3> next{}, pace{};
  std::int64_t left = 0;
  for (int axis = 0; axis < 3; ++axis) {
    const auto k = static_cast<std::size_t>(axis);
    const double a = from[axis] / place_.edge, d = way[axis] / place_.edge;
    at[k] = static_cast<std::int64_t>(std::floor(a)) - place_.first[k];
    end[k] = static_cast<std::int64_t>(std::floor(to[axis] / place_.edge)) - place_.first[k];
    left += std::abs(end[k] - at[k]);
    step[k] = d > 0 ? 1 : -1;
    pace[k] = d == 0 ? std::numeric_limits<double>::infinity() : std::abs(1 / d);
    next[k] = d == 0 ? pace[k] : (d > 0 ? std::floor(a) + 1 - a : a - std::floor(a)) * pace[k];
  }
  for (; left > 0; --left) {
    const bool inside = at[0] >= 0 && at[1] >= 0 && at[2] >= 0 && at[0] < place_.count[0] && at[1] < place_.count[1] &&
                        at[2] < place_.count[2];
    if (inside) crossed_by_[place_.index(at[0], at[1], at[2])] = views_;
    const std::size_t k = next[0] < next[1] ? (next[0] < next[2] ? 0 : 2) : (next[1] < next[2] ? 1 : 2);
    at[k] += step[k];
    next[k] += pace[k];
  }
}

void VoxelMap::vote(std::size_t cell, std::int16_t label) {
  if (lead_[cell] == 0) label_[cell] = label;
  lead_[cell] += label_[cell] == label ? 1 : -1;
}

void VoxelMap::add(const RayCamera& camera, const RenderedFrame& frame, const SeenPixels& pixels) {
  ++views_;
  has_labels_ = has_labels_ || !frame.label.empty();
  for (std::size_t i = 0; i < pixels.seen.size(); ++i) {
    if (pixels.seen[i] == 0) continue;
    cross(camera.world_from_camera.t, pixels.place[i]);
    const std::optional<std::size_t> end = cell_of(pixels.place[i]);
    if (!end) continue;
    hit_by_[*end] = views_;
    if (!frame.label.empty() && frame.label[i] != kVoid) vote(*end, frame.label[i]);
  }
  for (std::size_t cell = 0; cell < odds_.size(); ++cell) {
    const bool hit = hit_by_[cell] == views_;
    if (!hit && crossed_by_[cell] != views_) continue;
    known_[cell] = 1;
    odds_[cell] = std::clamp(odds_[cell] + (hit ? kHit : kMiss), kLeast, kMost);
  }
}

// Voxels as NumPy arrays.

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

// Octrees of OctoMap [Hornung13]: a header of text, then the nodes, parents before children.

namespace {

constexpr int kTreeLevels = 16;
constexpr std::int64_t kMiddle = std::int64_t{1} << (kTreeLevels - 1);  // the key of cubes that begin at 0
constexpr std::int64_t kFarthest = 32'000;                              // cubes from 0 that are left where they are

using TreeColor = std::array<std::uint8_t, 3>;

struct TreeNode {
  std::array<std::unique_ptr<TreeNode>, 8> child;
  float log_odds = 0;
  TreeColor color{255, 255, 255};

  bool leaf() const {
    return std::all_of(child.begin(), child.end(), [](const auto& c) { return c == nullptr; });
  }
};

struct OctomapTree {
  TreeNode root;
  std::size_t nodes = 1;

  // A leaf of the lowest level: bit k of the keys chooses a child on the way down, x the lowest of the number.
  void add(const std::array<std::int64_t, 3>& key, float log_odds, const TreeColor& color) {
    TreeNode* node = &root;
    for (int level = kTreeLevels - 1; level >= 0; --level) {
      std::size_t number = 0;
      for (std::size_t axis = 0; axis < 3; ++axis) number |= static_cast<std::size_t>(key[axis] >> level & 1) << axis;
      if (node->child[number] == nullptr) {
        node->child[number] = std::make_unique<TreeNode>();
        ++nodes;
      }
      node = node->child[number].get();
    }
    node->log_odds = log_odds;
    node->color = color;
  }
};

// An inner node is as occupied as the most occupied of its children, and has their mean colour.
void finish_tree(TreeNode& node) {
  if (node.leaf()) return;
  std::array<int, 3> sum{};
  int count = 0;
  node.log_odds = -1e9F;
  for (const auto& child : node.child) {
    if (child == nullptr) continue;
    finish_tree(*child);
    node.log_odds = std::max(node.log_odds, child->log_odds);
    for (std::size_t k = 0; k < 3; ++k) sum[k] += child->color[k];
    ++count;
  }
  for (std::size_t k = 0; k < 3; ++k) node.color[k] = static_cast<std::uint8_t>(sum[k] / count);
}

// Of each child two bits, that of the first child lowest: 1 free, 2 occupied, 3 has children, 0 unknown.
void write_states(BufferedFile& file, const TreeNode& node) {
  std::uint16_t bits = 0;
  for (std::size_t i = 0; i < 8; ++i) {
    const TreeNode* child = node.child[i].get();
    if (child != nullptr)
      bits = static_cast<std::uint16_t>(bits | (!child->leaf() ? 3 : child->log_odds > 0 ? 2 : 1) << (2 * i));
  }
  file.value(bits);
  for (const auto& child : node.child)
    if (child != nullptr && !child->leaf()) write_states(file, *child);
}

void write_nodes(BufferedFile& file, const TreeNode& node) {
  file.value(node.log_odds);
  file.value(node.color);
  std::uint8_t bits = 0;
  for (std::size_t i = 0; i < 8; ++i) bits = static_cast<std::uint8_t>(bits | (node.child[i] != nullptr ? 1 : 0) << i);
  file.value(bits);
  for (const auto& child : node.child)
    if (child != nullptr) write_nodes(file, *child);
}

}  // namespace

Vec3d write_octomap(const std::string& path, const VoxelMap& map, const ClassTable& classes, bool with_color) {
  const VoxelGridPlace& place = map.place();
  std::array<std::int64_t, 3> shift{};
  bool far = false;
  for (std::size_t k = 0; k < 3; ++k)
    far = far || place.first[k] < -kFarthest || place.first[k] + place.count[k] > kFarthest;
  if (far)
    for (std::size_t k = 0; k < 3; ++k) shift[k] = place.first[k] + place.count[k] / 2;
  OctomapTree tree;
  for (std::int64_t z = 0; z < place.count[2]; ++z)
    for (std::int64_t y = 0; y < place.count[1]; ++y)
      for (std::int64_t x = 0; x < place.count[0]; ++x) {
        const std::size_t cell = place.index(x, y, z);
        if (map.state(cell) == VoxelState::unknown) continue;
        const std::int16_t label = map.label(cell);
        const std::array<std::int64_t, 3> key{place.first[0] + x - shift[0] + kMiddle,
                                              place.first[1] + y - shift[1] + kMiddle,
                                              place.first[2] + z - shift[2] + kMiddle};
        tree.add(key, map.log_odds(cell), label == kVoid ? TreeColor{255, 255, 255} : class_color(label, classes));
      }
  finish_tree(tree.root);
  BufferedFile file(path);
  file.text(
      fmt::format("# Octomap OcTree {}file\n# Semfield: edges of cubes in the unit of the input\nid {}\nsize {}\nres "
                  "{:.17g}\ndata\n",
                  with_color ? "" : "binary ", with_color ? "ColorOcTree" : "OcTree", tree.nodes, place.edge));
  if (with_color) {
    write_nodes(file, tree.root);
  } else {
    write_states(file, tree.root);
  }
  file.commit();
  return {static_cast<double>(shift[0]) * place.edge, static_cast<double>(shift[1]) * place.edge,
          static_cast<double>(shift[2]) * place.edge};
}

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
              fmt::format("up is {:.3f} {:.3f} {:.3f}, which is not an axis of the world, but maps follow its axes",
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
  const fs::path file(path);
  const std::string yaml = fs::path(file).replace_extension(".yaml").string();
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
