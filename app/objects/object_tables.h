// The table of objects as files: JSON, CSV and labelled points. Edits that a person made are in them.
#pragma once

#include <cstdint>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "objects/object_edits.h"
#include "objects/segments.h"
#include "scene/scene.h"

namespace semfield::app {

/// Names objects and their edits: the same have the same, others another.
std::string objects_state(const ObjectEdits& edits);

/// Writes objects.json, the table with the keys of set.about, the number of edits and objects_state beside it, then
/// objects.csv and objects.ply (points of the surface, label = id, in colours of the objects), into `folder`. Every
/// file appears whole; objects.json is first, so that where it has another state than the edits, any may be old. Throws
/// as write_file_atomic; Error(data) for more than 1,024 objects.
void write_object_tables(const std::string& folder, const EditedObjects& objects, const SceneInfo& info);
/// The state of the tables in `folder`; "": there are none. Earlier versions told none: then that of `edits` where
/// there are none that the tables could lack.
std::string tables_state(const std::string& folder, const ObjectEdits& edits);

/// The objects in RUN/objects with their edits; none where none were found. `classes`: valid ones of the run's table.
/// Throws as read_edited_objects.
std::optional<ObjectSet> objects_of_run(const std::string& run_dir, int classes);

/// Throws Error(data) for more objects than files hold, before anything is written.
void check_object_count(const std::vector<ObjectRow>& rows);

/// "chair", or "object" where the class is not known.
std::string object_class_name(const ObjectRow& row, const ClassTable& classes);
/// "chair 3", or what a person called it.
std::string object_name(const ObjectRow& row, const ClassTable& classes);

/// A row of the table as a JSON object, as objects.json has it.
std::string object_row_json(const ObjectRow& row, const ClassTable& classes);

// Objects for the eye: a strip of panels for a view.

/// Writes a PNG of panels side by side: the photograph, the segments that were given (left out where `given` is empty),
/// the objects found and the true ones. A found object has the colour of the true one that it shares most pixels with;
/// what is no object is grey. `id` [H * W] objects found, 0: none; `stuff` [classes]. `frame` has labels and instances.
/// Throws as write_png_rgb.
void write_object_strip(const std::string& path, const StoredFrame& frame, const FrameSegments& given,
                        std::span<const std::int32_t> id, const std::vector<bool>& stuff);

}  // namespace semfield::app
