// Assignment: segments of an image are given to slots, each to one, and points learn the slot of their segment.
#include "groupings/assignment/assignment.h"

#include "plugin/module.h"

namespace semfield {

SEMFIELD_PLUGIN_MODULE(assignment, "1.0", [](Registry& registry) {
  registry.add_grouping<Assignment>("assignment",
                                    "A slot per object: segments of an image are given to slots, each to one.");
})

}  // namespace semfield
