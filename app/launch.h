// Verbs as one of several processes that mpirun or srun started.
#pragma once

#include <cstdint>
#include <functional>
#include <string>

#include "app/app_context.h"

namespace semfield::app {

/// What a verb does as one of several processes that a launcher started.
enum class Launch : std::uint8_t {
  alone,   ///< it is refused
  ranks,   ///< rank 0 runs it with AppContext::ranks, and the others follow (session/session.h)
  beside,  ///< every process runs it, and it sees to the others itself
};

/// Whether this process prints what went wrong before it has joined the others: rank 0 does, and who is alone.
bool is_first_process();

/// What a process of a launcher does.
struct LaunchedVerb {
  std::string name;
  Launch launch = Launch::alone;
  std::function<int(AppContext&)> run;
  std::string words;  ///< its command line, without the program
};

/// Runs a verb as its `launch` says; without a launcher it just runs. Throws Error(usage) where a verb works alone, and
/// where ranks were started with different words: rank 0's alone would count.
int run_launched(const LaunchedVerb& verb, AppContext& context);

}  // namespace semfield::app
