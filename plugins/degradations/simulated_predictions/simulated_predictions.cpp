// Simulated predictions: labels with the errors of a network, made from clean ones by a seeded model; the formulas
// stand in docs/guide/label_experiments.md.
#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <span>

#include "core/rng.h"
#include "labels/mask_outlines.h"
#include "labels/training_labels.h"
#include "plugin/module.h"
#include "scene/scene.h"

namespace semfield {

namespace {

constexpr std::string_view kSimulatedPredictions = "simulated_predictions";
constexpr int kMostSimilar = 16;
constexpr double kLargeRegion = 0.1;  // share of a frame from which on a region is never wholly mistaken

enum class Output { soft, hard };

}  // namespace

SEMFIELD_CHOICES(Output, "soft", "hard");

namespace {

// Smooth random field: standard normal values on a square lattice, cubic steps between them.
class NoiseField {
 public:
  NoiseField(std::int32_t width, std::int32_t height, double cell_px, const RandomAddress& address,
             std::uint64_t first_index)
      : cell_px_(cell_px), columns_(nodes(width)) {
    values_.resize(columns_ * nodes(height));
    for (std::size_t i = 0; i < values_.size(); ++i)
      values_[i] = static_cast<float>(normal01(address, first_index + i));
  }

  double at(std::int32_t x, std::int32_t y) const {
    const auto [column, u] = place(x);
    const auto [row, v] = place(y);
    const float* node = values_.data() + row * columns_ + column;
    const double upper = node[0] + u * (node[1] - node[0]);
    const double lower = node[columns_] + u * (node[columns_ + 1] - node[columns_]);
    return upper + v * (lower - upper);
  }

  std::size_t size() const { return values_.size(); }

 private:
  std::size_t nodes(std::int32_t size) const { return static_cast<std::size_t>((size - 1) / cell_px_) + 2; }
  std::pair<std::size_t, double> place(std::int32_t x) const {
    const double cells = x / cell_px_, whole = std::floor(cells), rest = cells - whole;
    return {static_cast<std::size_t>(whole), rest * rest * (3 - 2 * rest)};
  }

  double cell_px_;
  std::size_t columns_;
  std::vector<float> values_;
};

// What is alike in all frames: which classes a class is taken for, and how readily.
struct Confusions {
  std::vector<std::int16_t> classes;               // of the scene
  std::vector<std::vector<std::int16_t>> similar;  // [table] by class index; empty for classes that are not the scene's
  std::vector<std::vector<double>> overlap;        // as `similar`, in [0, 1)
};

Confusions draw_confusions(std::vector<std::int16_t> classes, int count, int table, std::uint64_t seed) {
  Confusions out;
  out.similar.resize(static_cast<std::size_t>(table));
  out.overlap.resize(static_cast<std::size_t>(table));
  for (int c = 0; c < table; ++c) {
    const auto own = static_cast<std::uint64_t>(c);
    std::vector<std::int16_t> others = classes;
    std::erase(others, static_cast<std::int16_t>(c));
    const std::size_t wanted = std::min(others.size(), static_cast<std::size_t>(count));
    for (std::size_t k = 0; k < wanted; ++k) {
      const RandomAddress which{seed, own, stream_id("labels/simulated_predictions/similar")};
      std::swap(others[k], others[k + uniform_below(which, k, others.size() - k)]);
      const RandomAddress how_much{seed, own, stream_id("labels/simulated_predictions/overlap")};
      out.overlap[own].push_back(static_cast<double>(uniform01(how_much, k)));
    }
    others.resize(wanted);
    out.similar[own] = std::move(others);
  }
  out.classes = std::move(classes);
  return out;
}

// Sums over a frame, for the manifest.
struct FrameFacts {
  std::int64_t labelled = 0, wrong = 0, regions_mistaken = 0;
  double confidence = 0;
};

class SimulatedPredictions final : public Degradation {
 public:
  void describe(ParamVisitor& visit) override {
    SEMFIELD_PARAM(visit, *this, output, "class probabilities, or the most probable class alone");
    SEMFIELD_PARAM(visit, *this, strength, "multiplies overlap, region_error, boundary_width and noise; 0 = no error",
                   {0, 4});
    SEMFIELD_PARAM(visit, *this, evidence, "logit of the class that is seen; the others are at 0", {0.1, 30});
    SEMFIELD_PARAM(visit, *this, similar, "how many classes of the scene a class is mistaken for", {1, kMostSimilar});
    SEMFIELD_PARAM(visit, *this, overlap, "largest share of the evidence that a similar class gets in every frame",
                   {0, 1});
    SEMFIELD_PARAM(visit, *this, region_error,
                   "chance that a small region is wholly mistaken for a similar class; it falls to 0 at a tenth of the "
                   "frame",
                   {0, 1});
    SEMFIELD_PARAM(visit, *this, boundary_width, "how far boundaries stray (standard deviation), share of the width",
                   {0, 0.25});
    SEMFIELD_PARAM(visit, *this, noise, "standard deviation of each frame's smooth noise on the logits", {0, 30});
    SEMFIELD_PARAM(visit, *this, noise_size, "distance between independent values of the noise, share of the width",
                   {0.02, 1});
    SEMFIELD_PARAM(visit, *this, depth_half_m, "depth at which the evidence is halved, metres; 0 = depth is not used",
                   {0, 1000});
  }

  bool wants_depth() const override { return depth_half_m > 0; }

  StepFacts apply(const LoadedScene& scene, std::uint64_t seed, LabelSet& labels) const override {
    const int table = scene.info.classes.valid_count();
    const Confusions confusions = draw_confusions(scene_classes(scene, kSimulatedPredictions), similar, table, seed);
    std::vector<FrameFacts> of_frame(labels.size());
    std::vector<SoftMap> soft(labels.size());
    for (const std::size_t f : hard_frames(scene, labels, kSimulatedPredictions)) check_depth(scene, f);
    StepFacts facts =
        change_hard_labels(scene, kSimulatedPredictions, labels, [&](std::size_t f, std::vector<std::int16_t>& hard) {
          if (output == Output::soft) soft[f] = SoftMap(hard.size(), table);
          of_frame[f] = predict({scene.frames[f], f, seed}, confusions, hard, soft[f]);
        });
    FrameFacts sum;
    for (std::size_t f = 0; f < labels.size(); ++f) {
      sum.labelled += of_frame[f].labelled;
      sum.wrong += of_frame[f].wrong;
      sum.regions_mistaken += of_frame[f].regions_mistaken;
      sum.confidence += of_frame[f].confidence;
      if (soft[f].empty()) continue;
      labels[f].soft = std::move(soft[f]);
      labels[f].hard = {};
    }
    const auto share = [&](double value) {
      return sum.labelled == 0 ? std::string("none") : fmt::format("{:.6f}", value / static_cast<double>(sum.labelled));
    };
    facts.emplace_back("simulated", "true");
    facts.emplace_back("pixel accuracy", share(static_cast<double>(sum.labelled - sum.wrong)));
    facts.emplace_back("mean probability of the most probable class", share(sum.confidence));
    facts.emplace_back("regions wholly mistaken", std::to_string(sum.regions_mistaken));
    return facts;
  }

  Output output = Output::soft;
  double strength = 1;
  double evidence = 8;
  int similar = 3;
  double overlap = 0.6;
  double region_error = 0.15;
  double boundary_width = 0.012;
  double noise = 2;
  double noise_size = 0.1;
  double depth_half_m = 5;

 private:
  struct Place {
    const StoredFrame& frame;
    std::size_t index;
    std::uint64_t seed;
    RandomAddress address(std::string_view stream) const { return {seed, index, stream_id(stream)}; }
  };

  // Without it the same configuration would give other labels wherever depth is not kept in memory.
  void check_depth(const LoadedScene& scene, std::size_t f) const {
    if (depth_half_m > 0 && scene.info.frames[f].has_depth && scene.frames[f].depth_m.empty()) {
      throw Error(
          ErrorKind::internal, "internal.degradation.depth",
          std::string(kSimulatedPredictions) + ": the depth of " + frame_place(scene.info.frames[f]) + " was not kept");
    }
  }

  // What the network takes each region for, then each pixel: boundaries stray along a smooth random displacement.
  std::vector<std::int16_t> seen_classes(const Place& at, const Confusions& confusions,
                                         const std::vector<std::int16_t>& clean, FrameFacts& facts) const {
    const std::int32_t width = at.frame.width_px, height = at.frame.height_px;
    const PixelRegions regions = regions_of(clean, width, height);
    const RandomAddress chance = at.address("labels/simulated_predictions/region");
    const RandomAddress partner = at.address("labels/simulated_predictions/partner");
    std::vector<std::int16_t> of_region;
    for (std::size_t r = 0; r < regions.first.size(); ++r) {
      const std::size_t first = regions.first[r];
      std::int16_t label = clean[first];
      const double share = static_cast<double>(regions.pixels[r]) / static_cast<double>(clean.size());
      const double q = strength * region_error * std::max(0.0, 1 - share / kLargeRegion);
      if (label != kVoid && static_cast<double>(uniform01(chance, first)) < q) {
        const std::vector<std::int16_t>& others = confusions.similar[static_cast<std::size_t>(label)];
        if (!others.empty()) {
          label = others[uniform_below(partner, first, others.size())];
          ++facts.regions_mistaken;
        }
      }
      of_region.push_back(label);
    }
    const double stray_px = strength * boundary_width * width;
    const double cell_px = std::max(2.0, 4 * stray_px);
    const RandomAddress boundary = at.address("labels/simulated_predictions/boundary");
    const NoiseField dx(width, height, cell_px, boundary, 0), dy(width, height, cell_px, boundary, dx.size());
    std::vector<std::int16_t> seen(clean.size(), kVoid);
    for (std::int32_t y = 0; y < height; ++y) {
      for (std::int32_t x = 0; x < width; ++x) {
        const auto pixel = static_cast<std::size_t>(y) * static_cast<std::size_t>(width) + static_cast<std::size_t>(x);
        if (clean[pixel] == kVoid) continue;
        const auto moved = [stray_px](std::int32_t from, double by, std::int32_t size) {
          return static_cast<std::size_t>(std::clamp(std::lround(from + stray_px * by), 0L, long{size} - 1));
        };
        const std::size_t other =
            moved(y, dy.at(x, y), height) * static_cast<std::size_t>(width) + moved(x, dx.at(x, y), width);
        seen[pixel] = of_region[regions.of_pixel[clean[other] == kVoid ? pixel : other]];
      }
    }
    return seen;
  }

  double evidence_at(const Place& at, std::size_t pixel) const {
    const double depth_m =
        depth_half_m > 0 && !at.frame.depth_m.empty() ? static_cast<double>(at.frame.depth_m[pixel]) : 0;
    return depth_m > 0 ? evidence / (1 + depth_m / depth_half_m) : evidence;
  }

  // `hard` becomes the most probable class; `soft`, unless empty, the probabilities.
  FrameFacts predict(const Place& at, const Confusions& confusions, std::vector<std::int16_t>& hard,
                     SoftMap& soft) const {
    const std::int32_t width = at.frame.width_px;
    FrameFacts facts;
    const std::vector<std::int16_t> seen = seen_classes(at, confusions, hard, facts);
    const double cell_px = std::max(1.0, noise_size * width);
    std::vector<NoiseField> fields;
    for (std::size_t c = 0; c < confusions.similar.size(); ++c) {
      const std::uint64_t first_index = fields.empty() ? 0 : c * fields.front().size();
      fields.emplace_back(width, at.frame.height_px, cell_px, at.address("labels/simulated_predictions/noise"),
                          first_index);
    }
    std::vector<float> row(confusions.similar.size());
    for (std::size_t pixel = 0; pixel < hard.size(); ++pixel) {
      if (hard[pixel] == kVoid) continue;
      const auto x = static_cast<std::int32_t>(pixel % static_cast<std::size_t>(width));
      const auto y = static_cast<std::int32_t>(pixel / static_cast<std::size_t>(width));
      probabilities(
          confusions, seen[pixel], evidence_at(at, pixel),
          [&](std::size_t c) { return strength * noise * fields[c].at(x, y); }, row);
      const auto best = std::max_element(row.begin(), row.end());
      const auto label = static_cast<std::int16_t>(best - row.begin());
      ++facts.labelled;
      facts.wrong += label != hard[pixel] ? 1 : 0;
      facts.confidence += static_cast<double>(*best);
      hard[pixel] = label;
      if (!soft.empty()) soft.set_row(pixel, row);
    }
    return facts;
  }

  // Softmax over the scene's classes; classes of the table that the scene lacks have probability 0.
  template <class Noise>
  void probabilities(const Confusions& confusions, std::int16_t seen, double raised_by, const Noise& noise_of,
                     std::span<float> row) const {
    const auto own = static_cast<std::size_t>(seen);
    const std::vector<std::int16_t>& others = confusions.similar[own];
    std::array<std::pair<std::size_t, double>, 1 + kMostSimilar> logits;  // of the classes that are not at 0
    logits[0] = {own, raised_by + noise_of(own)};
    double most = std::max(0.0, logits[0].second);
    for (std::size_t k = 0; k < others.size(); ++k) {
      const auto c = static_cast<std::size_t>(others[k]);
      const double shared = std::min(1.0, strength * overlap) * confusions.overlap[own][k];
      logits[k + 1] = {c, shared * raised_by + noise_of(c)};
      most = std::max(most, logits[k + 1].second);
    }
    const std::span<const std::pair<std::size_t, double>> raised = std::span(logits).first(others.size() + 1);
    std::fill(row.begin(), row.end(), 0.0F);
    for (const std::int16_t c : confusions.classes)
      row[static_cast<std::size_t>(c)] = static_cast<float>(std::exp(-most));
    for (const auto& [c, logit] : raised) row[c] = static_cast<float>(std::exp(logit - most));
    double sum = 0;
    for (const float p : row) sum += static_cast<double>(p);
    for (float& p : row) {
      // As stored, so that the most probable class is the same in soft and hard output.
      if (p > 0) p = float_of_half(half_of(static_cast<float>(static_cast<double>(p) / sum)));
    }
  }
};

}  // namespace

SEMFIELD_PLUGIN_MODULE(simulated_predictions, "1.0", [](Registry& registry) {
  registry.add_degradation<SimulatedPredictions>(
      "simulated_predictions", "soft or hard labels with the errors of a network, simulated from the clean labels");
})

}  // namespace semfield
