// Which training frames keep their labels; colour of all frames is always used.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "config/params.h"
#include "loading/frame_source.h"

namespace semfield {

enum class LabelMode { even, random, named, coverage };
template <>
struct ChoiceNames<LabelMode> {
  static constexpr std::array<std::string_view, 4> names{"even", "random", "named", "coverage"};
};

struct LabelParams {
  std::string frames = "all";
  LabelMode mode = LabelMode::even;
  std::int64_t seed = 1;
  std::vector<std::string> names;
  std::string clicks;  ///< label events (labels/clicks) painted over the labels; see LabelConfig::click_file
  int class_room = 0;
};
void describe(ParamVisitor& visit, LabelParams& params);
void validate(const LabelParams& params, Diagnostics& diagnostics);

/// How many of `available` labelled frames "all", "none", "10%" or "12" keeps: a share is rounded to the nearest whole
/// number, at least 1 where the share is above 0. Throws Error(config) for any other text, a share above 100 % and a
/// number above `available`.
int label_frame_count(const std::string& frames, int available);

/// Indices into info.frames, ascending, of the training frames whose labels train: N key-frames at ranks floor(k * n /
/// N) (`even`), N drawn without replacement from the address (seed, "labels/selection") (`random`), or the frames of
/// the given names (`named`), or one by one the frame that shows most classes not yet seen (`coverage`; of equals the
/// one with most labelled pixels, then the first), as an annotator would choose key-frames. Only frames with labels
/// count. `class_pixels` [frames][C + 1] as in LoadedScene, for `coverage` alone. Throws Error(config) naming a frame
/// that is missing, is no training frame or has no labels.
std::vector<int> select_label_frames(const SceneInfo& info, const LabelParams& params,
                                     const std::vector<std::vector<std::int64_t>>& class_pixels = {});

}  // namespace semfield
