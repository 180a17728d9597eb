// Clicks: pixels that somebody has named, in a CSV file or a log of label events.
#include "labels/clicks.h"

#include <fmt/format.h>

#include <algorithm>
#include <optional>
#include <tuple>

#include "core/files.h"
#include "formats/image_io.h"
#include "formats/text_rows.h"
#include "labels/frame_match.h"
#include "labels/label_files.h"
#include "labels/mask_outlines.h"
#include "plugin/module.h"

namespace semfield {

namespace {

struct Click {
  std::string place, label;
  std::int64_t x = 0, y = 0;
  double radius_px = 0;
};

const char* kRemedy = "write lines 'frame,x,y,class' or 'frame,x,y,class,radius'";

Click click_of(const TextRow& row) {
  const std::vector<std::string>& f = row.fields;
  Click click{row.place, f[3], 0, 0, 0};
  if (f[0].empty()) refuse_labels("labels.clicks.format", row.place, "no frame is named", kRemedy);
  for (const auto& [name, field, into] : {std::tuple{'x', f[1], &click.x}, {'y', f[2], &click.y}})
    if (!parse_whole(field, *into))
      refuse_labels("labels.clicks.format", row.place,
                    fmt::format("{}: expected a whole number of pixels, got '{}'", name, field), kRemedy);
  if (f[3].empty()) refuse_labels("labels.clicks.format", row.place, "no class is named", kRemedy);
  if (!f[4].empty() && (!parse_real(f[4], click.radius_px) || click.radius_px < 0 || click.radius_px > kMaxCoordinate))
    refuse_labels("labels.clicks.format", row.place, "radius: expected pixels from 0 to a million, got '" + f[4] + "'",
                  kRemedy);
  return click;
}

// Size of the image that was clicked on, as viewers show it: that of its file, or the frame's where there is none.
ImageSize clicked_size(const FrameInfo& frame) {
  if (is_file(frame.source)) {
    try {
      ImageSize size = image_size(frame.source);
      if (turned_by_quarter(frame.orientation)) std::swap(size.width_px, size.height_px);
      return size;
    } catch (const Error&) {  // a packed scene, for one
    }
  }
  return {frame.camera.width_px, frame.camera.height_px, 0, 0};
}

// By its extension, or by its first character: a CSV file begins with the name of a frame.
bool holds_events(const std::string& path) {
  if (fs::path(path).extension() == ".jsonl") return true;
  const std::string start = read_file_start(path, 4096);
  const std::size_t first = start.find_first_not_of(" \t\r\n");
  return first != std::string::npos && start[first] == '{';
}

// Label events whose frames are known by what the events say of them.
class EventFrames {
 public:
  EventFrames(std::string file, const ClassTable& known, Diagnostics& diagnostics)
      : file_(std::move(file)), events_(read_click_log(file_, diagnostics)) {
    scene_.classes = known;
    for (const LabelEvent& event : events_) {
      if (event.frame.empty() || !frame_of_.emplace(event.frame, static_cast<int>(scene_.frames.size())).second)
        continue;
      FrameInfo& frame = scene_.frames.emplace_back();
      frame.name = event.frame;
      frame.camera.width_px = event.width_px;
      frame.camera.height_px = event.height_px;
    }
    const Annotations sum = replay(scene_, 0, events_, file_);
    table_ = sum.named_table();
    const std::vector<int> clicked = sum.frames_with_marks();
    std::erase_if(frame_of_,
                  [&](const auto& entry) { return !std::binary_search(clicked.begin(), clicked.end(), entry.second); });
  }

  const ClassTable& table() const { return table_; }
  /// Events name frames as the run did that they are of.
  void match(const std::vector<FrameInfo>& frames, Diagnostics& diagnostics) const {
    std::vector<std::string> strays;
    for (const auto& [name, index] : frame_of_)
      if (std::ranges::find(frames, name, &FrameInfo::name) == frames.end()) strays.push_back("'" + name + "'");
    if (!strays.empty())
      diagnostics.warning("labels.frame.unmatched", file_,
                          fmt::format("{} of {} frames with clicks are not in the scene, such as {}", strays.size(),
                                      frame_of_.size(), strays.front()),
                          "give the log of a run of this scene");
  }
  bool empty() const { return frame_of_.empty(); }
  bool has(const FrameInfo& frame) const { return frame_of_.contains(frame.name); }

  // The page shows images as they are stored.
  LabelRaster read(const FrameInfo& shown, const ClassTable& classes) const {
    const auto found = frame_of_.find(shown.name);
    if (found == frame_of_.end())
      refuse_labels("labels.frame.unlabelled", file_, "no click in frame '" + shown.name + "'");
    const FrameInfo frame = as_shown(shown);
    SceneInfo scene = scene_;
    Camera& camera = scene.frames[static_cast<std::size_t>(found->second)].camera;
    camera.width_px = frame.camera.width_px;
    camera.height_px = frame.camera.height_px;
    const Annotations sum = replay(scene, 0, events_, file_);
    LabelRaster raster{camera.width_px, camera.height_px, sum.paint(found->second, {}), {}, true};
    for (std::int16_t& label : raster.hard)
      if (label != kVoid) label = static_cast<std::int16_t>(classes.index_of(sum.classes().valid(label).id));
    return raster;
  }

 private:
  std::string file_;
  std::vector<LabelEvent> events_;
  SceneInfo scene_;
  std::map<std::string, int> frame_of_;  // those with clicks
  ClassTable table_;
};

class ClickReader : public LabelReader {
 public:
  void describe(ParamVisitor& visit) override {
    SEMFIELD_PARAM(visit, *this, file,
                   "CSV file of lines frame,x,y,class[,radius]: column and row of a pixel of the image file as viewers "
                   "show it, and the radius of a disc in pixels; or a log of the labelling page, clicks.jsonl");
  }

  ClassTable open(const ClassTable& known, Diagnostics& diagnostics) override {
    clicks_.clear();
    pictures_.clear();
    clicks_of_frame_.clear();
    events_.reset();
    if (holds_events(file)) {
      events_.emplace(file, known, diagnostics);
      if (events_->empty())
        diagnostics.error("labels.clicks.empty", file, "no clicks in it", "label the scene with `semfield serve`");
      return events_->table();
    }
    const TextTable table = read_text_table(file, {{"frame", "image", "file", "file_name", "filename", "picture"},
                                                   {"x", "column", "col", "u"},
                                                   {"y", "row", "v"},
                                                   {"class", "label", "name", "class_name", "category"},
                                                   {"radius", "r"}});
    if (!table.header.empty() && std::find(table.has.begin(), table.has.begin() + 4, 0) != table.has.begin() + 4)
      refuse_labels("labels.clicks.format", table.header, "expected columns frame, x, y and class", kRemedy);
    ProblemList problems(diagnostics);
    std::map<std::string, std::string> place_of_name;
    for (const TextRow& row : table.rows) {
      problems.collect([&] {
        Click click = click_of(row);
        place_of_name.emplace(click.label, click.place);
        const auto [at, fresh] = clicks_.try_emplace(row.fields[0]);
        if (fresh) pictures_.push_back({.path = row.fields[0], .place = row.place});
        at->second.push_back(std::move(click));
      });
    }
    if (clicks_.empty() && problems.count() == 0)
      problems.error("labels.clicks.empty", file, "no clicks in it", kRemedy);
    return table_for(place_of_name, known, problems);
  }

  void match(const std::vector<FrameInfo>& frames, Diagnostics& diagnostics) override {
    if (events_) return events_->match(frames, diagnostics);
    for (const auto& [frame, picture] : match_frames(pictures_, frames, file, diagnostics))
      clicks_of_frame_[frame] = pictures_[picture].path;
  }

  bool adds_classes() const override { return events_.has_value(); }

  bool has(const FrameInfo& frame) const override {
    return events_ ? events_->has(frame) : clicks_of_frame_.contains(frame.name);
  }

  LabelRaster read(const FrameInfo& frame, const ClassTable& classes) const override {
    if (events_) return events_->read(frame, classes);
    const auto found = clicks_of_frame_.find(frame.name);
    if (found == clicks_of_frame_.end())
      refuse_labels("labels.frame.unlabelled", file, "no click in frame '" + frame.name + "'");
    // At the frame's own size: scaled as an image by the nearest pixel, a single pixel could get lost.
    LabelRaster raster = void_raster(frame.camera.width_px, frame.camera.height_px);
    const ImageSize size = clicked_size(frame);
    const double scale_x = static_cast<double>(raster.width_px) / size.width_px,
                 scale_y = static_cast<double>(raster.height_px) / size.height_px;
    const ClassNames names(classes);
    for (const Click& click : clicks_.at(found->second)) {
      if (click.x < 0 || click.y < 0 || click.x >= size.width_px || click.y >= size.height_px)
        refuse_labels("labels.shape.outside", click.place,
                      fmt::format("pixel ({}, {}) lies outside the image of {} x {}", click.x, click.y, size.width_px,
                                  size.height_px),
                      "columns and rows are counted from 0");
      const std::int16_t index = names.index_of(click.label, click.place);
      const PixelPoint center{(static_cast<double>(click.x) + 0.5) * scale_x,
                              (static_cast<double>(click.y) + 0.5) * scale_y};
      paint(disc_runs(center, click.radius_px * scale_x, raster.width_px, raster.height_px), index, raster);
      const auto x = static_cast<std::int32_t>(center.x), y = static_cast<std::int32_t>(center.y);
      paint({{y, x, x + 1}}, index, raster);
    }
    return raster;
  }

  std::string file;

 private:
  std::map<std::string, std::vector<Click>> clicks_;  // by what the file calls the frame
  std::vector<PictureName> pictures_;                 // the same names, in order
  std::map<std::string, std::string> clicks_of_frame_;
  std::optional<EventFrames> events_;  // of a log
};

}  // namespace

SEMFIELD_PLUGIN_MODULE(clicks, "1.0", [](Registry& registry) {
  registry.add_label_reader<ClickReader>(
      "clicks",
      "single pixels or discs from a CSV file, or clicks and strokes of the labelling page; all else is void");
})

}  // namespace semfield
