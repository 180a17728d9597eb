#include "loading/capture/prepare_state.h"

#include <cerrno>
#include <filesystem>
#include <nlohmann/json.hpp>

#include "core/error.h"
#include "core/text.h"
#include "system/files.h"

namespace semfield {

namespace fs = std::filesystem;
using Json = nlohmann::ordered_json;

PrepareState::PrepareState(std::string file, std::string identity)
    : file_(std::move(file)), identity_(std::move(identity)) {
  if (!std::filesystem::exists(file_)) {
    write();
    return;
  }
  const Json root = Json::parse(read_text_file(file_), nullptr, false);
  const bool ours = root.is_object() && root.contains("made_from") && root["made_from"] == identity_ &&
                    root.contains("steps") && root["steps"].is_object();
  if (!ours) {
    throw Error(ErrorKind::cannot_create, "capture.scene.other",
                "the scene of '" + file_ + "' was begun from other photographs or with other options",
                "name another folder with --out, or remove this one");
  }
  for (const auto& [step, found] : root["steps"].items())
    steps_.emplace_back(step, found.is_string() ? found.get<std::string>() : "");
}

const std::string* PrepareState::done(const std::string& step) const {
  for (const auto& [name, found] : steps_) {
    if (name == step) return &found;
  }
  return nullptr;
}

std::vector<std::string> PrepareState::lines(const std::string& step) const {
  std::vector<std::string> out;
  const std::string* const found = done(step);
  std::string_view rest = found == nullptr ? std::string_view() : *found;
  for (std::string_view line; next_line(rest, line);) out.emplace_back(line);
  return out;
}

void PrepareState::mark(const std::string& step, const std::string& found) {
  std::erase_if(steps_, [&](const auto& one) { return one.first == step; });
  steps_.emplace_back(step, found);
  write();
}

void PrepareState::forget(const std::string& step) {
  if (std::erase_if(steps_, [&](const auto& one) { return one.first == step; }) > 0) write();
}

void PrepareState::write() const {
  Json steps = Json::object();
  for (const auto& [step, found] : steps_) steps[step] = found;
  write_file_atomic(
      file_,
      Json{{"made_from", identity_}, {"steps", steps}}.dump(1, ' ', false, Json::error_handler_t::replace) + "\n");
}

PrepareFolder::PrepareFolder(const std::string& scene) : prepare_(scene + "/prepare") {
  std::error_code unknown;
  if (fs::exists(scene, unknown) && !fs::exists(prepare_, unknown) && !fs::is_empty(scene, unknown)) {
    throw Error(ErrorKind::cannot_create, "files.output.exists", "'" + scene + "' is there already",
                "name another folder with --out");
  }
  create_folders(logs());
  create_folders(work());
  if (const int cause = lock_.take(prepare_); cause == EWOULDBLOCK)
    throw Error(ErrorKind::cannot_create, "capture.scene.busy", lock_.holder() + " prepares '" + scene + "'",
                "wait until it has ended");
  else if (cause != 0)
    throw write_error("lock", prepare_, cause);
}

}  // namespace semfield
