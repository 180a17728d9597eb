// What `semfield objects` writes: images of ids, COCO's panoptic form, the table of objects, and labelled points.
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
///   objects.json, objects.csv   a row per object
///   objects.ply          points of the surface, label = id, in colours of the objects
/// Every file appears whole. Throws as write_file_atomic; Error(data) for more than 1,024 objects.
class ObjectFiles {
 public:
  /// Borrows all three.
  ObjectFiles(std::string folder, const FoundObjects& found, const SceneInfo& info);
  void add(const ObjectView& view);
  /// `about`: keys of objects.json beside the table, as JSON text of an object.
  void finish(const std::string& about);

 private:
  std::string path(const std::string& name) const;
  std::int32_t panoptic_id(std::int32_t object, std::int16_t label) const;
  std::string panoptic_json() const;
  std::string table_json(const std::string& about) const;
  std::string table_csv() const;
  void write_points() const;

  std::string folder_;
  const FoundObjects& found_;
  const SceneInfo& info_;
  std::vector<std::string> images_, annotations_;  // JSON texts
};

/// "chair", or "object" where the class is not known.
std::string object_class_name(const ObjectRow& row, const ClassTable& classes);

}  // namespace semfield::app
