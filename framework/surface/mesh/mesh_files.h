// Surfaces and points as files: PLY, OBJ with MTL, GLB. Positions are written in the world frame and scale they have.
#pragma once

#include <array>
#include <bit>
#include <cstdint>
#include <cstring>
#include <map>
#include <span>
#include <string>
#include <string_view>
#include <type_traits>
#include <unordered_map>
#include <vector>

#include "core/files.h"
#include "eval/evaluator.h"
#include "scene/classes/class_table.h"
#include "surface/mesh/surface.h"

namespace semfield {

/// Points without triangles: labelled point clouds.
struct PointSet {
  std::vector<Vec3d> positions;
  std::vector<Vec3d> normals;    ///< unit, towards the eye; empty: not known
  std::vector<float> footprint;  ///< side of the square that a pixel saw of the surface there; empty: not known
  PointAttributes attributes;
};

/// Binary little-endian PLY. Vertices: x y z (double), nx ny nz (float), red green blue (uchar); with semantics label
/// (int: the id of the class table), scalar_label (float: the same, as CloudCompare has scalar fields), quality (float:
/// the same, as MeshLab has one), and entropy (float, nats); with objects instance and scalar_instance (their ids, 0 =
/// none). Faces: vertex_indices. Open3D reads label from files with int, and none with ushort.
void write_ply(const std::string& path, const Surface& surface, const ClassTable& classes);
/// The same without faces, and without normals where there are none.
void write_ply(const std::string& path, const PointSet& points, const ClassTable& classes);

/// OBJ: vertices with colours behind their coordinates (0..1), normals, and one group of faces with one material per
/// class; beside it `path` with .mtl, in which Kd is the class's colour in linear light. Materials carry the classes'
/// names, with blanks as '_'; two that would be equal get their id behind. Without semantics one material 'surface'.
void write_obj(const std::string& path, const Surface& surface, const ClassTable& classes);

/// How a viewer shows a GLB file.
struct GlbLook {
  Vec3d up{0, 1, 0};   ///< unit vector of the world that is upright
  bool unlit = false;  ///< colours hold the light already: they are shown as they are (KHR_materials_unlit)
  std::map<std::int32_t, std::string> objects{};  ///< names by id; one that is not there is "object 3"
};

/// glTF 2.0 binary: one primitive per class and one material, each primitive with vertices of its own: POSITION,
/// NORMAL, COLOR_0 (linear light, 16 bits) and, with semantics, _LABEL (the id, 16 bits) and _ENTROPY (nats). Materials
/// are single-sided, so that a room seen from outside is open; their extras hold class_id and the class's colour. An
/// object is a node "chair 3" with a mesh of its own, whose extras hold object_id; the rest is the mesh of the root.
/// Positions are in the input's world less offset_of_floats, rounded to 32 bits; the root turns `up` to +y and moves
/// them back, and asset.extras say both. Throws Error(data) for files over 4 GiB.
void write_glb(const std::string& path, const Surface& surface, const ClassTable& classes, const GlbLook& look);

/// What coordinates of 32 bits are counted from: 0, or, where one is 1,024 times as large as the box or more, the
/// middle of the box in whole hundreds of its decade().
Vec3d offset_of_floats(const Box& box);
/// The power of ten that the longest side of a box has: 1 for 1 to 9.99. 1 for a box without a size.
double decade(const Box& box);
Box box_around(std::span<const Vec3d> positions);

// A labelled point cloud from rendered depth of many views, thinned by voxels.

/// Where the pixels of a rendered view see a surface [H * W]: its place in the world, the unit normal of what the
/// pixels around show, towards the eye, and the side of the square that the pixel covers there. Depth is divided by
/// opacity: the mean of what was met.
struct SeenPixels {
  std::vector<char> seen;  ///< 0: opacity under `least_opacity`, or no depth
  std::vector<Vec3d> place, normal;
  std::vector<float> footprint;
};
SeenPixels seen_pixels(const RayCamera& camera, const RenderedFrame& frame, float least_opacity = 0.9F);

/// One point a cube of edge `voxel` (world units): mean place, normal and colour of what was seen in it, the least
/// footprint; label and entropy of the surest sight. Points come in the order in which cubes were first met, so views
/// in the same order give the same cloud.
class PointCloud {
 public:
  /// `background` is the colour behind the scene that rendering adds where light is left. Throws Error(usage) for an
  /// edge that is no positive number.
  explicit PointCloud(double voxel, const std::array<double, 3>& background = {});

  /// Adds what a rendered view saw. Colour is divided by opacity, as depth is.
  void add(const RenderedFrame& frame, const SeenPixels& pixels);
  PointSet points() const;

 private:
  struct Cell {
    Vec3d place_sum, normal_sum;
    std::array<double, 3> color_sum{};
    std::int64_t count = 0;
    std::int16_t label = -1;
    float entropy = 0, footprint = 0;
  };
  struct Hash {
    std::size_t operator()(const std::array<std::int64_t, 3>& key) const;
  };
  double voxel_;
  std::array<double, 3> background_;
  bool labels_ = false;
  std::unordered_map<std::array<std::int64_t, 3>, std::uint32_t, Hash> index_;
  std::vector<Cell> cells_;
};

// Little-endian values and text in large pieces into a file that appears whole or not at all.

class BufferedFile {
 public:
  explicit BufferedFile(const std::string& path) : file_(path) {}

  void text(std::string_view words) { bytes(words.data(), words.size()); }
  template <class T>
  void value(T number) {
    static_assert(std::is_arithmetic_v<T> && std::endian::native == std::endian::little);
    bytes(&number, sizeof number);
  }
  template <class T, std::size_t N>
  void value(const std::array<T, N>& numbers) {
    for (const T number : numbers) value(number);
  }
  template <class... T>
  void values(const T&... numbers) {
    (value(numbers), ...);
  }
  void floats(Vec3d v) { values(static_cast<float>(v.x), static_cast<float>(v.y), static_cast<float>(v.z)); }
  void commit() {
    flush();
    file_.commit();
  }

 private:
  void bytes(const void* data, std::size_t count) {
    const std::size_t at = pending_.size();
    pending_.resize(at + count);
    std::memcpy(pending_.data() + at, data, count);
    if (pending_.size() >= kPiece) flush();
  }
  void flush() {
    file_.append(pending_);
    pending_.clear();
  }

  static constexpr std::size_t kPiece = std::size_t{1} << 20;
  AtomicFile file_;
  std::vector<std::byte> pending_;
};

// Triangles of a surface by class, that of their corners (smooth_borders), with a name and a colour for each group: what
// OBJ and GLB write as materials.

struct ClassGroup {
  std::string name;                      ///< unique, of the class table; "surface" without semantics, "void" for none
  std::int32_t id = -1;                  ///< -1: no class
  std::int32_t instance = 0;             ///< object, where groups are told apart by it
  std::array<std::uint8_t, 3> color{};   ///< display-referred
  std::vector<std::uint32_t> triangles;  ///< numbers of triangles, ascending
};

/// Groups that have triangles, by ascending class index. `by_object`: by ascending object first, a group for every
/// class in it; groups of one class then have the same name.
std::vector<ClassGroup> class_groups(const Surface& surface, const ClassTable& classes, bool by_object = false);

/// A class's colour in its table; grey for kVoid.
std::array<std::uint8_t, 3> class_color(std::int16_t label, const ClassTable& classes);
/// That of every point; the attributes must have labels.
std::vector<std::array<std::uint8_t, 3>> class_colors(const PointAttributes& attributes, const ClassTable& classes);

/// Linear light of a display-referred 8-bit value (IEC 61966-2-1), 0..1.
double linear_light(std::uint8_t value);

}  // namespace semfield
