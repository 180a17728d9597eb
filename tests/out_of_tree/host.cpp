// Loads the outside plugins by path, runs their laws, and checks every refusal. Usage: host FOLDER_OF_MODULES.
#include <cstdio>

#include "plugin/loader.h"
#include "testkit/laws.h"

namespace {

int g_failures = 0;

void expect(bool holds, const std::string& what) {
  if (holds) return;
  ++g_failures;
  std::fprintf(stderr, "FAILED: %s\n", what.c_str());
}

void expect_none(const semfield::testkit::Failures& failures, const std::string& what) {
  expect(failures.empty(), what + ":\n" + semfield::testkit::to_text(failures));
}

// Loading `path` is refused with every one of `words` and leaves the registry as it was.
void expect_refusal(semfield::Registry& registry, const std::string& path, const std::vector<std::string>& words) {
  const std::size_t before = registry.entries().size();
  try {
    semfield::load_module(registry, path);
    expect(false, path + " was not refused");
  } catch (const semfield::Error& error) {
    expect(error.kind() == semfield::ErrorKind::unavailable, path + ": refused with another kind of error");
    const std::string text = error.what();
    expect(text.find(path) != std::string::npos, "the refusal does not name the file: " + text);
    for (const std::string& word : words) expect(text.find(word) != std::string::npos, "no '" + word + "' in: " + text);
    std::printf("refused: %s\n", text.c_str());
  }
  expect(registry.entries().size() == before, path + ": the registry changed");
}

void check_refusals(semfield::Registry& registry, const std::string& folder) {
  const std::string ours = std::to_string(semfield::kPluginApi);
  expect_refusal(registry, folder + "missing.so", {"there is no such file"});
  expect_refusal(registry, folder + "no_symbol.so", {"has no section '.semfield_plugin'"});
  expect_refusal(registry, folder + "other_api.so", {"plugin API 999", "speaks " + ours});
  expect_refusal(registry, folder + "other_abi.so", {"'cxx0-another-library'", semfield::abi_tag_of_framework()});
  expect_refusal(registry, folder + "throwing_registration.so",
                 {"while registering module 'refused 0.1'", "half way through"});
  expect_refusal(registry, folder + "duplicate_name.so", {"dataset name 'corridor'", "taken by module 'corridor 0.1'"});
  const std::size_t before = registry.entries().size();
  semfield::load_module(registry, folder + "waves.so");
  expect(registry.entries().size() == before, "a module that is there already is left at that");
}

// The module loads; its factory's Error crosses the border as what it is.
void check_throwing_factory(semfield::Registry& registry, const std::string& path) {
  semfield::load_module(registry, path);
  const semfield::PluginEntry& entry = registry.get(semfield::PluginKind::dataset, "broken");
  try {
    entry.dataset(*entry.new_params(), {});
    expect(false, "the throwing factory made a dataset");
  } catch (const semfield::Error& error) {
    expect(error.message() == "the factory found nothing to read", error.message());
  }
}

}  // namespace

int main(int argc, char** argv) {
  if (argc != 2) return 2;
  const std::string folder = std::string(argv[1]) + "/";
  try {
    semfield::Registry registry;
    semfield::register_linked_plugins(registry);
    semfield::load_module(registry, folder + "waves.so");
    semfield::load_module(registry, folder + "corridor.so");
    expect_none(semfield::testkit::encoder_laws(registry, "waves", {}, {}), "laws of the encoder");
    expect_none(semfield::testkit::encoder_laws(registry, "waves", {{"bands", "7"}}, {}),
                "laws of the encoder, 7 bands");
    expect_none(semfield::testkit::declaration_laws(registry.get(semfield::PluginKind::encoder, "waves")),
                "declaration of the encoder");
    semfield::testkit::DatasetExpectation expected;
    expected.frames = 4;
    expected.depth = expected.labels = true;
    expect_none(semfield::testkit::dataset_laws(registry, "corridor", {}, {}, expected), "laws of the dataset");
    check_refusals(registry, folder);
    check_throwing_factory(registry, folder + "throwing_factory.so");
  } catch (const std::exception& error) {
    expect(false, std::string("unexpected exception: ") + error.what());
  }
  std::printf("%d failures\n", g_failures);
  return g_failures == 0 ? 0 : 1;
}
