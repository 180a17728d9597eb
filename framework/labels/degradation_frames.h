// What the degradations share: the walk over frames with hard labels, and the classes that a scene has.
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <string_view>
#include <vector>

#include "labels/label_steps.h"

namespace semfield {

/// Frames that have labels, ascending. `type` names the degradation in messages. Throws Error(data) naming a frame
/// whose labels are soft.
std::vector<std::size_t> hard_frames(const LoadedScene& scene, const LabelSet& labels, std::string_view type);

/// Internal indices, ascending, of the classes that occur in the scene's own labels, of whatever split and frame: what
/// is drawn at random is drawn from these, since a table may know many classes that the scene does not have. All
/// classes of the table where the scene has no labels of its own. Throws Error(data) for an empty table.
std::vector<std::int16_t> scene_classes(const LoadedScene& scene, std::string_view type);

/// Calls change(frame, labels [H * W]) for every frame of hard_frames(), in parallel; a frame's result may depend on
/// the frame alone. Returns the facts that every degradation tells: frames, labelled pixels before and after, pixels
/// whose label is another one.
StepFacts change_hard_labels(const LoadedScene& scene, std::string_view type, LabelSet& labels,
                             const std::function<void(std::size_t frame, std::vector<std::int16_t>& hard)>& change);

/// Whole number nearest to share * count; halves go up. At most `count` for shares up to 1.
std::int64_t rounded_share(double share, std::int64_t count);

}  // namespace semfield
