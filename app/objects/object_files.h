// Objects in rendered views as files: images of ids and COCO's panoptic form.
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "objects/find_objects.h"

namespace semfield::app {

/// A rendered view: ids and, with semantics, the field's classes, [H * W] each.
struct ObjectView {
  const FrameInfo& frame;
  std::span<const std::int32_t> id;
  std::span<const std::int16_t> label;
};

/// Writes into `folder`, which it makes:
///   instance/FRAME.png   16 bits, the ids of the table, 0: no object
///   panoptic/FRAME.png   COCO's panoptic form: R + 256 G + 65536 B, with panoptic.json beside the folder; ids of
///                        stuff lie behind those of the objects
/// Every file appears whole. Throws as write_file_atomic.
class ObjectFiles {
 public:
  /// Borrows all three.
  ObjectFiles(std::string folder, const FoundObjects& found, const SceneInfo& info);
  void add(const ObjectView& view);
  /// pictures/FRAME.png in `folder`, whose folder it makes.
  std::string picture_path(const FrameInfo& frame) const;
  void finish();

 private:
  std::string path(const std::string& name) const;
  std::int32_t panoptic_id(std::int32_t object, std::int16_t label) const;
  std::string panoptic_json() const;

  std::string folder_;
  const FoundObjects& found_;
  const SceneInfo& info_;
  std::vector<std::string> images_, annotations_;  // JSON texts
};

}  // namespace semfield::app
