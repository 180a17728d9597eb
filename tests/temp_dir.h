// A temporary folder of a test.
#pragma once

#include <filesystem>

#include "core/error.h"
#include "core/files.h"
#include "core/non_copyable.h"

namespace semfield {

/// A fresh folder, removed at the end with what is in it.
class TempDir : NonCopyable {
 public:
  TempDir() {
    std::string pattern = (std::filesystem::temp_directory_path() / "semfield_test_XXXXXX").string();
    if (mkdtemp(pattern.data()) == nullptr)
      throw Error(ErrorKind::cannot_create, "test.error.made", "cannot make " + pattern);
    path_ = pattern;
  }
  ~TempDir() {
    std::error_code ignored;
    std::filesystem::remove_all(path_, ignored);
  }

  const std::string& path() const { return path_; }
  std::string operator/(const std::string& name) const { return path_ + "/" + name; }
  /// Writes a file, and the folders that lead to it; returns its path.
  std::string write(const std::string& name, std::string_view text) const {
    const std::string file = *this / name;
    std::filesystem::create_directories(std::filesystem::path(file).parent_path());
    write_file_atomic(file, text);
    return file;
  }

 private:
  std::string path_;
};

}  // namespace semfield
