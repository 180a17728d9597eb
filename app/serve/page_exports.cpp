#include "app/serve/page_exports.h"

#include <fmt/format.h>
#include <sys/resource.h>
#include <sys/wait.h>

#include <algorithm>
#include <chrono>
#include <csignal>
#include <map>

#include "app/child_process.h"
#include "app/serve/page_requests.h"
#include "app/serve/page_server.h"
#include "core/error.h"
#include "core/files.h"
#include "formats/zip_archive.h"

namespace semfield::app {

namespace {

constexpr int kLowPriority = 10;  // of 19: training goes first
constexpr auto kProgramLook = std::chrono::milliseconds(100);
constexpr const char* kLabelEnd = "_label.png";
constexpr int kSideBySide = 2;        // more would only take the CPU from each other
constexpr std::size_t kMostOpen = 8;  // that wait or are being made

// The verb of an export, where RUN is the run's folder and TO the export's, and the files that it leaves.
struct Recipe {
  const char* begun;
  std::vector<std::string> files, words;
};

const std::map<std::string, Recipe>& recipes() {
  static const std::map<std::string, Recipe> all{
      {"labels",
       {"rendering the labels",
        {"labels.zip"},
        {"labels", "export", "RUN", "--split", "train", "--format", "png", "--out", "TO"}}},
      {"coco",
       {"rendering the labels",
        {"coco.json"},
        {"labels", "export", "RUN", "--split", "train", "--format", "coco", "--out", "TO/coco.json"}}},
      {"mesh",
       {"finding the surface",
        {"mesh.ply", "mesh.glb", "mesh_classes.ply", "mesh_classes.glb"},
        {"mesh", "RUN", "--format", "ply,glb", "--out", "TO/mesh.ply"}}}};
  return all;
}

std::string type_of_export(const std::string& file) {
  if (file.ends_with(".zip")) return "application/zip";
  if (file.ends_with(".json")) return "application/json";
  return "application/octet-stream";
}

}  // namespace

PageExports::~PageExports() {
  {
    const std::scoped_lock lock(mutex_);
    stopping_ = true;
  }
  turn_.notify_all();
  for (Export& one : exports_) one.thread.join();
}

std::string PageExports::start(const std::string& what) {
  if (!recipes().contains(what)) kRequest.refuse_value("what", "labels, coco or mesh", what);
  const std::scoped_lock lock(mutex_);
  if (std::count_if(exports_.begin(), exports_.end(), [](const Export& e) { return e.state.is_open(); }) >=
      static_cast<std::ptrdiff_t>(kMostOpen))
    throw Error(ErrorKind::unavailable, "serve.exports.full",
                fmt::format("{} exports are running or waiting", kMostOpen), "wait until one is done, or cancel one");
  std::string id;
  for (int n = 1; id.empty() || fs::exists(folder_of(id)); ++n) id = fmt::format("{}-{}", what, n);
  create_folders(folder_of(id));
  Export& one = exports_.emplace_back(Export{{id, what, "waiting", "for its turn", {}}});
  ++changes_;
  one.thread = std::thread([this, &one] { make(one); });
  return id;
}

std::string PageExports::cancel(const std::string& id) {
  const std::scoped_lock lock(mutex_);
  const auto one = std::find_if(exports_.begin(), exports_.end(), [&](const Export& e) { return e.state.id == id; });
  if (one == exports_.end())
    throw Error(ErrorKind::data, "serve.export.unknown", "no export '" + id + "'", "the state lists those that exist");
  one->canceled = true;
  turn_.notify_all();
  return id;
}

std::vector<ExportState> PageExports::list() const {
  const std::scoped_lock lock(mutex_);
  std::vector<ExportState> out;
  for (const Export& one : exports_) out.push_back(one.state);
  return out;
}

void PageExports::tell(Export& one, const std::string& state, const std::string& text,
                       const std::vector<std::string>& files) {
  const std::scoped_lock lock(mutex_);
  if (one.state.state == state && one.state.text == text) return;
  one.state = {one.state.id, one.state.what, state, text, files};
  ++changes_;
}

bool PageExports::ends(const Export& one) const {
  const std::scoped_lock lock(mutex_);
  return stopping_ || one.canceled;
}

void PageExports::make(Export& one) {
  const std::string folder = folder_of(one.state.id);  // the id never changes
  {
    std::unique_lock lock(mutex_);
    turn_.wait(lock, [&] { return stopping_ || one.canceled || making_ < kSideBySide; });
    ++making_;
  }
  try {
    if (!ends(one)) {
      tell(one, "running", "saving the field");
      save_();
      run_verb(one);
      if (one.state.what == "labels") pack_labels(folder);
    }
    if (ends(one)) {
      tell(one, "canceled", "");
    } else {
      tell(one, "done", "in " + folder, recipes().at(one.state.what).files);
    }
  } catch (const std::exception& e) {
    tell(one, ends(one) ? "canceled" : "failed", ends(one) ? "" : e.what());
  }
  const std::scoped_lock lock(mutex_);
  --making_;
  turn_.notify_all();
}

void PageExports::run_verb(Export& one) {
  const std::string folder = folder_of(one.state.id), log = folder + "/log.txt";
  const Recipe& recipe = recipes().at(one.state.what);
  const std::string begun = recipe.begun;
  std::vector<std::string> words{options_.program};
  for (const std::string& word : recipe.words)
    words.push_back(word == "RUN" ? options_.run_dir : word.starts_with("TO") ? folder + word.substr(2) : word);
  for (const std::string& module : options_.modules) words.insert(words.end(), {"--plugin", module});
  tell(one, "running", begun);
  const pid_t child =
      start_child(words, {folder + "/output.txt", log}, [] { setpriority(PRIO_PROCESS, 0, kLowPriority); });
  int status = 0;
  bool asked = false;
  while (waitpid(child, &status, WNOHANG) == 0) {
    if (!asked && ends(one)) {
      kill(child, SIGTERM);
      asked = true;
    }
    const std::string line = last_line(log);
    tell(one, "running", line.empty() ? begun : line);
    std::this_thread::sleep_for(kProgramLook);
  }
  if (asked) return;
  if (!WIFEXITED(status) || WEXITSTATUS(status) != 0)
    throw Error(ErrorKind::failure, "export.process.failed", child_failure(status, log));
}

// Class ids as PNG, and the table that says what they mean.
void PageExports::pack_labels(const std::string& folder) const {
  ZipWriter zip(folder + "/labels.zip");
  for (const fs::directory_entry& entry : sorted_folder(folder)) {
    const std::string name = entry.path().filename().string();
    if (name.ends_with(kLabelEnd) || name == "classes.yaml") zip.add(name, read_text_file(entry.path().string()));
  }
  zip.write();
}

HttpResponse PageExports::download(const std::string& place) const {
  const std::lock_guard lock(mutex_);
  for (const Export& one : exports_) {
    for (std::size_t n = 0; n < one.state.files.size(); ++n) {
      if (place != fmt::format("{}/{}", one.state.id, n)) continue;
      const std::string& name = one.state.files[n];
      HttpResponse response{200, type_of_export(name), ""};
      response.file = folder_of(one.state.id) + "/" + name;
      response.download_name = name;
      return response;
    }
  }
  return {404, "application/json",
          error_json("serve.export.unknown", "no such file of an export", "the state lists what is done")};
}

}  // namespace semfield::app
