#include "session/settings/label_choices.h"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

#include "compute/parallel.h"
#include "core/check.h"

namespace semfield {

namespace {

// Of one pixel and the labelled one before it in its row or column, `distance` away.
void add_pair(std::int16_t label, std::int16_t other, std::int64_t distance, LabelStatistics& sums) {
  const bool beside = distance == 1;
  if (other == kVoid || distance > kReach) return;
  (beside ? sums.neighbours : sums.apart) += 1;
  if (label == other) (beside ? sums.equal : sums.apart_equal) += 1;
}

struct Seen {
  std::int64_t at = 0;  // column or row
  std::int16_t label = kVoid;
};

void add_frame(const TrainingLabels::Frame& labels, std::int32_t width_px, LabelStatistics& sums) {
  std::vector<Seen> above(static_cast<std::size_t>(width_px));
  Seen left;
  for (std::size_t pixel = 0; pixel < labels.size(); ++pixel) {
    const std::int16_t label = labels[pixel];
    const auto x = static_cast<std::int64_t>(pixel) % width_px, y = static_cast<std::int64_t>(pixel) / width_px;
    if (x == 0) left = {};
    if (label == kVoid) continue;
    Seen& over = above[static_cast<std::size_t>(x)];
    ++sums.labelled;
    add_pair(label, left.label, x - left.at, sums);
    add_pair(label, over.label, y - over.at, sums);
    left = {x, label};
    over = {y, label};
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
    sums.apart += frame.apart;
    sums.apart_equal += frame.apart_equal;
  }
  return sums;
}

LabelKind kind_of(const LabelStatistics& s) {
  const bool few = s.share() < kFewShare;
  if (s.side_by_side()) {
    if (s.agreement() < kAgreement) return LabelKind::noisy;
  } else if (!few && s.near_one_another() && s.agreement_apart() < kAgreementApart) {
    return LabelKind::noisy;
  }
  return few ? LabelKind::few : s.share() < kDenseShare ? LabelKind::many : LabelKind::dense;
}

namespace {

// What is seen of their agreement, or that nothing is.
std::string agreement_text(const LabelStatistics& s) {
  if (s.side_by_side()) return fmt::format("{:.3g} % of neighbouring labels agree", 100 * s.agreement());
  if (s.share() >= kFewShare && s.near_one_another())
    return fmt::format("{:.3g} % of labels next to each other within {} pixels agree", 100 * s.agreement_apart(),
                       kReach);
  return "too few lie side by side to see whether many are wrong; if so, name the branch for noisy labels alone";
}

std::string reason_text(LabelKind kind, const LabelStatistics& s) {
  if (s.labelled == 0) return "labels are to come, and will be few";
  return fmt::format("labels are {} ({:.3g} % of the training pixels have one; {})",
                     ChoiceNames<LabelKind>::names[static_cast<std::size_t>(kind)], 100 * s.share(), agreement_text(s));
}

}  // namespace

std::vector<std::string> choose_branches(RunConfig& config, const LabelStatistics& statistics) {
  std::vector<std::string> lines;
  const LabelKind kind = kind_of(statistics);
  for (PassConfig& pass : config.passes) {
    if (pass.semantic.size() < 2) continue;
    const auto fits = std::find_if(pass.semantic.begin(), pass.semantic.end(), [kind](const SemanticBranchConfig& b) {
      return b.labels == kind || b.labels == LabelKind::any ||
             (kind == LabelKind::dense && b.labels == LabelKind::many);
    });
    SEMFIELD_CHECK(fits != pass.semantic.end(), "some branch is for every kind of labels");
    std::vector<SemanticBranchConfig> chosen;
    chosen.push_back(std::move(*fits));
    pass.semantic = std::move(chosen);
    lines.push_back(fmt::format("{}.{}: {} and {} were chosen, because {}", pass.key, pass.branch()->key,
                                pass.branch()->position.entry->name, pass.branch()->field.entry->name,
                                reason_text(kind, statistics)));
  }
  return lines;
}

std::string choose_ray_source(TrainParams& train, const LabelCount& labels) {
  if (train.ray_source != RaySourceKind::automatic) return {};
  const bool balanced = labels.labelled_px > 0 || labels.may_come;
  train.ray_source = balanced ? RaySourceKind::label_balanced : RaySourceKind::all_images;
  if (!balanced) return "train.ray_source: all_images was chosen, because no training pixel has a label";
  if (labels.labelled_px == 0)
    return "train.ray_source: label_balanced was chosen, because labels may come; until then rays come from all pixels";
  return fmt::format(
      "train.ray_source: label_balanced was chosen, because {:.3g} % of the training pixels have a label; they get "
      "{:g} % "
      "of the rays",
      100.0 * static_cast<double>(labels.labelled_px) / static_cast<double>(labels.train_px),
      100 * train.labelled_share);
}

void warn_of_rare_labels(const TrainParams& train, const LabelCount& labels, Diagnostics& diagnostics) {
  const bool evenly = train.ray_source == RaySourceKind::all_images || train.ray_source == RaySourceKind::one_image;
  const double share =
      static_cast<double>(labels.labelled_px) / static_cast<double>(std::max<std::int64_t>(1, labels.train_px));
  if (!evenly || labels.labelled_px == 0 || share >= kRareShare) return;
  diagnostics.warning(
      "train.ray_source.rare", "train.ray_source",
      fmt::format(
          "{} draws pixels evenly, and {:.3g} % of them have a label: about {:.3g} of the {} rays of a step see "
          "one, so classes are hardly learned",
          ChoiceNames<RaySourceKind>::names[static_cast<std::size_t>(train.ray_source)], 100 * share,
          share * static_cast<double>(train.rays), train.rays),
      "set train.ray_source: auto");
}

}  // namespace semfield
