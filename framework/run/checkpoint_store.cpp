// The checkpoints of one run.
#include "run/checkpoint_store.h"

#include <fmt/format.h>

#include <algorithm>
#include <charconv>
#include <filesystem>

#include "core/check.h"
#include "system/files.h"

namespace semfield {

namespace fs = std::filesystem;

namespace {

constexpr std::string_view kPrefix = "step_";
constexpr std::string_view kSuffix = ".safetensors";

std::optional<std::int64_t> step_of(const std::string& name) {
  if (!name.starts_with(kPrefix) || !name.ends_with(kSuffix) || name.size() <= kPrefix.size() + kSuffix.size())
    return std::nullopt;
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
  create_folders(folder_);
  remove_stale_temporaries(folder_);
}

CheckpointStore CheckpointStore::read(std::string folder) { return CheckpointStore(std::move(folder), Reading{}); }

std::vector<CheckpointStore::Entry> CheckpointStore::list() const {
  std::vector<Entry> entries;
  std::error_code error, ignored;
  do {
    entries.clear();
    for (fs::directory_iterator entry(folder_, error), end; !error && entry != end; entry.increment(error)) {
      const std::optional<std::int64_t> step = step_of(entry->path().filename().string());
      if (step && entry->is_regular_file(ignored)) entries.push_back({*step, entry->path().string()});
    }
  } while (error == std::errc::interrupted);
  // Not the same as no checkpoints: a run that took it for that would start over.
  if (error && error != std::errc::no_such_file_or_directory) {
    throw Error(ErrorKind::io, "files.folder.unreadable",
                fmt::format("cannot read the folder '{}': {}", folder_, error.message()),
                "check the permissions and the disk");
  }
  std::sort(entries.begin(), entries.end(), [](const Entry& a, const Entry& b) { return a.step > b.step; });
  return entries;
}

std::string CheckpointStore::save(std::int64_t step, const std::vector<TensorRef>& tensors,
                                  const TensorMetadata& metadata) {
  SEMFIELD_CHECK(step >= 0, "a step is not negative");
  const std::vector<Entry> before = list();
  const std::string path = (fs::path(folder_) / file_name(step)).string();
  try {
    write_safetensors(path, tensors, metadata);
    write_file_atomic((fs::path(folder_) / "latest").string(), file_name(step) + "\n");
  } catch (Error& error) {
    error.while_doing(fmt::format("while saving the checkpoint of step {} ({})", step, kept_text()));
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

std::string CheckpointStore::kept_text() const {
  try {
    Diagnostics ignored;
    const std::optional<Found> found = find_latest(ignored);
    return found ? fmt::format("the checkpoint of step {} is kept", found->step)
                 : "there is no checkpoint yet: a resume begins at step 0";
  } catch (const std::exception& error) {
    return error.what();  // of another failure beside the one that is reported
  }
}

std::optional<CheckpointStore::Found> CheckpointStore::find_latest(Diagnostics& diagnostics) const {
  const std::vector<Entry> entries = list();
  std::string causes;
  for (const Entry& entry : entries) {
    try {
      return Found{entry.step, entry.path, TensorFile::read(entry.path)};
    } catch (const Error& error) {
      diagnostics.warning(error.code(), entry.path, error.message(), "an older checkpoint is tried");
      causes += "\n" + error.message();
    }
  }
  if (entries.empty()) return std::nullopt;
  throw Error(ErrorKind::data, "checkpoint.none.readable",
              fmt::format("none of the {} checkpoints in '{}' can be read:{}", entries.size(), folder_, causes),
              "train again, or copy a checkpoint from a backup");
}

}  // namespace semfield
