// Event records: protocol buffer messages Event and Summary with the few fields that a scalar needs.
#include "run/rows/tensorboard.h"

#include <fcntl.h>
#include <fmt/format.h>
#include <unistd.h>

#include <bit>
#include <cerrno>
#include <cstring>
#include <span>

#include "core/error.h"
#include "system/checksum.h"
#include "system/files.h"

namespace semfield {

namespace {

void put_varint(std::string& out, std::uint64_t value) {
  while (value >= 0x80) {
    out.push_back(static_cast<char>(value | 0x80));
    value >>= 7;
  }
  out.push_back(static_cast<char>(value));
}

template <class T>
void put_fixed(std::string& out, T value) {
  char bytes[sizeof(T)];
  std::memcpy(bytes, &value, sizeof(T));
  out.append(bytes, sizeof(T));
}

enum Wire : std::uint64_t { varint = 0, fixed64 = 1, sized = 2, fixed32 = 5 };

void put_key(std::string& out, std::uint64_t field, Wire wire) { put_varint(out, field << 3 | wire); }

void put_text(std::string& out, std::uint64_t field, std::string_view text) {
  put_key(out, field, Wire::sized);
  put_varint(out, text.size());
  out += text;
}

// Event { double wall_time = 1; int64 step = 2; string file_version = 3; Summary summary = 5; }
std::string event_head(double now_s) {
  std::string event;
  put_key(event, 1, Wire::fixed64);
  put_fixed(event, now_s);
  return event;
}

}  // namespace

std::uint32_t masked_crc32c(std::string_view bytes) {
  const std::uint32_t crc = crc32c(std::as_bytes(std::span(bytes.data(), bytes.size())));
  return std::rotr(crc, 15) + 0xA282EAD8u;
}

std::string record_frame(std::string_view bytes) {
  std::string frame;
  put_fixed(frame, static_cast<std::uint64_t>(bytes.size()));
  put_fixed(frame, masked_crc32c(frame));
  frame += bytes;
  put_fixed(frame, masked_crc32c(bytes));
  return frame;
}

EventWriter::EventWriter(const std::string& folder, double now_s) {
  char host[256] = "host";
  if (::gethostname(host, sizeof(host) - 1) != 0) std::strcpy(host, "host");
  path_ =
      fmt::format("{}/events.out.tfevents.{:010d}.{}.{}", folder, static_cast<std::int64_t>(now_s), host, ::getpid());
  descriptor_ = ::open(path_.c_str(), O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0644);
  if (descriptor_ < 0) {
    throw Error(ErrorKind::cannot_create, "files.write.failed",
                fmt::format("cannot open '{}' for writing: {}", path_, std::strerror(errno)),
                "make the run folder writable, or choose another with --out");
  }
  std::string event = event_head(now_s);
  put_text(event, 3, "brain.Event:2");
  write(event);
}

EventWriter::~EventWriter() {
  if (descriptor_ >= 0) ::close(descriptor_);
}

void EventWriter::scalar(std::string_view tag, std::int64_t step, double value, double now_s) {
  std::string point;  // Summary.Value { string tag = 1; float simple_value = 2; }
  put_text(point, 1, tag);
  put_key(point, 2, Wire::fixed32);
  put_fixed(point, static_cast<float>(value));
  std::string summary;  // Summary { repeated Value value = 1; }
  put_text(summary, 1, point);
  std::string event = event_head(now_s);
  put_key(event, 2, Wire::varint);
  put_varint(event, static_cast<std::uint64_t>(step));
  put_text(event, 5, summary);
  write(event);
}

void EventWriter::write(const std::string& event) { append_all(descriptor_, path_, record_frame(event)); }

}  // namespace semfield
