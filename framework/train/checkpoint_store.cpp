// The checkpoints of one run.
#include "train/checkpoint_store.h"

#include <fmt/format.h>

#include <algorithm>
#include <charconv>
#include <filesystem>

#include "core/check.h"
#include "core/files.h"

namespace semfield {

namespace fs = std::filesystem;

namespace {

constexpr std::string_view kPrefix = "step_";
constexpr std::string_view kSuffix = ".safetensors";

std::optional<std::int64_t> step_of(const std::string& name) {
  if (!name.starts_with(kPrefix) || !name.ends_with(kSuffix) || name.size() <= kPrefix.size() + kSuffix.size()) return std::nullopt;
  const char* begin = name.data() + kPrefix.size();
  const char* end = name.data() + name.size() - kSuffix.size();
  std::int64_t step = 0;
  const auto [rest, status] = std::from_chars(begin, end, step);
  if (status != std::errc{} || rest != end || step < 0) return std::nullopt;
  return step;
}

}  // namespace

std::string CheckpointStore::file_name(std::int64_t step) { return fmt::format("{}{:08d}{}", kPrefix, step, kSuffix); }

CheckpointStore::CheckpointStore(std::string folder, int keep) : folder_(std::move(folder)), keep_(keep) {
  SEMFIELD_CHECK(keep >= 2, "at least two checkpoints are kept");
  std::error_code error;
  fs::create_directories(folder_, error);
  if (error) {
    throw Error(ErrorKind::cannot_create, fmt::format("cannot create the folder '{}': {}", folder_, error.message()),
                "choose another run folder with --out");
  }
  std::vector<fs::path> stale;
  for (const fs::directory_entry& entry : fs::directory_iterator(folder_, error)) {
    if (entry.path().filename().string().find(".tmp") != std::string::npos && entry.is_regular_file()) stale.push_back(entry.path());
  }
  for (const fs::path& path : stale) fs::remove(path, error);
}

std::vector<CheckpointStore::Entry> CheckpointStore::list() const {
  std::vector<Entry> entries;
  std::error_code error;
  for (const fs::directory_entry& entry : fs::directory_iterator(folder_, error)) {
    const std::optional<std::int64_t> step = step_of(entry.path().filename().string());
    if (step && entry.is_regular_file()) entries.push_back({*step, entry.path().string()});
  }
  std::sort(entries.begin(), entries.end(), [](const Entry& a, const Entry& b) { return a.step > b.step; });
  return entries;
}

std::string CheckpointStore::save(std::int64_t step, const std::vector<TensorRef>& tensors, const TensorMetadata& metadata) {
  SEMFIELD_CHECK(step >= 0, "a step is not negative");
  const std::vector<Entry> before = list();
  const std::string path = (fs::path(folder_) / file_name(step)).string();
  try {
    write_safetensors(path, tensors, metadata);
    (void)TensorFile::read(path);  // what was written is what a resume would read
    write_file_atomic((fs::path(folder_) / "latest").string(), file_name(step) + "\n");
  } catch (Error& error) {
    const std::string kept = before.empty() ? "no earlier checkpoint exists"
                                            : fmt::format("the checkpoint of step {} is kept", before.front().step);
    error.while_doing(fmt::format("while saving the checkpoint of step {} ({})", step, kept));
    throw;
  }
  int kept = 1;
  std::error_code ignored;  // an old file that stays is no harm
  for (const Entry& entry : before) {
    if (entry.step > step) {
      fs::rename(entry.path, entry.path + ".abandoned", ignored);
    } else if (entry.step < step && ++kept > keep_) {
      fs::remove(entry.path, ignored);
    }
  }
  return path;
}

std::optional<CheckpointStore::Found> CheckpointStore::find_latest(Diagnostics& diagnostics) const {
  const std::vector<Entry> entries = list();
  for (const Entry& entry : entries) {
    try {
      return Found{entry.step, entry.path, TensorFile::read(entry.path)};
    } catch (const Error& error) {
      diagnostics.warning(entry.path, error.message(), "an older checkpoint is tried");
    }
  }
  if (entries.empty()) return std::nullopt;
  throw Error(ErrorKind::data, fmt::format("none of the {} checkpoints in '{}' can be read", entries.size(), folder_),
              "train again, or copy a checkpoint from a backup");
}

}  // namespace semfield
