// Rooms of OBJ + MTL files: triangle meshes, rays against them, pictures, camera paths through free space, and classes
// by the names of parts. mesh_io.cpp is the only user of tinyobjloader, mesh_render.cpp of Embree.
#pragma once

#include <array>
#include <cstdint>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "core/error.h"
#include "core/non_copyable.h"
#include "core/small_math.h"
#include "scene/classes/class_table.h"
#include "scene/scene.h"

namespace semfield {

using Vec3f = Vec3<float>;

/// Appearance of a surface: lambertian colour, emission and cut-outs.
struct Material {
  std::string name;
  std::array<float, 3> diffuse{0.6f, 0.6f, 0.6f};  ///< Kd, linear
  std::array<float, 3> emission{};                 ///< Ke, linear; multiplied by the colour texture when there is one
  float opacity = 1;                               ///< d; below 0.5 the surface lets rays through
  std::string diffuse_map;                         ///< map_Kd, path as resolved from the MTL's folder; "" = none
  std::string opacity_map;                         ///< map_d, likewise
};

/// A triangle soup with names. Per-triangle vectors have one element a triangle.
struct TriangleMesh {
  std::vector<Vec3f> positions;                         ///< file units (metres)
  std::vector<std::array<std::uint32_t, 3>> triangles;  ///< indices into positions
  std::vector<std::array<std::array<float, 2>, 3>> uv;  ///< per corner, v up; zeros where the file has none
  std::vector<std::array<Vec3f, 3>> normals;            ///< per corner, unit; zero vectors where the file has none
  std::vector<std::int32_t> material_of;                ///< index into materials, -1 = none named or not found
  std::vector<std::int32_t> object_of;                  ///< index into objects
  std::vector<std::int32_t> piece_of;                   ///< what instances are by; empty: object_of
  std::vector<std::int32_t> group_of;                   ///< index into groups
  std::vector<Material> materials;
  std::vector<std::string> objects;  ///< `o` names (the `g` names of a file without `o`), file order
  std::vector<std::string> groups;   ///< `g` names, "" = none
  std::vector<std::string> files;    ///< that it was read from, and those of its textures
  Box bounds;
  std::int64_t zero_area_skipped = 0;

  std::size_t size() const { return triangles.size(); }
  /// Corner k of a triangle in float64.
  Vec3d corner(std::size_t triangle, std::size_t k) const {
    const Vec3f p = positions[triangles[triangle][k]];
    return {p.x, p.y, p.z};
  }
  /// Along its normal, as long as twice its area.
  Vec3d cross_of_sides(std::size_t triangle) const {
    const Vec3d a = corner(triangle, 0);
    return cross(corner(triangle, 1) - a, corner(triangle, 2) - a);
  }
};

/// Reads an OBJ file with its MTL files. Polygons are cut into triangles, negative indices count back from the last
/// vertex, faces without area are skipped and counted. Missing MTL files, materials and texture files become warnings
/// that name them (surfaces without a material get a colour by object). Throws Error(no_input) for a missing file and
/// Error(data) with file and line for vertices that are not finite numbers, faces with fewer than three corners,
/// indices out of range and files without any triangle.
TriangleMesh load_obj(const std::string& path, Diagnostics& diagnostics);

/// Cuts a planar polygon with n >= 3 corners into n - 2 triangles of corner numbers, keeping its orientation; ear
/// clipping, so that concave polygons come out right. Falls back to a fan for polygons that cross themselves.
std::vector<std::array<int, 3>> triangulate_polygon(const std::vector<Vec3f>& corners);

// Pieces of a mesh: what is of one class and touches, whatever the names and materials of its parts.

/// The piece of each triangle, numbered from 0 on in the order of the first triangles. Triangles of one class
/// (`class_of`, one a triangle) are of one piece where points of them lie within about `gap_m` of each other.
std::vector<std::int32_t> pieces_of(const TriangleMesh& mesh, const std::vector<std::int16_t>& class_of, double gap_m);

// Rays, const and callable from any thread, and pictures: lambertian shading with soft shadows and ambient occlusion,
// labels and depth at pixel centres.

/// Nearest surface along a ray.
struct RayHit {
  std::int64_t triangle = -1;  ///< -1 = nothing hit
  double distance_m = 0;       ///< along the unit direction, from the triangle's plane in float64
  float b1 = 0, b2 = 0;        ///< barycentric weights of corners 1 and 2

  bool hit() const { return triangle >= 0; }
};

/// False where a surface lets rays through: (triangle, b1, b2).
using OpaqueTest = std::function<bool(std::int64_t, float, float)>;

/// Whether this build can cast rays (SEMFIELD_WITH_RAYCAST).
bool raycast_available();

/// Ray queries, const and callable from any thread. Keeps its own copy of nothing: the mesh must outlive it.
class Raycaster : NonCopyable {
 public:
  /// `cut_out` has one element a triangle (true: ask `opaque` at every hit) or is empty. Throws Error(unavailable) in a
  /// build without Embree.
  explicit Raycaster(const TriangleMesh& mesh, std::vector<bool> cut_out = {}, OpaqueTest opaque = {});
  ~Raycaster();

  /// Nearest hit of origin + t * direction with t in (0, max_m]; direction has unit length.
  RayHit trace(Vec3d origin, Vec3d direction, double max_m = 1e6) const;
  /// Whether anything opaque lies on origin + t * direction, t in [0, max_m].
  bool blocked(Vec3d origin, Vec3d direction, double max_m) const;
  /// Distance from a point to the nearest triangle, at most `limit_m` (returned when nothing is nearer). Exact, any
  /// direction.
  double clearance(Vec3d point, double limit_m) const;

 private:
  struct Impl;
  std::unique_ptr<Impl> impl_;
};

// Pictures.

/// Repeating RGB texture, linear [0, 1].
class Texture {
 public:
  Texture() = default;
  /// `rgb` is sRGB-coded [H * W * 3], top row first.
  Texture(std::int32_t width, std::int32_t height, const std::vector<std::uint8_t>& rgb);
  /// Throws Error naming the file.
  static Texture load(const std::string& path);

  std::int32_t width() const { return levels_.empty() ? 0 : levels_[0].width; }
  std::int32_t height() const { return levels_.empty() ? 0 : levels_[0].height; }
  /// Trilinear: (u, v) with v up as in OBJ files; `level` 0 = full size, each level halves it.
  std::array<float, 3> sample(float u, float v, float level) const;

 private:
  struct Level {
    std::int32_t width = 0, height = 0;
    std::vector<float> rgb;
  };
  std::array<float, 3> bilinear(const Level& level, float u, float v) const;
  std::vector<Level> levels_;
};

/// Repeating opacity mask [0, 1]: the image's alpha channel, or its brightness without one. Nearest texel.
class Mask {
 public:
  static Mask load(const std::string& path);
  bool opaque(float u, float v) const;

 private:
  std::int32_t width_ = 0, height_ = 0;
  std::vector<std::uint8_t> values_;
};

float srgb_of_linear(float value);

/// A ball of light.
struct Light {
  Vec3d position;
  double radius_m = 0.15;
  std::array<float, 3> intensity{1, 1, 1};  ///< irradiance at 1 m, facing it
};

struct RenderSettings {
  std::vector<Light> lights;
  std::array<float, 3> ambient_above{0.42f, 0.43f, 0.45f};  ///< irradiance of a surface facing up, unoccluded
  std::array<float, 3> ambient_below{0.34f, 0.32f, 0.30f};  ///< ... facing down
  Vec3d up{0, 0, 1};
  double occlusion_m = 1.0;  ///< hemisphere rays end here
  int occlusion_rays = 8;    ///< a pixel
  int shadow_rays = 2;       ///< a pixel and light
  int supersample = 2;       ///< colour samples per pixel = its square
  float exposure = 1.0f;
  std::array<float, 3> background{0.75f, 0.85f, 0.95f};  ///< linear colour where no surface is hit
  std::uint64_t seed = 0;
};

/// Renders a mesh. Colours do not depend on the view direction; results do not depend on threads.
class MeshRenderer : NonCopyable {  // the ray-casting scene points into this object
 public:
  /// Loads textures (problems become warnings) and builds the ray-casting scene. `class_of` has one class index a
  /// triangle.
  MeshRenderer(TriangleMesh mesh, std::vector<std::int16_t> class_of, RenderSettings settings,
               Diagnostics& diagnostics);

  /// All channels of one frame; instance = piece or object index + 1. `frame` addresses the random values.
  void render(const Camera& camera, const Pose& world_from_camera, std::uint64_t frame, FrameBuffer& out) const;

  const Raycaster& rays() const { return *rays_; }
  const TriangleMesh& mesh() const { return mesh_; }
  void set_lights(std::vector<Light> lights) { settings_.lights = std::move(lights); }

 private:
  struct Surface {
    std::int64_t triangle = -1;
    std::int32_t object = -1;
    double distance_m = 0;
    Vec3d point;
    Vec3f normal;  // shading normal towards the viewer
    Vec3f facet;   // geometric normal towards the viewer
    float u = 0, v = 0;
  };
  using Color = std::array<float, 3>;
  struct Look {
    const Material* material = nullptr;
    const Texture* texture = nullptr;
    const Mask* mask = nullptr;
    bool is_open() const { return material != nullptr && material->opacity < 0.5f; }
  };

  const Look& look(std::size_t triangle) const {
    return looks_[static_cast<std::size_t>(mesh_.material_of[triangle] + 1)];
  }
  Surface surface(Vec3d origin, Vec3d direction) const;
  Color albedo(const Surface& s, double footprint_m) const;
  Color emission(const Surface& s, const Color& albedo) const;
  /// Irradiance from `pattern` (0..15) of 16 interleaved sample sets; all 16 together are one well spread set.
  Color irradiance(const Surface& s, int pattern, std::uint64_t frame, std::uint64_t pixel) const;
  bool opaque(std::int64_t triangle, float b1, float b2) const;
  float noise(Vec3d p) const;
  void prepare_materials(Diagnostics& diagnostics);

  TriangleMesh mesh_;
  std::vector<std::int16_t> class_of_;
  RenderSettings settings_;
  std::map<std::string, std::optional<Texture>> textures_;  // by path; none where it cannot be read
  std::map<std::string, std::optional<Mask>> masks_;
  std::vector<Look> looks_{{}};      // of no material, then of each
  std::vector<float> texels_per_m_;  // by triangle, 0 = no texture
  std::vector<Color> object_color_;  // for surfaces without material
  std::vector<float> lattice_;       // 32^3 random values
  std::unique_ptr<Raycaster> rays_;
};

// Frames that were cast before: casting is the slowest part of opening a room, and every program that reads it would do
// it again.

/// SHA-256 over all that the pictures of a room depend on: the library that casts, its parameters as text, and the
/// bytes of the files that it is read from.
std::string cast_key(const std::string& settings, const std::vector<std::string>& files);

/// A folder of the user's cache, one file a frame. Every read is checked by the file's checksums, and what is missing
/// or damaged counts as not there. Thread-safe.
class CastCache {
 public:
  /// Keeps nothing.
  CastCache() = default;
  /// The room of that key. Keeps nothing where there is no cache folder (core/files.h).
  explicit CastCache(const std::string& key);

  bool read(std::uint64_t number, const FrameInfo& frame, FrameBuffer& out) const;
  /// A frame that cannot be written is not kept; the next program casts it again.
  void write(std::uint64_t number, const FrameInfo& frame, const ClassTable& classes, const FrameBuffer& cast) const;

 private:
  std::string file_of(std::uint64_t number) const { return folder_ + "/" + std::to_string(number) + ".sfpack"; }
  std::string folder_;
};

// Camera paths.

struct PathSettings {
  int poses = 0;
  std::uint64_t seed = 0;
  Vec3d up{0, 0, 1};          ///< one of the world's axes
  Box region;                 ///< camera centres stay in it, world units
  double clearance_m = 0.35;  ///< no surface is nearer to a camera centre
  double lowest_m = 0.9;      ///< height above the floor of the region
  double highest_m = 1.9;
};

/// Seeded 6-DOF path, roll locked. Key positions are free, see surfaces in nearly every direction (so they lie inside
/// the room) and can see each other along free segments; key directions turn by the golden angle towards surfaces;
/// poses between the keys lie on a Catmull-Rom spline, or on the straight segment where the spline would come too near
/// to a surface. Throws Error(data) when the region has no free space.
std::vector<Pose> make_camera_path(const Raycaster& rays, const PathSettings& settings);

// From the names in a mesh file to classes.

/// Every pattern given must match; '*' stands for any text, '?' for one character. Earlier rules win.
struct ClassRule {
  std::string object, group, material;  ///< "" = not asked
  std::int32_t id = 0;
};

struct ClassRules {
  ClassTable table;
  std::vector<ClassRule> rules;
};

/// Reads classes.yaml or classes.csv as ClassTable::load does, or a YAML map
///   classes: [{id, name, color, ignore}, ...]
///   rules: [{object: "chair_*", class: chair}, {material: Glass, class: window}, ...]
/// Errors name file, line and column; all of a file are reported together.
ClassRules load_class_rules(const std::string& path);

/// Internal class index of each triangle. Without a matching rule the object's name decides: the part before "__", or
/// the name without trailing "_12", ".003" and the like, has to be a class name. Every object that has no class gets
/// its own error in one pass (its triangles become void).
std::vector<std::int16_t> classes_of_mesh(const TriangleMesh& mesh, const ClassRules& rules, Diagnostics& diagnostics);

bool matches_glob(const std::string& text, const std::string& pattern);

}  // namespace semfield
