#include "datasets/obj_room/cast_cache.h"

#include <dlfcn.h>

#include <cstdio>
#include <filesystem>
#include <span>
#include <type_traits>

#include "loading/packed_scene.h"
#include "system/cache_folder.h"
#include "system/files.h"
#include "system/sha256.h"

namespace semfield {

namespace {

namespace fs = std::filesystem;

class Sum {
 public:
  template <class T>
  void add(const T& value) {
    static_assert(std::is_trivially_copyable_v<T> && std::has_unique_object_representations_v<T>);
    sha_.add(std::as_bytes(std::span<const T>(&value, 1)));
  }
  void add(double value) { sha_.add(std::as_bytes(std::span<const double>(&value, 1))); }
  void add(float value) { sha_.add(std::as_bytes(std::span<const float>(&value, 1))); }
  void add(Vec3d v) {
    for (int k = 0; k < 3; ++k) add(v[k]);
  }
  void add(const std::string& text) {
    add(static_cast<std::uint64_t>(text.size()));
    sha_.add(std::as_bytes(std::span<const char>(text)));
  }
  template <class T, std::size_t kSize>
  void add(const std::array<T, kSize>& values) {
    for (const T& value : values) add(value);
  }
  /// Elements without gaps between or in them.
  template <class T>
  void add_all(const std::vector<T>& values) {
    add(static_cast<std::uint64_t>(values.size()));
    sha_.add(std::as_bytes(std::span<const T>(values)));
  }
  std::string hex() { return sha_.hex(); }

 private:
  Sha256 sha_;
};

/// Size and time of the file that holds this code: another build may cast other pictures.
void add_program(Sum& sum) {
  Dl_info info{};
  if (dladdr(reinterpret_cast<const void*>(&add_program), &info) == 0 || info.dli_fname == nullptr) return;
  std::error_code failed;
  sum.add(static_cast<std::uint64_t>(fs::file_size(info.dli_fname, failed)));
  sum.add(static_cast<std::int64_t>(fs::last_write_time(info.dli_fname, failed).time_since_epoch().count()));
}

/// A texture's bytes; one that cannot be read is a warning of the renderer and paints nothing.
void add_file(Sum& sum, const std::string& path) {
  sum.add(path);
  if (path.empty()) return;
  try {
    sum.add(read_text_file(path));
  } catch (const Error&) {
    sum.add(std::string("unreadable"));
  }
}

SceneInfo alone(const FrameInfo& frame, const ClassTable& classes) {
  SceneInfo info;
  info.name = "cast";
  info.classes = classes;
  info.frames = {frame};
  return info;
}

}  // namespace

std::string cast_key(const TriangleMesh& mesh, const std::vector<std::int16_t>& class_of,
                     const RenderSettings& settings) {
  Sum sum;
  add_program(sum);
  sum.add_all(mesh.positions);
  sum.add_all(mesh.triangles);
  sum.add_all(mesh.uv);
  sum.add_all(mesh.normals);
  sum.add_all(mesh.material_of);
  sum.add_all(mesh.object_of);
  if (!mesh.piece_of.empty()) sum.add_all(mesh.piece_of);
  sum.add_all(class_of);
  for (const Material& m : mesh.materials) {
    sum.add(m.diffuse);
    sum.add(m.emission);
    sum.add(m.opacity);
    add_file(sum, m.diffuse_map);
    add_file(sum, m.opacity_map);
  }
  for (const Light& light : settings.lights) {
    sum.add(light.position);
    sum.add(light.radius_m);
    sum.add(light.intensity);
  }
  sum.add(settings.ambient_above);
  sum.add(settings.ambient_below);
  sum.add(settings.up);
  sum.add(settings.occlusion_m);
  for (const int count : {settings.occlusion_rays, settings.shadow_rays, settings.supersample}) sum.add(count);
  sum.add(settings.exposure);
  sum.add(settings.background);
  sum.add(settings.seed);
  return sum.hex();
}

CastCache::CastCache(const std::string& key) {
  const std::uint64_t limit = cache_limit();
  const std::string rooms = cache_folder("rooms");
  if (rooms.empty() || limit == 0) return;
  const std::string folder = (fs::path(rooms) / key).string();
  std::error_code failed;
  fs::create_directory(folder, failed);
  if (failed) return;
  use_cache_entry(folder, limit);
  folder_ = folder;
}

std::string CastCache::file_of(std::uint64_t number, const FrameInfo& frame) const {
  Sum sum;
  const Camera& c = frame.camera;
  for (const double value : {c.fx, c.fy, c.cx, c.cy}) sum.add(value);
  sum.add(c.width_px);
  sum.add(c.height_px);
  for (int axis = 0; axis < 3; ++axis) {
    Vec3d unit{0, 0, 0};
    unit[axis] = 1;
    sum.add(frame.world_from_camera.rotate(unit));
  }
  sum.add(frame.world_from_camera.t);
  return folder_ + "/" + std::to_string(number) + "_" + sum.hex().substr(0, 16) + ".sfpack";
}

bool CastCache::read(std::uint64_t number, const FrameInfo& frame, FrameBuffer& out) const {
  if (folder_.empty()) return false;
  try {
    const std::string file = file_of(number, frame);
    if (!fs::exists(file)) return false;
    PackedScene(file).read(0, out);
    return out.width_px == frame.camera.width_px && out.height_px == frame.camera.height_px && !out.rgb.empty();
  } catch (const Error&) {
    return false;
  }
}

void CastCache::write(std::uint64_t number, const FrameInfo& frame, const ClassTable& classes,
                      const FrameBuffer& cast) const {
  if (folder_.empty()) return;
  try {
    write_packed_scene(file_of(number, frame), alone(frame, classes), [&cast](int, FrameBuffer& out) { out = cast; },
                       {.depth_as_mm = false});
  } catch (const Error&) {  // a full disk, or the folder was removed meanwhile
  }
}

}  // namespace semfield
