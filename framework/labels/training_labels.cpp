#include "labels/training_labels.h"

#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <exception>
#include <nlohmann/json.hpp>

#include "compute/parallel.h"
#include "core/check.h"
#include "core/checksum.h"
#include "core/files.h"
#include "core/text.h"
#include "formats/image_io.h"
#include "formats/text_rows.h"
#include "scene/loading/frame_files.h"
#include "scene/scene.h"

namespace semfield {

namespace {

// The raster at the loaded frame's size, as its pixels are stored: each target pixel takes the source pixel that holds
// its centre in the picture as shown.
FrameLabels scaled(const LabelRaster& raster, const FrameInfo& frame, int classes) {
  const auto source_w = std::int64_t{raster.width_px}, source_h = std::int64_t{raster.height_px};
  const std::int64_t w = frame.camera.width_px, h = frame.camera.height_px;
  const int orientation = raster.as_stored ? 1 : frame.orientation;
  const Camera shown = raster.as_stored ? frame.camera : as_shown(frame).camera;
  check_label_shape(source_w, source_h, shown);
  FrameLabels out;
  const auto pixels = static_cast<std::size_t>(w * h);
  const auto width = static_cast<std::size_t>(classes);
  if (raster.soft.empty()) {
    out.hard.resize(pixels);
  } else {
    out.soft = SoftMap(pixels, classes);
  }
  for (std::int64_t y = 0; y < h; ++y) {
    for (std::int64_t x = 0; x < w; ++x) {
      const ShownPlace at = shown_place(x, y, w, h, orientation);
      const std::int64_t sx = (2 * at.x + 1) * source_w / (2 * shown.width_px),
                         sy = (2 * at.y + 1) * source_h / (2 * shown.height_px);
      const auto from = static_cast<std::size_t>(sy * source_w + sx);
      const auto to = static_cast<std::size_t>(y * w + x);
      if (raster.soft.empty()) {
        out.hard[to] = raster.hard.at(from);
      } else {
        out.soft.set_row(to, std::span(raster.soft).subspan(from * width, width));
      }
    }
  }
  return out;
}

bool labelled_by(const LoadedScene& scene, const LabelConfig& config, std::size_t frame) {
  const FrameInfo& info = scene.info.frames[frame];
  return config.from.reader ? config.from.reader->has(info) : info.has_labels;
}

// A masked pixel has no label, whoever gave it one.
void hide_masked_labels(const LoadedScene& scene, LabelSet& labels) {
  parallel_for(std::ssize(labels), [&](std::int64_t index) {
    const auto f = static_cast<std::size_t>(index);
    const PixelMask& mask = scene.frames[f].mask;
    FrameLabels& own = labels[f];
    if (mask.empty() || own.empty()) return;
    const std::vector<float> none(static_cast<std::size_t>(own.soft.classes()));
    const std::size_t pixels = own.soft.empty() ? own.hard.size() : own.soft.pixels();
    for (std::size_t p = 0; p < pixels; ++p) {
      if (mask.uses(p)) continue;
      if (own.soft.empty()) {
        own.hard[p] = kVoid;
      } else {
        own.soft.set_row(p, none);
      }
    }
  });
}

// Labels of the frames that `wanted` says, read in parallel; every error goes into `diagnostics`.
LabelSet read_frames(const LoadedScene& scene, const LabelConfig& config, const std::vector<char>& wanted,
                     Diagnostics& diagnostics) {
  LabelSet labels(scene.frames.size());
  std::vector<std::optional<Error>> errors(scene.frames.size());
  std::vector<std::optional<UnknownLabelError>> unknown(scene.frames.size());
  const int classes = scene.info.classes.valid_count();
  parallel_for(std::ssize(labels), [&](std::int64_t index) {
    const auto i = static_cast<std::size_t>(index);
    if (wanted[i] == 0) return;
    try {
      if (config.from.reader) {
        const FrameInfo& frame = scene.info.frames[i];
        labels[i] = scaled(config.from.reader->read(as_shown(frame), scene.info.classes), frame, classes);
      } else {
        labels[i].hard = scene.frames[i].label.expand();
      }
    } catch (const UnknownLabelError& e) {
      unknown[i] = e;
    } catch (const Error& e) {
      errors[i] = e;
    }
  });
  hide_masked_labels(scene, labels);
  report_unknown_labels(scene.info.frames, unknown, diagnostics);
  for (std::size_t i = 0; i < errors.size(); ++i) {
    if (!errors[i]) continue;
    const FrameInfo& frame = scene.info.frames[i];
    const bool turned = errors[i]->code() == Code("labels.image.size") && turned_by_quarter(frame.orientation);
    diagnostics.error(
        errors[i]->code(), frame_place(frame),
        errors[i]->message() +
            (turned ? " (as shown, by its EXIF orientation " + std::to_string(frame.orientation) + ")" : ""),
        turned ? kShownRemedy : errors[i]->remedy());
  }
  return labels;
}

// As in LoadedScene. Soft labels count for their most probable class; a class that is nowhere the most probable but has
// probability somewhere counts 1, so that it keeps its logit.
template <class Labels>
std::vector<std::int64_t> count_classes(const Labels& frame, int classes) {
  const auto valid = static_cast<std::size_t>(classes);
  std::vector<std::int64_t> counts(valid + 1);
  std::vector<float> row(valid);
  std::vector<char> seen(valid);
  const std::size_t size = frame.soft.empty() ? frame.hard.size() : frame.soft.pixels();
  for (std::size_t i = 0; i < size; ++i) {
    const std::int16_t c = frame.soft.empty() ? frame.hard[i] : frame.soft.argmax(i);
    ++counts[c < 0 ? valid : static_cast<std::size_t>(c)];
    if (frame.soft.empty()) continue;
    frame.soft.row(i, row);
    for (std::size_t k = 0; k < valid; ++k) seen[k] |= row[k] > 0 ? 1 : 0;
  }
  for (std::size_t k = 0; k < valid; ++k) {
    if (seen[k] != 0 && counts[k] == 0) counts[k] = 1;
  }
  return counts;
}

// Of a table that has only classes behind those of the scene's own.
void take_table(LoadedScene& scene, const ClassTable& table) {
  const auto added = static_cast<std::size_t>(std::max(0, table.valid_count() - scene.info.classes.valid_count()));
  for (std::vector<std::int64_t>& counts : scene.class_pixels) {
    if (!counts.empty()) counts.insert(counts.end() - 1, added, 0);  // the last one counts void
  }
  scene.info.classes = table;
}

}  // namespace

std::string LabelConfig::click_file() const {
  return selection.clicks.empty() ? "" : (fs::path(run_dir) / selection.clicks).string();
}

bool LabelConfig::needs_instances() const {
  return std::any_of(degrade.begin(), degrade.end(), [](const Step& s) { return s.degradation->needs_instances(); });
}

bool LabelConfig::wants_depth() const {
  return std::any_of(degrade.begin(), degrade.end(), [](const Step& s) { return s.degradation->wants_depth(); });
}

namespace {

void open_reader(LoadedScene& scene, const LabelConfig& config, Diagnostics& diagnostics) {
  Diagnostics found;
  const ClassTable table = config.from.reader->open(scene.info.classes, found);
  if (!found.has_errors()) config.from.reader->match(scene.info.frames, found);
  for (const Diagnostic& d : found.all()) {
    const std::string where = "scene.labels.from" + (d.where.empty() ? "" : ": " + d.where);
    diagnostics.add({d.severity, d.code, where, d.message, d.remedy});
  }
  const auto trains = [&](const FrameInfo& frame) {
    return frame.split == Split::train && config.from.reader->has(frame);
  };
  const std::vector<FrameInfo>& frames = scene.info.frames;
  if (!diagnostics.has_errors() && !frames.empty() && std::none_of(frames.begin(), frames.end(), trains)) {
    diagnostics.error("labels.training.none", "scene.labels.from", "no training frame has labels",
                      "name label files as frames are named, such as '" + frames.front().name +
                          "', or set the reader's pattern to what the files add to it");
  }
  if (scene.info.classes.empty() || config.from.reader->adds_classes()) take_table(scene, table);
  if (scene.info.classes.empty() && !diagnostics.has_errors()) {
    diagnostics.error("labels.classes.none", "scene.labels.from",
                      "neither the scene nor its label files have a class table",
                      "write classes.yaml next to the scene, or name a table in scene.labels.from");
  }
}

Annotations read_clicks(const SceneInfo& scene, const LabelConfig& config, Diagnostics& diagnostics) {
  const std::string file = config.click_file();
  const int room = config.selection.class_room;
  Diagnostics found;
  std::vector<LabelEvent> events;
  try {
    if (!file.empty() && (room == 0 || is_there(file))) events = read_click_log(file, found);
    for (const Diagnostic& d : found.all())
      diagnostics.warning(d.code, "scene.labels.clicks: " + d.where, d.message, d.remedy);
    return replay(scene, room, events, file);
  } catch (const Error& e) {
    throw Error(e.kind(), e.code(), "scene.labels.clicks: " + e.message(), e.remedy());
  }
}

}  // namespace

void open_label_files(LoadedScene& scene, LabelConfig& config, Diagnostics& diagnostics) {
  if (config.from.reader) open_reader(scene, config, diagnostics);
  if (diagnostics.has_errors() || (config.selection.clicks.empty() && config.selection.class_room == 0)) return;
  config.clicks = read_clicks(scene.info, config, diagnostics);
  take_table(scene, config.clicks->classes());
}

void read_test_labels(LoadedScene& scene, const LabelConfig& config, Diagnostics& diagnostics) {
  if (!config.from.reader) return;
  std::vector<char> wanted(scene.frames.size());
  for (std::size_t i = 0; i < wanted.size(); ++i) {
    const FrameInfo& info = scene.info.frames[i];
    wanted[i] = info.split == Split::test && !info.has_labels && config.from.reader->has(info) ? 1 : 0;
  }
  LabelSet labels = read_frames(scene, config, wanted, diagnostics);
  for (std::size_t i = 0; i < wanted.size(); ++i) {
    if (wanted[i] == 0 || labels[i].empty()) continue;
    if (labels[i].hard.empty()) {
      for (std::size_t p = 0; p < labels[i].soft.pixels(); ++p) labels[i].hard.push_back(labels[i].soft.argmax(p));
    }
    scene.class_pixels[i] = count_classes(labels[i], scene.info.classes.valid_count());
    scene.frames[i].label = LabelMap(std::move(labels[i].hard));
    scene.info.frames[i].has_labels = true;
  }
}

TrainingLabels make_training_labels(const LoadedScene& scene, const LabelConfig& config, Diagnostics& diagnostics) {
  SceneInfo listed = scene.info;  // has_labels as the source of the labels tells, for the selection and its messages
  for (std::size_t i = 0; i < listed.frames.size(); ++i) {
    FrameInfo& frame = listed.frames[i];
    if (frame.split == Split::train) frame.has_labels = labelled_by(scene, config, i);
  }
  std::vector<char> wanted(scene.frames.size());
  LabelSet labels;
  if (config.selection.mode == LabelMode::coverage) {
    // The choice depends on what the labels show, so all are read.
    for (std::size_t i = 0; i < wanted.size(); ++i)
      wanted[i] = listed.frames[i].split == Split::train && listed.frames[i].has_labels ? 1 : 0;
    labels = read_frames(scene, config, wanted, diagnostics);
    std::vector<std::vector<std::int64_t>> pixels(labels.size());
    for (std::size_t i = 0; i < labels.size(); ++i) {
      if (!labels[i].empty()) pixels[i] = count_classes(labels[i], scene.info.classes.valid_count());
    }
    const std::vector<int> chosen = select_label_frames(listed, config.selection, pixels);
    for (std::size_t i = 0; i < labels.size(); ++i) {
      if (!std::binary_search(chosen.begin(), chosen.end(), static_cast<int>(i))) labels[i] = {};
    }
  } else {
    for (const int f : select_label_frames(listed, config.selection)) wanted[static_cast<std::size_t>(f)] = 1;
    labels = read_frames(scene, config, wanted, diagnostics);
  }
  diagnostics.throw_if_errors(ErrorKind::data, "the labels have problems:");

  TrainingLabels out;
  for (const LabelConfig::Step& step : config.degrade) {
    // A type that is named again draws anew: its second turn would otherwise choose the pixels of its first. Seeds of
    // the configuration are below 2^53.
    const auto turn =
        std::count_if(out.steps.begin(), out.steps.end(), [&](const auto& s) { return s.type == step.type; });
    const auto seed = static_cast<std::uint64_t>(config.selection.seed) + (static_cast<std::uint64_t>(turn) << 53);
    try {
      out.steps.push_back({step.type, step.degradation->apply(scene, seed, labels)});
    } catch (Error& e) {
      throw e.while_doing("scene.labels.degrade: " + step.type);
    }
  }
  hide_masked_labels(scene, labels);  // a degradation may have spread labels there
  out.frames.resize(labels.size());
  out.class_pixels.resize(labels.size());
  const int classes = scene.info.classes.valid_count();
  parallel_for(std::ssize(labels), [&](std::int64_t index) {
    const auto i = static_cast<std::size_t>(index);
    if (labels[i].empty()) return;
    out.class_pixels[i] = count_classes(labels[i], classes);
    if (labels[i].soft.empty()) {
      out.frames[i].hard = LabelMap(std::move(labels[i].hard));
    } else {
      out.frames[i].soft = std::move(labels[i].soft);
    }
    labels[i] = {};
  });
  if (config.clicks) {
    out.unclicked = out.frames;
    const std::vector<int> clicked = config.clicks->frames_with_marks();
    parallel_for(std::ssize(clicked),
                 [&](std::int64_t i) { paint_clicks(*config.clicks, clicked[static_cast<std::size_t>(i)], out); });
  }
  const auto has_class = [](const std::vector<std::int64_t>& pixels) {
    return !pixels.empty() && std::any_of(pixels.begin(), pixels.end() - 1, [](std::int64_t n) { return n > 0; });
  };
  const auto labelled = std::count_if(out.class_pixels.begin(), out.class_pixels.end(),
                                      [](const auto& pixels) { return !pixels.empty(); });
  if (labelled > 0 && config.selection.class_room == 0 &&
      std::none_of(out.class_pixels.begin(), out.class_pixels.end(), has_class)) {
    diagnostics.error("labels.training.void", scene.info.name,
                      "the labels of all " + std::to_string(labelled) +
                          " labelled training frames are void in every pixel: nothing can be learned from them",
                      "export label images that hold class ids, or train without them: --set scene.labels.frames=none");
  }
  out.soft = std::any_of(out.frames.begin(), out.frames.end(), [](const auto& f) { return !f.soft.empty(); });
  return out;
}

void paint_clicks(const Annotations& clicks, int frame, TrainingLabels& labels) {
  const auto f = static_cast<std::size_t>(frame);
  const TrainingLabels::Frame& base = labels.unclicked.at(f);
  TrainingLabels::Frame& out = labels.frames[f];
  const bool clicked = std::any_of(clicks.marks().begin(), clicks.marks().end(),
                                   [frame](const Annotations::Mark& mark) { return mark.frame == frame; });
  if (!clicked) {
    out = base;
  } else if (base.soft.empty()) {
    out = {LabelMap(clicks.paint(frame, base.hard.expand())), {}};
  } else {
    constexpr std::int16_t kNotPainted = -2;
    out = base;
    const auto classes = static_cast<std::size_t>(clicks.classes().valid_count());
    const std::vector<std::int16_t> painted =
        clicks.paint(frame, std::vector<std::int16_t>(base.soft.pixels(), kNotPainted));
    std::vector<float> row(classes);
    for (std::size_t p = 0; p < painted.size(); ++p) {
      if (painted[p] == kNotPainted) continue;
      std::fill(row.begin(), row.end(), 0.0F);
      if (painted[p] >= 0) row[static_cast<std::size_t>(painted[p])] = 1;
      out.soft.set_row(p, row);
    }
  }
  labels.class_pixels[f].clear();
  if (!out.empty()) labels.class_pixels[f] = count_classes(out, clicks.classes().valid_count());
}

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

namespace {

fs::path place_of(const fs::path& path) {
  std::error_code unknown;
  const fs::path place = fs::weakly_canonical(fs::absolute(path), unknown);
  return unknown ? fs::absolute(path).lexically_normal() : place;
}

std::string events_text(std::int64_t events) { return fmt::format("{} event{}", events, events == 1 ? "" : "s"); }

}  // namespace

void settle_click_file(LabelConfig& labels, const std::string& run_dir) {
  const std::string file = labels.click_file();
  labels.run_dir = fs::absolute(run_dir).lexically_normal().string();
  if (file.empty()) return;
  labels.selection.clicks = place_of(file) == place_of(fs::path(run_dir) / kClickFile) ? kClickFile : file;
}

void require_clicks(const ClicksTrained& trained, const LabelConfig& labels, const std::string& run_dir,
                    Diagnostics& diagnostics) {
  const std::string file = labels.click_file(), other = "--set scene.labels.clicks=FILE";
  const bool room = labels.selection.class_room > 0;
  // A checkpoint of an earlier version does not say what it knew; its run has had the file from the start.
  const bool unknown = trained.any_checkpoint && !trained.known;
  if (!file.empty() && !is_there(file) && (unknown || !room)) {
    throw Error(ErrorKind::no_input, "labels.clicks.missing",
                fmt::format("'{}' is not there, where scene.labels.clicks of the run '{}' points", file, run_dir),
                fmt::format("put the file back, or say where it is: {}{}", other,
                            unknown ? "; where nobody ever clicked, make an empty one" : ""));
  }
  if (!trained.known || trained.known->events == 0) return;
  Diagnostics ignored;  // told when the labels are read
  EventsKnown now;
  bool begins = false;
  for (const LabelEvent& event : is_there(file) ? read_click_log(file, ignored) : std::vector<LabelEvent>()) {
    now.add(event);
    begins = begins || now == *trained.known;
  }
  if (now.events == 0) {
    throw Error(
        ErrorKind::no_input, "labels.clicks.missing",
        fmt::format("the run '{}' has learned from {} of clicks, and {}", run_dir, events_text(trained.known->events),
                    file.empty() ? "scene.labels.clicks names no file"
                                 : fmt::format("'{}' {}", file, is_there(file) ? "is empty" : "is not there")),
        fmt::format("put the file back, or say where it is: {}", other));
  }
  if (begins) return;
  diagnostics.warning("labels.clicks.changed", "scene.labels.clicks",
                      fmt::format("'{}' does not begin with the {} that the run has learned from: other clicks", file,
                                  events_text(trained.known->events)),
                      fmt::format("put the run's own file back, or say where it is: {}", other));
}

ClickLog open_click_log(const LabelConfig& labels, const std::string& run_dir, Diagnostics& diagnostics) {
  const std::string own = (fs::path(run_dir) / kClickFile).string();
  const std::string file = labels.selection.clicks.empty() ? own : labels.click_file();
  const fs::path folder = place_of(file).parent_path();
  if (folder != place_of(run_dir) && is_there(folder / "run.yaml")) {
    throw Error(ErrorKind::cannot_create, "labels.clicks.foreign",
                fmt::format("the clicks in '{}' are those of another run, so none are added to them", file),
                fmt::format("continue that run, or a copy of its folder; or name a file of this run's own: "
                            "--set scene.labels.clicks={}",
                            shell_word(own)));
  }
  ClickLog log = ClickLog::open(file, diagnostics);
  EventsKnown known;
  for (const LabelEvent& event : log.events()) known.add(event);
  if (labels.clicks && known != labels.clicks->known())
    throw Error(ErrorKind::cannot_create, "labels.clicks.changed",
                fmt::format("'{}' has changed while the scene was opened", file), "start the program again");
  return log;
}

// Frames and classes that degradations work on.

std::vector<std::size_t> hard_frames(const LoadedScene& scene, const LabelSet& labels, std::string_view type) {
  SEMFIELD_CHECK(labels.size() == scene.frames.size(), "one entry of labels per frame");
  std::vector<std::size_t> out;
  for (std::size_t f = 0; f < labels.size(); ++f) {
    if (labels[f].empty()) continue;
    if (!labels[f].soft.empty()) {
      throw Error(ErrorKind::data, "labels.degradation.soft",
                  std::string(type) + ": " + frame_place(scene.info.frames[f]) +
                      " has class probabilities, and this degradation works on hard labels",
                  "name it before the step that makes the labels soft, or read hard labels");
    }
    const StoredFrame& frame = scene.frames[f];
    SEMFIELD_CHECK(
        labels[f].hard.size() == static_cast<std::size_t>(frame.width_px) * static_cast<std::size_t>(frame.height_px),
        "labels have the size of their frame");
    out.push_back(f);
  }
  return out;
}

std::vector<std::int16_t> scene_classes(const LoadedScene& scene, std::string_view type) {
  const auto classes = static_cast<std::size_t>(scene.info.classes.valid_count());
  if (classes == 0) {
    throw Error(ErrorKind::data, "labels.classes.too_few",
                std::string(type) + ": the class table of the scene has no class to draw from",
                "give the scene a classes.yaml with a class that is not ignored");
  }
  std::vector<char> seen(classes, 0);
  for (const std::vector<std::int64_t>& counts : scene.class_pixels) {
    for (std::size_t c = 0; c < std::min(classes, counts.size()); ++c) {
      if (counts[c] > 0) seen[c] = 1;
    }
  }
  const bool any = std::find(seen.begin(), seen.end(), 1) != seen.end();
  std::vector<std::int16_t> out;
  for (std::size_t c = 0; c < classes; ++c) {
    if (!any || seen[c] != 0) out.push_back(static_cast<std::int16_t>(c));
  }
  return out;
}

StepFacts change_hard_labels(const LoadedScene& scene, std::string_view type, LabelSet& labels,
                             const std::function<void(std::size_t frame, std::vector<std::int16_t>& hard)>& change) {
  struct Counts {
    std::int64_t before = 0, after = 0, changed = 0;
  };
  const std::vector<std::size_t> frames = hard_frames(scene, labels, type);
  std::vector<Counts> counts(frames.size());
  parallel_for(static_cast<std::int64_t>(frames.size()), [&](std::int64_t i) {
    const std::size_t f = frames[static_cast<std::size_t>(i)];
    std::vector<std::int16_t>& hard = labels[f].hard;
    const std::vector<std::int16_t> old = hard;
    change(f, hard);
    Counts& n = counts[static_cast<std::size_t>(i)];
    for (std::size_t p = 0; p < hard.size(); ++p) {
      n.before += old[p] != kVoid ? 1 : 0;
      n.after += hard[p] != kVoid ? 1 : 0;
      n.changed += old[p] != hard[p] ? 1 : 0;
    }
  });
  Counts sum;
  for (const Counts& n : counts) {
    sum.before += n.before;
    sum.after += n.after;
    sum.changed += n.changed;
  }
  return {{"frames", std::to_string(frames.size())},
          {"labelled pixels before", std::to_string(sum.before)},
          {"labelled pixels after", std::to_string(sum.after)},
          {"pixels changed", std::to_string(sum.changed)}};
}

std::int64_t rounded_share(double share, std::int64_t count) {
  // The small number lets a decimal share count as it is written: 0.35 * 10 is a half, though the double is below it.
  return static_cast<std::int64_t>(std::floor(share * static_cast<double>(count) + 0.5 + 1e-9));
}

}  // namespace semfield
