#include "app/bench/bench_tools.h"

#include "app/allocation_count.h"
#include "system/files.h"

namespace semfield::app {

StudyTools study_tools(AppContext& context) {
  return {context.registry, [&context](const std::string& text) { print_note(context, text); }, shared_file,
          [] { return allocations_so_far().bytes; }};
}

}  // namespace semfield::app
