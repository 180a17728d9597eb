#include "scene/classes/void_class.h"

namespace semfield {

ClassTable with_void(const ClassTable& classes) {
  std::vector<ClassEntry> entries = classes.entries();
  std::int32_t free_id = 0;
  for (const ClassEntry& e : entries) {  // ordered by id
    if (e.ignore) return classes;
    if (e.id == free_id) ++free_id;
  }
  entries.push_back({free_id, "void", {0, 0, 0}, true});
  return ClassTable(std::move(entries));
}

}  // namespace semfield
