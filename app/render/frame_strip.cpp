#include "app/render/frame_strip.h"

#include <algorithm>

#include "eval/image_output.h"

namespace semfield::app {

namespace {

std::vector<std::uint8_t> overlay(const RenderedFrame& frame, const ClassTable& classes) {
  std::vector<std::uint8_t> out = to_bytes(frame.rgb);
  const std::vector<std::uint8_t> colors = label_colors(frame.label, classes);
  for (std::size_t i = 0; i < out.size(); ++i) {
    if (frame.label[i / 3] != kVoid) out[i] = static_cast<std::uint8_t>((out[i] + colors[i] + 1) / 2);
  }
  return out;
}

std::vector<std::uint8_t> panel_of(const RenderedFrame& frame, Panel panel, const Session& s) {
  switch (panel) {
    case Panel::rgb:
      return to_bytes(frame.rgb);
    case Panel::label:
      return overlay(frame, s.scene.info.classes);
    case Panel::depth:
      return depth_colors(frame.depth_m, s.limits.near_m, s.limits.far_m);
    default:
      return entropy_colors(frame.entropy, static_cast<int>(s.plan.class_of_logit.size()));
  }
}

}  // namespace

const std::vector<std::string>& panel_names() {
  static const std::vector<std::string> names{"rgb", "label", "depth", "entropy"};
  return names;
}

std::vector<Panel> panels_of(const std::vector<std::string>& names, bool semantics) {
  if (names.empty()) {
    if (!semantics) return {Panel::rgb, Panel::depth};
    return {Panel::rgb, Panel::label, Panel::depth, Panel::entropy};
  }
  std::vector<Panel> panels;
  for (const std::string& name : names) {
    const auto found = std::find(panel_names().begin(), panel_names().end(), name);
    panels.push_back(static_cast<Panel>(found - panel_names().begin()));
    if (!semantics && (panels.back() == Panel::label || panels.back() == Panel::entropy)) {
      throw Error(ErrorKind::usage, "run.semantics.none",
                  "--panels: this run has no semantics, so no panel '" + name + "'", "choose from rgb, depth");
    }
  }
  return panels;
}

std::vector<std::uint8_t> frame_strip(const RenderedFrame& frame, const std::vector<Panel>& panels, const Session& s) {
  const std::size_t row = 3 * static_cast<std::size_t>(frame.width_px);
  const auto height = static_cast<std::size_t>(frame.height_px);
  std::vector<std::uint8_t> strip(row * height * panels.size());
  for (std::size_t p = 0; p < panels.size(); ++p) {
    const std::vector<std::uint8_t> panel = panel_of(frame, panels[p], s);
    for (std::size_t y = 0; y < height; ++y) {
      std::copy_n(panel.begin() + static_cast<std::ptrdiff_t>(y * row), row,
                  strip.begin() + static_cast<std::ptrdiff_t>((y * panels.size() + p) * row));
    }
  }
  return strip;
}

}  // namespace semfield::app
