// Clicks: a CSV file of pixels that somebody has named.
#include <algorithm>
#include <filesystem>

#include "formats/image_io.h"
#include "formats/text_rows.h"
#include "labels/label_files.h"
#include "labels/outline_fill.h"
#include "labels/readers/label_readers.h"

namespace semfield {

namespace {

struct Click {
  std::string place, label;
  std::int64_t x = 0, y = 0;
  double radius_px = 0;
};

[[noreturn]] void refuse(const std::string& place, const std::string& message, const std::string& remedy = {}) {
  throw Error(ErrorKind::data, place + ": " + message, remedy);
}

const char* kRemedy = "write lines 'frame,x,y,class' or 'frame,x,y,class,radius'";

Click click_of(const TextRow& row) {
  const std::vector<std::string>& f = row.fields;
  if (f.size() != 4 && f.size() != 5)
    refuse(row.place, "expected 4 or 5 columns, got " + std::to_string(f.size()), kRemedy);
  Click click{row.place, f[3], 0, 0, 0};
  if (f[0].empty()) refuse(row.place, "no frame is named", kRemedy);
  if (!parse_whole(f[1], click.x))
    refuse(row.place, "x: expected a whole number of pixels, got '" + f[1] + "'", kRemedy);
  if (!parse_whole(f[2], click.y))
    refuse(row.place, "y: expected a whole number of pixels, got '" + f[2] + "'", kRemedy);
  if (f[3].empty()) refuse(row.place, "no class is named", kRemedy);
  if (f.size() == 5 && !f[4].empty() &&
      (!parse_real(f[4], click.radius_px) || click.radius_px < 0 || click.radius_px > kMaxCoordinate))
    refuse(row.place, "radius: expected pixels from 0 to a million, got '" + f[4] + "'", kRemedy);
  return click;
}

// Size of the image that was clicked on: the stored one, or the frame's where the source is no image file.
ImageSize clicked_size(const FrameInfo& frame) {
  std::error_code ignored;
  if (std::filesystem::is_regular_file(frame.source, ignored)) {
    try {
      return image_size(frame.source);
    } catch (const Error&) {  // a packed scene, for one
    }
  }
  return {frame.camera.width_px, frame.camera.height_px, 0, 0};
}

class ClickReader : public LabelReader {
 public:
  void describe(ParamVisitor& visit) override {
    SEMFIELD_PARAM(visit, *this, file,
                   "CSV file of lines frame,x,y,class[,radius]: column and row of a pixel of the stored image, and the "
                   "radius of a disc in pixels");
  }

  ClassTable open(const ClassTable& known, Diagnostics& diagnostics) override {
    clicks_.clear();
    const std::vector<TextRow> rows = read_text_rows(file, ',');
    ProblemList problems(diagnostics);
    std::map<std::string, std::string> place_of_name;
    for (std::size_t r = 0; r < rows.size(); ++r) {
      const std::vector<std::string>& f = rows[r].fields;
      if (r == 0 && f.size() >= 4 && f[0] == "frame" && f[1] == "x") continue;  // the header
      problems.collect([&] {
        Click click = click_of(rows[r]);
        place_of_name.emplace(click.label, click.place);
        clicks_[f[0]].push_back(std::move(click));
      });
    }
    if (clicks_.empty() && problems.count() == 0) problems.error(file, "no clicks in it", kRemedy);
    return table_for(place_of_name, known, problems);
  }

  bool has(const FrameInfo& frame) const override { return entry_of(clicks_, frame) != nullptr; }

  LabelRaster read(const FrameInfo& frame, const ClassTable& classes) const override {
    const std::vector<Click>* clicks = entry_of(clicks_, frame);
    if (clicks == nullptr) refuse(file, "no click in frame '" + frame.name + "'");
    // At the frame's own size: scaled as an image by the nearest pixel, a single pixel could get lost.
    LabelRaster raster = void_raster(frame.camera.width_px, frame.camera.height_px);
    const ImageSize size = clicked_size(frame);
    const double scale_x = static_cast<double>(raster.width_px) / size.width_px,
                 scale_y = static_cast<double>(raster.height_px) / size.height_px;
    const ClassNames names(classes);
    for (const Click& click : *clicks) {
      if (click.x < 0 || click.y < 0 || click.x >= size.width_px || click.y >= size.height_px) {
        refuse(click.place,
               "pixel (" + std::to_string(click.x) + ", " + std::to_string(click.y) + ") lies outside the image of " +
                   std::to_string(size.width_px) + " x " + std::to_string(size.height_px),
               "columns and rows are counted from 0");
      }
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
  std::map<std::string, std::vector<Click>> clicks_;  // by frame
};

}  // namespace

std::unique_ptr<LabelReader> make_click_reader() { return std::make_unique<ClickReader>(); }

}  // namespace semfield
