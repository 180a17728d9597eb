// Which of the shipped presets suits a scene, from what was found in it.
#pragma once

#include <array>
#include <optional>
#include <string>

#include "loading/frame_source.h"

namespace semfield {

struct PresetAdvice {
  std::string preset;  ///< as `include` takes it: "presets/room.yaml"
  std::string why;     ///< what was found, in one clause
  /// rendering.background, where the preset's own is another.
  std::optional<std::array<double, 3>> background;

  /// "presets/object.yaml with rendering.background: [0, 0.2, 1]: ..."
  std::string text() const;
};

/// Nothing of a scene that was not loaded. tests/datasets/datasets_test.cpp holds it against training.
std::optional<PresetAdvice> advised_preset(const LoadedScene& scene);

}  // namespace semfield
