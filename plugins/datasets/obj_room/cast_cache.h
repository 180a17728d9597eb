// Frames that were cast before: casting is the slowest part of opening a room, and every program that reads it would do
// it again.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "datasets/obj_room/mesh_render.h"
#include "scene/scene.h"

namespace semfield {

/// SHA-256 over all that pictures of a mesh depend on beside the camera: the mesh, its classes, materials with the
/// bytes of their textures, lights, settings, and the library that casts.
std::string cast_key(const TriangleMesh& mesh, const std::vector<std::int16_t>& class_of,
                     const RenderSettings& settings);

/// A folder of the user's cache, one file a frame. Every read is checked by the file's checksums, and what is missing
/// or damaged counts as not there. Thread-safe.
class CastCache {
 public:
  /// Keeps nothing.
  CastCache() = default;
  /// The room of that key. Keeps nothing where there is no cache folder (system/cache_folder.h).
  explicit CastCache(const std::string& key);

  bool read(std::uint64_t number, const FrameInfo& frame, FrameBuffer& out) const;
  /// A frame that cannot be written is not kept; the next program casts it again.
  void write(std::uint64_t number, const FrameInfo& frame, const ClassTable& classes, const FrameBuffer& cast) const;

 private:
  std::string file_of(std::uint64_t number, const FrameInfo& frame) const;
  std::string folder_;
};

}  // namespace semfield
