// A loadable module that shows, by a file, that code of it ran; CASE_ definitions make those that must be refused.
#include <cstdio>
#include <cstdlib>
#include <stdexcept>

#include "plugin/module.h"
#include "tests/plugin/toy_encoder.h"

namespace semfield::toy {
namespace {

// Runs when the library is mapped, before anything of it can be called.
const bool g_ran = [] {
  if (const char* const file = std::getenv("SEMFIELD_PROBE_FILE")) {
    if (std::FILE* const out = std::fopen(file, "w")) std::fclose(out);
  }
#if defined(CASE_THROWING)
  throw std::runtime_error("no licence found");
#endif
  return true;
}();

}  // namespace

#if defined(CASE_BENT)
/// Breaks a law: its gradient of the coordinates is wrong.
template <class Real>
class Bent final : public ToyEncoder<Real> {
 public:
  Bent(const ToyParams& params, const EncoderBuild& build, const KernelTables& kernels)
      : ToyEncoder<Real>(params, build, kernels, "wrong_dx") {}
};
void register_bent(Registry& registry);
void register_bent(Registry& registry) {
  registry.add_encoder<Bent, ToyParams>("bent", "A toy with a wrong gradient.");
}
#endif

#if defined(CASE_QUITTING)
/// Ends the process as a success in the middle of its laws.
template <class Real>
class Quitting final : public ToyEncoder<Real> {
 public:
  using ToyEncoder<Real>::ToyEncoder;

 protected:
  void do_backward(const StepContext&, const Tensors<Real>&, View<const double>, View<const Real>,
                   View<Real>) const override {
    std::exit(0);
  }
};
void register_quitting(Registry& registry);
void register_quitting(Registry& registry) {
  if (std::getenv("SEMFIELD_PROBE_QUITS") != nullptr) std::_Exit(0);
  registry.add_encoder<Quitting, ToyParams>("quitting", "A toy that ends the program.");
}
#endif

}  // namespace semfield::toy

#if defined(CASE_OTHER_API)
#define PROBE_API 999
#define PROBE_ABI SEMFIELD_ABI_TAG
#else
#define PROBE_API ::semfield::kPluginApi
#define PROBE_ABI "cxx0-another-library"
#endif

#if defined(CASE_OTHER_API) || defined(CASE_OTHER_ABI)
extern "C" {
extern const semfield::PluginStamp semfield_plugin_stamp;
__attribute__((section(".semfield_plugin"), used))
const semfield::PluginStamp semfield_plugin_stamp = {"semfield plugin", PROBE_API, PROBE_ABI};
}
#elif defined(CASE_OTHER_STAMP)
extern "C" {
extern const char semfield_plugin_stamp[256];
__attribute__((section(".semfield_plugin"), used)) const char semfield_plugin_stamp[256] = "something else";
}
#elif defined(CASE_SOUND_CUDA)
namespace semfield::cuda {
void probe_kernels(KernelTables& tables);
void probe_kernels(KernelTables& tables) {
  static constexpr int kTable = 0;
  tables.add(Device::cuda, "encoder 'toy'", &kTable);
}
}  // namespace semfield::cuda
SEMFIELD_PLUGIN_CUDA_KERNELS(probe_kernels)
#elif defined(CASE_BENT)
SEMFIELD_PLUGIN_MODULE(bent, "1.0", semfield::toy::register_bent)
#elif defined(CASE_QUITTING)
SEMFIELD_PLUGIN_MODULE(quitting, "1.0", semfield::toy::register_quitting)
#elif !defined(CASE_NO_STAMP)
SEMFIELD_PLUGIN_MODULE(probe, "1.0", semfield::toy::register_into)
#endif
