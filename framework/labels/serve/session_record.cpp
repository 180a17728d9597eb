#include "labels/serve/session_record.h"

#include <algorithm>
#include <map>
#include <numeric>

#include "core/files.h"
#include "eval/image_output.h"
#include "formats/image_io.h"
#include "labels/labelling_record.h"
#include "labels/mask_outlines.h"

namespace semfield {

namespace {

constexpr std::size_t kShown = 4;  // frames with pictures
constexpr std::array<std::uint8_t, 3> kRim{{255, 255, 255}};

using Mark = Annotations::Mark;

void paint(std::vector<std::uint8_t>& rgb, const StoredFrame& photo, const Mark& mark, double radius_px,
           const std::array<std::uint8_t, 3>& color) {
  for (const PixelRun& run : stroke_runs(mark.points, radius_px, photo.width_px, photo.height_px))
    for (std::int32_t x = run.x0; x < run.x1; ++x)
      std::copy(color.begin(), color.end(),
                rgb.begin() + 3 * (static_cast<std::ptrdiff_t>(run.y) * photo.width_px + x));
}

// The photograph with the frame's clicks in the colours of their classes, large enough to be seen, with a light rim.
std::vector<std::uint8_t> with_clicks(const StoredFrame& photo, const std::vector<const Mark*>& marks,
                                      const ClassTable& classes) {
  std::vector<std::uint8_t> rgb = photo.rgb;
  const double least = std::max(1.0, photo.width_px / 160.0);
  for (const double rim : {std::max(1.0, least / 3), 0.0})
    for (const Mark* mark : marks) {
      const std::array<std::uint8_t, 3> color =
          mark->class_index == kVoid ? std::array<std::uint8_t, 3>{} : classes.valid(mark->class_index).color;
      paint(rgb, photo, *mark, std::max(mark->radius_px, least) + rim, rim > 0 ? kRim : color);
    }
  return rgb;
}

void write_pictures(const RunFolder& folder, const Session& session, LabelLoop& loop, int view,
                    const std::vector<const Mark*>& marks) {
  const PoolView& pool_view = loop.view(view);
  const std::string& name = session.scene.info.frames[static_cast<std::size_t>(pool_view.frame)].name;
  const auto path = [&](const char* kind) { return folder.render_path("labelled", name, kind); };
  const StoredFrame& photo = *pool_view.photo;
  const ClassTable& classes = session.scene.info.classes;
  write_png_rgb(path("clicks"), photo.width_px, photo.height_px, with_clicks(photo, marks, classes));
  if (!loop.learned()) return;
  const ViewLabels labels = loop.labels_of(view);
  write_png_rgb(path("label_vis"), labels.width_px, labels.height_px, label_colors(labels.label, classes));
  std::vector<std::uint8_t> entropy;
  for (const std::uint8_t share : labels.entropy) {
    const std::array<std::uint8_t, 3> color = perceptual_color(share / 255.0);
    entropy.insert(entropy.end(), color.begin(), color.end());
  }
  write_png_rgb(path("entropy_vis"), labels.width_px, labels.height_px, entropy);
}

}  // namespace

void write_labelling_record(const RunFolder& folder, const Session& session, LabelLoop& loop, const LabelState& state) {
  LabellingRecord record;
  record.step = state.step;
  record.clicks = std::ssize(state.marks);
  record.frames = std::ssize(loop.pooled());
  for (const ClassState& c : state.classes)
    record.classes.push_back({c.id, c.name, c.color, c.clicks, c.area_share, c.confidence});
  std::map<int, std::vector<const Mark*>> of_frame;
  for (const Mark& mark : state.marks) of_frame[mark.frame].push_back(&mark);
  record.clicked_frames = std::ssize(of_frame);
  const auto marks_of = [&](int view) -> const auto& { return of_frame[loop.view(view).frame]; };
  std::vector<int> views(loop.pooled().size());
  std::iota(views.begin(), views.end(), 0);
  std::stable_sort(views.begin(), views.end(), [&](int a, int b) { return marks_of(a).size() > marks_of(b).size(); });
  for (const int view : views) {
    if (marks_of(view).empty() || record.shown.size() == kShown) break;
    write_pictures(folder, session, loop, view, marks_of(view));
    const auto frame = static_cast<std::size_t>(loop.view(view).frame);
    record.shown.push_back({session.scene.info.frames[frame].name, std::ssize(marks_of(view))});
  }
  write_file_atomic(folder.labelling_path(), labelling_record_json(record));
}

}  // namespace semfield
