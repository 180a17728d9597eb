// Octrees of OctoMap [Hornung13]: a header of text, then the nodes, parents before children.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <memory>

#include "handover/voxel_map.h"
#include "surface/mesh/buffered_file.h"
#include "surface/mesh/class_groups.h"

namespace semfield {

namespace {

constexpr int kLevels = 16;
constexpr std::int64_t kMiddle = std::int64_t{1} << (kLevels - 1);  // the key of cubes that begin at 0
constexpr std::int64_t kFarthest = 32'000;                          // cubes from 0 that are left where they are

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
    for (int level = kLevels - 1; level >= 0; --level) {
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
  for (const std::uint8_t c : node.color) file.value(c);
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

}  // namespace semfield
