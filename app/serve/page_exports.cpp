#include "app/serve/page_exports.h"

#include <fmt/format.h>
#include <sys/resource.h>
#include <sys/wait.h>

#include <algorithm>
#include <chrono>
#include <csignal>
#include <filesystem>

#include "app/child_process.h"
#include "core/error.h"
#include "formats/zip_archive.h"
#include "system/files.h"

namespace semfield::app {

namespace fs = std::filesystem;

namespace {

constexpr int kLowPriority = 10;  // of 19: training goes first
constexpr auto kProgramLook = std::chrono::milliseconds(100);
constexpr const char* kLabelEnd = "_label.png";
constexpr int kSideBySide = 2;        // more would only take the CPU from each other
constexpr std::size_t kMostOpen = 8;  // that wait or are being made

std::vector<std::string> files_of(ExportKind kind) {
  if (kind == ExportKind::labels) return {"labels.zip"};
  if (kind == ExportKind::coco) return {"coco.json"};
  if (kind == ExportKind::film) return {"video.mp4"};
  return {"mesh.ply", "mesh.glb", "mesh_classes.ply", "mesh_classes.glb"};
}

std::string type_of_export(const std::string& file) {
  if (file.ends_with(".zip")) return "application/zip";
  if (file.ends_with(".mp4")) return "video/mp4";
  if (file.ends_with(".json")) return "application/json";
  return "application/octet-stream";
}

bool is_open(const ExportState& state) { return state.state == "waiting" || state.state == "running"; }

// What a program said last of how far it is.
std::string last_line(const std::string& log) {
  std::error_code failed;
  if (fs::file_size(log, failed) == 0 || failed) return {};
  std::string text = read_text_file(log);
  while (!text.empty() && text.back() == '\n') text.pop_back();
  return text.substr(text.rfind('\n') + 1);
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

std::string PageExports::start(ExportKind kind, const std::function<void(const std::string& folder)>& prepare) {
  const std::scoped_lock lock(mutex_);
  if (std::count_if(exports_.begin(), exports_.end(), [](const Export& e) { return is_open(e.state); }) >=
      static_cast<std::ptrdiff_t>(kMostOpen))
    throw Error(ErrorKind::unavailable, "serve.exports.full",
                fmt::format("{} exports are running or waiting", kMostOpen), "wait until one is done, or cancel one");
  std::string id;
  for (int n = 1; id.empty() || fs::exists(folder_of(id)); ++n) id = fmt::format("{}-{}", export_name(kind), n);
  create_folders(folder_of(id));
  if (prepare) prepare(folder_of(id));
  Export& one = exports_.emplace_back(Export{kind, {id, export_name(kind), "waiting", "for its turn", {}}});
  ++changes_;
  one.thread = std::thread([this, &one] { make(one); });
  return id;
}

bool PageExports::cancel(const std::string& id) {
  const std::scoped_lock lock(mutex_);
  const auto one = std::find_if(exports_.begin(), exports_.end(), [&](const Export& e) { return e.state.id == id; });
  if (one == exports_.end()) return false;
  one->canceled = true;
  turn_.notify_all();
  return true;
}

std::vector<ExportState> PageExports::list() const {
  const std::scoped_lock lock(mutex_);
  std::vector<ExportState> out;
  for (const Export& one : exports_) out.push_back(one.state);
  return out;
}

std::string PageExports::file(const std::string& id, std::uint64_t number) const {
  const std::scoped_lock lock(mutex_);
  for (const Export& one : exports_) {
    if (one.state.id == id && number < one.state.files.size()) return folder_of(id) + "/" + one.state.files[number];
  }
  return {};
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
      if (save_) save_();
      run_verb(one);
      if (one.kind == ExportKind::labels) pack_labels(folder);
    }
    if (ends(one)) {
      tell(one, "canceled", "");
    } else {
      tell(one, "done", "in " + folder, files_of(one.kind));
    }
  } catch (const std::exception& e) {
    tell(one, ends(one) ? "canceled" : "failed", ends(one) ? "" : e.what());
  }
  const std::scoped_lock lock(mutex_);
  --making_;
  turn_.notify_all();
}

std::vector<std::string> PageExports::words(ExportKind kind, const std::string& folder) const {
  const std::string& run = options_.run_dir;
  std::vector<std::string> words{options_.program};
  const auto add = [&](std::vector<std::string> more) { words.insert(words.end(), more.begin(), more.end()); };
  if (kind == ExportKind::labels) add({"export", run, "--split", "train", "--format", "png", "--out", folder});
  if (kind == ExportKind::coco)
    add({"export", run, "--split", "train", "--format", "coco", "--out", folder + "/coco.json"});
  if (kind == ExportKind::mesh) add({"mesh", run, "--format", "ply,glb", "--out", folder + "/mesh.ply"});
  if (kind == ExportKind::film)
    add({"render", run, "--trajectory", folder + "/path.json", "--video", "--out", folder + "/video.mp4"});
  for (const std::string& module : options_.modules) add({"--plugin", module});
  return words;
}

void PageExports::run_verb(Export& one) {
  const std::string folder = folder_of(one.state.id), log = folder + "/log.txt";
  const std::string begun = one.kind == ExportKind::mesh   ? "finding the surface"
                            : one.kind == ExportKind::film ? "rendering the path"
                                                           : "rendering the labels";
  tell(one, "running", begun);
  const pid_t child = start_child(words(one.kind, folder), {folder + "/output.txt", log},
                                  [] { setpriority(PRIO_PROCESS, 0, kLowPriority); });
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
  const std::size_t slash = place.find('/');
  const std::string number = slash == std::string::npos ? "" : place.substr(slash + 1);
  const bool digits = !number.empty() && number.size() < 4 &&
                      std::all_of(number.begin(), number.end(), [](char c) { return c >= '0' && c <= '9'; });
  const std::string file = digits ? this->file(place.substr(0, slash), std::stoul(number)) : "";
  if (file.empty())
    return {404, "application/json",
            error_json("serve.export.unknown", "no such file of an export", "the state lists what is done")};
  HttpResponse response{200, type_of_export(file), ""};
  response.file = file;
  response.download_name = file.substr(file.rfind('/') + 1);
  return response;
}

}  // namespace semfield::app
