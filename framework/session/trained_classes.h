// Whether a scene's classes are still those that a network was trained with.
#pragma once

#include <optional>
#include <string>

#include "labels/clicks/annotations.h"
#include "scene/classes/class_table.h"

namespace semfield {

/// Throws Error(data) with the first id that `trained`, a table as YAML, and `now` do not agree in; colours do not
/// count. Labels would be shifted without a word. Classes that `clicks` gave names to may have had another one, or
/// none: they are told by their place.
void require_class_table(const std::string& trained, const ClassTable& now,
                         const std::optional<Annotations>& clicks = {});

}  // namespace semfield
