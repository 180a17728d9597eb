// Label readers and degradations of the registry with the parameters of a YAML map, and readers on small files of a
// test.
#pragma once

#include "config/config_tree.h"
#include "config/params.h"
#include "labels/label_files.h"
#include "tests/linked_registry.h"
#include "tests/scene/tiny_scene.h"

namespace semfield::testing_labels {

// Label readers and degradations of the registry, with the parameters of a YAML map.

using testkit::linked_registry;

/// Parameters of `entry` as the YAML map gives them; every error is thrown.
inline std::unique_ptr<PluginParams> params_from(const PluginEntry& entry, const std::string& yaml) {
  std::unique_ptr<PluginParams> params = entry.new_params();
  Diagnostics found;
  read_params(
      parse_config_text(yaml, "test.yaml"), entry.name, [&](ParamVisitor& visit) { params->describe(visit); }, found);
  params->validate(found);
  found.throw_if_errors(ErrorKind::config, "parameters:");
  return params;
}

inline std::unique_ptr<LabelReader> make_reader(const std::string& type, const std::string& yaml) {
  const PluginEntry& entry = linked_registry().get(PluginKind::label_reader, type);
  return entry.label_reader(*params_from(entry, yaml));
}

inline std::unique_ptr<Degradation> make_degradation(const std::string& type, const std::string& yaml = "{}") {
  const PluginEntry& entry = linked_registry().get(PluginKind::degradation, type);
  return entry.degradation(*params_from(entry, yaml));
}

// Label readers as `scene.labels.from` makes them, on small files of a test.

inline FrameInfo frame_of(const std::string& name, int width = 4, int height = 3) {
  return FrameInfo{
      .name = name, .source = "/nowhere/" + name + ".png", .camera = {.width_px = width, .height_px = height}};
}

/// wall 1, chair 4, table 7 -> indices 0, 1, 2; id 0 void.
inline ClassTable room_table() {
  return ClassTable({{0, "void", {0, 0, 0}, true},
                     {1, "wall", {10, 20, 30}, false},
                     {4, "chair", {40, 50, 60}, false},
                     {7, "table", {70, 80, 90}, false}});
}

/// Opens for a scene of these frames.
inline ClassTable open_for(LabelReader& reader, const ClassTable& known, const std::vector<FrameInfo>& frames,
                           Diagnostics& diagnostics) {
  const ClassTable table = reader.open(known, diagnostics);
  if (!diagnostics.has_errors()) reader.match(frames, diagnostics);
  return table;
}

/// Opens with `known` for a scene of this frame, expecting no finding but notes, and reads.
inline LabelRaster read_labels(LabelReader& reader, const FrameInfo& frame, const ClassTable& known) {
  Diagnostics diagnostics;
  const ClassTable table = open_for(reader, known, {frame}, diagnostics);
  for (const Diagnostic& d : diagnostics.all())
    if (d.severity != Severity::note) ADD_FAILURE() << d.text();
  EXPECT_TRUE(reader.has(frame));
  return reader.read(frame, table);
}

/// Rows of a raster as text: '.' void, else the index.
inline std::vector<std::string> rows_of(const LabelRaster& raster) {
  std::vector<std::string> rows;
  for (std::int32_t y = 0; y < raster.height_px; ++y) {
    rows.emplace_back();
    for (std::int32_t x = 0; x < raster.width_px; ++x) {
      const std::int16_t c = raster.hard.at(static_cast<std::size_t>(y * raster.width_px + x));
      rows.back() += c < 0 ? '.' : static_cast<char>('0' + c);
    }
  }
  return rows;
}

using Rows = std::vector<std::string>;

}  // namespace semfield::testing_labels
