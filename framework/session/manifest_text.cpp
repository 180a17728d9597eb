#include "session/manifest_text.h"

#include <algorithm>
#include <cmath>
#include <exception>
#include <nlohmann/json.hpp>

#include "core/error.h"
#include "formats/json_numbers.h"

namespace semfield {

namespace {

// One walk for both directions, so writer and reader cannot disagree.
template <class Field>
void walk(KnownScene& scene, Field&& field) {
  SceneManifest& m = scene.manifest;
  field("classes", m.classes);
  field("train_class_pixels", m.train_class_pixels);
  field("train_pixels", m.train_pixels);
  field("train_frames", m.train_frames);
  field("labelled_frames", m.labelled_frames);
  field("any_depth", m.any_depth);
  field("any_distortion", m.any_distortion);
  field("direction_spread_deg", m.direction_spread_deg);
  field("pixel_footprint_m", scene.pixel_footprint_m);
}

}  // namespace

std::string manifest_text(const KnownScene& scene) {
  nlohmann::ordered_json json;
  KnownScene copy = scene;
  walk(copy, [&](const char* name, auto& value) { json[name] = value; });
  return json.dump();
}

std::optional<KnownScene> read_manifest_text(const TensorMetadata& metadata) {
  const auto text = metadata.find("scene");
  if (text == metadata.end()) return std::nullopt;
  KnownScene scene;
  const SceneManifest& m = scene.manifest;
  try {
    const nlohmann::json json = nlohmann::json::parse(text->second);
    walk(scene, [&](const char* name, auto& value) {
      // Not in checkpoints of before it was counted: then it stays unknown, as in the run that wrote them.
      if (std::string_view(name) == "direction_spread_deg" && !json.contains(name)) return;
      read_json_value(json, name, value);
    });
    const auto negative = [](std::int64_t pixels) { return pixels < 0; };
    if (std::ssize(m.train_class_pixels) != m.classes ||
        std::any_of(m.train_class_pixels.begin(), m.train_class_pixels.end(), negative) ||
        !(scene.pixel_footprint_m > 0) || !std::isfinite(scene.pixel_footprint_m))
      throw std::out_of_range(std::to_string(m.train_class_pixels.size()) + " counts of pixels for " +
                              std::to_string(m.classes) + " classes, a pixel of " +
                              std::to_string(scene.pixel_footprint_m) + " m");
  } catch (const std::exception& e) {  // of the JSON, or out of range
    throw Error(ErrorKind::data, "checkpoint.metadata.damaged",
                std::string("checkpoint metadata 'scene' cannot be read: ") + e.what(),
                "resume from another checkpoint of the run");
  }
  return scene;
}

}  // namespace semfield
