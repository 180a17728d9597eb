#include "labels/clicks/annotations.h"

#include <algorithm>
#include <set>

#include "core/error.h"
#include "formats/image_io.h"
#include "labels/label_files.h"
#include "scene/classes/class_table.h"

namespace semfield {

namespace {

[[noreturn]] void refuse(Code code, const LabelEvent& event, const std::string& message,
                         const std::string& remedy = {}) {
  throw Error(ErrorKind::data, code, "event '" + event.id + "': " + message, remedy);
}

Annotations::Mark mark_of(const LabelEvent& event, int frame, const Camera& camera, int class_index) {
  const double scale_x = static_cast<double>(camera.width_px) / event.width_px,
               scale_y = static_cast<double>(camera.height_px) / event.height_px;
  Annotations::Mark mark{event.id, frame, {}, event.radius_px * scale_x, class_index, event.fill, event.object};
  for (const PixelPoint& p : event.points) mark.points.push_back({p.x * scale_x, p.y * scale_y});
  return mark;
}

bool ends_a_class(LabelEventKind kind) {
  return kind == LabelEventKind::merge_class || kind == LabelEventKind::delete_class;
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
  for (auto end = records_.rbegin(); end != records_.rend(); ++end) {
    if (!end->in_force || !ends_a_class(end->event.kind) || end->event.class_name != name) continue;
    const bool merged = end->event.kind == LabelEventKind::merge_class;
    refuse("labels.class.unknown", event, "no class '" + name + "' any more",
           merged ? "it was merged into '" + end->event.new_name + "'" : "it was deleted");
  }
  refuse("labels.class.unknown", event, "no class '" + name + "'", names.remedy_for(name));
}

int Annotations::resolve_added_class(const LabelEvent& event, const char* remedy) const {
  const int c = resolve_class(event, event.class_name);
  if (c == kVoid) refuse("labels.event.void", event, "'" + event.class_name + "' stands for pixels without a class");
  if (c < own_classes_)
    refuse("labels.event.own_class", event, "the class '" + event.class_name + "' is one of the scene's own", remedy);
  return c;
}

void Annotations::require_free_name(const LabelEvent& event, const std::string& name, const char* remedy) const {
  for (const ClassEntry& entry : classes_.entries()) {
    const int c = classes_.index_of(entry.id);
    if (entry.name == name && (c == kVoid || is_named(c)))
      refuse("labels.event.taken", event, "there is a class '" + name + "' already", remedy);
  }
  if (is_void_name(name) || is_unnamed_class(name))
    refuse("labels.event.void", event, "'" + name + "' stands for pixels and classes without a name", remedy);
}

void Annotations::resolve_place(const LabelEvent& event) const {
  const auto frame = frame_of_.find(event.frame);
  if (frame == frame_of_.end()) {
    std::vector<std::string> known;
    for (const FrameShape& f : frames_) known.push_back(f.name);
    refuse("scene.frame.unknown", event, "no frame '" + event.frame + "'",
           near_name_remedy(event.frame, known, "see `semfield inspect` for the names"));
  }
  const FrameShape& shape = frames_[static_cast<std::size_t>(frame->second)];
  if (shape.split != Split::train)
    refuse("labels.frame.untrained", event, "frame '" + event.frame + "' is not a training frame",
           "label training frames only");
  if (event.width_px < 1 || event.height_px < 1 || event.points.empty())
    refuse("labels.event.points", event, "needs the size of an image and a point in it");
  try {
    check_label_shape(event.width_px, event.height_px, shape.camera);
  } catch (const Error& e) {
    refuse(e.code(), event, "frame '" + event.frame + "': " + e.message(), e.remedy());
  }
  for (const PixelPoint& p : event.points) {
    if (!(p.x >= 0 && p.x <= event.width_px && p.y >= 0 && p.y <= event.height_px))
      refuse("labels.event.points", event,
             "a point lies outside the image of " + std::to_string(event.width_px) + " x " +
                 std::to_string(event.height_px));
  }
}

Annotations::Turned Annotations::turned_by(int of) const {
  Turned turned{{of}, !records_[static_cast<std::size_t>(of)].in_force};
  while (records_[static_cast<std::size_t>(turned.records.back())].of >= 0) {
    turned.records.push_back(records_[static_cast<std::size_t>(turned.records.back())].of);
    turned.in_force = !turned.in_force;
  }
  return turned;
}

std::vector<std::optional<int>> Annotations::classes_now() const {
  std::vector<std::optional<int>> of(records_.size()), now;
  for (int c = 0; c < named_classes(); ++c) now.emplace_back(c);
  for (std::size_t r = records_.size(); r-- > 0;) {
    const Record& record = records_[r];
    const auto c = static_cast<std::size_t>(record.class_index);
    if (record.event.kind == LabelEventKind::click) of[r] = record.class_index < 0 ? kVoid : now[c];
    if (!record.in_force || !ends_a_class(record.event.kind)) continue;
    now[c] = record.into < 0 ? std::nullopt : now[static_cast<std::size_t>(record.into)];
  }
  return of;
}

const Annotations::Record* Annotations::end_of_class(int added) const {
  for (auto r = std::ssize(records_) - 1; r > added; --r) {
    const Record& e = records_[static_cast<std::size_t>(r)];
    const bool is_its_end = e.class_record == added || e.into_record == added;
    if (e.in_force && ends_a_class(e.event.kind) && is_its_end) return &e;
  }
  return nullptr;
}

void Annotations::check_undo(const LabelEvent& event) const {
  const auto found = record_of_.find(event.of);
  if (found == record_of_.end()) refuse("labels.event.undo", event, "there is no event '" + event.of + "' to undo");
  if (!records_[static_cast<std::size_t>(found->second)].in_force)
    refuse("labels.event.undo", event, "event '" + event.of + "' is undone already", "undo its undo to bring it back");
  const Turned turned = turned_by(found->second);
  const int last = turned.records.back();
  const Record& record = records_[static_cast<std::size_t>(last)];
  if (record.event.kind == LabelEventKind::skip) return;
  if (record.event.kind != LabelEventKind::click) return check_class_undo(event, turned);
  if (!turned.in_force) return;
  const bool is_deleted = !classes_now()[static_cast<std::size_t>(last)].has_value();
  if (is_deleted || !has_its_class(record))
    refuse("labels.event.undo", event,
           "the class '" + record.event.class_name + "' of this click is " + (is_deleted ? "deleted" : "undone"),
           "bring the class back first");
}

void Annotations::check_class_undo(const LabelEvent& event, const Turned& turned) const {
  const Record& last = records_[static_cast<std::size_t>(turned.records.back())];
  const auto c = static_cast<std::size_t>(last.class_index);
  if (last.event.kind == LabelEventKind::add_class && !turned.in_force) {
    if (const Record* const end = end_of_class(turned.records.back()))
      refuse("labels.event.undo", event, "the class '" + last.event.class_name + "' was merged or deleted since",
             "undo event '" + end->event.id + "' first");
    const std::vector<std::optional<int>> classes = classes_now();
    std::int64_t clicks = 0;
    for (std::size_t r = 0; r < records_.size(); ++r) clicks += records_[r].in_force && classes[r] == last.class_index;
    if (clicks > 0) {
      refuse("labels.event.undo", event,
             "the class '" + named_[c]->name + "' has " + std::to_string(clicks) + " clicks", "undo its clicks first");
    }
  }
  const bool ends = ends_a_class(last.event.kind);
  if (ends && turned.in_force) {
    const auto is_there = [&](int of, int added) { return is_named(of) && record_of_class(of) == added; };
    const bool has_own = is_there(last.class_index, last.class_record);
    if (!has_own || (last.into >= 0 && !is_there(last.into, last.into_record)))
      refuse("labels.event.undo", event,
             "the class '" + (has_own ? last.event.new_name : last.event.class_name) + "' is no longer there",
             "bring the class back first");
  }
  const bool comes_back = last.event.kind == LabelEventKind::add_class ? turned.in_force : ends && !turned.in_force;
  if (comes_back && named_[c]) {
    refuse("labels.event.undo", event,
           "the place of the class '" + last.event.class_name + "' has been given to '" + named_[c]->name + "'",
           "add the class again, or undo '" + named_[c]->name + "' first");
  }
  const std::optional<Naming> after = namings(turned.records.back())[c];
  if (after && (!named_[c] || named_[c]->name != after->name))
    require_free_name(event, after->name, "rename one of the two first");
}

Annotations::Record Annotations::resolve(const LabelEvent& event) const {
  Record record{event};
  if (!is_event_id(event.id))
    refuse("labels.event.format", event, "its id is not 1 to 64 letters of a-z, A-Z, 0-9, '-' and '_'");
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
      record.class_record = record_of_class(record.class_index);
      break;
    case LabelEventKind::change_class:
      record.class_index = resolve_class(event, event.class_name);
      record.class_record = record_of_class(record.class_index);
      if (record.class_index == kVoid)
        refuse("labels.event.void", event, "'" + event.class_name + "' stands for pixels without a class");
      if (event.new_name == event.class_name) break;
      (void)resolve_added_class(event, "rename it in the scene's table");
      require_free_name(event, event.new_name, "choose another name");
      break;
    case LabelEventKind::merge_class:
      record.class_index = resolve_added_class(event, "merge the other one into it");
      record.class_record = record_of_class(record.class_index);
      record.into = resolve_class(event, event.new_name);
      record.into_record = record_of_class(record.into);
      if (record.into == kVoid)
        refuse("labels.event.void", event, "'" + event.new_name + "' stands for pixels without a class");
      if (record.into == record.class_index)
        refuse("labels.event.merge", event, "a class cannot be merged into itself", "name another class");
      break;
    case LabelEventKind::delete_class:
      record.class_index = resolve_added_class(event, "undo its clicks instead");
      record.class_record = record_of_class(record.class_index);
      break;
    case LabelEventKind::add_class:
      require_free_name(event, event.class_name, "choose another name");
      record.class_index = free_place();
      if (record.class_index < 0) {
        refuse("labels.event.room", event,
               "there is room for " + std::to_string(ids_.size()) + " classes, and all have names",
               "rename a class that nobody needs, or raise scene.labels.class_room in a new run");
      }
      break;
  }
  return record;
}

// One that never had a name while there is one, so that an undone class can come back; -1: none.
int Annotations::free_place() const {
  if (named_.size() < ids_.size()) return named_classes();
  const auto undone = std::find_if(named_.begin(), named_.end(), [](const auto& naming) { return !naming; });
  return undone == named_.end() ? -1 : static_cast<int>(undone - named_.begin());
}

bool Annotations::check(const LabelEvent& event) const {
  if (seen(event.id)) return false;
  (void)resolve(event);
  return true;
}

bool Annotations::apply(const LabelEvent& event) {
  if (!enter(event)) return false;
  list_marks();
  return true;
}

bool Annotations::enter(const LabelEvent& event) {
  if (seen(event.id)) return false;
  records_.push_back(resolve(event));
  record_of_.emplace(event.id, static_cast<int>(records_.size()) - 1);
  LabelEventKind changed = event.kind;
  if (event.kind == LabelEventKind::undo) {
    for (const int r : turned_by(records_.back().of).records) {
      Record& record = records_[static_cast<std::size_t>(r)];
      record.in_force = !record.in_force;
      changed = record.event.kind;
    }
  }
  if (changed != LabelEventKind::click && changed != LabelEventKind::skip) {
    if (event.kind == LabelEventKind::add_class && records_.back().class_index == named_classes())
      named_.emplace_back();
    list_classes();
  }
  known_.add(event);
  return true;
}

void Annotations::list_marks() {
  marks_.clear();
  skips_.clear();
  const std::vector<std::optional<int>> classes = classes_now();
  for (std::size_t r = 0; r < records_.size(); ++r) {
    const LabelEvent& event = records_[r].event;
    const bool is_skip = event.kind == LabelEventKind::skip;
    if (!records_[r].in_force || (!classes[r] && !is_skip)) continue;
    const int frame = frame_of_.at(event.frame);
    const Camera& camera = frames_[static_cast<std::size_t>(frame)].camera;
    (is_skip ? skips_ : marks_).push_back(mark_of(event, frame, camera, classes[r].value_or(kVoid)));
  }
}

// With the record `turned`, if any, taken out or put back.
std::vector<std::optional<Annotations::Naming>> Annotations::namings(int turned) const {
  std::vector<std::optional<Naming>> out;
  for (const ClassEntry& entry : own_) {
    if (!entry.ignore) out.emplace_back(Naming{entry.name, entry.color});
  }
  out.resize(named_.size());
  for (int r = 0; r < static_cast<int>(records_.size()); ++r) {
    const Record& record = records_[static_cast<std::size_t>(r)];
    if (record.in_force == (r == turned) || record.class_index < 0) continue;
    if (record.class_record >= 0 && record.class_record != turned && !has_its_class(record)) continue;
    std::optional<Naming>& naming = out[static_cast<std::size_t>(record.class_index)];
    if (record.event.kind == LabelEventKind::add_class) naming = Naming{record.event.class_name, record.event.color, r};
    if (ends_a_class(record.event.kind)) naming.reset();
    if (record.event.kind != LabelEventKind::change_class || !naming) continue;
    naming->name = record.event.new_name;
    if (record.event.color) naming->color = record.event.color;
  }
  return out;
}

void Annotations::list_classes() {
  named_ = namings();
  std::vector<ClassEntry> entries;
  for (const ClassEntry& entry : own_) {
    if (entry.ignore) entries.push_back(entry);
  }
  for (std::size_t c = 0; c < ids_.size(); ++c) {
    const bool named = c < named_.size() && named_[c];
    entries.push_back({ids_[c], named ? named_[c]->name : unnamed_class(ids_[c]),
                       named && named_[c]->color ? *named_[c]->color : ClassTable::default_color(ids_[c]), false});
  }
  classes_ = ClassTable(std::move(entries));
}

ClassTable Annotations::named_table() const {
  std::vector<ClassEntry> entries;
  for (const ClassEntry& entry : classes_.entries()) {
    if (entry.ignore || is_named(classes_.index_of(entry.id))) entries.push_back(entry);
  }
  return ClassTable(std::move(entries));
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
      sum.enter(events[i]);
    } catch (const Error& e) {
      const bool adds = events[i].kind == LabelEventKind::add_class;
      throw Error(e.kind(), e.code(), name + ":" + std::to_string(i + 1) + ": " + e.message(),
                  adds                 ? "delete the line, or change its name: clicks name their class by its name"
                  : e.remedy().empty() ? "fix or delete the line"
                                       : e.remedy());
    }
  }
  sum.list_marks();
  return sum;
}

// Marks as pixels: what they paint in images of any size, and where they say to ignore labels.

std::vector<PixelRun> runs_of(const Annotations::Mark& mark, std::int32_t width_px, std::int32_t height_px) {
  std::vector<PixelRun> inside;
  if (mark.fill) inside = outline_runs(mark.points, width_px, height_px);
  return inside.empty() ? stroke_runs(mark.points, mark.radius_px, width_px, height_px) : inside;
}

std::vector<std::int16_t> Annotations::paint(int frame, std::span<const std::int16_t> base) const {
  const Camera& camera = frames_.at(static_cast<std::size_t>(frame)).camera;
  LabelRaster raster = void_raster(camera.width_px, camera.height_px);
  if (!base.empty()) {
    if (base.size() != raster.hard.size())
      throw Error(ErrorKind::internal, "internal.labels.size", "labels to paint over have another size than the frame");
    raster.hard.assign(base.begin(), base.end());
  }
  paint_marks(frame, raster);
  return std::move(raster.hard);
}

// Over a raster of any size of the frame's shape.
void Annotations::paint_marks(int frame, LabelRaster& raster) const {
  const Camera& camera = frames_.at(static_cast<std::size_t>(frame)).camera;
  const double scale_x = static_cast<double>(raster.width_px) / camera.width_px,
               scale_y = static_cast<double>(raster.height_px) / camera.height_px;
  for (const Mark& mark : marks()) {
    if (mark.frame != frame) continue;
    Mark scaled = mark;
    scaled.radius_px *= scale_x;
    for (PixelPoint& p : scaled.points) p = {p.x * scale_x, p.y * scale_y};
    semfield::paint(runs_of(scaled, raster.width_px, raster.height_px), static_cast<std::int16_t>(mark.class_index),
                    raster);
  }
}

bool Annotations::clear_ignored(int frame, std::int32_t width_px, std::int32_t height_px,
                                std::span<std::int16_t> labels) const {
  const auto ignores = [&](const Mark& mark) { return mark.frame == frame && mark.class_index == kVoid; };
  if (std::none_of(marks().begin(), marks().end(), ignores)) return false;
  constexpr std::int16_t kUntouched = -2;
  LabelRaster raster = void_raster(width_px, height_px);
  std::fill(raster.hard.begin(), raster.hard.end(), kUntouched);
  paint_marks(frame, raster);
  for (std::size_t p = 0; p < labels.size(); ++p)
    if (raster.hard.at(p) == kVoid) labels[p] = kVoid;
  return true;
}

}  // namespace semfield
