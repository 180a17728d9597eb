// Configurations in the documents are read by the program.
#include <gtest/gtest.h>
#include <unistd.h>

#include <filesystem>

#include "plugin/linked_plugins.h"
#include "session/settings/run_config.h"
#include "system/files.h"
#include "tests/docs/pages.h"

namespace semfield::docs {
namespace {

namespace fs = std::filesystem;

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
