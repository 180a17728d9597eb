// Preloaded by scripts/odd_machines: the program believes in as many cores as SEMFIELD_ODD_CORES says, and lives inside
// a program that has taken over its user's locale.
#include <dlfcn.h>
#include <sched.h>

#include <cstdlib>
#include <exception>
#include <locale>

extern "C" int sched_getaffinity(pid_t pid, size_t size, cpu_set_t* set) noexcept {
  using Call = int (*)(pid_t, size_t, cpu_set_t*);
  static const Call system_call = reinterpret_cast<Call>(dlsym(RTLD_NEXT, "sched_getaffinity"));
  const char* const cores = std::getenv("SEMFIELD_ODD_CORES");
  if (cores == nullptr) return system_call(pid, size, set);
  CPU_ZERO_S(size, set);
  for (int core = 0; core < std::atoi(cores); ++core) CPU_SET_S(static_cast<size_t>(core), size, set);
  return 0;
}

namespace {
struct TakeLocale {
  TakeLocale() {
    if (std::getenv("SEMFIELD_ODD_LOCALE") == nullptr) return;
    try {
      std::locale::global(std::locale(""));  // of streams, and of the C library with it
    } catch (const std::exception&) {
      std::abort();  // a locale that is not installed would test nothing
    }
  }
} const take_locale;
}  // namespace
