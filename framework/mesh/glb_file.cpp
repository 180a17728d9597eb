// glTF 2.0 binary: a JSON chunk that describes one binary chunk.
#include <algorithm>
#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>

#include "core/error.h"
#include "mesh/buffered_file.h"
#include "mesh/class_groups.h"
#include "mesh/mesh_files.h"
#include "mesh/upright.h"

namespace semfield {

namespace {

using Json = nlohmann::ordered_json;

// Numbers of the format.
constexpr int kUnsignedShort = 5123, kUnsignedInt = 5125, kFloat = 5126;
constexpr int kArrayBuffer = 34962, kElementArrayBuffer = 34963;
constexpr std::uint32_t kMagic = 0x46546C67, kJsonChunk = 0x4E4F534A, kBinaryChunk = 0x004E4942;

// Views of the binary chunk, one behind the other; every element of an attribute begins at a multiple of four bytes.
class Layout {
 public:
  explicit Layout(Json& root) : root_(root) {}

  /// Number of the accessor of `count` elements of `stride` bytes.
  std::size_t attribute(std::size_t count, std::size_t stride, int component, const char* type, bool normalised) {
    const std::size_t view = add_view(count * stride, kArrayBuffer);
    root_["bufferViews"][view]["byteStride"] = stride;
    Json accessor{{"bufferView", view}, {"componentType", component}, {"count", count}, {"type", type}};
    if (normalised) accessor["normalized"] = true;
    return add_accessor(std::move(accessor));
  }
  std::size_t indices(std::size_t count) {
    const std::size_t view = add_view(count * sizeof(std::uint32_t), kElementArrayBuffer);
    return add_accessor({{"bufferView", view}, {"componentType", kUnsignedInt}, {"count", count}, {"type", "SCALAR"}});
  }
  std::size_t bytes() const { return bytes_; }

 private:
  std::size_t add_view(std::size_t bytes, int target) {
    Json& views = root_["bufferViews"];
    views.push_back({{"buffer", 0}, {"byteOffset", bytes_}, {"byteLength", bytes}, {"target", target}});
    bytes_ += bytes;
    return views.size() - 1;
  }
  std::size_t add_accessor(Json accessor) {
    Json& accessors = root_["accessors"];
    accessors.push_back(std::move(accessor));
    return accessors.size() - 1;
  }
  Json& root_;
  std::size_t bytes_ = 0;
};

void set_range(Json& accessor, const std::vector<Vec3d>& positions) {
  std::array<float, 3> least, most;
  least.fill(std::numeric_limits<float>::max());
  most.fill(std::numeric_limits<float>::lowest());
  for (const Vec3d& p : positions) {
    for (std::size_t axis = 0; axis < 3; ++axis) {
      const auto value = static_cast<float>(p[static_cast<int>(axis)]);
      least[axis] = std::min(least[axis], value);
      most[axis] = std::max(most[axis], value);
    }
  }
  accessor["min"] = least;  // as doubles: the digits give the very floats back
  accessor["max"] = most;
}

Json material(const ClassGroup& group, bool unlit) {
  Json out{{"name", group.name},
           {"pbrMetallicRoughness",
            {{"baseColorFactor", {1.0, 1.0, 1.0, 1.0}}, {"metallicFactor", 0.0}, {"roughnessFactor", 1.0}}},
           {"doubleSided", false}};
  if (unlit) out["extensions"]["KHR_materials_unlit"] = Json::object();
  if (group.id >= 0) out["extras"] = {{"class_id", group.id}, {"class_color", group.color}};
  return out;
}

void write_binary(BufferedFile& file, const Surface& surface, const ClassTable& classes,
                  const std::vector<ClassGroup>& groups) {
  for (const std::vector<Vec3d>* vectors : {&surface.positions, &surface.normals}) {
    for (const Vec3d& v : *vectors) {
      for (int axis = 0; axis < 3; ++axis) file.value(static_cast<float>(v[axis]));
    }
  }
  for (const auto& color : surface.attributes.color) {
    for (const std::uint8_t c : color) file.value(static_cast<std::uint16_t>(std::lround(65535 * linear_light(c))));
    file.value(std::uint16_t{65535});
  }
  for (const std::int16_t label : surface.attributes.label) {
    file.value(static_cast<std::uint32_t>(classes.id_of(label)));  // 16 bits and two bytes of padding
  }
  for (const float entropy : surface.attributes.entropy) file.value(entropy);
  for (const ClassGroup& group : groups) {
    for (const std::uint32_t i : group.triangles) {
      for (const std::uint32_t v : surface.triangles[i]) file.value(v);
    }
  }
}

}  // namespace

void write_glb(const std::string& path, const Surface& surface, const ClassTable& classes, const GlbLook& look) {
  const std::vector<ClassGroup> groups = class_groups(surface, classes);
  Json root;
  root["asset"] = {{"version", "2.0"},
                   {"generator", "Semfield"},
                   {"extras",
                    {{"axes", "positions are in the input's world; the node turns 'up' to +y"},
                     {"up", {look.up.x, look.up.y, look.up.z}}}}};
  if (look.unlit) root["extensionsUsed"] = Json::array({"KHR_materials_unlit"});
  root["scene"] = 0;
  root["scenes"] = Json::array({{{"nodes", {0}}}});
  root["nodes"] = Json::array({{{"mesh", 0}, {"name", "surface"}, {"rotation", turn_to_y(look.up)}}});
  root["bufferViews"] = Json::array();
  root["accessors"] = Json::array();
  Layout layout(root);
  const std::size_t count = surface.positions.size();
  Json attributes;
  attributes["POSITION"] = layout.attribute(count, 12, kFloat, "VEC3", false);
  set_range(root["accessors"][0], surface.positions);
  attributes["NORMAL"] = layout.attribute(count, 12, kFloat, "VEC3", false);
  attributes["COLOR_0"] = layout.attribute(count, 8, kUnsignedShort, "VEC4", true);
  if (surface.attributes.has_labels()) {
    attributes["_LABEL"] = layout.attribute(count, 4, kUnsignedShort, "SCALAR", false);
    attributes["_ENTROPY"] = layout.attribute(count, 4, kFloat, "SCALAR", false);
  }
  Json primitives = Json::array();
  for (std::size_t g = 0; g < groups.size(); ++g) {
    root["materials"].push_back(material(groups[g], look.unlit));
    primitives.push_back({{"attributes", attributes},
                          {"indices", layout.indices(3 * groups[g].triangles.size())},
                          {"material", g},
                          {"mode", 4}});
  }
  root["meshes"] = Json::array({{{"name", "surface"}, {"primitives", std::move(primitives)}}});
  root["buffers"] = Json::array({{{"byteLength", layout.bytes()}}});

  std::string json = root.dump();
  while (json.size() % 4 != 0) json += ' ';
  const std::size_t total = 12 + 8 + json.size() + 8 + layout.bytes();
  if (total > std::numeric_limits<std::uint32_t>::max()) {
    throw Error(ErrorKind::data, path + ": " + std::to_string(total) + " bytes do not fit the 4 GiB of a GLB file",
                "choose a larger --voxel, or --format ply");
  }
  BufferedFile file(path);
  for (const std::uint32_t word : {kMagic, 2U, static_cast<std::uint32_t>(total)}) file.value(word);
  file.value(static_cast<std::uint32_t>(json.size()));
  file.value(kJsonChunk);
  file.text(json);
  file.value(static_cast<std::uint32_t>(layout.bytes()));
  file.value(kBinaryChunk);
  write_binary(file, surface, classes, groups);
  file.commit();
}

}  // namespace semfield
