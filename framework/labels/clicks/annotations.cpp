#include "labels/clicks/annotations.h"

#include <algorithm>
#include <set>

#include "core/error.h"
#include "formats/text_rows.h"
#include "labels/label_files.h"
#include "scene/classes/class_table.h"

namespace semfield {

namespace {

Annotations::Mark mark_of(const LabelEvent& event, int frame, const Camera& camera, int class_index) {
  const double scale_x = static_cast<double>(camera.width_px) / event.width_px,
               scale_y = static_cast<double>(camera.height_px) / event.height_px;
  Annotations::Mark mark{event.id, frame, {}, event.radius_px * scale_x, class_index, event.fill, event.object};
  for (const PixelPoint& p : event.points) mark.points.push_back({p.x * scale_x, p.y * scale_y});
  return mark;
}

}  // namespace

Annotations::Annotations(const SceneInfo& scene, int room) : own_(scene.classes.entries()) {
  for (const FrameInfo& frame : scene.frames) {
    frame_of_.emplace(frame.name, static_cast<int>(frames_.size()));
    frames_.push_back({frame.name, frame.camera, frame.split});
  }
  if (own_.empty()) own_.push_back({0, "void", ClassTable::default_color(0), true});
  std::set<std::int32_t> ignored;
  std::int32_t next = 0;
  for (const ClassEntry& entry : own_) {
    if (entry.ignore) {
      ignored.insert(entry.id);
      continue;
    }
    ids_.push_back(entry.id);
    named_.emplace_back(Naming{entry.name, entry.color});
    next = entry.id + 1;
  }
  own_classes_ = static_cast<int>(ids_.size());
  for (; static_cast<int>(ids_.size()) < room; ++next) {
    if (!ignored.contains(next)) ids_.push_back(next);
  }
  list_classes();
}

int Annotations::resolve_class(const LabelEvent& event, const std::string& name) const {
  for (std::size_t c = 0; c < named_.size(); ++c) {
    if (named_[c] && named_[c]->name == name) return static_cast<int>(c);
  }
  const ClassNames names(named_table());
  if (names.find(name) == kVoid) return kVoid;
  for (auto end = ends_.rbegin(); end != ends_.rend(); ++end) {
    const Record& record = records_[static_cast<std::size_t>(*end)];
    if (!record.in_force || record.event.class_name != name) continue;
    const bool merged = record.event.kind == LabelEventKind::merge_class;
    refuse_event("labels.class.unknown", event, "no class '" + name + "' any more",
                 merged ? "it was merged into '" + record.event.new_name + "'" : "it was deleted");
  }
  refuse_event("labels.class.unknown", event, "no class '" + name + "'", names.remedy_for(name));
}

void Annotations::resolve_place(const LabelEvent& event) const {
  const auto frame = frame_of_.find(event.frame);
  if (frame == frame_of_.end()) {
    std::vector<std::string> known;
    for (const FrameShape& f : frames_) known.push_back(f.name);
    refuse_event("scene.frame.unknown", event, "no frame '" + event.frame + "'",
                 near_name_remedy(event.frame, known, "see `semfield inspect` for the names"));
  }
  const FrameShape& shape = frames_[static_cast<std::size_t>(frame->second)];
  if (shape.split != Split::train)
    refuse_event("labels.frame.untrained", event, "frame '" + event.frame + "' is not a training frame",
                 "label training frames only");
  if (event.width_px < 1 || event.height_px < 1 || event.points.empty())
    refuse_event("labels.event.points", event, "needs the size of an image and a point in it");
  try {
    check_label_shape(event.width_px, event.height_px, shape.camera);
  } catch (const Error& e) {
    refuse_event(e.code(), event, "frame '" + event.frame + "': " + e.message(), e.remedy());
  }
  for (const PixelPoint& p : event.points) {
    if (!(p.x >= 0 && p.x <= event.width_px && p.y >= 0 && p.y <= event.height_px))
      refuse_event("labels.event.points", event,
                   "a point lies outside the image of " + std::to_string(event.width_px) + " x " +
                       std::to_string(event.height_px));
  }
}

std::optional<int> Annotations::class_now(int record) const {
  int c = records_[static_cast<std::size_t>(record)].class_index;
  for (auto end = std::upper_bound(ends_.begin(), ends_.end(), record); end != ends_.end(); ++end) {
    const Record& e = records_[static_cast<std::size_t>(*end)];
    if (!e.in_force || e.class_index != c) continue;
    if (e.event.kind == LabelEventKind::delete_class) return std::nullopt;
    c = e.into;
  }
  return c;
}

Annotations::Record Annotations::resolve(const LabelEvent& event) const {
  Record record{event};
  if (!is_event_id(event.id))
    refuse_event("labels.event.format", event, "its id is not 1 to 64 letters of a-z, A-Z, 0-9, '-' and '_'");
  switch (event.kind) {
    case LabelEventKind::undo:
      check_undo(event);
      record.of = record_of_.at(event.of);
      break;
    case LabelEventKind::skip:
      resolve_place(event);
      break;
    case LabelEventKind::click:
      resolve_place(event);
      record.class_index = resolve_class(event, event.class_name);
      break;
    case LabelEventKind::change_class:
      record.class_index = resolve_class(event, event.class_name);
      if (record.class_index == kVoid)
        refuse_event("labels.event.void", event, "'" + event.class_name + "' stands for pixels without a class");
      if (event.new_name == event.class_name) break;
      (void)resolve_added_class(event, "rename it in the scene's table");
      require_free_name(event, event.new_name, "choose another name");
      break;
    case LabelEventKind::merge_class:
      record.class_index = resolve_added_class(event, "merge the other one into it");
      record.into = resolve_class(event, event.new_name);
      record.into_record = record_of_class(record.into);
      if (record.into == kVoid)
        refuse_event("labels.event.void", event, "'" + event.new_name + "' stands for pixels without a class");
      if (record.into == record.class_index)
        refuse_event("labels.event.merge", event, "a class cannot be merged into itself", "name another class");
      break;
    case LabelEventKind::delete_class:
      record.class_index = resolve_added_class(event, "undo its clicks instead");
      break;
    case LabelEventKind::add_class:
      require_free_name(event, event.class_name, "choose another name");
      record.class_index = free_place();
      if (record.class_index < 0) {
        refuse_event("labels.event.room", event,
                     "there is room for " + std::to_string(ids_.size()) + " classes, and all have names",
                     "rename a class that nobody needs, or raise scene.labels.class_room in a new run");
      }
      break;
  }
  if (event.kind != LabelEventKind::add_class) record.class_record = record_of_class(record.class_index);
  return record;
}

bool Annotations::check(const LabelEvent& event) const {
  if (seen(event.id)) return false;
  (void)resolve(event);
  return true;
}

bool Annotations::apply(const LabelEvent& event) {
  if (seen(event.id)) return false;
  records_.push_back(resolve(event));
  const auto last = static_cast<int>(records_.size()) - 1;
  record_of_.emplace(event.id, last);
  int changed = last;
  if (event.kind == LabelEventKind::undo) {
    const Turned turned = turned_by(records_.back().of);
    for (const int r : turned.records) {
      bool& in_force = records_[static_cast<std::size_t>(r)].in_force;
      in_force = !in_force;
    }
    changed = turned.records.back();
  }
  if (ends_a_class(event.kind)) ends_.push_back(last);
  const Record& record = records_[static_cast<std::size_t>(changed)];
  if (record.event.kind == LabelEventKind::click || record.event.kind == LabelEventKind::skip) {
    put_mark(changed, record.in_force);
  } else {
    if (event.kind == LabelEventKind::add_class && record.class_index == named_classes()) named_.emplace_back();
    list_classes();
    if (ends_a_class(record.event.kind)) list_marks();
  }
  known_.add(event);
  return true;
}

// In its place by the order of events, or out of the list.
void Annotations::put_mark(int record, bool in_force) {
  const Record& of = records_[static_cast<std::size_t>(record)];
  Marks& marks = of.event.kind == LabelEventKind::click ? marks_ : skips_;
  const auto at = std::lower_bound(marks.records.begin(), marks.records.end(), record);
  const auto place = at - marks.records.begin();
  const bool is_listed = at != marks.records.end() && *at == record;
  const std::optional<int> c = class_now(record);
  if (in_force && c && !is_listed) {
    const int frame = frame_of_.at(of.event.frame);
    const Camera& camera = frames_[static_cast<std::size_t>(frame)].camera;
    marks.list.insert(marks.list.begin() + place, mark_of(of.event, frame, camera, *c));
    marks.records.insert(at, record);
  } else if (!in_force && is_listed) {
    marks.list.erase(marks.list.begin() + place);
    marks.records.erase(at);
  }
}

std::vector<int> Annotations::frames_with_marks() const {
  std::set<int> frames;
  for (const Mark& mark : marks()) frames.insert(mark.frame);
  return {frames.begin(), frames.end()};
}

Annotations replay(const SceneInfo& scene, int room, const std::vector<LabelEvent>& events, const std::string& name) {
  const auto added = std::count_if(events.begin(), events.end(),
                                   [](const LabelEvent& e) { return e.kind == LabelEventKind::add_class; });
  const int all = scene.classes.valid_count() + static_cast<int>(added);
  Annotations sum(scene, room > 0 ? room : all);
  for (std::size_t i = 0; i < events.size(); ++i) {
    try {
      if (!sum.has_room() && events[i].kind == LabelEventKind::add_class) return replay(scene, all, events, name);
      sum.apply(events[i]);
    } catch (const Error& e) {
      const bool adds = events[i].kind == LabelEventKind::add_class;
      throw Error(e.kind(), e.code(), name + ":" + std::to_string(i + 1) + ": " + e.message(),
                  adds                 ? "delete the line, or change its name: clicks name their class by its name"
                  : e.remedy().empty() ? "fix or delete the line"
                                       : e.remedy());
    }
  }
  return sum;
}

}  // namespace semfield
