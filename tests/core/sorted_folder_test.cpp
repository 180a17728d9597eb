// Folders are read in the order of names on every file system.
#include "system/sorted_folder.h"

#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>

#include "core/error.h"
#include "system/files.h"

namespace semfield {
namespace {

namespace fs = std::filesystem;

TEST(SortedFolder, NamesInOrderWhateverTheFileSystemGives) {
  const fs::path folder = fs::path(testing::TempDir()) / ("semfield_sorted_" + std::to_string(::getpid()));
  fs::create_directories(folder);
  std::vector<std::string> names;
  for (int i = 0; i < 100; ++i) names.push_back(std::to_string(37 * i % 100));
  for (const std::string& name : names) write_file_atomic((folder / name).string(), std::string_view("x"));
  std::sort(names.begin(), names.end());
  std::vector<std::string> found;
  for (const auto& entry : sorted_folder(folder.string())) found.push_back(entry.path().filename().string());
  EXPECT_EQ(found, names);
  fs::remove_all(folder);
}

TEST(SortedFolder, AFolderThatCannotBeReadIsNamed) {
  try {
    (void)sorted_folder("/no/such/folder");
    FAIL() << "a folder that is not there was read";
  } catch (const Error& error) {
    EXPECT_EQ(error.kind(), ErrorKind::no_input);
    EXPECT_EQ(std::string(error.what()),
              "cannot read the folder '/no/such/folder': No such file or directory; check the path");
  }
}

}  // namespace
}  // namespace semfield
