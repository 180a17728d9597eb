#include "scene/output_names.h"

#include <algorithm>

#include "core/text.h"
#include "scene/scene_checks.h"

namespace semfield {

namespace {

constexpr std::size_t kMostBytes = 200;  // file systems take 255, and kinds and endings follow

}  // namespace

std::string output_name(std::string_view frame) {
  std::string name(frame);
  std::replace(name.begin(), name.end(), '/', '_');
  return name;
}

std::optional<std::string> OutputNames::add(const std::string& frame) {
  if (frame.empty()) return "its name is empty";
  if (frame.size() > kMostBytes)
    return "its name has " + std::to_string(frame.size()) + " bytes; at most " + std::to_string(kMostBytes) +
           " are allowed";
  if (!is_line_of_text(frame)) return "its name has a control character, or is not UTF-8";
  const auto [other, fresh] = frames_.emplace(output_name(frame), frame);
  if (fresh) return std::nullopt;
  if (other->second == frame) return "another one has its name";
  return "its files would be called '" + other->first + "', as those of '" + other->second + "'";
}

void check_output_names(const SceneInfo& info, Diagnostics& diagnostics) {
  OutputNames names;
  for (const FrameInfo& frame : info.frames) {
    if (const auto wrong = names.add(frame.name))
      diagnostics.error("scene.frame.name", frame_place(frame), *wrong, kFrameNameRemedy);
  }
}

}  // namespace semfield
