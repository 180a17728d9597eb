// Runs the laws of the page's plugins from the generated table of linked plugins, on the page's own sample, and prints
// what a module's test needs to read that sample. Usage: linked_host EMPTY_FOLDER.
#include <cstdio>

#include "plugin/loader.h"
#include "testkit/laws.h"
#include "tests/conformance/dataset_samples.h"

namespace semfield::testkit {
DatasetSample semfield_sample_pose_list(const std::string& folder);
}

int main(int argc, char** argv) {
  using namespace semfield;
  if (argc != 2) return 2;
  try {
    Registry registry;
    register_linked_plugins(registry);
    testkit::Failures failures;
    if (registry.entries().size() != 6) failures.push_back("the table of linked plugins does not hold the page's");
    for (const PluginEntry* entry : registry.entries()) {
      if (entry->kind == PluginKind::dataset)
        testkit::append(failures, testkit::declaration_laws(*entry));
      else
        testkit::append(failures, testkit::plugin_laws(registry, entry->kind, entry->name));
    }
    const testkit::DatasetSample sample = testkit::semfield_sample_pose_list(argv[1]);
    DatasetBuild build;
    build.config_dir = argv[1];
    testkit::append(failures, testkit::dataset_laws(registry, "pose_list", sample.settings, build, sample.expected));
    std::fputs(testkit::to_text(failures).c_str(), stderr);
    std::fputs(sample.settings.at("focal_px").c_str(), stdout);
    return failures.empty() ? 0 : 1;
  } catch (const std::exception& error) {
    std::fprintf(stderr, "unexpected exception: %s\n", error.what());
    return 1;
  }
}
