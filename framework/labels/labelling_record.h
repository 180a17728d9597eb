// What a labelling session leaves in its run's folder for the report: its classes, its clicks and the frames to show.
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

namespace semfield {

/// labelling.json. The frames' pictures are render/labelled/FRAME_{clicks,label_vis,entropy_vis}.png.
struct LabellingRecord {
  struct Class {
    std::int32_t id = 0;
    std::string name;
    std::array<std::uint8_t, 3> color{};
    std::int64_t clicks = 0;
    double area_share = 0, confidence = 0;  ///< of the surface that the views show, and mean over it
    bool operator==(const Class&) const = default;
  };
  struct Frame {
    std::string name;
    std::int64_t clicks = 0;
    bool operator==(const Frame&) const = default;
  };
  std::int64_t step = 0, clicks = 0, clicked_frames = 0, frames = 0;
  std::vector<Class> classes;  ///< those with a name, in the order of their indices
  std::vector<Frame> shown;    ///< frames with pictures, the most clicks first
  bool operator==(const LabellingRecord&) const = default;
};

std::string labelling_record_json(const LabellingRecord& record);
/// Throws Error(data) naming `name`.
LabellingRecord parse_labelling_record(std::string_view json, const std::string& name);

}  // namespace semfield
