// OBJ + MTL reading on tinyobjloader's callbacks, with every index checked here.
#include <algorithm>
#include <cmath>
#include <map>
#include <tuple>

#include "datasets/obj_room/obj_room.h"

#ifdef SEMFIELD_WITH_RAYCAST
#include <tiny_obj_loader.h>
#endif

#include <fmt/format.h>

#include <charconv>
#include <set>
#include <sstream>
#include <string_view>

#include "core/files.h"
#include "core/joined_sets.h"
#include "core/text.h"
#include "formats/text_rows.h"
#include "scene/loading/frame_files.h"

namespace semfield {

#ifdef SEMFIELD_WITH_RAYCAST
namespace {

/// What a first look at the text gives: lines of faces (for messages) and names of MTL files.
struct Outline {
  std::vector<std::uint32_t> face_lines;
  std::vector<std::string> material_files;
  std::vector<std::size_t> bare_groups;  // where a 'g' without a name ends
  bool has_objects = false;
};

// Cutting a polygon may take the third power of its corners; those of rooms have tens.
constexpr int kMostCorners = 1024;

std::string_view trimmed(std::string_view text) {
  const auto begin = text.find_first_not_of(" \t\r");
  if (begin == std::string_view::npos) return {};
  return text.substr(begin, text.find_last_not_of(" \t\r") - begin + 1);
}

[[noreturn]] void refuse_damaged(const std::string& place, const std::string& message) {
  throw Error(ErrorKind::data, "scene.obj.damaged", place + ": " + message, "export the mesh again");
}

// The loader reads "abc" and "nan" as 0: numbers are checked before it sees them. What is wrong with them, or "".
std::string wrong_numbers(std::string_view rest, int least) {
  int count = 0;
  while (!(rest = trimmed(rest)).empty()) {
    const std::string_view word = rest.substr(0, rest.find_first_of(" \t"));
    const std::string_view digits = word.front() == '+' ? word.substr(1) : word;
    double value = 0;
    const auto [end, code] = std::from_chars(digits.data(), digits.data() + digits.size(), value);
    const bool too_small = code == std::errc::result_out_of_range && digits.find("e-") != std::string_view::npos;
    if (!too_small && (code != std::errc{} || end != digits.data() + digits.size() || !std::isfinite(value) ||
                       std::abs(value) > 1e30))
      return "'" + std::string(word) + "' is not a finite number";
    rest.remove_prefix(word.size());
    ++count;
  }
  return count < least ? "expected " + std::to_string(least) + " numbers, found " + std::to_string(count) : "";
}

// The loader reads "abc" as 0 and wraps what does not fit 32 bits.
std::string wrong_indices(std::string_view rest) {
  while (!(rest = trimmed(rest)).empty()) {
    const std::string_view word = rest.substr(0, rest.find_first_of(" \t"));
    std::string_view left = word;
    bool good = true;
    for (int part = 0; good; ++part) {
      std::string_view number = left.substr(0, left.find('/'));
      left.remove_prefix(number.size());
      if (number.size() > 1 && number.front() == '+') number.remove_prefix(1);
      good = part < 3 && (number.empty() ? part > 0 : to_number<int>(number).has_value());
      if (left.empty()) break;
      left.remove_prefix(1);
    }
    if (!good) return "'" + std::string(word) + "' is not an index";
    rest.remove_prefix(word.size());
  }
  return "";
}

Outline outline_of(const std::string& text, const std::string& path) {
  Outline outline;
  std::size_t line = 0;
  for (std::size_t begin = 0; begin < text.size();) {
    const std::size_t end = std::min(text.find_first_of("\r\n", begin), text.size());
    ++line;
    const std::string_view row = trimmed(std::string_view(text).substr(begin, end - begin));
    begin = end + (text.compare(end, 2, "\r\n") == 0 ? 2 : 1);
    if (row == "g") outline.bare_groups.push_back(static_cast<std::size_t>(row.data() - text.data()) + 1);
    if (row.size() < 2) continue;
    const std::string_view word = row.substr(0, row.find_first_of(" \t"));
    std::string wrong;
    if (word == "v") wrong = wrong_numbers(row.substr(1), 3);
    if (word == "vn") wrong = wrong_numbers(row.substr(2), 3);
    if (word == "vt") wrong = wrong_numbers(row.substr(2), 1);
    if (word == "f") wrong = wrong_indices(row.substr(1));
    if (!wrong.empty()) refuse_damaged(path + ":" + std::to_string(line), wrong);
    if (word == "f") outline.face_lines.push_back(static_cast<std::uint32_t>(line));
    if (word == "o") outline.has_objects = true;
    if (word == "mtllib") outline.material_files.emplace_back(trimmed(row.substr(6)));
  }
  return outline;
}

// The loader overlooks a group without a name unless a blank follows.
std::string with_blank_groups(const std::string& text, const std::vector<std::size_t>& ends) {
  std::string out;
  std::size_t begin = 0;
  for (const std::size_t end : ends) {
    out.append(text, begin, end - begin);
    out.push_back(' ');
    begin = end;
  }
  return out.append(text, begin, std::string::npos);
}

std::string resolved_map(const fs::path& folder, const std::string& name, const std::string& owner,
                         Diagnostics& diagnostics) {
  if (name.empty()) return {};
  const fs::path file = FileNames().of((folder / name).string());
  if (is_file(file)) return file.string();
  diagnostics.warning("scene.obj.texture", owner, "texture '" + file.string() + "' is missing",
                      "the plain colour is used; add the file to see it");
  return {};
}

// A line may name several files, or one whose name has spaces.
std::vector<std::string> material_names(const fs::path& folder, const std::string& line) {
  const auto is_there = [&](const std::string& name) { return is_file(FileNames().of((folder / name).string())); };
  if (is_there(line)) return {line};
  const std::vector<std::string> words = word_list(line);
  return std::any_of(words.begin(), words.end(), is_there) ? words : std::vector<std::string>{line};
}

// Names of an MTL file's materials in their order: some versions of the loader cut them at the first blank.
std::vector<std::string> names_of_materials(const std::string& text) {
  std::vector<std::string> names;
  for (std::size_t begin = 0; begin < text.size();) {
    const std::size_t end = std::min(text.find_first_of("\r\n", begin), text.size());
    const std::string_view row = trimmed(std::string_view(text).substr(begin, end - begin));
    begin = end + 1;
    if (row.starts_with("newmtl ") || row.starts_with("newmtl\t")) names.emplace_back(trimmed(row.substr(7)));
  }
  return names;
}

void load_materials(const fs::path& folder, const std::string& name, TriangleMesh& mesh,
                    std::map<std::string, int>& index, Diagnostics& diagnostics) {
  const fs::path file = FileNames().of((folder / name).string());
  if (!is_file(file)) {
    diagnostics.warning("scene.obj.material", file.string(), "material file is missing",
                        "surfaces get a colour by object; put it next to the OBJ file");
    return;
  }
  const std::string text = read_text_file(file.string());
  mesh.files.push_back(file.string());
  const std::vector<std::string> names = names_of_materials(text);
  std::istringstream stream(text);
  std::map<std::string, int> local;
  std::vector<tinyobj::material_t> found;
  std::string warning, error;
  tinyobj::LoadMtl(&local, &found, &stream, &warning, &error);
  for (std::size_t i = 0; i < found.size() && found.size() == names.size(); ++i) found[i].name = names[i];
  for (const tinyobj::material_t& m : found) {
    if (m.name.empty() || index.count(m.name) != 0) continue;
    const auto map_of = [&](const std::string& texture) {
      std::string map = resolved_map(file.parent_path(), texture, file.string() + ": " + m.name, diagnostics);
      if (!map.empty()) mesh.files.push_back(map);
      return map;
    };
    const auto color_of = [](const tinyobj::real_t* rgb) {
      return std::array{static_cast<float>(rgb[0]), static_cast<float>(rgb[1]), static_cast<float>(rgb[2])};
    };
    index[m.name] = static_cast<int>(mesh.materials.size());
    mesh.materials.push_back({m.name, color_of(m.diffuse), color_of(m.emission), static_cast<float>(m.dissolve),
                              map_of(m.diffuse_texname), map_of(m.alpha_texname)});
  }
}

struct Builder {
  const std::string& path;
  const Outline& outline;
  TriangleMesh& mesh;
  const std::map<std::string, int>& material_index;
  std::map<std::string, int> object_index, group_index;
  std::set<std::string> missing_materials;
  std::vector<Vec3f> normals;
  std::vector<std::array<float, 2>> uvs;
  std::int32_t object = -1, group = -1, material = -1;
  std::size_t face = 0;

  static std::int32_t named(std::map<std::string, int>& index, std::vector<std::string>& names,
                            const std::string& name) {
    const auto [it, fresh] = index.emplace(name, static_cast<int>(names.size()));
    if (fresh) names.push_back(name);
    return it->second;
  }

  [[noreturn]] void fail(const std::string& why) const {
    const std::string owner = object < 0 ? "" : "object '" + mesh.objects[static_cast<std::size_t>(object)] + "': ";
    refuse_damaged(path + ":" + std::to_string(outline.face_lines.at(face)), owner + why);
  }

  // 1-based or negative (counting back) to 0-based; -1 for "none given".
  std::int64_t resolve(int raw, std::size_t count, const char* what) const {
    if (raw == 0) return -1;
    const std::int64_t n = static_cast<std::int64_t>(count);
    const std::int64_t i = raw > 0 ? raw - 1 : n + raw;
    if (i < 0 || i >= n) fail(fmt::format("face names {} {} of {}", what, raw, count));
    return i;
  }

  void add_face(const tinyobj::index_t* corners, int count) {
    if (count < 3) fail("face has " + std::to_string(count) + " corners, at least 3 are needed");
    if (count > kMostCorners)
      fail("face has " + std::to_string(count) + " corners; at most " + std::to_string(kMostCorners) + " are read");
    if (object < 0) object = named(object_index, mesh.objects, "unnamed");
    if (group < 0) group = named(group_index, mesh.groups, "");
    std::vector<Vec3f> polygon;
    std::vector<std::array<std::int64_t, 3>> index;  // position, uv, normal
    for (int k = 0; k < count; ++k) {
      const std::int64_t p = resolve(corners[k].vertex_index, mesh.positions.size(), "vertex");
      if (p < 0) fail("face names vertex 0; indices start at 1");
      index.push_back({p, resolve(corners[k].texcoord_index, uvs.size(), "texture coordinate"),
                       resolve(corners[k].normal_index, normals.size(), "normal")});
      polygon.push_back(mesh.positions[static_cast<std::size_t>(p)]);
    }
    for (const std::array<int, 3>& t : triangulate_polygon(polygon)) add_triangle(t, index);
    check_input_limit(3 * std::ssize(mesh.triangles), input_limits().mesh_corners, path + ": ", "corners of triangles",
                      "mesh_corners");
    ++face;
  }

  void add_triangle(const std::array<int, 3>& corner, const std::vector<std::array<std::int64_t, 3>>& index) {
    std::array<std::uint32_t, 3> triangle{};
    std::array<std::array<float, 2>, 3> uv{};
    std::array<Vec3f, 3> normal{};
    for (std::size_t k = 0; k < 3; ++k) {
      const auto& c = index[static_cast<std::size_t>(corner[k])];
      triangle[k] = static_cast<std::uint32_t>(c[0]);
      if (c[1] >= 0) uv[k] = uvs[static_cast<std::size_t>(c[1])];
      if (c[2] >= 0) normal[k] = normals[static_cast<std::size_t>(c[2])];
    }
    mesh.triangles.push_back(triangle);
    const std::size_t t = mesh.size() - 1;
    const Vec3d a = mesh.corner(t, 0), b = mesh.corner(t, 1), c = mesh.corner(t, 2);
    const double longest = std::max({dot(b - a, b - a), dot(c - b, c - b), dot(a - c, a - c)});
    // Relative to the longest side: a sliver of this shape is a line in float32.
    if (!(length(mesh.cross_of_sides(t)) > 1e-9 * longest)) {
      ++mesh.zero_area_skipped;
      return mesh.triangles.pop_back();
    }
    for (const Vec3d& p : {a, b, c}) mesh.bounds.include(p);
    mesh.uv.push_back(uv);
    mesh.normals.push_back(normal);
    mesh.material_of.push_back(material);
    mesh.object_of.push_back(object);
    mesh.group_of.push_back(group);
  }
};

Builder& self(void* user) { return *static_cast<Builder*>(user); }

tinyobj::callback_t callbacks() {
  tinyobj::callback_t c;
  c.vertex_cb = [](void* user, tinyobj::real_t x, tinyobj::real_t y, tinyobj::real_t z, tinyobj::real_t) {
    self(user).mesh.positions.push_back({static_cast<float>(x), static_cast<float>(y), static_cast<float>(z)});
  };
  c.normal_cb = [](void* user, tinyobj::real_t x, tinyobj::real_t y, tinyobj::real_t z) {
    const Vec3f n{static_cast<float>(x), static_cast<float>(y), static_cast<float>(z)};
    const float size = length(n);
    self(user).normals.push_back(size > 1e-20f ? n * (1 / size) : Vec3f{});
  };
  c.texcoord_cb = [](void* user, tinyobj::real_t x, tinyobj::real_t y, tinyobj::real_t) {
    self(user).uvs.push_back({static_cast<float>(x), static_cast<float>(y)});
  };
  c.index_cb = [](void* user, tinyobj::index_t* corners, int count) { self(user).add_face(corners, count); };
  c.usemtl_cb = [](void* user, const char* name, int) {
    Builder& b = self(user);
    const std::string text(trimmed(name));
    const auto it = b.material_index.find(text);
    b.material = it == b.material_index.end() ? -1 : it->second;
    if (it == b.material_index.end()) b.missing_materials.insert(text);
  };
  c.group_cb = [](void* user, const char** names, int count) {
    Builder& b = self(user);
    std::string name;
    for (int i = 0; i < count; ++i) name.append(i == 0 ? "" : " ").append(names[i]);
    b.group = Builder::named(b.group_index, b.mesh.groups, name);
    if (!b.outline.has_objects)
      b.object = Builder::named(b.object_index, b.mesh.objects, name.empty() ? "unnamed" : name);
  };
  c.object_cb = [](void* user, const char* name) {
    Builder& b = self(user);
    b.object = Builder::named(b.object_index, b.mesh.objects, std::string(trimmed(name)));
    b.group = Builder::named(b.group_index, b.mesh.groups, "");
  };
  return c;
}

}  // namespace

TriangleMesh load_obj(const std::string& path, Diagnostics& diagnostics) {
  const std::string text = read_text_file(path, std::size_t{1} << 30);
  const Outline outline = outline_of(text, path);
  const fs::path folder = fs::path(path).parent_path();
  TriangleMesh mesh;
  mesh.files.push_back(path);
  std::map<std::string, int> material_index;
  for (const std::string& line : outline.material_files)
    for (const std::string& name : material_names(folder, line))
      load_materials(folder, name, mesh, material_index, diagnostics);
  Builder builder{path, outline, mesh, material_index, {}, {}, {}, {}, {}};
  std::istringstream stream(outline.bare_groups.empty() ? text : with_blank_groups(text, outline.bare_groups));
  std::string warning, error;
  tinyobj::LoadObjWithCallback(stream, callbacks(), &builder, nullptr, &warning, &error);
  if (!error.empty()) refuse_damaged(path, error);
  for (const std::string& name : builder.missing_materials)
    diagnostics.warning("scene.obj.material", path, "material '" + name + "' is not defined",
                        "its surfaces get a colour by object; add it to the MTL file");
  if (mesh.triangles.empty())
    throw Error(ErrorKind::data, "scene.obj.empty", path + ": holds no triangle",
                "check that the file was exported completely");
  if (mesh.zero_area_skipped > 0)
    diagnostics.note("scene.obj.area", path, fmt::format("skipped {} faces without area", mesh.zero_area_skipped));
  return mesh;
}
#else
TriangleMesh load_obj(const std::string& path, Diagnostics&) {
  throw Error(ErrorKind::unavailable, "scene.obj.unsupported", path + ": this build cannot read OBJ files",
              "configure with -DSEMFIELD_WITH_RAYCAST=ON (needs tinyobjloader)");
}
#endif

std::vector<std::int32_t> pieces_of(const TriangleMesh& mesh, const std::vector<std::int16_t>& class_of, double gap_m) {
  using Cell = std::tuple<std::int16_t, int, int, int>;
  std::map<Cell, std::uint32_t> first;  // triangle of a class in a cell
  JoinedSets sets(mesh.size());         // of triangles
  for (std::size_t t = 0; t < mesh.size(); ++t) {
    const Vec3d a = mesh.corner(t, 0), ab = mesh.corner(t, 1) - a, ac = mesh.corner(t, 2) - a;
    const auto n = static_cast<int>(
        std::clamp(std::ceil(std::max({length(ab), length(ac), length(ac - ab)}) / gap_m), 1.0, 1000.0));
    for (int i = 0; i <= n; ++i) {
      for (int j = 0; i + j <= n; ++j) {
        const Vec3d p = a + ab * (static_cast<double>(i) / n) + ac * (static_cast<double>(j) / n);
        const Cell cell{class_of[t], static_cast<int>(std::floor(p.x / gap_m)),
                        static_cast<int>(std::floor(p.y / gap_m)), static_cast<int>(std::floor(p.z / gap_m))};
        const auto [found, fresh] = first.emplace(cell, static_cast<std::uint32_t>(t));
        if (!fresh) sets.join(found->second, static_cast<std::uint32_t>(t));
      }
    }
  }
  for (const auto& [cell, t] : first) {
    const auto [c, x, y, z] = cell;
    for (int step = 14; step < 27; ++step) {  // half of the 26 cells around it
      const auto other = first.find({c, x + step / 9 - 1, y + step / 3 % 3 - 1, z + step % 3 - 1});
      if (other != first.end()) sets.join(t, other->second);
    }
  }
  std::map<std::uint32_t, std::int32_t> number;
  std::vector<std::int32_t> piece;
  for (std::uint32_t t = 0; t < mesh.size(); ++t)
    piece.push_back(number.emplace(sets.of(t), static_cast<std::int32_t>(number.size())).first->second);
  return piece;
}

// Polygons into triangles by ear clipping.

std::vector<std::array<int, 3>> triangulate_polygon(const std::vector<Vec3f>& corners) {
  const int n = static_cast<int>(corners.size());
  std::vector<std::array<int, 3>> out;
  if (n == 3) return {{0, 1, 2}};
  // Newell's normal: its largest component is the axis to drop.
  Vec3d normal{};
  for (int i = 0; i < n; ++i) {
    const Vec3f p = corners[static_cast<std::size_t>(i)], q = corners[static_cast<std::size_t>((i + 1) % n)];
    normal.x += static_cast<double>(p.y - q.y) * (p.z + q.z);
    normal.y += static_cast<double>(p.z - q.z) * (p.x + q.x);
    normal.z += static_cast<double>(p.x - q.x) * (p.y + q.y);
  }
  int drop = 0;
  if (std::abs(normal.y) > std::abs(normal[drop])) drop = 1;
  if (std::abs(normal.z) > std::abs(normal[drop])) drop = 2;
  const int ax = (drop + 1) % 3, ay = (drop + 2) % 3;
  const double sign = normal[drop] < 0 ? -1 : 1;
  const auto turn = [&](int a, int b, int c) {  // > 0: left turn seen along the normal
    const Vec3f &p = corners[static_cast<std::size_t>(a)], &q = corners[static_cast<std::size_t>(b)],
                &r = corners[static_cast<std::size_t>(c)];
    return sign * ((static_cast<double>(q[ax]) - p[ax]) * (static_cast<double>(r[ay]) - p[ay]) -
                   (static_cast<double>(q[ay]) - p[ay]) * (static_cast<double>(r[ax]) - p[ax]));
  };
  std::vector<int> ring;
  for (int i = 0; i < n; ++i) ring.push_back(i);
  while (ring.size() > 3) {
    const std::size_t m = ring.size();
    std::size_t ear = m;
    for (std::size_t i = 0; i < m && ear == m; ++i) {
      const int a = ring[(i + m - 1) % m], b = ring[i], c = ring[(i + 1) % m];
      if (turn(a, b, c) <= 0) continue;
      bool clear = true;
      for (std::size_t k = 0; k < m && clear; ++k) {
        const int p = ring[k];
        if (p == a || p == b || p == c) continue;
        clear = !(turn(a, b, p) >= 0 && turn(b, c, p) >= 0 && turn(c, a, p) >= 0);
      }
      if (clear) ear = i;
    }
    if (ear == m) break;  // crosses itself or is flat: a fan of what is left
    out.push_back({ring[(ear + m - 1) % m], ring[ear], ring[(ear + 1) % m]});
    ring.erase(ring.begin() + static_cast<std::ptrdiff_t>(ear));
  }
  for (std::size_t i = 1; i + 1 < ring.size(); ++i) out.push_back({ring[0], ring[i], ring[i + 1]});
  return out;
}

}  // namespace semfield
