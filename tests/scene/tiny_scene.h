// The box room of room_files.h in folders of the running test: what tests of datasets read.
#pragma once

#include <gtest/gtest.h>
#include <unistd.h>

#include <filesystem>
#include <string>
#include <vector>

#include "tests/scene/room_files.h"

namespace semfield::testing_room {

/// Folders of this program's tests; removed when it ends, unless a test failed: then they are there to look at.
struct FolderKeeper {
  std::vector<std::filesystem::path> folders;
  ~FolderKeeper() {
    if (::testing::UnitTest::GetInstance()->Failed()) return;
    std::error_code ignored;
    for (const std::filesystem::path& folder : folders) std::filesystem::remove_all(folder, ignored);
  }
};

/// A fresh folder of the running test.
inline std::string fresh_folder(const std::string& name) {
  static FolderKeeper keeper;
  const auto* info = ::testing::UnitTest::GetInstance()->current_test_info();
  const std::filesystem::path folder =
      std::filesystem::path(::testing::TempDir()) / (std::string("semfield_") + info->test_suite_name() + "_" +
                                                     info->name() + "_" + std::to_string(::getpid()) + "_" + name);
  std::filesystem::remove_all(folder);
  std::filesystem::create_directories(folder);
  keeper.folders.push_back(folder);
  return folder.string();
}

/// The message of the Error that `body` throws, "" when it throws none.
template <class Body>
std::string error_of(Body&& body) {
  try {
    body();
  } catch (const Error& e) {
    return e.what();
  }
  return {};
}

}  // namespace semfield::testing_room
