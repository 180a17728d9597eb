#include "labels/scene_inputs.h"

#include <fmt/format.h>

#include <algorithm>
#include <exception>
#include <nlohmann/json.hpp>

#include "compute/parallel.h"
#include "core/text.h"
#include "formats/json_numbers.h"
#include "system/checksum.h"

namespace semfield {

namespace {

template <class Inputs, class Field>
void walk(Inputs& inputs, Field&& field) {
  field("frames", inputs.frames);
  field("names", inputs.names);
  field("cameras", inputs.cameras);
  field("colors", inputs.colors);
}

std::optional<std::uint32_t> crc_of(const LabelMap& labels) {
  if (labels.empty()) return std::nullopt;
  const std::vector<std::int16_t> all = labels.expand();
  return crc32c(std::as_bytes(std::span(all)));
}

std::optional<std::uint32_t> crc_of(const SoftMap& labels) {
  std::uint32_t crc = 0;
  std::vector<float> row(static_cast<std::size_t>(labels.classes()));
  for (std::size_t p = 0; p < labels.pixels(); ++p) {
    labels.row(p, row);
    crc = crc32c(std::as_bytes(std::span(row)), crc);
  }
  return crc;
}

// Of frame by frame; "" where none has labels.
template <class Crc>
std::string labels_checksum(std::size_t frames, Crc&& crc) {
  std::vector<std::optional<std::uint32_t>> of(frames);
  parallel_for(std::ssize(of),
               [&](std::int64_t f) { of[static_cast<std::size_t>(f)] = crc(static_cast<std::size_t>(f)); });
  if (std::none_of(of.begin(), of.end(), [](const auto& c) { return c.has_value(); })) return {};
  std::string text;
  for (const std::optional<std::uint32_t>& c : of) text += c ? hex64(*c) : "-";
  return hex64(fnv1a64(text));
}

}  // namespace

std::string inputs_text(const SceneInputs& inputs) {
  nlohmann::ordered_json json;
  walk(inputs, [&](const char* name, const auto& value) { json[name] = value; });
  if (inputs.labels) json["labels"] = *inputs.labels;
  if (inputs.training_labels) json["training_labels"] = *inputs.training_labels;
  return json.dump();
}

SceneInputs read_inputs_text(const std::string& text) {
  SceneInputs inputs;
  try {
    const nlohmann::json json = nlohmann::json::parse(text);
    walk(inputs, [&](const char* name, auto& value) { read_json_value(json, name, value); });
    if (json.contains("labels")) inputs.labels = json.at("labels").get<std::string>();
    if (json.contains("training_labels")) inputs.training_labels = json.at("training_labels").get<std::string>();
  } catch (const std::exception& error) {  // of the JSON, or out of range
    throw Error(ErrorKind::data, "checkpoint.metadata.damaged", error.what());
  }
  return inputs;
}

std::string SceneInputs::hash() const { return hex64(fnv1a64(inputs_text(*this))); }

SceneInputs scene_inputs(const LoadedScene& scene, const TrainingLabels& labels) {
  SceneInputs inputs;
  std::string names, cameras, colors;
  for (const FrameInfo& frame : scene.info.frames) {
    names += fmt::format("{} {}\n", static_cast<int>(frame.split), frame.name);
    const Camera& c = frame.camera;
    cameras += fmt::format("{} {}", c.width_px, c.height_px);
    for (const double v : {c.fx, c.fy, c.cx, c.cy, c.k1, c.k2, c.k3, c.k4, c.p1, c.p2})
      cameras += fmt::format(" {:.6g}", v);
    if (c.is_wide()) cameras += fmt::format(" {}", static_cast<int>(c.lens));
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
    if (!scene.frames[f].mask.empty()) checksums[f] = crc32c(std::as_bytes(scene.frames[f].mask.words()), checksums[f]);
  });
  for (const std::uint32_t checksum : checksums) colors += hex64(checksum);
  inputs.labels = labels_checksum(scene.frames.size(), [&](std::size_t f) { return crc_of(scene.frames[f].label); });
  const std::vector<TrainingLabels::Frame>& given = labels.unclicked.empty() ? labels.frames : labels.unclicked;
  inputs.training_labels = labels_checksum(given.size(), [&](std::size_t f) {
    return given[f].soft.empty() ? crc_of(given[f].hard) : crc_of(given[f].soft);
  });
  inputs.frames = std::ssize(scene.info.frames);
  inputs.names = hex64(fnv1a64(names));
  inputs.cameras = hex64(fnv1a64(cameras));
  if (any_pixel) inputs.colors = hex64(fnv1a64(colors));
  return inputs;
}

std::vector<std::string> other_inputs(const SceneInputs& a, const SceneInputs& b) {
  if (a.frames != b.frames) return {fmt::format("{} frames where there were {}", b.frames, a.frames)};
  if (a.names != b.names) return {"other frames, or another split of them"};
  std::vector<std::string> others;
  const auto differ = [](const std::string& x, const std::string& y) { return !x.empty() && !y.empty() && x != y; };
  if (a.cameras != b.cameras) others.emplace_back("other cameras (focal length, lens, size or pose)");
  if (differ(a.colors, b.colors)) others.emplace_back("other images");
  if (differ(a.labels.value_or(""), b.labels.value_or("")) ||
      differ(a.training_labels.value_or(""), b.training_labels.value_or("")))
    others.emplace_back("other labels");
  return others;
}

void warn_of_other_inputs(const SceneInputs& trained, const SceneInputs& now, Diagnostics& diagnostics) {
  if (const std::vector<std::string> others = other_inputs(trained, now); !others.empty()) {
    diagnostics.warning("run.scene.changed", "scene",
                        "it has changed since the run was trained: " + join(others, " and "),
                        "restore the data, or train again");
  }
  if (!trained.labels && now.labels != "")
    diagnostics.note("checkpoint.labels.unknown", "scene",
                     "the checkpoint is of an older version, which kept no checksum of labels: whether they "
                     "are still the same was not compared");
}

}  // namespace semfield
