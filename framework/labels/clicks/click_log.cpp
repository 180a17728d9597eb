#include "labels/clicks/click_log.h"

#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <filesystem>
#include <map>

#include "system/files.h"

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
  std::error_code ignored;
  // What is no file is refused before a lock is made for it.
  if (std::filesystem::is_directory(path, ignored)) (void)read_text_file(path);
  FolderLock lock = lock_of(path);
  if (std::filesystem::exists(path, ignored)) text = read_text_file(path, kMostLogBytes);
  std::vector<LabelEvent> events = parse_click_log(text, path, diagnostics);
  const int file = open_for_appending(path);
  if (file < 0) throw write_error("open", path, errno);
  ClickLog log(path, std::move(lock), file);
  log.events_ = std::move(events);
  log.size_ = whole_lines(text, path);
  if (log.size_ < text.size()) {
    log.require_own(std::string_view(text).substr(log.size_));
    cut(file, path, log.size_);
    sync_file(file, path);
  }
  sync_folder_of(path);
  return log;
}

ClickLog::ClickLog(ClickLog&& other) noexcept
    : path_(std::move(other.path_)),
      lock_(std::move(other.lock_)),
      file_(other.file_),
      size_(other.size_),
      torn_(std::move(other.torn_)),
      events_(std::move(other.events_)) {
  other.file_ = -1;
}

ClickLog::~ClickLog() {
  if (file_ >= 0) ::close(file_);
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

}  // namespace semfield
