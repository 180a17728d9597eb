// Metadata of checkpoints: written, read strictly, compared with a scene.
#include "session/checkpoint_facts.h"

#include <fmt/format.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <exception>
#include <nlohmann/json.hpp>

#include "formats/text_rows.h"

namespace semfield {

namespace {

constexpr const char* kCheckpointFormat = "semfield-checkpoint-1";
constexpr const char* kOtherCheckpoint = "resume from another checkpoint of the run: move this file out of the folder";

[[noreturn]] void refuse(Code code, const TensorFile& file, const std::string& what,
                         const std::string& remedy = kOtherCheckpoint) {
  throw Error(ErrorKind::data, code, fmt::format("'{}': {}", file.name(), what), remedy);
}

const std::string& text_of(const TensorFile& file, const std::string& key) {
  const auto entry = file.metadata().find(key);
  if (entry == file.metadata().end())
    refuse("checkpoint.metadata.damaged", file, fmt::format("metadata '{}' is missing", key));
  return entry->second;
}

template <class Number>
Number number_of(const TensorFile& file, const std::string& key) {
  const std::string& text = text_of(file, key);
  Number value = 0;
  const auto [end, status] = std::from_chars(text.data(), text.data() + text.size(), value);
  const bool finite = std::isfinite(static_cast<double>(value));
  if (status != std::errc{} || end != text.data() + text.size() || !finite || value < 0)
    refuse("checkpoint.metadata.damaged", file,
           fmt::format("metadata '{}' is '{}', no number of that kind", key, text));
  return value;
}

std::optional<EventsKnown> clicks_of(const TensorFile& file) {
  const auto text = file.metadata().find("clicks");
  if (text == file.metadata().end()) return std::nullopt;
  EventsKnown known;
  const char* const end = text->second.data() + text->second.size();
  const auto events = std::from_chars(text->second.data(), end, known.events);
  const auto checksum = events.ptr < end ? std::from_chars(events.ptr + 1, end, known.checksum, 16) : events;
  if (events.ec != std::errc{} || checksum.ec != std::errc{} || checksum.ptr != end || checksum.ptr == events.ptr ||
      known.events < 0)
    refuse("checkpoint.metadata.damaged", file,
           fmt::format("metadata 'clicks' is '{}', no count and checksum", text->second));
  return known;
}

// read(text of `key`). Throws Error(data) naming file and key where it cannot be read.
template <class Read>
auto parsed(const TensorFile& file, const std::string& key, const Read& read) {
  const std::string& text = text_of(file, key);
  try {
    return read(text);
  } catch (const Error& error) {
    refuse("checkpoint.metadata.damaged", file, fmt::format("metadata '{}' cannot be read: {}", key, error.message()));
  } catch (const nlohmann::json::exception& error) {
    refuse("checkpoint.metadata.damaged", file, fmt::format("metadata '{}' cannot be read: {}", key, error.what()));
  }
}

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

TensorMetadata checkpoint_metadata(const CheckpointFacts& facts, const std::string& config_hash) {
  TensorMetadata metadata;
  metadata["format"] = kCheckpointFormat;
  metadata["step"] = std::to_string(facts.step);
  metadata["train_s"] = fmt::format("{}", facts.train_s);
  metadata["seed"] = std::to_string(facts.seed);
  metadata["config"] = facts.config;
  metadata["config_hash"] = config_hash;
  metadata["classes"] = facts.classes;
  metadata["scene"] = manifest_text(facts.scene);
  metadata["inputs"] = inputs_text(facts.inputs);
  if (!facts.modules.empty()) metadata["modules"] = nlohmann::json(facts.modules).dump();
  if (facts.clicks) metadata["clicks"] = fmt::format("{} {:08x}", facts.clicks->events, facts.clicks->checksum);
  if (!facts.self_labels.empty()) metadata["self_labels"] = facts.self_labels;
  return metadata;
}

CheckpointFacts read_checkpoint_facts(const TensorFile& file) {
  if (const std::string format = text_of(file, "format"); format != kCheckpointFormat) {
    refuse("checkpoint.file.version", file,
           fmt::format("its format is '{}', this program reads '{}'", format, kCheckpointFormat),
           "use the version of the program that wrote it, or train again");
  }
  for (const char* key : {"scene", "inputs"})  // which programs before 1.0 did not write
    if (!file.metadata().contains(key))
      refuse("checkpoint.file.version", file, fmt::format("it has no '{}': a version older than 1.0 wrote it", key),
             "use the version of the program that wrote it, or train again");
  CheckpointFacts facts;
  facts.step = number_of<std::int64_t>(file, "step");
  facts.train_s = number_of<double>(file, "train_s");
  facts.seed = number_of<std::uint32_t>(file, "seed");
  facts.config = text_of(file, "config");
  facts.classes = text_of(file, "classes");
  facts.scene = read_manifest_text(text_of(file, "scene"));
  facts.inputs = parsed(file, "inputs", [](const std::string& text) { return read_inputs_text(text); });
  facts.clicks = clicks_of(file);
  if (file.metadata().contains("modules"))
    facts.modules = parsed(file, "modules", [](const std::string& text) {
      return nlohmann::json::parse(text).get<std::map<std::string, std::string>>();
    });
  if (file.metadata().contains("self_labels")) facts.self_labels = text_of(file, "self_labels");
  return facts;
}

CheckpointFacts read_checkpoint_facts(const TensorFile& file, std::int64_t step) {
  CheckpointFacts facts = read_checkpoint_facts(file);
  if (facts.step != step) {
    refuse("checkpoint.file.name", file, fmt::format("its name says step {}, its metadata step {}", step, facts.step),
           fmt::format("name it step_{:08d}.safetensors", facts.step));
  }
  return facts;
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
      throw Error(ErrorKind::data, "checkpoint.labels.changed",
                  what + ": the network has one logit for each class with such pixels",
                  "restore the labels, or train again with --out");
    diagnostics.warning("checkpoint.labels.changed", "scene", "the labels are not as they were: " + what,
                        "restore the labels, or train again");
    return;
  }
}

std::string manifest_text(const KnownScene& scene) {
  nlohmann::ordered_json json;
  KnownScene copy = scene;
  walk(copy, [&](const char* name, auto& value) { json[name] = value; });
  return json.dump();
}

KnownScene read_manifest_text(const std::string& text) {
  KnownScene scene;
  const SceneManifest& m = scene.manifest;
  try {
    const nlohmann::json json = nlohmann::json::parse(text);
    walk(scene, [&](const char* name, auto& value) { read_json_value(json, name, value); });
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
