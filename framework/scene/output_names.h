// What the files of a frame are called: one rule for all that write them.
#pragma once

#include <map>
#include <optional>
#include <string>
#include <string_view>

#include "scene/scene.h"

namespace semfield {

/// What the names of a frame's files begin with: its name, with '/' as '_'.
std::string output_name(std::string_view frame);

/// Frames added so far, by the names of their files.
class OutputNames {
 public:
  /// Adds the next frame. Nothing where it can have files of its own; else what is wrong with its name: empty, longer
  /// than 200 bytes, no line of text, or an earlier frame's files would be called the same.
  std::optional<std::string> add(const std::string& frame);

 private:
  std::map<std::string, std::string> frames_;  // by output name
};

/// What to do about what OutputNames::add finds.
inline constexpr const char* kFrameNameRemedy =
    "give each frame a printable name of its own; '/' becomes '_' in names of files";

/// Every frame must be able to have files of its own: an error for each that cannot. So no two frames of a scene that
/// was opened share a file.
void check_output_names(const SceneInfo& info, Diagnostics& diagnostics);

}  // namespace semfield
