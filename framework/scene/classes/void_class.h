// An id for void, so that label images can be written of any class table.
#pragma once

#include "scene/classes/class_table.h"

namespace semfield {

/// The table with an id for void: itself where it has one, else with an entry "void" of the lowest free id; without it
/// void pixels would be written with the id of a class or with one that nobody knows. Internal indices do not change.
ClassTable with_void(const ClassTable& classes);

}  // namespace semfield
