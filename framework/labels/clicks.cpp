#include "labels/clicks.h"

#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <nlohmann/json.hpp>
#include <set>

#include "core/checksum.h"
#include "core/text.h"
#include "formats/image_io.h"
#include "labels/label_files.h"
#include "labels/strict_json.h"
#include "scene/classes/class_table.h"

namespace semfield {

namespace {

constexpr std::size_t kMostLogBytes = std::size_t{256} << 20;

void cut(int file, const std::string& path, std::uint64_t size) {
  if (::ftruncate(file, static_cast<off_t>(size)) != 0) throw write_error("shorten", path, errno);
}

// Bytes of the lines that were written to their end. Each line is on the disk before the next begins, so a kill or a
// power cut can leave the last one without its end, or with zeros in place of blocks.
std::size_t whole_lines(std::string_view text, const std::string& name) {
  constexpr std::string_view kZero("\0", 1);
  std::size_t whole = text.rfind('\n') + 1;  // npos + 1 is 0
  if (whole == text.size() && whole > 0) {
    const std::size_t last = text.rfind('\n', whole - 2) + 1;
    if (whole >= 2 && text.substr(last).find(kZero) != std::string_view::npos) whole = last;
  }
  const std::string_view torn = text.substr(whole);
  if (torn.size() > kMostEventBytes || (!torn.empty() && torn.front() != '{' && torn.front() != '\0'))
    throw Error(ErrorKind::data, "labels.clicks.format",
                "'" + name + "' holds no label events: its last line has no end and begins with no '{'",
                "check the path");
  return whole;
}

FolderLock lock_of(const std::string& path) {
  FolderLock lock;
  const int cause = lock.take_file(path);
  if (cause == EWOULDBLOCK) {
    throw Error(ErrorKind::cannot_create, "labels.clicks.busy",
                "the file of clicks '" + path + "' is in use by " + lock.holder(),
                "end that program first, or name another file: --set scene.labels.clicks=FILE");
  }
  if (cause != 0) throw write_error("open", path, cause);
  return lock;
}

}  // namespace

std::vector<LabelEvent> parse_click_log(std::string_view text, const std::string& name, Diagnostics& diagnostics) {
  std::vector<LabelEvent> events;
  std::map<std::string, std::size_t> line_of;
  const std::size_t whole = whole_lines(text, name);
  for (std::size_t at = 0; at < whole;) {
    const std::size_t end = text.find('\n', at);
    const std::string place = name + ":" + std::to_string(events.size() + 1);
    try {
      events.push_back(parse_label_event(text.substr(at, end - at)));
    } catch (const Error& e) {
      throw Error(e.kind(), e.code(), place + ": " + e.message(),
                  e.remedy().empty() ? "fix or delete the line" : e.remedy());
    }
    const auto [first, is_new] = line_of.emplace(events.back().id, events.size());
    if (!is_new) {
      throw Error(ErrorKind::data, "labels.clicks.twice",
                  place + ": line " + std::to_string(first->second) + " has the id '" + events.back().id + "', too",
                  "delete one of the lines, or give it another id");
    }
    at = end + 1;
  }
  if (whole < text.size()) {
    diagnostics.warning("labels.clicks.torn", name + ":" + std::to_string(events.size() + 1),
                        "the last line is incomplete, as after a kill in the middle of an event; it is dropped",
                        "check the last click");
  }
  return events;
}

std::vector<LabelEvent> read_click_log(const std::string& path, Diagnostics& diagnostics) {
  return parse_click_log(read_text_file(path, kMostLogBytes), path, diagnostics);
}

ClickLog ClickLog::open(const std::string& path, Diagnostics& diagnostics) {
  std::string text;
  // What is no file is refused before a lock is made for it.
  if (is_folder(path)) (void)read_text_file(path);
  FolderLock lock = lock_of(path);
  if (is_there(path)) text = read_text_file(path, kMostLogBytes);
  std::vector<LabelEvent> events = parse_click_log(text, path, diagnostics);
  FileDescriptor file = open_for_appending(path);
  if (file < 0) throw write_error("open", path, errno);
  ClickLog log(path, std::move(lock), std::move(file));
  log.events_ = std::move(events);
  log.size_ = whole_lines(text, path);
  if (log.size_ < text.size()) {
    log.require_own(std::string_view(text).substr(log.size_));
    cut(log.file_, path, log.size_);
    sync_file(log.file_, path);
  }
  sync_folder_of(path);
  return log;
}

// Behind the events the file has the beginning of `mine`, or all of it, and nothing else.
void ClickLog::require_own(std::string_view mine) const {
  struct stat now {};
  if (::fstat(file_, &now) != 0) throw write_error("look at", path_, errno);
  if (now.st_nlink == 0) {
    throw Error(ErrorKind::io, "labels.clicks.changed", "'" + path_ + "' was removed while this program appends to it",
                "put the file back, and start this program again");
  }
  const auto size = static_cast<std::uint64_t>(now.st_size);
  std::string tail(size > size_ ? std::min<std::uint64_t>(size - size_, mine.size() + 1) : 0, '\0');
  ssize_t read = 0;
  do read = ::pread(file_, tail.data(), tail.size(), static_cast<off_t>(size_));
  while (read < 0 && errno == EINTR);
  const bool is_read = read == static_cast<ssize_t>(tail.size());
  if (size >= size_ && is_read && mine.starts_with(tail)) return;
  throw Error(ErrorKind::io, "labels.clicks.changed",
              "'" + path_ + "' has " + std::to_string(size) + " bytes where this program left " +
                  std::to_string(size_) + ": another program has changed it",
              "end that program, and start this one again");
}

void ClickLog::take_back(std::string_view line) noexcept {
  try {
    require_own(line);
    cut(file_, path_, size_);
    torn_.clear();
  } catch (const std::exception&) {  // the next append tries again
  }
}

void ClickLog::append(const LabelEvent& event) {
  std::string line = label_event_json(event) + "\n";
  if (size_ + line.size() > kMostLogBytes) {
    throw Error(ErrorKind::io, "labels.clicks.full",
                "'" + path_ + "' is full: it holds " + std::to_string(kMostLogBytes) + " bytes at most",
                "export the labels and continue in a new run");
  }
  require_own(torn_);
  if (!torn_.empty()) cut(file_, path_, size_);
  torn_.clear();
  events_.push_back(event);
  try {
    append_all(file_, path_, line);
    sync_file(file_, path_);
  } catch (const Error&) {
    events_.pop_back();
    torn_ = std::move(line);
    take_back(std::string(torn_));
    throw;
  }
  size_ += line.size();
}

namespace {

using Json = nlohmann::ordered_json;

struct KindText {
  LabelEventKind kind;
  const char* type;
  std::vector<std::string> keys;  // those it must have, beside "id" and "type"
  std::vector<std::string> may;   // those it may have
};

const std::vector<KindText>& kinds() {
  static const std::vector<KindText> all{
      {LabelEventKind::click, "click", {"frame", "size", "points", "radius", "class"}, {"fill", "object"}},
      {LabelEventKind::add_class, "class", {"name"}, {"color"}},
      {LabelEventKind::change_class, "rename", {"class", "name"}, {"color"}},
      {LabelEventKind::undo, "undo", {"of"}, {}},
      {LabelEventKind::skip, "skip", {"frame", "size", "points"}, {}},
      {LabelEventKind::merge_class, "merge", {"class", "into"}, {}},
      {LabelEventKind::delete_class, "delete", {"class"}, {}}};
  return all;
}

Error wrong_format(const std::string& message, const std::string& remedy) {
  return {ErrorKind::data, "labels.event.format", "event: " + message, remedy};
}
constexpr StrictJson<Json> kEvent{wrong_format};

[[noreturn]] void refuse_points(const std::string& message, const std::string& remedy = {}) {
  throw Error(ErrorKind::data, "labels.event.points", "event: " + message, remedy);
}

// 1 to `most` bytes of text without control characters.
std::string line_at(const Json& root, const char* key, std::size_t most) {
  const Json& value = kEvent.at(root, key);
  const std::string* text = value.get_ptr<const std::string*>();
  if (text == nullptr || text->empty() || text->size() > most || !is_line_of_text(*text))
    kEvent.refuse_value(key, "a text of 1 to " + std::to_string(most) + " bytes without control characters", value);
  return *text;
}

std::string id_at(const Json& root, const char* key) {
  const Json& value = kEvent.at(root, key);
  const std::string* text = value.get_ptr<const std::string*>();
  if (text == nullptr || !is_event_id(*text))
    kEvent.refuse_value(key, "1 to 64 letters of a-z, A-Z, 0-9, '-' and '_'", value);
  return *text;
}

void read_size(const Json& root, LabelEvent& event) {
  const Json& size = kEvent.at(root, "size");
  if (!size.is_array() || size.size() != 2) kEvent.refuse_value("size", "[width, height]", size);
  const auto side = [&](std::size_t i) {
    return static_cast<std::int32_t>(
        kEvent.whole(size[i], "size", 1, kMostEventSide, "whole numbers from 1 to " + std::to_string(kMostEventSide)));
  };
  event.width_px = side(0);
  event.height_px = side(1);
}

void read_points(const Json& root, LabelEvent& event) {
  const Json& points = kEvent.at(root, "points");
  const std::size_t most = event.kind == LabelEventKind::skip ? 1 : kMostEventPoints;
  if (!points.is_array() || points.empty() || points.size() > most) {
    kEvent.refuse_value(
        "points", most == 1 ? "a list of one point" : "a list of 1 to " + std::to_string(most) + " points", points);
  }
  for (const Json& point : points) {
    const std::string which = "'points': point " + std::to_string(event.points.size() + 1);
    if (!point.is_array() || point.size() != 2 || !point[0].is_number() || !point[1].is_number())
      refuse_points(which + " is not a pair of numbers [x, y]: " + kEvent.shown(point));
    const PixelPoint p{point[0].get<double>(), point[1].get<double>()};
    if (!(p.x >= 0 && p.x <= event.width_px && p.y >= 0 && p.y <= event.height_px)) {
      refuse_points(which + ", (" + kEvent.shown(point[0]) + ", " + kEvent.shown(point[1]) +
                        "), lies outside the image of " + std::to_string(event.width_px) + " x " +
                        std::to_string(event.height_px),
                    "count pixels of the image of 'size'");
    }
    event.points.push_back(p);
  }
}

void read_radius(const Json& root, LabelEvent& event) {
  const Json& radius = kEvent.at(root, "radius");
  if (radius.is_number()) event.radius_px = radius.get<double>();
  if (!radius.is_number() || !(event.radius_px >= 0 && event.radius_px <= kMostEventRadius))
    kEvent.refuse_value("radius", "pixels from 0 to a million", radius);
}

void read_fill(const Json& root, LabelEvent& event) {
  kEvent.flag(root, "fill", event.fill);
  if (event.fill && event.points.size() < kLeastOutlinePoints)
    refuse_points("'fill': an outline needs 3 points, and there are " + std::to_string(event.points.size()));
}

void read_object(const Json& root, LabelEvent& event) {
  const auto object = root.find("object");
  if (object == root.end()) return;
  event.object = static_cast<std::int32_t>(kEvent.whole(
      *object, "object", 1, kMostObjectNumber, "a whole number from 1 to " + std::to_string(kMostObjectNumber)));
}

void read_color(const Json& root, LabelEvent& event) {
  const auto color = root.find("color");
  if (color == root.end()) return;
  std::array<std::uint8_t, 3> rgb{};
  if (!color->is_array() || color->size() != 3) kEvent.refuse_value("color", "[red, green, blue]", *color);
  for (std::size_t i = 0; i < 3; ++i)
    rgb[i] = static_cast<std::uint8_t>(kEvent.whole((*color)[i], "color", 0, 255, "whole numbers from 0 to 255"));
  event.color = rgb;
}

const KindText& kind_at(const Json& root) {
  const Json& type = kEvent.at(root, "type");
  std::vector<std::string> known;
  for (const KindText& kind : kinds()) {
    if (type == kind.type) return kind;
    known.emplace_back(kind.type);
  }
  kEvent.refuse_value("type", join(known), type);
}

void check_keys(const Json& root, const KindText& kind) {
  std::vector<std::string> known{"id", "type", "time_ms"};
  known.insert(known.end(), kind.keys.begin(), kind.keys.end());
  known.insert(known.end(), kind.may.begin(), kind.may.end());
  kEvent.check_keys(root, known, std::string(" of a '") + kind.type + "'");
}

// The event's text behind a key that names a class; null for other keys.
std::string LabelEvent::*name_behind(std::string_view key, LabelEventKind kind) {
  if (key == "class" || (key == "name" && kind == LabelEventKind::add_class)) return &LabelEvent::class_name;
  return key == "name" || key == "into" ? &LabelEvent::new_name : nullptr;
}

}  // namespace

bool is_event_id(std::string_view text) {
  const auto allowed = [](char c) { return is_alnum(c) || c == '-' || c == '_'; };
  return !text.empty() && text.size() <= 64 && std::all_of(text.begin(), text.end(), allowed);
}

LabelEvent parse_label_event(std::string_view json) {
  if (json.size() > kMostEventBytes)
    throw Error(ErrorKind::data, "labels.event.size",
                "event: it is " + std::to_string(json.size()) + " bytes long; at most " +
                    std::to_string(kMostEventBytes) + " are read",
                "send a stroke in parts");
  const Json root = kEvent.map(json, R"( {"id":...,"type":...})");
  const KindText& kind = kind_at(root);
  check_keys(root, kind);
  LabelEvent event;
  event.kind = kind.kind;
  event.id = id_at(root, "id");
  if (const auto time = root.find("time_ms"); time != root.end())
    event.unix_ms = kEvent.whole(*time, "time_ms", 0, std::int64_t{1} << 53, "milliseconds since 1970");
  const bool click = kind.kind == LabelEventKind::click;
  if (click || kind.kind == LabelEventKind::skip) {
    event.frame = line_at(root, "frame", kMostFrameNameBytes);
    read_size(root, event);
    read_points(root, event);
  }
  if (click) {
    read_radius(root, event);
    read_fill(root, event);
    read_object(root, event);
  }
  for (const std::string& key : kind.keys) {
    if (const auto name = name_behind(key, event.kind)) event.*name = line_at(root, key.c_str(), kMostClassNameBytes);
  }
  read_color(root, event);
  if (kind.kind == LabelEventKind::undo) {
    event.of = id_at(root, "of");
    if (event.of == event.id) kEvent.refuse("'of': it is the event's own id");
  }
  return event;
}

std::string label_event_json(const LabelEvent& event) {
  const auto kind =
      std::find_if(kinds().begin(), kinds().end(), [&](const KindText& k) { return k.kind == event.kind; });
  Json root;
  root["id"] = event.id;
  root["type"] = kind->type;
  if (event.unix_ms != 0) root["time_ms"] = event.unix_ms;
  for (const std::string& key : kind->keys) {
    Json& value = root[key];
    if (key == "frame") value = event.frame;
    if (key == "size") value = {event.width_px, event.height_px};
    if (key == "radius") value = event.radius_px;
    if (key == "of") value = event.of;
    if (const auto name = name_behind(key, event.kind)) value = event.*name;
    if (key != "points") continue;
    value = Json::array();
    for (const PixelPoint& p : event.points) value.push_back({p.x, p.y});
  }
  if (event.fill) root["fill"] = true;
  if (event.object != 0) root["object"] = event.object;
  if (event.color) root["color"] = *event.color;
  return root.dump(-1, ' ', false, Json::error_handler_t::strict);
}

void EventsKnown::add(const LabelEvent& event) {
  const std::string line = label_event_json(event) + "\n";
  checksum = crc32c(std::as_bytes(std::span(line)), checksum);
  ++events;
}

// What label events add up to.

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
