// Metadata of checkpoints: written, read strictly, compared with a scene.
#include "session/checkpoint_facts.h"

#include <fmt/format.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <nlohmann/json.hpp>

#include "compute/parallel.h"
#include "system/checksum.h"

namespace semfield {

namespace {

constexpr const char* kCheckpointFormat = "semfield-checkpoint-1";
constexpr const char* kOtherCheckpoint = "resume from another checkpoint of the run: move this file out of the folder";

[[noreturn]] void refuse(const TensorFile& file, const std::string& what,
                         const std::string& remedy = kOtherCheckpoint) {
  throw Error(ErrorKind::data, fmt::format("'{}': {}", file.name(), what), remedy);
}

const std::string& text_of(const TensorFile& file, const std::string& key) {
  const auto entry = file.metadata().find(key);
  if (entry == file.metadata().end()) refuse(file, fmt::format("metadata '{}' is missing", key));
  return entry->second;
}

template <class Number>
Number number_of(const TensorFile& file, const std::string& key) {
  const std::string& text = text_of(file, key);
  Number value = 0;
  const auto [end, status] = std::from_chars(text.data(), text.data() + text.size(), value);
  const bool finite = std::isfinite(static_cast<double>(value));
  if (status != std::errc{} || end != text.data() + text.size() || !finite || value < 0)
    refuse(file, fmt::format("metadata '{}' is '{}', no number of that kind", key, text));
  return value;
}

template <class Inputs, class Field>
void walk(Inputs& inputs, Field&& field) {
  field("frames", inputs.frames);
  field("names", inputs.names);
  field("cameras", inputs.cameras);
  field("colors", inputs.colors);
}

std::string inputs_text(const SceneInputs& inputs) {
  nlohmann::ordered_json json;
  walk(inputs, [&](const char* name, const auto& value) { json[name] = value; });
  return json.dump();
}

std::optional<SceneInputs> inputs_of(const TensorFile& file) {
  const auto text = file.metadata().find("inputs");
  if (text == file.metadata().end()) return std::nullopt;
  SceneInputs inputs;
  try {
    const nlohmann::json json = nlohmann::json::parse(text->second);
    walk(inputs, [&](const char* name, auto& value) { json.at(name).get_to(value); });
  } catch (const nlohmann::json::exception& error) {
    refuse(file, fmt::format("metadata 'inputs' cannot be read: {}", error.what()));
  }
  return inputs;
}

}  // namespace

std::string SceneInputs::hash() const { return hex64(fnv1a64(inputs_text(*this))); }

SceneInputs scene_inputs(const LoadedScene& scene) {
  SceneInputs inputs;
  std::string names, cameras, colors;
  for (const FrameInfo& frame : scene.info.frames) {
    names += fmt::format("{} {}\n", static_cast<int>(frame.split), frame.name);
    const Camera& c = frame.camera;
    cameras += fmt::format("{} {}", c.width_px, c.height_px);
    for (const double v : {c.fx, c.fy, c.cx, c.cy, c.k1, c.k2, c.k3, c.k4, c.p1, c.p2})
      cameras += fmt::format(" {:.6g}", v);
    const Pose& pose = frame.world_from_camera;
    for (const auto& row : pose.r) {
      for (const double v : row) cameras += fmt::format(" {:.6f}", v);
    }
    cameras += fmt::format(" {:.6g} {:.6g} {:.6g}\n", pose.t.x, pose.t.y, pose.t.z);
  }
  std::vector<std::uint32_t> checksums(scene.frames.size());
  bool any_pixel = false;
  for (const StoredFrame& frame : scene.frames) any_pixel = any_pixel || !frame.rgb.empty();
  parallel_for(std::ssize(scene.frames), [&](std::int64_t i) {
    const auto f = static_cast<std::size_t>(i);
    checksums[f] = crc32c(std::as_bytes(std::span(scene.frames[f].rgb)));
  });
  for (const std::uint32_t checksum : checksums) colors += hex64(checksum);
  inputs.frames = std::ssize(scene.info.frames);
  inputs.names = hex64(fnv1a64(names));
  inputs.cameras = hex64(fnv1a64(cameras));
  if (any_pixel) inputs.colors = hex64(fnv1a64(colors));
  return inputs;
}

TensorMetadata checkpoint_metadata(const CheckpointFacts& facts, const std::string& config_hash) {
  TensorMetadata metadata;
  metadata["format"] = kCheckpointFormat;
  metadata["step"] = std::to_string(facts.step);
  metadata["train_s"] = fmt::format("{}", facts.train_s);
  metadata["seed"] = std::to_string(facts.seed);
  metadata["config"] = facts.config;
  metadata["config_hash"] = config_hash;
  metadata["classes"] = facts.classes;
  if (facts.scene) metadata["scene"] = manifest_text(*facts.scene);
  if (facts.inputs) metadata["inputs"] = inputs_text(*facts.inputs);
  if (!facts.self_labels.empty()) metadata["self_labels"] = facts.self_labels;
  return metadata;
}

CheckpointFacts read_checkpoint_facts(const TensorFile& file) {
  if (const std::string format = text_of(file, "format"); format != kCheckpointFormat) {
    refuse(file, fmt::format("its format is '{}', this program reads '{}'", format, kCheckpointFormat),
           "use the version of the program that wrote it, or train anew");
  }
  CheckpointFacts facts;
  facts.step = number_of<std::int64_t>(file, "step");
  facts.train_s = number_of<double>(file, "train_s");
  facts.seed = number_of<std::uint32_t>(file, "seed");
  facts.config = text_of(file, "config");
  facts.classes = text_of(file, "classes");
  facts.scene = read_manifest_text(file.metadata());
  facts.inputs = inputs_of(file);
  if (const auto round = file.metadata().find("self_labels"); round != file.metadata().end())
    facts.self_labels = round->second;
  return facts;
}

CheckpointFacts read_checkpoint_facts(const TensorFile& file, std::int64_t step) {
  CheckpointFacts facts = read_checkpoint_facts(file);
  if (facts.step != step) {
    refuse(file, fmt::format("its name says step {}, its metadata step {}", step, facts.step),
           fmt::format("name it step_{:08d}.safetensors", facts.step));
  }
  return facts;
}

void warn_of_other_inputs(const SceneInputs& trained, const SceneInputs& now, Diagnostics& diagnostics) {
  std::vector<std::string> others;
  if (trained.frames != now.frames) {
    others.push_back(fmt::format("{} frames where there were {}", now.frames, trained.frames));
  } else if (trained.names != now.names) {
    others.push_back("other frames, or another split of them");
  } else {
    if (trained.cameras != now.cameras) others.push_back("other cameras (focal length, lens, size or pose)");
    if (!trained.colors.empty() && !now.colors.empty() && trained.colors != now.colors)
      others.push_back("other images");
  }
  if (others.empty()) return;
  diagnostics.warning("scene", "it is not as it was when the run was trained: " + join(others, " and "),
                      "restore the data, or train anew");
}

void compare_training_labels(const KnownScene& trained, const SceneManifest& now, const ClassTable& classes,
                             const std::vector<std::string>& keep, Diagnostics& diagnostics) {
  const std::vector<std::int64_t>&before = trained.manifest.train_class_pixels, &after = now.train_class_pixels;
  const auto kept = [&](const char* name) { return std::find(keep.begin(), keep.end(), name) != keep.end(); };
  const auto any = [](const std::vector<std::int64_t>& pixels) {
    return std::any_of(pixels.begin(), pixels.end(), [](std::int64_t n) { return n > 0; });
  };
  const bool every_class_has_a_logit = kept("absent_classes") && (kept("semantics") || (any(before) && any(after)));
  for (std::size_t c = 0; c < std::min(before.size(), after.size()); ++c) {
    if (before[c] == after[c]) continue;
    const std::string what =
        fmt::format("class '{}' had {} labelled training pixels when the run began, and has {} now",
                    classes.valid(static_cast<int>(c)).name, before[c], after[c]);
    if ((before[c] == 0) != (after[c] == 0) && !every_class_has_a_logit)
      throw Error(ErrorKind::data, what + ": the network has one logit for each class with such pixels",
                  "restore the labels, or train anew with --out");
    diagnostics.warning("scene", "the labels are not as they were: " + what, "restore the labels, or train anew");
    return;
  }
}

}  // namespace semfield
