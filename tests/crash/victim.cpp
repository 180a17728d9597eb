// The process that faults are thrown at: `save WHAT FOLDER` saves, `look WHAT FOLDER` says what a fresh start finds.
#include <cstdio>

#include "core/error.h"
#include "tests/crash/scenarios.h"

int main(int count, char** words) {
  using namespace semfield;
  using namespace semfield::testing_crash;
  if (count != 4) return 2;
  const std::string verb = words[1], folder = words[3];
  const Save what = save_of(words[2]);
  if (verb == "look") {
    const Look found = look(what, folder);
    std::printf("%08x %d %s\n", found.crc, found.temporaries, found.bad.c_str());
    return 0;
  }
  try {
    perform(what, folder);
  } catch (const Error& error) {
    std::fprintf(stderr, "%s\n", error.what());
    return static_cast<int>(error.kind());
  }
  return 0;
}
