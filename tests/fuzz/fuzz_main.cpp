// The entry point of libFuzzer: the environment variable SEMFIELD_FUZZ_TARGET names the target.
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <cstdlib>

#include "tests/fuzz/targets.h"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size);

int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  static const semfield::fuzz::Target& target = []() -> const semfield::fuzz::Target& {
    const char* name = std::getenv("SEMFIELD_FUZZ_TARGET");
    const semfield::fuzz::Target* found = semfield::fuzz::find_target(name != nullptr ? name : "");
    if (found == nullptr) {
      std::fputs("SEMFIELD_FUZZ_TARGET has to be one of:", stderr);
      for (const semfield::fuzz::Target& each : semfield::fuzz::targets())
        std::fprintf(stderr, " %.*s", static_cast<int>(each.name.size()), each.name.data());
      std::fputs("\n", stderr);
      std::exit(2);
    }
    return *found;
  }();
  target.run({reinterpret_cast<const char*>(data), size});
  return 0;
}
