// PLY and OBJ.
#include "surface/mesh/mesh_files.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>
#include <optional>
#include <set>

#include "core/error.h"

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
    file.values(positions[v].x, positions[v].y, positions[v].z);
    if (!normals.empty()) file.floats(normals[v]);
    file.value(attributes.color[v]);
    if (attributes.has_labels()) {
      const std::int32_t id = classes.id_of(attributes.label[v]);
      file.values(id, static_cast<float>(id), static_cast<float>(id), attributes.entropy[v]);
    }
    if (attributes.has_instances()) file.values(attributes.instance[v], static_cast<float>(attributes.instance[v]));
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
  for (const Triangle& t : surface.triangles) file.values(std::uint8_t{3}, t);
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
  const fs::path mtl = fs::path(path).replace_extension(".mtl");
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

// glTF 2.0 binary: a JSON chunk that describes one binary chunk.

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
  each([&](std::uint32_t v) { file.floats(surface.positions[v] - offset); });
  each([&](std::uint32_t v) { file.floats(surface.normals[v]); });
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
  file.values(kMagic, std::uint32_t{2}, static_cast<std::uint32_t>(total));
  file.values(static_cast<std::uint32_t>(json.size()), kJsonChunk);
  file.text(json);
  file.values(static_cast<std::uint32_t>(layout.bytes()), kBinaryChunk);
  write_binary(file, surface, classes, vertices, offset);
  file.commit();
}

PointCloud::PointCloud(double voxel, const std::array<double, 3>& background) : voxel_(voxel), background_(background) {
  if (!(voxel > 0) || !std::isfinite(voxel))
    throw Error(ErrorKind::usage, "mesh.voxel.size", "a voxel of " + std::to_string(voxel),
                "give a positive edge length");
}

std::size_t PointCloud::Hash::operator()(const std::array<std::int64_t, 3>& key) const {
  std::uint64_t h = 0;
  for (const std::int64_t k : key) {
    h = (h ^ static_cast<std::uint64_t>(k)) * 0x9E3779B97F4A7C15U;
    h ^= h >> 32;
  }
  return h;
}

namespace {

// From a pixel to the nearer one of its neighbours at `before` and `behind`, along the way from the first to the
// second; {0, 0, 0} where neither is seen.
Vec3d step_at(const SeenPixels& pixels, std::size_t i, std::optional<std::size_t> before,
              std::optional<std::size_t> behind) {
  Vec3d least;
  double shortest = std::numeric_limits<double>::infinity();
  const auto consider = [&](std::optional<std::size_t> other, double sign) {
    if (!other || pixels.seen[*other] == 0) return;
    const Vec3d step = sign * (pixels.place[*other] - pixels.place[i]);
    if (length(step) >= shortest) return;
    shortest = length(step);
    least = step;
  };
  consider(behind, 1);
  consider(before, -1);
  return least;
}

// What the neighbours of a pixel show. Seen at more than 84 degrees it is an edge of depth more often than a surface.
Vec3d normal_at(const SeenPixels& pixels, std::size_t i, std::int32_t width, std::int32_t height, Vec3d to_eye) {
  constexpr double kLeastCosine = 0.1;
  const std::size_t w = static_cast<std::size_t>(width), column = i % w, row = i / w;
  using Place = std::optional<std::size_t>;
  const Vec3d right = step_at(pixels, i, column > 0 ? Place(i - 1) : Place(), column + 1 < w ? Place(i + 1) : Place());
  const Vec3d down = step_at(pixels, i, row > 0 ? Place(i - w) : Place(),
                             row + 1 < static_cast<std::size_t>(height) ? Place(i + w) : Place());
  const Vec3d normal = cross(down, right);
  const double size = length(normal);
  if (!(size > 0)) return to_eye;
  const double cosine = dot(normal, to_eye) / size;
  return std::abs(cosine) < kLeastCosine ? to_eye : normal * ((cosine < 0 ? -1 : 1) / size);
}

}  // namespace

SeenPixels seen_pixels(const RayCamera& camera, const RenderedFrame& frame, float least_opacity) {
  const std::size_t count = frame.opacity.size();
  SeenPixels out{std::vector<char>(count), std::vector<Vec3d>(count), std::vector<Vec3d>(count),
                 std::vector<float>(count)};
  const Camera& c = camera.camera;
  for (std::size_t i = 0; i < count; ++i) {
    if (!(frame.opacity[i] >= least_opacity) || !(frame.depth_m[i] > 0) || !std::isfinite(frame.depth_m[i])) continue;
    const auto width = static_cast<std::size_t>(frame.width_px);
    const double u = static_cast<double>(i % width) + 0.5, v = static_cast<double>(i / width) + 0.5;
    const Vec3d ray = camera.undistort ? c.direction(u, v) : normalized(Vec3d{(u - c.cx) / c.fx, (v - c.cy) / c.fy, 1});
    const double share = c.depth_of(ray);
    if (!(share > 0)) continue;
    const double depth = static_cast<double>(frame.depth_m[i]) / static_cast<double>(frame.opacity[i]);
    out.seen[i] = 1;
    out.place[i] = camera.world_from_camera.apply(ray * (depth / share));
    out.footprint[i] = static_cast<float>(depth / std::sqrt(c.fx * c.fy));
  }
  for (std::size_t i = 0; i < count; ++i) {
    if (out.seen[i] == 0) continue;
    const Vec3d to_eye = normalized(camera.world_from_camera.t - out.place[i]);
    out.normal[i] = normal_at(out, i, frame.width_px, frame.height_px, to_eye);
  }
  return out;
}

void PointCloud::add(const RenderedFrame& frame, const SeenPixels& pixels) {
  labels_ = labels_ || !frame.label.empty();
  for (std::size_t i = 0; i < pixels.seen.size(); ++i) {
    if (pixels.seen[i] == 0) continue;
    const Vec3d p = pixels.place[i];
    const std::array<std::int64_t, 3> key{static_cast<std::int64_t>(std::floor(p.x / voxel_)),
                                          static_cast<std::int64_t>(std::floor(p.y / voxel_)),
                                          static_cast<std::int64_t>(std::floor(p.z / voxel_))};
    const auto [found, fresh] = index_.try_emplace(key, static_cast<std::uint32_t>(cells_.size()));
    if (fresh) cells_.emplace_back();
    Cell& cell = cells_[found->second];
    cell.place_sum = cell.place_sum + p;
    cell.normal_sum = cell.normal_sum + pixels.normal[i];
    cell.footprint = fresh ? pixels.footprint[i] : std::min(cell.footprint, pixels.footprint[i]);
    const auto met = static_cast<double>(frame.opacity[i]);
    for (std::size_t k = 0; k < 3; ++k)
      cell.color_sum[k] += (static_cast<double>(frame.rgb[3 * i + k]) - (1 - met) * background_[k]) / met;
    ++cell.count;
    if (!frame.label.empty() && (fresh || frame.entropy[i] < cell.entropy)) {
      cell.label = frame.label[i];
      cell.entropy = frame.entropy[i];
    }
  }
}

PointSet PointCloud::points() const {
  PointSet out;
  for (const Cell& cell : cells_) {
    const double share = 1.0 / static_cast<double>(cell.count);
    out.positions.push_back(cell.place_sum * share);
    const double size = length(cell.normal_sum);
    out.normals.push_back(size > 0 ? cell.normal_sum * (1 / size) : Vec3d{0, 0, 1});
    out.footprint.push_back(cell.footprint);
    auto& color = out.attributes.color.emplace_back();
    for (std::size_t k = 0; k < 3; ++k)
      color[k] = static_cast<std::uint8_t>(std::lround(255 * std::clamp(cell.color_sum[k] * share, 0.0, 1.0)));
    if (!labels_) continue;
    out.attributes.label.push_back(cell.label);
    out.attributes.entropy.push_back(cell.entropy);
  }
  return out;
}

std::vector<ClassGroup> class_groups(const Surface& surface, const ClassTable& classes, bool by_object) {
  std::map<std::pair<std::int32_t, std::int16_t>, ClassGroup> found;
  for (std::size_t i = 0; i < surface.triangles.size(); ++i) {
    const std::uint32_t corner = surface.triangles[i][0];
    const PointAttributes& known = surface.attributes;
    const std::int32_t instance = by_object && known.has_instances() ? known.instance[corner] : 0;
    ClassGroup& group = found[{instance, known.has_labels() ? known.label[corner] : kVoid}];
    group.instance = instance;
    group.triangles.push_back(static_cast<std::uint32_t>(i));
  }
  std::set<std::int16_t> labels;
  for (const auto& [key, group] : found) labels.insert(key.second);
  std::map<std::int16_t, std::string> name_of;
  std::set<std::string> names;
  for (const std::int16_t label : labels) {
    std::string name = surface.attributes.has_labels() ? "void" : "surface";
    if (label != kVoid) {
      const ClassEntry& entry = classes.valid(label);
      name = entry.name.empty() ? fmt::format("class_{}", entry.id) : entry.name;
    }
    for (char& c : name) {
      // Words of an OBJ line end at a blank, lines at a control character.
      if (static_cast<unsigned char>(c) <= ' ' || c == 127) c = '_';
    }
    while (!names.insert(name).second) name += fmt::format("_{}", label == kVoid ? -1 : classes.valid(label).id);
    name_of[label] = name;
  }
  std::vector<ClassGroup> groups;
  for (auto& [key, group] : found) {
    group.name = name_of[key.second];
    if (key.second != kVoid) group.id = classes.valid(key.second).id;
    group.color = class_color(key.second, classes);
    groups.push_back(std::move(group));
  }
  return groups;
}

std::array<std::uint8_t, 3> class_color(std::int16_t label, const ClassTable& classes) {
  if (label == kVoid) return {128, 128, 128};
  return classes.valid(label).color;
}

std::vector<std::array<std::uint8_t, 3>> class_colors(const PointAttributes& attributes, const ClassTable& classes) {
  std::vector<std::array<std::uint8_t, 3>> colors;
  colors.reserve(attributes.label.size());
  for (const std::int16_t label : attributes.label) colors.push_back(class_color(label, classes));
  return colors;
}

double linear_light(std::uint8_t value) {
  const double v = value / 255.0;
  return v <= 0.04045 ? v / 12.92 : std::pow((v + 0.055) / 1.055, 2.4);
}

}  // namespace semfield
