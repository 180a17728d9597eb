// Whether a scene's classes are still those that a network was trained with.
#pragma once

#include <string>

#include "classes/class_table.h"

namespace semfield {

/// Throws Error(data) with the first id that `trained`, a table as YAML, and `now` do not agree in; colours do not
/// count. Labels would be shifted without a word.
void require_class_table(const std::string& trained, const ClassTable& now);

}  // namespace semfield
