#include "train/changed_labels.h"

#include <fmt/format.h>

#include <algorithm>
#include <tuple>
#include <utility>

#include "core/checksum.h"
#include "core/error.h"

namespace semfield {

namespace {

Error no_logit(const std::string& place, const std::string& name) {
  return Error(ErrorKind::data, "labels.class.no_logit",
               fmt::format("{}: no label had class '{}' when the session opened, so the network has no logit for it",
                           place, name),
               "open it with runtime.keep: [semantics, absent_classes]");
}

}  // namespace

ChangedLabels::ChangedLabels(Session& session, RaySource& rays)
    : session_(session), rays_(rays), was_set_(session.scene.frames.size(), false) {
  if (session.config.labels.clicks) clicks_ = session.config.labels.clicks->known();
}

void ChangedLabels::require_drawn(int frame) const {
  const std::vector<int> drawn = session_.drawn_frames();
  if (std::find(drawn.begin(), drawn.end(), frame) != drawn.end()) return;
  throw Error(ErrorKind::data, "labels.frame.untrained",
              fmt::format("frame {}: it is not a training frame, so none of its labels train", frame),
              "name one of Session::drawn_frames");
}

// paint(frame) gives each of the frames other labels. Where it or the ray source throws, all are again as they were.
template <class Paint>
void ChangedLabels::replace(std::span<const int> frames, const Paint& paint) {
  TrainingLabels& labels = session_.labels;
  std::vector<std::pair<TrainingLabels::Frame, std::vector<std::int64_t>>> before;
  try {
    for (const int frame : frames) {
      const auto f = static_cast<std::size_t>(frame);
      before.emplace_back(std::move(labels.frames[f]), std::move(labels.class_pixels[f]));
      paint(f);
    }
    rays_.relabel();
  } catch (...) {
    for (std::size_t i = before.size(); i-- > 0;) {
      const auto f = static_cast<std::size_t>(frames[i]);
      std::tie(labels.frames[f], labels.class_pixels[f]) = std::move(before[i]);
    }
    rays_.relabel();
    throw;
  }
}

void ChangedLabels::set(int frame, std::vector<std::int16_t> labels) {
  require_drawn(frame);
  const auto f = static_cast<std::size_t>(frame);
  const FrameInfo& info = session_.scene.info.frames[f];
  const auto refuse = [&](Code code, const std::string& what, const std::string& remedy) {
    throw Error(ErrorKind::data, code, fmt::format("labels of frame '{}': {}", info.name, what), remedy);
  };
  const std::int32_t width = info.camera.width_px, height = info.camera.height_px;
  if (std::ssize(labels) != std::int64_t{width} * height) {
    refuse("labels.given.size", fmt::format("{} values for {} x {} pixels", labels.size(), width, height),
           "give a class index, or -1 for none, for every pixel, row by row");
  }
  const std::vector<std::int16_t> logit_of_class = session_.logit_of_class();
  std::vector<std::int64_t> counts(static_cast<std::size_t>(session_.classes()) + 1);
  for (std::size_t p = 0; p < labels.size(); ++p) {
    const std::int16_t label = labels[p];
    if (label == kVoid) {
      ++counts.back();
      continue;
    }
    const auto place = [&] {
      return fmt::format("pixel x {}, y {}", p % static_cast<std::size_t>(width), p / static_cast<std::size_t>(width));
    };
    if (label < 0 || label >= session_.classes()) {
      refuse("labels.class.range",
             fmt::format("{}: {} is not a class; there are {}", place(), label, session_.classes()),
             "give class indices, which begin at 0, or -1 for none");
    }
    if (!session_.plan.semantics || logit_of_class[static_cast<std::size_t>(label)] == kVoid) {
      throw no_logit(fmt::format("labels of frame '{}': {}", info.name, place()),
                     session_.scene.info.classes.valid(label).name);
    }
    ++counts[static_cast<std::size_t>(label)];
  }
  replace({&frame, 1}, [&](std::size_t own) {
    session_.labels.frames[own] = {};
    session_.labels.frames[own].hard = LabelMap(std::move(labels));
    session_.labels.class_pixels[own] = std::move(counts);
  });
  was_set_[f] = true;
}

void ChangedLabels::set_clicks(const Annotations& clicks, std::span<const int> frames) {
  const ClassTable& classes = session_.scene.info.classes;
  if (session_.labels.unclicked.empty() || clicks.classes().valid_count() != classes.valid_count()) {
    throw Error(ErrorKind::data, "labels.clicks.foreign",
                "clicks: they are not those of this session, which was opened for other ones",
                "open it with scene.labels.clicks or .class_room, and apply events to a copy of config.labels.clicks");
  }
  for (const int frame : frames) require_drawn(frame);
  const std::vector<std::int16_t> logit_of_class = session_.logit_of_class();
  replace(frames, [&](std::size_t f) {
    paint_clicks(clicks, static_cast<int>(f), session_.labels);
    const std::vector<std::int64_t>& counts = session_.labels.class_pixels[f];
    for (std::size_t c = 0; c + 1 < counts.size(); ++c) {
      if (counts[c] > 0 && logit_of_class[c] == kVoid)
        throw no_logit(fmt::format("clicks in frame '{}'", session_.scene.info.frames[f].name),
                       classes.valid(static_cast<int>(c)).name);
    }
  });
  for (const int frame : frames)
    was_set_[static_cast<std::size_t>(frame)] = session_.config.labels.selection.clicks.empty();
  session_.scene.info.classes = clicks.classes();
  clicks_ = clicks.known();
}

std::string ChangedLabels::name() const {
  std::uint32_t crc = 0;
  int frames = 0;
  for (std::size_t f = 0; f < was_set_.size(); ++f) {
    if (!was_set_[f]) continue;
    ++frames;
    const std::vector<std::int16_t> labels = session_.labels.frames[f].hard.expand();
    crc = crc32c(std::as_bytes(std::span(session_.scene.info.frames[f].name)), crc);
    crc = crc32c(std::as_bytes(std::span(labels)), crc);
  }
  return frames == 0 ? "" : fmt::format("{} frames, {:08x}", frames, crc);
}

}  // namespace semfield
