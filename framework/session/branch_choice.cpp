#include "session/branch_choice.h"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

#include "compute/parallel.h"
#include "core/check.h"

namespace semfield {

namespace {

void add_frame(const TrainingLabels::Frame& labels, std::int32_t width_px, LabelStatistics& sums) {
  const auto size = static_cast<std::int64_t>(labels.size());
  const auto at = [&](std::int64_t pixel) { return labels[static_cast<std::size_t>(pixel)]; };
  std::int16_t left = kVoid;
  for (std::int64_t pixel = 0; pixel < size; ++pixel) {
    const std::int16_t label = at(pixel);
    if (pixel % width_px == 0) left = kVoid;
    if (label != kVoid) {
      ++sums.labelled;
      const std::int16_t above = pixel >= width_px ? at(pixel - width_px) : kVoid;
      for (const std::int16_t other : {left, above}) {
        sums.neighbours += other != kVoid ? 1 : 0;
        sums.equal += other == label ? 1 : 0;
      }
    }
    left = label;
  }
}

}  // namespace

LabelStatistics label_statistics(const LoadedScene& scene, const TrainingLabels& labels) {
  std::vector<LabelStatistics> of_frame(scene.frames.size());
  parallel_for(std::ssize(scene.frames), [&](std::int64_t i) {
    const auto f = static_cast<std::size_t>(i);
    if (scene.info.frames[f].split != Split::train) return;
    of_frame[f].pixels = std::int64_t{scene.frames[f].width_px} * scene.frames[f].height_px;
    if (!labels.frames[f].empty()) add_frame(labels.frames[f], scene.frames[f].width_px, of_frame[f]);
  });
  LabelStatistics sums;
  for (const LabelStatistics& frame : of_frame) {
    sums.pixels += frame.pixels;
    sums.labelled += frame.labelled;
    sums.neighbours += frame.neighbours;
    sums.equal += frame.equal;
  }
  return sums;
}

LabelKind kind_of(const LabelStatistics& s) {
  const bool seen = s.neighbours > 0 && s.neighbours >= s.labelled / 2;
  if (seen && s.agreement() < kAgreement) return LabelKind::noisy;
  return s.share() < kFewShare ? LabelKind::few : LabelKind::many;
}

std::vector<std::string> choose_branches(RunConfig& config, const LabelStatistics& statistics) {
  std::vector<std::string> lines;
  const LabelKind kind = kind_of(statistics);
  for (PassConfig& pass : config.passes) {
    if (pass.semantic.size() < 2) continue;
    const auto fits = std::find_if(pass.semantic.begin(), pass.semantic.end(), [kind](const SemanticBranchConfig& b) {
      return b.labels == kind || b.labels == LabelKind::any;
    });
    SEMFIELD_CHECK(fits != pass.semantic.end(), "some branch is for every kind of labels");
    std::vector<SemanticBranchConfig> chosen;
    chosen.push_back(std::move(*fits));
    pass.semantic = std::move(chosen);
    lines.push_back(
        fmt::format("{}.{}: {} and {} were chosen, because labels are {} ({:.3g} % of the training pixels have one; "
                    "{:.3g} % of neighbouring labels agree)",
                    pass.key, pass.branch()->key, pass.branch()->position.entry->name, pass.branch()->field.entry->name,
                    ChoiceNames<LabelKind>::names[static_cast<std::size_t>(kind)], 100 * statistics.share(),
                    100 * statistics.agreement()));
  }
  return lines;
}

}  // namespace semfield
