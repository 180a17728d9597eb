// The table of objects as files: JSON, CSV and labelled points. Edits that a person made are in them.
#pragma once

#include <optional>
#include <string>

#include "objects/object_set.h"
#include "scene/scene.h"

namespace semfield::app {

/// Writes objects.csv, objects.ply (points of the surface, label = id, in colours of the objects) and objects.json, the
/// table with the keys of set.about beside it, into `folder`. Every file appears whole. Throws as write_file_atomic;
/// Error(data) for more than 1,024 objects.
void write_object_tables(const std::string& folder, const ObjectSet& set, const SceneInfo& info);

/// The objects in RUN/objects with their edits; none where none were found. Throws as read_edited_objects.
std::optional<ObjectSet> objects_of_run(const std::string& run_dir);

/// Throws Error(data) for more objects than files hold, before anything is written.
void check_object_count(const std::vector<ObjectRow>& rows);

/// "chair", or "object" where the class is not known.
std::string object_class_name(const ObjectRow& row, const ClassTable& classes);
/// "chair 3", or what a person called it.
std::string object_name(const ObjectRow& row, const ClassTable& classes);

/// A row of the table as a JSON object, as objects.json has it.
std::string object_row_json(const ObjectRow& row, const ClassTable& classes);

}  // namespace semfield::app
