#include "loading/file_names.h"

#include <algorithm>
#include <filesystem>

#include "core/unicode_forms.h"

namespace semfield {

namespace fs = std::filesystem;

namespace {

bool exists(const std::string& path) {
  std::error_code ignored;
  return fs::exists(path, ignored);
}

}  // namespace

std::string with_slashes(std::string path) {
  std::replace(path.begin(), path.end(), '\\', '/');
  return path;
}

const std::string* FileNames::looks_like(const std::string& folder, const std::string& name) {
  const auto [found, fresh] = folders_.try_emplace(folder);
  if (fresh) {
    std::error_code unknown;
    for (fs::directory_iterator it(folder.empty() ? "." : folder, unknown), end; !unknown && it != end;
         it.increment(unknown)) {
      const std::string entry = it->path().filename().string();
      const auto [other, first] = found->second.emplace(decomposed(entry), entry);
      if (!first) other->second.clear();
    }
  }
  const auto entry = found->second.find(decomposed(name));
  return entry == found->second.end() || entry->second.empty() ? nullptr : &entry->second;
}

std::string FileNames::of(const std::string& path) {
  if (exists(path)) return path;
  const std::string slashed = with_slashes(path);
  const bool ascii = std::all_of(slashed.begin(), slashed.end(), [](char c) { return (c & 0x80) == 0; });
  if (ascii || exists(slashed)) return slashed;
  fs::path found;
  for (const fs::path& part : fs::path(slashed)) {
    const fs::path next = found / part;
    if (exists(next.string())) {
      found = next;
      continue;
    }
    const std::string* const other = looks_like(found.string(), part.string());
    if (other == nullptr) return slashed;
    found /= *other;
  }
  return found.string();
}

}  // namespace semfield
