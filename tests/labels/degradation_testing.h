// Shared by the tests of degradations: a step from YAML, and scenes of a few labelled pixels.
#pragma once

#include "compute/parallel.h"
#include "core/rng.h"
#include "tests/labels/label_plugins.h"
#include "tests/scene/tiny_scene.h"

namespace semfield::testing_degrade {

/// The step of a type with its keys as YAML ("{ratio: 0.5}"); every error is thrown.
inline std::unique_ptr<Degradation> step(const std::string& type, const std::string& keys = "{}") {
  return testing_labels::make_degradation(type, keys);
}

struct Case {
  LoadedScene scene;
  LabelSet labels;  ///< of every frame, the scene's own

  /// Adds a training frame; the scene's class table has classes 0 .. classes - 1 with ids 1 .. classes.
  void add(int width, int height, const std::vector<std::int16_t>& label,
           const std::vector<std::int32_t>& instance = {}, const std::vector<float>& depth_m = {}) {
    FrameBuffer buffer{
        .width_px = width, .height_px = height, .depth_m = depth_m, .label = label, .instance = instance};
    FrameInfo info;
    info.name = "rgb_" + std::to_string(scene.frames.size());
    info.has_labels = true;
    info.has_instances = !instance.empty();
    info.has_depth = !depth_m.empty();
    scene.info.frames.push_back(info);
    std::vector<std::int64_t> counts(static_cast<std::size_t>(scene.info.classes.valid_count()) + 1);
    for (const std::int16_t c : label) ++counts[c == kVoid ? counts.size() - 1 : static_cast<std::size_t>(c)];
    scene.class_pixels.push_back(counts);
    scene.frames.emplace_back(buffer);
    labels.push_back({label, {}});
  }

  StepFacts apply(const Degradation& degradation, std::uint64_t seed = 1) {
    return degradation.apply(scene, seed, labels);
  }
};

inline Case scene_of(int classes) {
  Case c;
  std::vector<ClassEntry> entries{{0, "void", {}, true}};
  for (int i = 0; i < classes; ++i) entries.push_back({i + 1, "class_" + std::to_string(i), {}, false});
  c.scene.info.classes = ClassTable(std::move(entries));
  return c;
}

/// Blocks of 8 x 6 pixels with random classes, every 16th block void; instance = block + 1.
inline void add_blocks(Case& c, int width, int height, std::uint64_t seed) {
  const int classes = c.scene.info.classes.valid_count();
  std::vector<std::int16_t> label;
  std::vector<std::int32_t> instance;
  std::vector<float> depth_m;
  for (int y = 0; y < height; ++y) {
    for (int x = 0; x < width; ++x) {
      const int block = y / 6 * 64 + x / 8;
      const auto drawn = static_cast<int>(uniform_below({seed, 0, 1}, static_cast<std::uint64_t>(block), 16));
      label.push_back(drawn == 0 ? kVoid : static_cast<std::int16_t>(block % classes));
      instance.push_back(block + 1);
      depth_m.push_back(1.0F + 0.05F * static_cast<float>(x));
    }
  }
  c.add(width, height, label, instance, depth_m);
}

inline std::string fact(const StepFacts& facts, const std::string& name) {
  for (const auto& [key, value] : facts) {
    if (key == name) return value;
  }
  return "no fact '" + name + "'";
}

/// Facts of all frames, hard and soft labels.
inline bool same_labels(const LabelSet& a, const LabelSet& b) {
  if (a.size() != b.size()) return false;
  for (std::size_t f = 0; f < a.size(); ++f) {
    if (a[f].hard != b[f].hard || !(a[f].soft == b[f].soft)) return false;
  }
  return true;
}

}  // namespace semfield::testing_degrade
