// Metadata of checkpoints: written, read strictly, compared with a scene; and their tensors.
#include "train/checkpoint.h"

#include <fmt/format.h>

#include <algorithm>
#include <charconv>
#include <cmath>
#include <cstring>
#include <exception>
#include <nlohmann/json.hpp>
#include <set>
#include <span>

#include "core/text.h"
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
  const auto value = to_number<Number>(text);
  if (!value || !std::isfinite(static_cast<double>(*value)) || *value < 0)
    refuse("checkpoint.metadata.damaged", file,
           fmt::format("metadata '{}' is '{}', no number of that kind", key, text));
  return *value;
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

// Tensors.

namespace {

const char* const kMoment1 = "adam/m/";
const char* const kMoment2 = "adam/v/";

std::vector<std::int64_t> shape_of(const Tensor<float>& t) { return {t.spec.rows, t.spec.cols}; }

Error refused_network(Code code, const TensorFile& file, const std::string& what) {
  return Error(ErrorKind::data, code, file.name() + ": tensor " + what + ": this is another network's checkpoint",
               "train and load with the same configuration (run.yaml of the checkpoint's run)");
}

// Checks shape and presence of one tensor in the file.
const TensorRef& matching(const TensorFile& file, const std::string& name, const Tensor<float>& t) {
  const TensorRef* found = file.find(name);
  const std::string want = fmt::format("[{}, {}]", t.spec.rows, t.spec.cols);
  if (found == nullptr)
    throw refused_network("checkpoint.tensor.missing", file, fmt::format("'{}' {} is missing", name, want));
  if (found->shape != shape_of(t) || found->type != TensorType::f32) {
    std::string have;
    for (const std::int64_t n : found->shape) have += (have.empty() ? "" : ", ") + std::to_string(n);
    throw refused_network("checkpoint.tensor.shape", file,
                          fmt::format("'{}' is [{}], the network needs {}", name, have, want));
  }
  return *found;
}

// visit(name, tensor, buffer) for what a checkpoint holds: values, and with `moments` those of learned tensors.
template <class Visit>
void each_stored(const ParamStore<float>& store, bool moments, const Visit& visit) {
  for (const Tensor<float>& t : store.all()) {
    if (!is_stored(t.spec.role)) continue;
    visit(t.name, t, t.value);
    if (!moments || !t.learned()) continue;
    visit(kMoment1 + t.name, t, t.moment1);
    visit(kMoment2 + t.name, t, t.moment2);
  }
}

}  // namespace

std::vector<TensorRef> stored_tensors(const ParamStore<float>& store) {
  std::vector<TensorRef> out;
  each_stored(store, true, [&](const std::string& name, const Tensor<float>& t, const AlignedBuffer<float>& buffer) {
    out.push_back(tensor_ref(name, shape_of(t), std::span<const float>(buffer.data(), buffer.size())));
  });
  return out;
}

void check_storable(const ParamStore<float>& store, std::int64_t step) {
  each_stored(store, true, [&](const std::string&, const Tensor<float>& t, const AlignedBuffer<float>& buffer) {
    const std::int64_t bad = first_non_finite<float>(t.view(buffer));
    if (bad < 0) return;
    throw Error(ErrorKind::failure, "checkpoint.save.not_finite",
                fmt::format("no checkpoint of step {}: {}'{}' holds {} at row {}, column {}", step,
                            &buffer == &t.value ? "" : "a moment of ", t.name, buffer.data()[bad], bad / t.spec.cols,
                            bad % t.spec.cols),
                "resume from the last checkpoint");
  });
}

// Everything is checked before anything is changed.
void load_tensors(const TensorFile& file, ParamStore<float>& store, bool moments) {
  std::set<std::string> known;
  const auto note = [&](const std::string& name, const auto&, const auto&) { known.insert(name); };
  each_stored(store, moments, note);
  for (const TensorRef& have : file.tensors())
    if (moments && !known.contains(have.name))
      throw refused_network("checkpoint.tensor.unknown", file,
                            "'" + have.name + "' belongs to no part of this network");
  each_stored(store, moments, [&](const std::string& name, const Tensor<float>& t, const AlignedBuffer<float>&) {
    (void)matching(file, name, t);
  });
  each_stored(store, moments, [&](const std::string& name, const Tensor<float>& t, const AlignedBuffer<float>& to) {
    const TensorRef& from = matching(file, name, t);
    std::memcpy(to.data(), from.bytes.data(), from.bytes.size());
  });
}

}  // namespace semfield
