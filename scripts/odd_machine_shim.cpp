// Preloaded by scripts/odd_machines: programs believe in as many cores as SEMFIELD_ODD_CORES says.
#include <dlfcn.h>
#include <sched.h>

#include <cstdlib>

extern "C" int sched_getaffinity(pid_t pid, size_t size, cpu_set_t* set) noexcept {
  using Call = int (*)(pid_t, size_t, cpu_set_t*);
  static const Call system_call = reinterpret_cast<Call>(dlsym(RTLD_NEXT, "sched_getaffinity"));
  const char* const cores = std::getenv("SEMFIELD_ODD_CORES");
  if (cores == nullptr) return system_call(pid, size, set);
  CPU_ZERO_S(size, set);
  for (int core = 0; core < std::atoi(cores); ++core) CPU_SET_S(static_cast<size_t>(core), size, set);
  return 0;
}
