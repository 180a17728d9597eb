#include "labels/clicks/click_log.h"

#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <filesystem>
#include <map>
#include <nlohmann/json.hpp>

#include "core/checksum.h"
#include "core/error.h"
#include "core/files.h"
#include "core/text.h"
#include "labels/strict_json.h"

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
                        "the last line is torn, as a kill leaves an event that was not yet acknowledged; it is dropped",
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

}  // namespace semfield
