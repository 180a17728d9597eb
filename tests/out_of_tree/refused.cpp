// Modules that a host must refuse, one a CASE_ definition.
#include <stdexcept>

#include "plugin/module.h"

namespace outside {

struct NoParams {};
void describe(semfield::ParamVisitor&, NoParams&) {}
void validate(const NoParams&, semfield::Diagnostics&) {}

/// A dataset whose construction fails.
class Broken final : public semfield::Dataset {
 public:
  Broken(const NoParams&, const semfield::DatasetBuild&) {
    throw semfield::Error(semfield::ErrorKind::data, "test.error.made", "the factory found nothing to read");
  }
  semfield::SceneInfo open(semfield::Diagnostics&) override { return {}; }
  void read(int, semfield::FrameBuffer&) const override {}
};

void register_into(semfield::Registry& registry) {
#if defined(CASE_DUPLICATE_NAME)
  registry.add_dataset<Broken, NoParams>("before_the_duplicate", "Must not stay when the next name is refused.");
  registry.add_dataset<Broken, NoParams>("corridor", "A name that another module took.");
#else
  registry.add_dataset<Broken, NoParams>("broken", "A dataset whose factory throws.");
#endif
#if defined(CASE_THROWING_REGISTRATION)
  throw std::runtime_error("half way through");
#endif
}

}  // namespace outside

#if defined(CASE_OTHER_API) || defined(CASE_OTHER_ABI)
#if defined(CASE_OTHER_API)
#define REFUSED_API 999
#define REFUSED_ABI SEMFIELD_ABI_TAG
#else
#define REFUSED_API ::semfield::kPluginApi
#define REFUSED_ABI "cxx0-another-library"
#endif
extern "C" {
extern const semfield::PluginStamp semfield_plugin_stamp;
__attribute__((section(".semfield_plugin"), used))
const semfield::PluginStamp semfield_plugin_stamp = {"semfield plugin", REFUSED_API, REFUSED_ABI};
extern const semfield::PluginModule semfield_plugin_module;
const semfield::PluginModule semfield_plugin_module = {REFUSED_API, REFUSED_ABI, "refused", "0.1",
                                                       outside::register_into};
}
#else
SEMFIELD_PLUGIN_MODULE(refused, "0.1", outside::register_into)
#endif
