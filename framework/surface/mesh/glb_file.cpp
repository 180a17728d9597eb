// glTF 2.0 binary: a JSON chunk that describes one binary chunk.
#include <algorithm>
#include <cmath>
#include <limits>
#include <map>
#include <nlohmann/json.hpp>

#include "core/error.h"
#include "surface/mesh/buffered_file.h"
#include "surface/mesh/class_groups.h"
#include "surface/mesh/mesh_files.h"
#include "surface/mesh/upright.h"

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

  /// Number of the view of `count` elements of `stride` bytes.
  std::size_t elements(std::size_t count, std::size_t stride) {
    const std::size_t view = add_view(count * stride, kArrayBuffer);
    root_["bufferViews"][view]["byteStride"] = stride;
    return view;
  }
  /// Number of the accessor of `count` elements of a view, from number `first` on.
  std::size_t attribute(std::size_t view, std::size_t first, std::size_t count, int component, const char* type) {
    const std::size_t stride = root_["bufferViews"][view]["byteStride"];
    return add_accessor({{"bufferView", view},
                         {"byteOffset", first * stride},
                         {"componentType", component},
                         {"count", count},
                         {"type", type}});
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

// The vertices that a group uses, in the order in which its triangles first do, and its triangles by their numbers
// there: a primitive over the vertices of the whole mesh would have them counted and loaded again for each class.
struct GroupVertices {
  std::vector<std::uint32_t> vertices;  ///< numbers of the surface's
  std::vector<std::uint32_t> indices;   ///< of `vertices`
};
std::vector<GroupVertices> vertices_of(const Surface& surface, const std::vector<ClassGroup>& groups) {
  constexpr std::uint32_t kNone = 0xFFFFFFFFU;
  std::vector<std::uint32_t> number(surface.positions.size(), kNone);
  std::vector<GroupVertices> all;
  for (const ClassGroup& group : groups) {
    GroupVertices& own = all.emplace_back();
    for (const std::uint32_t i : group.triangles) {
      for (const std::uint32_t v : surface.triangles[i]) {
        if (number[v] == kNone) {
          number[v] = static_cast<std::uint32_t>(own.vertices.size());
          own.vertices.push_back(v);
        }
        own.indices.push_back(number[v]);
      }
    }
    for (const std::uint32_t v : own.vertices) number[v] = kNone;
  }
  return all;
}

void set_range(Json& accessor, const Surface& surface, const std::vector<std::uint32_t>& vertices, Vec3d offset) {
  std::array<float, 3> least, most;
  least.fill(std::numeric_limits<float>::max());
  most.fill(std::numeric_limits<float>::lowest());
  for (const std::uint32_t v : vertices) {
    const Vec3d p = surface.positions[v] - offset;
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
                  const std::vector<GroupVertices>& groups, Vec3d offset) {
  const auto each = [&](const auto& write) {
    for (const GroupVertices& group : groups) {
      for (const std::uint32_t v : group.vertices) write(v);
    }
  };
  for (const auto& [vectors, from] : {std::pair{&surface.positions, offset}, {&surface.normals, Vec3d{}}}) {
    each([&](std::uint32_t v) {
      for (int axis = 0; axis < 3; ++axis) file.value(static_cast<float>((*vectors)[v][axis] - from[axis]));
    });
  }
  each([&](std::uint32_t v) {
    for (const std::uint8_t c : surface.attributes.color[v])
      file.value(static_cast<std::uint16_t>(std::lround(65535 * linear_light(c))));
    file.value(std::uint16_t{65535});
  });
  if (surface.attributes.has_labels()) {
    each([&](std::uint32_t v) {  // 16 bits and two bytes of padding
      file.value(static_cast<std::uint32_t>(classes.id_of(surface.attributes.label[v])));
    });
    each([&](std::uint32_t v) { file.value(surface.attributes.entropy[v]); });
  }
  for (const GroupVertices& group : groups) {
    for (const std::uint32_t index : group.indices) file.value(index);
  }
}

// v turned by x, y, z, w.
Vec3d turned(const std::array<double, 4>& q, Vec3d v) {
  const Vec3d u{q[0], q[1], q[2]}, t = 2.0 * cross(u, v);
  return v + q[3] * t + cross(u, t);
}

// Primitives by object, 0 for the rest, as the meshes and nodes of a file. The first node is the root.
void add_nodes(Json& root, const std::map<std::int32_t, Json>& primitives, const GlbLook& look, Vec3d offset) {
  Json base{{"name", "surface"}, {"rotation", turn_to_y(look.up)}};
  if (!(offset == Vec3d{})) {
    const Vec3d back = turned(turn_to_y(look.up), offset);
    base["translation"] = {back.x, back.y, back.z};
  }
  root["nodes"] = Json::array({base});
  root["meshes"] = Json::array();
  for (const auto& [instance, of_object] : primitives) {
    std::string name = "surface";
    if (instance != 0) {
      const auto known = look.objects.find(instance);
      name = known == look.objects.end() ? "object " + std::to_string(instance) : known->second;
    }
    const std::size_t mesh = root["meshes"].size();
    root["meshes"].push_back({{"name", name}, {"primitives", of_object}});
    if (instance == 0) {
      root["nodes"][0]["mesh"] = mesh;
    } else {
      root["nodes"][0]["children"].push_back(root["nodes"].size());
      root["nodes"].push_back({{"mesh", mesh}, {"name", name}, {"extras", {{"object_id", instance}}}});
    }
  }
}

}  // namespace

void write_glb(const std::string& path, const Surface& surface, const ClassTable& classes, const GlbLook& look) {
  const std::vector<ClassGroup> groups = class_groups(surface, classes, true);
  const Vec3d offset = offset_of_floats(box_around(surface.positions));
  Json root;
  root["asset"] = {
      {"version", "2.0"},
      {"generator", "Semfield"},
      {"extras",
       {{"axes", "positions are in the input's world less 'offset'; the root node adds it and turns 'up' to +y"},
        {"up", {look.up.x, look.up.y, look.up.z}},
        {"offset", {offset.x, offset.y, offset.z}}}}};
  if (look.unlit) root["extensionsUsed"] = Json::array({"KHR_materials_unlit"});
  root["scene"] = 0;
  root["scenes"] = Json::array({{{"nodes", {0}}}});
  root["bufferViews"] = Json::array();
  root["accessors"] = Json::array();
  Layout layout(root);
  const std::vector<GroupVertices> vertices = vertices_of(surface, groups);
  std::size_t count = 0;
  for (const GroupVertices& group : vertices) count += group.vertices.size();
  const bool labels = surface.attributes.has_labels();
  const std::size_t positions = layout.elements(count, 12), normals = layout.elements(count, 12),
                    colors = layout.elements(count, 8), ids = labels ? layout.elements(count, 4) : 0,
                    entropies = labels ? layout.elements(count, 4) : 0;
  std::map<std::int32_t, Json> primitives;  // by object
  std::map<std::string, std::size_t> material_of;
  std::size_t first = 0;
  for (std::size_t g = 0; g < groups.size(); ++g) {
    const std::size_t own = vertices[g].vertices.size();
    Json attributes;
    attributes["POSITION"] = layout.attribute(positions, first, own, kFloat, "VEC3");
    set_range(root["accessors"].back(), surface, vertices[g].vertices, offset);
    attributes["NORMAL"] = layout.attribute(normals, first, own, kFloat, "VEC3");
    attributes["COLOR_0"] = layout.attribute(colors, first, own, kUnsignedShort, "VEC4");
    root["accessors"].back()["normalized"] = true;
    if (labels) {
      attributes["_LABEL"] = layout.attribute(ids, first, own, kUnsignedShort, "SCALAR");
      attributes["_ENTROPY"] = layout.attribute(entropies, first, own, kFloat, "SCALAR");
    }
    first += own;
    const auto [known, fresh] = material_of.try_emplace(groups[g].name, material_of.size());
    if (fresh) root["materials"].push_back(material(groups[g], look.unlit));
    primitives[groups[g].instance].push_back({{"attributes", std::move(attributes)},
                                              {"indices", layout.indices(vertices[g].indices.size())},
                                              {"material", known->second},
                                              {"mode", 4}});
  }
  add_nodes(root, primitives, look, offset);
  root["buffers"] = Json::array({{{"byteLength", layout.bytes()}}});

  std::string json = root.dump();
  while (json.size() % 4 != 0) json += ' ';
  const std::size_t total = 12 + 8 + json.size() + 8 + layout.bytes();
  if (total > std::numeric_limits<std::uint32_t>::max()) {
    throw Error(ErrorKind::data, "mesh.file.size",
                path + ": " + std::to_string(total) + " bytes do not fit the 4 GiB of a GLB file",
                "choose a larger --voxel, or --format ply");
  }
  BufferedFile file(path);
  for (const std::uint32_t word : {kMagic, 2U, static_cast<std::uint32_t>(total)}) file.value(word);
  file.value(static_cast<std::uint32_t>(json.size()));
  file.value(kJsonChunk);
  file.text(json);
  file.value(static_cast<std::uint32_t>(layout.bytes()));
  file.value(kBinaryChunk);
  write_binary(file, surface, classes, vertices, offset);
  file.commit();
}

}  // namespace semfield
