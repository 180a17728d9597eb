// The folder of one run: layout, lock, checkpoints, and what it says of build and network.
#include "train/run_folder.h"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstring>
#include <fstream>
#include <nlohmann/json.hpp>

#include "compute/parallel.h"
#include "core/check.h"
#include "core/text.h"
#include "plugin/module.h"
#include "scene/scene.h"

#ifndef SEMFIELD_VERSION_TEXT
#define SEMFIELD_VERSION_TEXT "unknown"
#endif
#ifndef SEMFIELD_SOURCE_AT_CONFIGURE
#define SEMFIELD_SOURCE_AT_CONFIGURE ""
#endif
#ifndef SEMFIELD_BUILD_TYPE
#define SEMFIELD_BUILD_TYPE ""
#endif

namespace semfield {

namespace {

bool holds_files(const std::string& path) {
  std::error_code error;
  for (const fs::directory_entry& entry : fs::directory_iterator(path, error)) {
    if (entry.path().filename() != ".lock") return true;
  }
  return false;
}

Error cannot_write(const std::string& path, int cause) {
  const bool full = cause == ENOSPC || cause == EDQUOT;
  const bool closed = cause == EACCES || cause == EROFS || cause == EPERM;
  return Error(ErrorKind::cannot_create, "run.folder.unwritable",
               fmt::format("cannot write in the run folder '{}': {}", path,
                           full     ? "the disk is full"
                           : closed ? "it is read-only for this user"
                                    : std::strerror(cause)),
               full ? "free space, or choose a folder on another disk with --out"
                    : "choose a folder that you may write to with --out");
}

// What killed processes left in the folder and those below; the caller holds the folder's lock.
void remove_stale(const std::string& path) {
  remove_stale_temporaries(path);
  std::error_code error, ignored;
  for (fs::recursive_directory_iterator entry(path, error), end; !error && entry != end; entry.increment(error)) {
    if (entry->is_directory(ignored) && !entry->is_symlink(ignored)) remove_stale_temporaries(entry->path().string());
  }
}

constexpr std::string_view kPrefix = "step_";
constexpr std::string_view kSuffix = ".safetensors";

std::optional<std::int64_t> step_of(const std::string& name) {
  if (!name.starts_with(kPrefix) || !name.ends_with(kSuffix) || name.size() <= kPrefix.size() + kSuffix.size())
    return std::nullopt;
  const std::string_view digits(name.data() + kPrefix.size(), name.size() - kPrefix.size() - kSuffix.size());
  const auto step = to_number<std::int64_t>(digits);
  return step.value_or(-1) < 0 ? std::nullopt : step;
}

using Json = nlohmann::ordered_json;

// "key : value" of the first core in /proc/cpuinfo; "" where the system has no such file.
std::string cpu_info(const std::string& key) {
  std::ifstream file("/proc/cpuinfo");
  for (std::string line; std::getline(file, line);) {
    if (!line.starts_with(key)) continue;
    const std::size_t colon = line.find(": ");
    if (colon != std::string::npos) return line.substr(colon + 2);
  }
  return {};
}

// Of some hundred flags, those that change which instructions our loops become.
std::string cpu_features() {
  const std::string flags = " " + cpu_info("flags") + " ";
  constexpr std::array kTelling{"sse4_2",  "avx",      "avx2",     "fma",         "f16c",
                                "avx512f", "avx512bw", "avx512vl", "avx512_bf16", "amx_bf16"};
  std::vector<std::string> found;
  for (const char* flag : kTelling) {
    if (flags.find(fmt::format(" {} ", flag)) != std::string::npos) found.emplace_back(flag);
  }
  return join(found, " ");
}

std::string compiler() {
#if defined(__clang__)
  return "clang " __clang_version__;
#elif defined(__GNUC__)
  return "g++ " __VERSION__;
#else
  return "unknown";
#endif
}

Error damaged(const std::string& what) {
  return Error(ErrorKind::data, "run.record.damaged", what, "restore the file, or delete it");
}

Json parse(std::string_view text, const std::string& name) {
  Json json = Json::parse(text.begin(), text.end(), nullptr, false);
  if (json.is_discarded()) throw damaged(fmt::format("'{}' is not JSON", name));
  return json;
}

// A text as it is, anything else as JSON.
std::string text_of(const Json& value) { return value.is_string() ? value.get<std::string>() : value.dump(); }

// The file itself, taken in when the library is built.
constexpr const char* kTable =
#include "leave_out_table.inc"
    ;

}  // namespace

std::string RunFolder::in(std::string_view name) const { return (fs::path(path_) / name).string(); }

bool RunFolder::lock(bool may_create) {
  const int cause = lock_.take(path_, may_create);
  if (cause == 0) return true;
  if (cause == ENOENT && !may_create) return false;
  if (cause != EWOULDBLOCK) throw cannot_write(path_, cause);
  throw Error(ErrorKind::cannot_create, "run.folder.busy",
              fmt::format("the run folder '{}' is in use by {}", path_, lock_.holder()),
              "wait for it to end, stop it, or choose another folder with --out");
}

bool RunFolder::take_new() {
  // An existing lock first: "in use by process 17" says more than "holds files". No lock file is left in a folder of
  // others.
  const bool locked = fs::is_directory(path_) && lock(false);
  if (locked) remove_stale_temporaries(path_);  // of a run killed before its run.yaml was there
  if (!holds_files(path_)) return locked;
  throw Error(
      ErrorKind::cannot_create, "run.folder.used", fmt::format("the run folder '{}' holds files already", path_),
      fmt::format("{}choose another folder with --out",
                  fs::exists(config_path())
                      ? fmt::format("continue that run with `semfield train --resume {}`, or ", shell_word(path_))
                      : ""));
}

void RunFolder::require_new(const std::string& path) { RunFolder(path).take_new(); }

RunFolder RunFolder::create(const std::string& path) {
  RunFolder folder(path);
  try {
    create_folders(path);
  } catch (const Error& error) {
    throw Error(ErrorKind::cannot_create, "run.folder.unwritable", error.message(),
                "choose a folder that you may write to with --out");
  }
  if (!folder.take_new()) {
    folder.lock(true);
    if (holds_files(path))
      throw Error(ErrorKind::cannot_create, "run.folder.used", fmt::format("another process has just used '{}'", path),
                  "choose another folder with --out");
  }
  return folder;
}

RunFolder RunFolder::resume(const std::string& path) {
  RunFolder folder = read(path);
  folder.lock(true);
  remove_stale(path);
  return folder;
}

RunFolder RunFolder::read(const std::string& path) {
  RunFolder folder(path);
  if (!fs::is_directory(path)) {
    throw Error(ErrorKind::no_input, "run.folder.missing", fmt::format("there is no run folder '{}'", path),
                "give the folder that `train` printed");
  }
  if (!fs::exists(folder.config_path())) {
    throw Error(
        ErrorKind::no_input, "run.folder.foreign", fmt::format("'{}' holds no run.yaml: it is not a run folder", path),
        "give the folder that `train` printed; for the folder of a scene `semfield init` writes a configuration");
  }
  return folder;
}

std::string RunFolder::render_path(std::string_view split, std::string_view frame, std::string_view kind,
                                   std::string_view extension) const {
  const fs::path folder = fs::path(path_) / "render" / split;
  std::error_code error;
  fs::create_directories(folder, error);
  if (error) throw cannot_write(folder.string(), error.value());
  return (folder / fmt::format("{}_{}.{}", output_name(frame), kind, extension)).string();
}

// The checkpoints of one run.

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

// environment.json and left_out.json.

Environment this_environment() {
  Environment e;
  e.version = SEMFIELD_VERSION_TEXT;
  e.source = SEMFIELD_SOURCE_AT_CONFIGURE;
  e.compiler = compiler();
  e.build_type = SEMFIELD_BUILD_TYPE;
  e.cpu = cpu_info("model name");
  e.cpu_features = cpu_features();
  e.abi = SEMFIELD_ABI_TAG;
  e.hardware_threads = hardware_threads();
  e.threads = thread_count();
  return e;
}

std::string environment_json(const Environment& e) {
  Json json;
  json["version"] = e.version;
  json["source_at_configure"] = e.source;
  json["compiler"] = e.compiler;
  json["build_type"] = e.build_type;
  json["cpu"] = e.cpu;
  json["cpu_features"] = e.cpu_features;
  json["abi"] = e.abi;
  json["hardware_threads"] = e.hardware_threads;
  json["threads"] = e.threads;
  json["seed"] = e.seed;
  json["input_hash"] = e.input_hash;
  json["modules"] = e.modules;
  if (!e.settings_changed.empty()) json["settings_changed"] = e.settings_changed;
  for (const auto& [name, value] : e.more) json[name] = value;
  return json.dump(2, ' ', false, Json::error_handler_t::replace) + "\n";
}

std::vector<std::pair<std::string, std::string>> parse_environment(std::string_view text, const std::string& name) {
  const Json json = parse(text, name);
  if (!json.is_object()) throw damaged(fmt::format("'{}' is not a JSON object", name));
  std::vector<std::pair<std::string, std::string>> entries;
  for (const auto& [key, value] : json.items()) {
    std::vector<std::string> items;
    for (const Json& item : value.is_array() ? value : Json::array({value})) items.push_back(text_of(item));
    entries.emplace_back(key, join(items));
  }
  return entries;
}

std::vector<std::string> parse_settings_changed(std::string_view text, const std::string& name) {
  const Json json = parse(text, name);
  std::vector<std::string> changes;
  if (!json.is_object() || !json.contains("settings_changed")) return changes;
  for (const Json& change : json["settings_changed"]) changes.push_back(text_of(change));
  return changes;
}

std::string left_out_json(const std::vector<LeftOut>& rows) {
  Json json = Json::array();
  for (const LeftOut& row : rows) {
    const std::string measured = row.measured.empty() ? shipped_saving(row.component) : row.measured;
    json.push_back({{"component", row.component},
                    {"rule", row.rule},
                    {"evidence", row.evidence},
                    {"proof", std::string(1, static_cast<char>(row.proof))},
                    {"saving_estimate", row.saving},
                    {"saving_measured", measured.empty() ? Json() : Json(measured)}});  // not measured is not text
  }
  return json.dump(2, ' ', false, Json::error_handler_t::replace) + "\n";
}

std::string shipped_saving(const std::string& component) {
  static const nlohmann::json table = nlohmann::json::parse(kTable);
  std::string found;  // the last of a component's rows: those before it prove, on fields made for that
  for (const auto& row : table.at("rows")) {
    if (row.at("component") == component) found = row.at("saving_measured").get<std::string>();
  }
  return found.empty() ? found : found + "; of docs/reference/leave_out.md, not of this run";
}

}  // namespace semfield
