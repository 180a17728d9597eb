#include "app/serve/page_exports.h"

#include <fmt/format.h>
#include <sys/resource.h>
#include <sys/wait.h>

#include <algorithm>
#include <chrono>
#include <csignal>
#include <filesystem>

#include "app/child_process.h"
#include "classes/class_table.h"
#include "core/error.h"
#include "formats/zip_archive.h"
#include "system/files.h"
#include "system/sorted_folder.h"

namespace semfield::app {

namespace fs = std::filesystem;

namespace {

constexpr int kLowPriority = 10;  // of 19: training goes first
constexpr auto kProgramLook = std::chrono::milliseconds(100);
constexpr const char* kLabelEnd = "_label.png";

std::vector<std::string> files_of(ExportKind kind) {
  if (kind == ExportKind::labels) return {"labels.zip"};
  if (kind == ExportKind::coco) return {"coco.json"};
  return {"mesh.ply", "mesh.glb", "mesh_classes.ply", "mesh_classes.glb"};
}

std::size_t labels_in(const std::string& folder) {
  std::error_code failed;
  std::size_t count = 0;
  for (const auto& entry : fs::directory_iterator(folder, failed))
    count += entry.path().filename().string().ends_with(kLabelEnd) ? 1 : 0;
  return count;
}

}  // namespace

PageExports::~PageExports() {
  stopping_ = true;
  if (maker_.joinable()) maker_.join();
}

std::string PageExports::start(ExportKind kind) {
  const std::scoped_lock lock(mutex_);
  if (!list_.empty() && list_.back().state == "running")
    throw Error(ErrorKind::unavailable, "export " + list_.back().id + " is being made",
                "wait until it is done, then ask again");
  if (maker_.joinable()) maker_.join();
  std::string id;
  for (int n = 1; id.empty() || fs::exists(folder_of(id)); ++n) id = fmt::format("{}-{}", export_name(kind), n);
  create_folders(folder_of(id));
  list_.push_back({id, export_name(kind), "running", "saving the field", {}});
  ++changes_;
  maker_ = std::thread([this, kind, id] { make(kind, id); });
  return id;
}

std::vector<ExportState> PageExports::list() const {
  const std::scoped_lock lock(mutex_);
  return list_;
}

std::string PageExports::file(const std::string& id, std::uint64_t number) const {
  const std::scoped_lock lock(mutex_);
  for (const ExportState& e : list_) {
    if (e.id == id && number < e.files.size()) return folder_of(id) + "/" + e.files[number];
  }
  return {};
}

void PageExports::tell(const std::string& id, const std::string& state, const std::string& text,
                       const std::vector<std::string>& files) {
  const std::scoped_lock lock(mutex_);
  const auto e = std::find_if(list_.begin(), list_.end(), [&](const ExportState& one) { return one.id == id; });
  if (e->state == state && e->text == text) return;
  *e = {id, e->what, state, text, files};
  ++changes_;
}

void PageExports::make(ExportKind kind, std::string id) {
  try {
    source_.save();
    run_verb(kind, id);
    if (kind == ExportKind::labels) pack_labels(folder_of(id));
    tell(id, "done", "in " + folder_of(id), files_of(kind));
  } catch (const std::exception& e) {
    tell(id, "failed", e.what());
  }
}

std::vector<std::string> PageExports::words(ExportKind kind, const std::string& folder) const {
  const std::string& run = options_.run_dir;
  std::vector<std::string> words{options_.program};
  const auto add = [&](std::vector<std::string> more) { words.insert(words.end(), more.begin(), more.end()); };
  if (kind == ExportKind::labels) add({"render", run, "--split", "train", "--out", folder});
  if (kind == ExportKind::coco)
    add({"export", run, "--split", "train", "--format", "coco", "--out", folder + "/coco.json"});
  if (kind == ExportKind::mesh) add({"mesh", run, "--format", "ply,glb", "--out", folder + "/mesh.ply"});
  for (const std::string& module : options_.modules) add({"--plugin", module});
  return words;
}

void PageExports::run_verb(ExportKind kind, const std::string& id) {
  const std::string folder = folder_of(id), log = folder + "/log.txt";
  const std::size_t views = source_.state()->views.size();
  tell(id, "running", kind == ExportKind::mesh ? "finding the surface" : "rendering the labels");
  const pid_t child = start_child(words(kind, folder), {folder + "/output.txt", log},
                                  [] { setpriority(PRIO_PROCESS, 0, kLowPriority); });
  int status = 0;
  bool asked = false;
  while (waitpid(child, &status, WNOHANG) == 0) {
    if (stopping_ && !asked) {
      kill(child, SIGTERM);
      asked = true;
    }
    if (kind == ExportKind::labels) tell(id, "running", fmt::format("{} of {} views", labels_in(folder), views));
    std::this_thread::sleep_for(kProgramLook);
  }
  if (stopping_) throw Error(ErrorKind::failure, "the page was closed before it was done");
  if (!WIFEXITED(status) || WEXITSTATUS(status) != 0) throw Error(ErrorKind::failure, child_failure(status, log));
}

// Class ids as PNG, and the table that says what they mean.
void PageExports::pack_labels(const std::string& folder) const {
  ZipWriter zip(folder + "/labels.zip");
  for (const fs::directory_entry& entry : sorted_folder(folder)) {
    const std::string name = entry.path().filename().string();
    if (name.ends_with(kLabelEnd)) zip.add(name, read_text_file(entry.path().string()));
  }
  std::vector<ClassEntry> entries;
  for (const ClassState& c : source_.state()->classes) entries.push_back({c.id, c.name, c.color, false});
  zip.add("classes.yaml", ClassTable(std::move(entries)).to_yaml());
  zip.write();
}

}  // namespace semfield::app
