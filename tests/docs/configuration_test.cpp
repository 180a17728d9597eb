// Configurations in the documents are read by the program; the tables of sections are those of the declarations.
#include <gtest/gtest.h>
#include <unistd.h>

#include <cstdlib>
#include <filesystem>

#include "plugin/loader.h"
#include "session/settings/run_config.h"
#include "system/files.h"
#include "tests/docs/pages.h"

namespace semfield::docs {
namespace {

namespace fs = std::filesystem;

std::string code(const std::string& text) { return text.empty() ? "" : "`" + text + "`"; }

std::string cell(const std::string& text) {
  std::string out;
  for (const char c : text) {
    if (c == '|') out += '\\';
    out += c;
  }
  return out;
}

std::string heading_and_table(const std::string& heading, const std::vector<ParamDoc>& params) {
  std::string text = "\n### " + heading + "\n\n";
  text += "| key | type | default | allowed | meaning |\n|---|---|---|---|---|\n";
  for (const ParamDoc& doc : params)
    text += "| `" + doc.name + "` | " + doc.type + " | " + code(doc.default_value) + " | " +
            cell(doc.choices.empty() ? doc.range : join(doc.choices)) + " | " + cell(doc.help) + " |\n";
  return text;
}

std::string section_tables() {
  std::string text = "\n";
  for (const SectionDoc& section : describe_sections())
    text += heading_and_table("`" + section.path + "`: " + section.sentence, section.params);
  return text + "\n";
}

std::string degradation_tables() {
  std::string text = "\n";
  Registry registry;
  register_linked_plugins(registry);
  for (const std::string& name : registry.names(PluginKind::degradation)) {
    const PluginEntry& entry = registry.get(PluginKind::degradation, name);
    const std::unique_ptr<PluginParams> params = entry.new_params();
    text += heading_and_table("`" + name + "`: " + entry.summary,
                              describe_params([&](ParamVisitor& visit) { params->describe(visit); }));
  }
  return text + "\n";
}

// The part of a page between `begin` and `end` is `part`; written when the environment says so.
void expect_part(const char* path, const std::string& begin, const std::string& end, const std::string& part) {
  const std::string old = page(path);
  const std::string fresh = with_part(old, begin, end, part);
  if (std::getenv("SEMFIELD_WRITE_DOCS") != nullptr) {
    write_file_atomic((fs::path(SEMFIELD_SOURCE_DIR) / path).string(), fresh);
    return;
  }
  EXPECT_TRUE(old == fresh) << path << " is stale; run docs_test with SEMFIELD_WRITE_DOCS=1 in its environment";
}

TEST(ConfigurationPage, SectionTablesAreFresh) {
  expect_part("docs/reference/configuration.md", "<!-- sections -->", "<!-- /sections -->", section_tables());
}

TEST(LabelExperimentsPage, TablesOfDegradationsAreFresh) {
  expect_part("docs/guide/label_experiments.md", "<!-- degradations -->", "<!-- /degradations -->",
              degradation_tables());
}

// A block marked `yaml` is a whole configuration, saved in configs/ as it or the text around it says.
TEST(ConfigurationPage, EveryYamlBlockIsRead) {
  const fs::path folder = fs::path(testing::TempDir()) / ("semfield_docs_configs_" + std::to_string(::getpid()));
  const fs::path configs = fs::path(SEMFIELD_SOURCE_DIR) / "configs";
  for (const auto& entry : fs::recursive_directory_iterator(configs)) {  // by content: the originals may be read-only
    if (!entry.is_regular_file()) continue;
    const fs::path copy = folder / fs::relative(entry.path(), configs);
    fs::create_directories(copy.parent_path());
    write_file_atomic(copy.string(), read_text_file(entry.path().string()));
  }
  int read = 0;
  for (const std::string& path : all_pages()) {
    for (const Block& block : blocks_of(page(path))) {
      if (block.info != "yaml" && !block.info.starts_with("yaml file=configs/")) continue;
      const std::string file = (folder / "block.yaml").string();
      write_file_atomic(file, block.text);
      Registry registry;
      register_linked_plugins(registry);
      try {
        load_run_config(file, {}, registry);
        ++read;
      } catch (const Error& error) {
        ADD_FAILURE() << path << ":\n" << block.text << error.what();
      }
    }
  }
  EXPECT_GE(read, 4);
  fs::remove_all(folder);
}

}  // namespace
}  // namespace semfield::docs
