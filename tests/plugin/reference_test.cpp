// The reference is derived from declarations, and the committed pages are what it derives.
#include "plugin/reference.h"

#include <gtest/gtest.h>

#include <filesystem>
#include <fstream>
#include <sstream>

#include "plugin/linked_plugins.h"
#include "tests/plugin/toy_encoder.h"

namespace semfield {
namespace {

Registry toy_registry() {
  Registry registry;
  registry.set_current_module("toys 1.0");
  toy::register_into(registry);
  return registry;
}

std::string text_of(const std::filesystem::path& path) {
  std::ifstream file(path);
  std::ostringstream text;
  text << file.rdbuf();
  return text.str();
}

TEST(Reference, TheTableHasEveryParameterOnce) {
  const Registry registry = toy_registry();
  EXPECT_EQ(parameter_table_markdown(registry.get(PluginKind::encoder, "toy")),
            "| parameter | type | default | allowed | meaning |\n|---|---|---|---|---|\n"
            "| `bands` | int | `2` | [1, 8] | number of sine bands a coordinate |\n"
            "| `gain` | number | `1.5` | [0, 4] | factor of every output |\n"
            "| `flip` | bool | `false` |  | changes the sign of every output |\n");
}

TEST(Reference, ListShowAndMatrixNameThePlugin) {
  const Registry registry = toy_registry();
  EXPECT_EQ(plugins_list_text(registry), "encoders\n  toy  Sines with a learned amplitude. [toys 1.0]\n");
  EXPECT_NE(plugin_details_text(registry, "toy").find("gain: number = 1.5   ([0, 4])\n      factor of every output"),
            std::string::npos);
  EXPECT_NE(support_matrix_text(registry).find("| encoder | toy | cpu | toys 1.0 |"), std::string::npos);
  try {
    plugin_details_text(registry, "toi");
    FAIL() << "an unknown plugin was shown";
  } catch (const Error& error) {
    EXPECT_STREQ(error.what(), "no plugin named 'toi'; known: toy; did you mean 'toy'?");
  }
}

TEST(Reference, TheTableInAPageIsReplacedBetweenItsMarkers) {
  const Registry registry = toy_registry();
  const PluginEntry& entry = registry.get(PluginKind::encoder, "toy");
  const std::string page = "# Toy\n<!-- parameters -->\nstale\n<!-- /parameters -->\nrest\n";
  const std::string fresh = with_parameter_table(page, entry);
  EXPECT_EQ(fresh, "# Toy\n<!-- parameters -->\n" + parameter_table_markdown(entry) + "<!-- /parameters -->\nrest\n");
  EXPECT_EQ(with_parameter_table(fresh, entry), fresh);
  EXPECT_EQ(with_parameter_table("# no markers\n", entry), "# no markers\n");
}

TEST(CommittedPages, TheReferenceIsFresh) {
  Registry registry;
  register_linked_plugins(registry);
  const std::filesystem::path page = std::filesystem::path(SEMFIELD_SOURCE_DIR) / "docs/reference/plugins.md";
  EXPECT_TRUE(text_of(page) == plugins_markdown(registry))
      << "docs/reference/plugins.md is stale; run: semfield help --pages PROJECT_FOLDER";
}

TEST(CommittedPages, TheTablesOfPluginFoldersAreFresh) {
  Registry registry;
  register_linked_plugins(registry);
  const std::string empty_table = std::string(kTableBegin) + "\n" + kTableEnd;
  std::vector<std::string> never_generated;
  int checked = 0;
  for (const PluginEntry* entry : registry.entries()) {
    const std::string folder = std::string(kind_folder(entry->kind)) + "/" + entry->name;
    const std::filesystem::path source = SEMFIELD_SOURCE_DIR;
    std::filesystem::path readme = source / "plugins" / folder / "README.md";
    if (!std::filesystem::exists(readme)) readme = source / "framework" / folder / "README.md";
    const std::string page = text_of(readme);
    if (page.find(kTableBegin) == std::string::npos || page.find(empty_table) != std::string::npos) {
      never_generated.push_back(folder);
      continue;
    }
    ++checked;
    EXPECT_TRUE(with_parameter_table(page, *entry) == page)
        << folder << "/README.md has a stale parameter table; run: semfield help --pages PROJECT_FOLDER";
  }
  if (!never_generated.empty()) {
    GTEST_SKIP() << checked
                 << " tables checked; without a README, its markers or a generated table: " << join(never_generated)
                 << "; run: semfield help --pages PROJECT_FOLDER";
  }
}

}  // namespace
}  // namespace semfield
